"""Fusion on a GPU: a lane per (stream, component) fuses its matches in order, without rounds and without synchronising.

A program holds 32 components of a stream in registers. While any of them has a match left, each fuses its next match.
A component without matches is copied unchanged.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.nn.functional import pad

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.kernels.triton.correspond import WORD
from ufmstar_torch.kernels.triton.launch import launch, power_of_two
from ufmstar_torch.kernels.triton.matrices import (
    exact,
    floored,
    geodesic,
    load_symmetric,
    lowest_bit,
    moved,
    store_symmetric,
    turned,
)
from ufmstar_torch.steps.correspond import Correspondence
from ufmstar_torch.steps.fuse import COMPLETE, LEAST

_LANES = 32


def fuse(
    mixture: GaussianMixture,
    current: GaussianMixture,
    pairs: Correspondence,
    view: Tensor,
    config: UfMStarConfig,
    *,
    rounds: int | None = None,
) -> GaussianMixture:
    """As :func:`ufmstar_torch.steps.fuse.fuse`; ``rounds`` is ignored."""
    b, c, k = pairs.match.shape
    device = pairs.match.device
    words = triton.cdiv(c, WORD)
    flags = pad(pairs.match, (0, 0, 0, words * WORD - c)).mT.reshape(b, k, words, WORD).to(torch.int64)
    bits = (flags << torch.arange(WORD, device=device)).sum(-1)
    index = torch.arange(c, dtype=torch.int32, device=device).repeat(b, 1)
    position = torch.arange(k, dtype=torch.int32, device=device).repeat(b, 1)
    count = torch.full((b,), c, dtype=torch.int32, device=device)
    still = torch.eye(3, dtype=torch.float64, device=device).repeat(b, 1, 1), index.new_zeros(b, 3, dtype=torch.float64)
    return fuse_bits(mixture, current, still, (bits, index, position, count), view, config, pairs)


def fuse_bits(
    mixture: GaussianMixture,
    current: GaussianMixture,
    motion: tuple[Tensor, Tensor],
    matches: tuple[Tensor, Tensor, Tensor, Tensor],
    view: Tensor,
    config: UfMStarConfig,
    pairs: Correspondence | None = None,
) -> GaussianMixture:
    """Fuse the matches of ``correspond.match_bits`` into a new mixture.

    Args:
        mixture: M_(i-1), [B, K].
        current: C_i, [B, C] float64.
        motion: R [B, 3, 3] and t [B, 3] float64 from the frame of ``current`` to the mixture's frame.
        matches: bits [B, K, words], indices of the listed c's [B, C], row of each k in the bits [B, K], number of
            listed c's [B].
        view: [B, 4] as :func:`ufmstar_torch.steps.fuse.fuse`.
        config: of UfM*.
        pairs: overlaps if the config needs them; None = not weighted by overlap.
    """
    b, k = mixture.weight.shape
    out = GaussianMixture(**{name: torch.empty_like(value.contiguous()) for name, value in mixture.tensors().items()})
    bits, index, position, count = matches
    weighted = pairs is not None and config.overlap_weighted
    unused = current.weight
    overlap = pairs.overlap.contiguous() if pairs is not None and weighted else unused
    channels = mixture.features.shape[2]
    launch(
        _fuse, (triton.cdiv(k, _LANES), b),
        *(v.contiguous() for v in mixture.tensors().values()),
        *(v.contiguous() for v in (current.mean, current.covariance, current.weight, current.features)),
        *motion, bits, index, position, count, overlap, view.contiguous(), *out.tensors().values(),
        k, current.capacity, bits.shape[2], epsilon=8 * torch.finfo(mixture.covariance.dtype).eps,
        baseline=config.view_baseline or 0.0, near=config.near_plane, complete=COMPLETE, least=LEAST,
        weighted=weighted, channels=channels, padded=power_of_two(channels), word=WORD,
        lanes=_LANES, warps=1,
    )  # fmt: skip
    return out


def floor_covariance(covariance: Tensor, floor: Tensor) -> Tensor:
    """As :func:`ufmstar_torch.gaussians.gaussian.floor_covariance` for positive semidefinite float64 tensors."""
    contiguous = covariance.to(torch.float64).contiguous()
    lifted = torch.empty_like(contiguous)
    limits = floor.to(torch.float64).expand(contiguous.shape[:-2]).contiguous()
    launch(_floor, (triton.cdiv(limits.numel(), 128),), contiguous, limits, lifted, limits.numel(), chunk=128)
    return lifted


@triton.jit
def _floor(covariance, floor, lifted, count, chunk: tl.constexpr):
    n = tl.program_id(0) * chunk + tl.arange(0, chunk)
    inside = n < count
    n = n.to(tl.int64)
    limit = tl.load(floor + n, mask=inside, other=0.0)
    xx, xy, xz, yy, yz, zz = load_symmetric(covariance + 9 * n, inside)
    xx, xy, xz, yy, yz, zz = floored(xx, xy, xz, yy, yz, zz, limit)
    store_symmetric(lifted + 9 * n, xx, xy, xz, yy, yz, zz, inside)


@triton.jit
def _number(pointer, mask):
    """A number of every lane, 0 outside the mask."""
    return tl.load(pointer, mask=mask, other=0.0).to(tl.float64)


@triton.jit
def _vector(pointer, mask):
    """Three successive numbers of every lane."""
    return _number(pointer, mask), _number(pointer + 1, mask), _number(pointer + 2, mask)


@triton.jit
def _increase(
    view, reference, k, inside, x, y, z,
    baseline: tl.constexpr, near: tl.constexpr, least: tl.constexpr, lanes: tl.constexpr,
):  # fmt: skip
    """The weight w of a comparison (``steps.fuse.view_weights``)."""
    w = tl.full([lanes], 1.0, tl.float64)
    if baseline > 0:
        vx, vy, vz = tl.load(view), tl.load(view + 1), tl.load(view + 2)
        rx, ry, rz = _vector(reference + 5 * k, inside)
        squared = (vx - rx) * (vx - rx) + (vy - ry) * (vy - ry) + (vz - rz) * (vz - rz)
        reach = (x - vx) * (x - vx) + (y - vy) * (y - vy) + (z - vz) * (z - vz)
        reach = tl.maximum(reach, exact(near * near, reach)) * exact(baseline * baseline, reach)
        increase = 1 - tl.exp(-squared / reach) - _number(reference + 5 * k + 4, inside)
        other = _number(reference + 5 * k + 3, inside) != tl.load(view + 3)
        w = tl.where(other, 1.0, tl.where(increase >= exact(least, increase), increase, 0.0))
    return w


@triton.jit
def _write_reference(view, reference, reference_o, k, inside, any_match, w, complete: tl.constexpr):
    """Add the change of the view to the matched components, whose reference it becomes where the change is complete."""
    change = _number(reference + 5 * k + 4, inside)
    change = tl.where(any_match, change + w, change)
    new = any_match & (change >= exact(complete, change))
    for i in tl.static_range(4):
        entry = tl.where(new, tl.load(view + i), _number(reference + 5 * k + i, inside))
        tl.store(reference_o + 5 * k + i, entry, mask=inside)
    tl.store(reference_o + 5 * k + 4, tl.where(new, 0.0, change), mask=inside)


@triton.jit
def _or_unit(use, xx, xy, xz, yy, yz, zz):
    """Symmetric matrices, the identity outside the mask."""
    return (
        tl.where(use, xx, 1.0), tl.where(use, xy, 0.0), tl.where(use, xz, 0.0),
        tl.where(use, yy, 1.0), tl.where(use, yz, 0.0), tl.where(use, zz, 1.0),
    )  # fmt: skip


@triton.jit
def _updated(use, new, old, pointer):
    """``new`` where the mask is True, rounded to the precision in which it is stored, else ``old``."""
    return tl.where(use, new.to(pointer.dtype.element_ty).to(tl.float64), old)


@triton.jit
def _next_match(remaining, index_c, first, use):
    """The next match of every lane in the bits ``remaining``, and the bits without it."""
    bit, rest = lowest_bit(tl.where(use, remaining, 1))
    return tl.load(index_c + first + bit, mask=use, other=0), tl.where(use, rest, 0)


@triton.jit
def _fuse(
    mean, covariance, weight, disagreement, compared, views, reference, features,
    mean_c, covariance_c, weight_c, features_c,
    R, t, bits, index_c, position, listed_c, overlap, view,
    mean_o, covariance_o, weight_o, disagreement_o, compared_o, views_o, reference_o, features_o,
    capacity_k, capacity_c, words,
    epsilon: tl.constexpr, baseline: tl.constexpr, near: tl.constexpr, complete: tl.constexpr, least: tl.constexpr,
    weighted: tl.constexpr, channels: tl.constexpr, padded: tl.constexpr,
    word: tl.constexpr, lanes: tl.constexpr,
):  # fmt: skip
    b = tl.program_id(1).to(tl.int64)
    slot = tl.program_id(0) * lanes + tl.arange(0, lanes)
    inside = slot < capacity_k
    k = b * capacity_k + slot
    R, t, view = R + 9 * b, t + 3 * b, view + 4 * b
    x, y, z = _vector(mean + 3 * k, inside)
    xx, xy, xz, yy, yz, zz = load_symmetric(covariance + 9 * k, inside)
    # A rotation rounds mirrored entries differently. Components without matches retain both triangles.
    yx, zx = _number(covariance + 9 * k + 3, inside), _number(covariance + 9 * k + 6, inside)
    zy = _number(covariance + 9 * k + 7, inside)
    pi, m = _number(weight + k, inside), _number(disagreement + k, inside)
    compared_k, n_k = _number(compared + k, inside), _number(views + k, inside)
    w = _increase(view, reference, k, inside, x, y, z, baseline, near, least, lanes)
    any_match = slot < 0
    f = tl.arange(0, padded)
    in_f = inside[:, None] & (f < channels)[None, :]
    h = tl.zeros([lanes, padded], tl.float64)
    if channels > 0:
        h = _number(features + k[:, None] * channels + f[None, :], in_f)
    row = tl.where(w > 0, tl.load(position + k, mask=inside, other=-1), -1)
    n = tl.load(listed_c + b)
    for part in range(tl.cdiv(n, word)):
        remaining = tl.load(bits + (b * capacity_k + row) * words + part, mask=row >= 0, other=0)
        while tl.max(remaining, 0) > 0:
            use = remaining != 0
            any_match = any_match | use
            c, remaining = _next_match(remaining, index_c, b * capacity_c + part * word, use)
            index = b * capacity_c + c
            cx, cy, cz = _vector(mean_c + 3 * index, use)
            c0, c1, c2, c3, c4, c5 = load_symmetric(covariance_c + 9 * index, use)
            cx, cy, cz = moved(R, t, cx, cy, cz)
            c0, c1, c2, c3, c4, c5 = turned(R, c0, c1, c2, c3, c4, c5)
            pi_c = _number(weight_c + index, use)
            if weighted:
                pi_c = pi_c * _number(overlap + index * capacity_k + slot, use)
            lam = pi_c / tl.where(use, pi + pi_c, 1.0)
            a0, a1, a2, a3, a4, a5 = _or_unit(use, xx, xy, xz, yy, yz, zz)
            c0, c1, c2, c3, c4, c5 = _or_unit(use, c0, c1, c2, c3, c4, c5)
            nx, ny, nz, n0, n1, n2, n3, n4, n5, d = geodesic(
                x, y, z, a0, a1, a2, a3, a4, a5, cx, cy, cz, c0, c1, c2, c3, c4, c5, lam
            )
            n0, n1, n2, n3, n4, n5 = floored(n0, n1, n2, n3, n4, n5, epsilon * (n0 + n3 + n5))
            # After each match, the values are rounded to the stored precision.
            x, y, z = _updated(use, nx, x, mean), _updated(use, ny, y, mean), _updated(use, nz, z, mean)
            xx, xy, xz = _updated(use, n0, xx, mean), _updated(use, n1, xy, mean), _updated(use, n2, xz, mean)
            yy, yz, zz = _updated(use, n3, yy, mean), _updated(use, n4, yz, mean), _updated(use, n5, zz, mean)
            yx, zx, zy = tl.where(use, xy, yx), tl.where(use, xz, zx), tl.where(use, yz, zy)
            pi = _updated(use, pi + pi_c, pi, mean)
            added = w * pi_c
            total = compared_k + added
            rho = added / tl.where(use, total, 1.0)
            m = _updated(use, (1 - rho) * m + rho * d, m, mean)
            compared_k = _updated(use, total, compared_k, mean)
            if channels > 0:
                new = _number(features_c + index[:, None] * channels + f[None, :], in_f & use[:, None])
                h = _updated(use[:, None], (1 - lam)[:, None] * h + lam[:, None] * new, h, mean)
    tl.store(mean_o + 3 * k, x, mask=inside)
    tl.store(mean_o + 3 * k + 1, y, mask=inside)
    tl.store(mean_o + 3 * k + 2, z, mask=inside)
    store_symmetric(covariance_o + 9 * k, xx, xy, xz, yy, yz, zz, inside)
    tl.store(covariance_o + 9 * k + 3, yx, mask=inside)
    tl.store(covariance_o + 9 * k + 6, zx, mask=inside)
    tl.store(covariance_o + 9 * k + 7, zy, mask=inside)
    tl.store(weight_o + k, pi, mask=inside)
    tl.store(disagreement_o + k, m, mask=inside)
    tl.store(compared_o + k, compared_k, mask=inside)
    tl.store(views_o + k, tl.where(any_match, n_k + w, n_k), mask=inside)
    _write_reference(view, reference, reference_o, k, inside, any_match, w, complete)
    if channels > 0:
        tl.store(features_o + k[:, None] * channels + f[None, :], h, mask=in_f)
