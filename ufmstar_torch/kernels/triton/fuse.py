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
        pairs: overlaps and distances if the config needs them; None = W2^2, not weighted by overlap.
    """
    b, k = mixture.weight.shape
    out = GaussianMixture(**{name: torch.empty_like(value.contiguous()) for name, value in mixture.tensors().items()})
    bits, index, position, count = matches
    has_distance = pairs is not None and pairs.distance is not None
    weighted = pairs is not None and config.overlap_weighted
    unused = current.weight
    overlap = pairs.overlap.contiguous() if pairs is not None and weighted else unused
    distance = pairs.distance.contiguous() if pairs is not None and pairs.distance is not None else unused
    channels = mixture.features.shape[2]
    launch(
        _fuse, (triton.cdiv(k, _LANES), b),
        *(v.contiguous() for v in mixture.tensors().values()),
        *(v.contiguous() for v in (current.mean, current.covariance, current.weight, current.features)),
        *motion, bits, index, position, count, overlap, distance, view.contiguous(), *out.tensors().values(),
        k, current.capacity, bits.shape[2], epsilon=8 * torch.finfo(mixture.covariance.dtype).eps,
        baseline=config.view_baseline or 0.0, near=config.near_plane, complete=COMPLETE, least=LEAST,
        weighted=weighted, has_distance=has_distance, channels=channels, padded=power_of_two(channels), word=WORD,
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
    xx, xy, xz, yy, yz, zz = load_symmetric(covariance + 9 * n, 1, inside)
    xx, xy, xz, yy, yz, zz = floored(xx, xy, xz, yy, yz, zz, limit)
    store_symmetric(lifted + 9 * n, xx, xy, xz, yy, yz, zz, inside)


@triton.jit
def _view(view):
    return tl.load(view), tl.load(view + 1), tl.load(view + 2), tl.load(view + 3)


@triton.jit
def _fuse(
    mean, covariance, weight, disagreement, compared, views, reference, features,
    mean_c, covariance_c, weight_c, features_c,
    R, t, bits, index_c, position, listed_c, overlap, distances, view,
    mean_o, covariance_o, weight_o, disagreement_o, compared_o, views_o, reference_o, features_o,
    capacity_k, capacity_c, words,
    epsilon: tl.constexpr, baseline: tl.constexpr, near: tl.constexpr, complete: tl.constexpr, least: tl.constexpr,
    weighted: tl.constexpr, has_distance: tl.constexpr, channels: tl.constexpr, padded: tl.constexpr,
    word: tl.constexpr, lanes: tl.constexpr,
):  # fmt: skip
    b = tl.program_id(1).to(tl.int64)
    stored = mean.dtype.element_ty
    slot = tl.program_id(0) * lanes + tl.arange(0, lanes)
    inside = slot < capacity_k
    k = b * capacity_k + slot
    R, t = R + 9 * b, t + 3 * b
    f = tl.arange(0, padded)
    x = tl.load(mean + 3 * k, mask=inside, other=0.0).to(tl.float64)
    y = tl.load(mean + 3 * k + 1, mask=inside, other=0.0).to(tl.float64)
    z = tl.load(mean + 3 * k + 2, mask=inside, other=0.0).to(tl.float64)
    xx, xy, xz, yy, yz, zz = load_symmetric(covariance + 9 * k, 1, inside)
    # A rotation rounds mirrored entries differently. Components without matches retain both triangles.
    yx = tl.load(covariance + 9 * k + 3, mask=inside, other=0.0).to(tl.float64)
    zx = tl.load(covariance + 9 * k + 6, mask=inside, other=0.0).to(tl.float64)
    zy = tl.load(covariance + 9 * k + 7, mask=inside, other=0.0).to(tl.float64)
    pi = tl.load(weight + k, mask=inside, other=0.0).to(tl.float64)
    m = tl.load(disagreement + k, mask=inside, other=0.0).to(tl.float64)
    compared_k = tl.load(compared + k, mask=inside, other=0.0).to(tl.float64)
    n_k = tl.load(views + k, mask=inside, other=0.0).to(tl.float64)
    vx, vy, vz, v_member = _view(view + 4 * b)
    rx = tl.load(reference + 5 * k, mask=inside, other=0.0).to(tl.float64)
    ry = tl.load(reference + 5 * k + 1, mask=inside, other=0.0).to(tl.float64)
    rz = tl.load(reference + 5 * k + 2, mask=inside, other=0.0).to(tl.float64)
    r_member = tl.load(reference + 5 * k + 3, mask=inside, other=0.0).to(tl.float64)
    change = tl.load(reference + 5 * k + 4, mask=inside, other=0.0).to(tl.float64)
    w = tl.full([lanes], 1.0, tl.float64)
    if baseline > 0:
        squared = (vx - rx) * (vx - rx) + (vy - ry) * (vy - ry) + (vz - rz) * (vz - rz)
        reach = (x - vx) * (x - vx) + (y - vy) * (y - vy) + (z - vz) * (z - vz)
        reach = tl.maximum(reach, exact(near * near, reach)) * exact(baseline * baseline, reach)
        increase = 1 - tl.exp(-squared / reach) - change
        w = tl.where(r_member != v_member, 1.0, tl.where(increase >= exact(least, increase), increase, 0.0))
    any_match = slot < 0
    in_f = inside[:, None] & (f < channels)[None, :]
    h = tl.zeros([lanes, padded], tl.float64)
    if channels > 0:
        h = tl.load(features + k[:, None] * channels + f[None, :], mask=in_f, other=0.0).to(tl.float64)
    row = tl.where(w > 0, tl.load(position + k, mask=inside, other=-1), -1)
    n = tl.load(listed_c + b)
    for part in range(tl.cdiv(n, word)):
        remaining = tl.load(bits + (b * capacity_k + row) * words + part, mask=row >= 0, other=0)
        while tl.max(remaining, 0) > 0:
            use = remaining != 0
            any_match = any_match | use
            bit, rest = lowest_bit(tl.where(use, remaining, 1))
            remaining = tl.where(use, rest, 0)
            c = tl.load(index_c + b * capacity_c + part * word + bit, mask=use, other=0)
            index = b * capacity_c + c
            cx = tl.load(mean_c + 3 * index, mask=use, other=0.0).to(tl.float64)
            cy = tl.load(mean_c + 3 * index + 1, mask=use, other=0.0).to(tl.float64)
            cz = tl.load(mean_c + 3 * index + 2, mask=use, other=0.0).to(tl.float64)
            c0, c1, c2, c3, c4, c5 = load_symmetric(covariance_c + 9 * index, 1, use)
            cx, cy, cz = moved(R, t, cx, cy, cz)
            c0, c1, c2, c3, c4, c5 = turned(R, c0, c1, c2, c3, c4, c5)
            pi_c = tl.load(weight_c + index, mask=use, other=0.0).to(tl.float64)
            if weighted:
                pi_c = pi_c * tl.load(overlap + index * capacity_k + slot, mask=use, other=0.0).to(tl.float64)
            lam = pi_c / tl.where(use, pi + pi_c, 1.0)
            nx, ny, nz, n0, n1, n2, n3, n4, n5, d = geodesic(
                x, y, z, tl.where(use, xx, 1.0), tl.where(use, xy, 0.0), tl.where(use, xz, 0.0),
                tl.where(use, yy, 1.0), tl.where(use, yz, 0.0), tl.where(use, zz, 1.0),
                cx, cy, cz, tl.where(use, c0, 1.0), tl.where(use, c1, 0.0), tl.where(use, c2, 0.0),
                tl.where(use, c3, 1.0), tl.where(use, c4, 0.0), tl.where(use, c5, 1.0), lam,
            )  # fmt: skip
            if has_distance:
                d = tl.load(distances + index * capacity_k + slot, mask=use, other=0.0).to(tl.float64)
            n0, n1, n2, n3, n4, n5 = floored(n0, n1, n2, n3, n4, n5, epsilon * (n0 + n3 + n5))
            # After each match, the values are rounded to the stored precision.
            x = tl.where(use, nx.to(stored).to(tl.float64), x)
            y = tl.where(use, ny.to(stored).to(tl.float64), y)
            z = tl.where(use, nz.to(stored).to(tl.float64), z)
            xx = tl.where(use, n0.to(stored).to(tl.float64), xx)
            xy = tl.where(use, n1.to(stored).to(tl.float64), xy)
            xz = tl.where(use, n2.to(stored).to(tl.float64), xz)
            yy = tl.where(use, n3.to(stored).to(tl.float64), yy)
            yz = tl.where(use, n4.to(stored).to(tl.float64), yz)
            zz = tl.where(use, n5.to(stored).to(tl.float64), zz)
            yx, zx, zy = tl.where(use, xy, yx), tl.where(use, xz, zx), tl.where(use, yz, zy)
            pi = tl.where(use, (pi + pi_c).to(stored).to(tl.float64), pi)
            added = w * pi_c
            total = compared_k + added
            rho = added / tl.where(use, total, 1.0)
            m = tl.where(use, ((1 - rho) * m + rho * d).to(stored).to(tl.float64), m)
            compared_k = tl.where(use, total.to(stored).to(tl.float64), compared_k)
            if channels > 0:
                from_c = features_c + index[:, None] * channels + f[None, :]
                new = tl.load(from_c, mask=in_f & use[:, None], other=0.0).to(tl.float64)
                mixed = ((1 - lam)[:, None] * h + lam[:, None] * new).to(stored).to(tl.float64)
                h = tl.where(use[:, None], mixed, h)
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
    change = tl.where(any_match, change + w, change)
    new = any_match & (change >= exact(complete, change))
    tl.store(reference_o + 5 * k, tl.where(new, vx, rx), mask=inside)
    tl.store(reference_o + 5 * k + 1, tl.where(new, vy, ry), mask=inside)
    tl.store(reference_o + 5 * k + 2, tl.where(new, vz, rz), mask=inside)
    tl.store(reference_o + 5 * k + 3, tl.where(new, v_member, r_member), mask=inside)
    tl.store(reference_o + 5 * k + 4, tl.where(new, 0.0, change), mask=inside)
    if channels > 0:
        tl.store(features_o + k[:, None] * channels + f[None, :], h, mask=in_f)
