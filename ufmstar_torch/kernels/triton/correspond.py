"""Correspondence on a GPU in two launches: candidates are projected and listed, then each is matched.

The second launch has a program per candidate k of the mixture. It compares k with all candidates c of the image, 32 at
a time. Where any match, it tests occlusion: c does not match k if a nearer k' overlaps k by more than eta_occl and also
overlaps c by at least eta. This is the reference's rule in an order in which a program needs no memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.gaussians.gaussian import PIXEL_VARIANCE
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.kernels.triton.launch import launch
from ufmstar_torch.kernels.triton.matrices import exact, load_symmetric, lowest_bit, moved, turned
from ufmstar_torch.steps.correspond import Correspondence

WORD = 32  # candidates c in one word of the matches (:func:`match_bits`)
_CHUNK = 64


@dataclass(frozen=True)
class Candidates:
    """Components of a mixture [B, N] in view, listed in slot order.

    Attributes:
        image: [B, 6, N] float64 u, v [px], the projected covariance xx, xy, yy [px^2], z [m].
        index: [B, N] int32 into the mixture.
        position: [B, N] int32 position of a component in the list, -1 = not in view.
        count: [B] int32.
    """

    image: Tensor
    index: Tensor
    position: Tensor
    count: Tensor

    @classmethod
    def empty(cls, mixture: GaussianMixture) -> Candidates:
        """Allocate the tensors for a mixture."""
        b, n = mixture.weight.shape
        device = mixture.mean.device
        image = torch.empty(b, 6, n, dtype=torch.float64, device=device)
        index, position = torch.empty(2, b, n, dtype=torch.int32, device=device).unbind(0)
        return cls(image, index, position, torch.empty(b, dtype=torch.int32, device=device))

    def tensors(self) -> tuple[Tensor, ...]:
        """The arguments of kernels."""
        return self.image, self.index, self.position, self.count


def correspond(
    previous_cam: GaussianMixture,
    current_cam: GaussianMixture,
    intrinsics: Tensor,
    size: tuple[int, int],
    config: UfMStarConfig,
) -> Correspondence:
    """As :func:`ufmstar_torch.steps.correspond.correspond`."""
    b, device = previous_cam.streams, previous_cam.mean.device
    shape = (b, current_cam.capacity, previous_cam.capacity)
    match = torch.zeros(shape, dtype=torch.bool, device=device)
    overlap = torch.zeros(shape, dtype=torch.float64, device=device)
    still = torch.eye(3, dtype=torch.float64, device=device).repeat(b, 1, 1), match.new_zeros(b, 3, dtype=torch.float64)
    camera = intrinsics.to(torch.float64).contiguous()
    previous, current = candidates(previous_cam, still, current_cam, camera, size, config)
    matched, pairs = match.new_zeros(b, 1), match.new_zeros(b, dtype=torch.int64)
    _launch_match(
        previous, current, config, match, overlap, match.new_zeros(1, dtype=torch.int64), matched, pairs, True
    )
    return Correspondence(match, overlap)


def candidates(
    previous: GaussianMixture,
    motion: tuple[Tensor, Tensor],
    current_cam: GaussianMixture,
    camera: Tensor,
    size: tuple[int, int],
    config: UfMStarConfig,
) -> tuple[Candidates, Candidates]:
    """List the components in view of the mixture and of the image's Gaussians.

    Args:
        previous: M_(i-1), [B, K].
        motion: R [B, 3, 3] and t [B, 3] float64 from the frame of ``previous`` to the camera frame.
        current_cam: C_i in the camera frame, [B, C].
        camera: [B, 3, 3] float64 [px].
        size: H and W [px].
        config: near_plane.
    """
    allocated = Candidates.empty(previous), Candidates.empty(current_cam)
    launch(
        _project, (previous.streams, 2),
        *_geometry(previous), *motion, *_geometry(current_cam), camera,
        *allocated[0].tensors(), *allocated[1].tensors(),
        previous.capacity, current_cam.capacity, *size, near_plane=config.near_plane, widening=PIXEL_VARIANCE,
        chunk=_CHUNK, warps=2,
    )  # fmt: skip
    return allocated


def match_bits(
    previous: Candidates, current: Candidates, config: UfMStarConfig, pairs: Tensor
) -> tuple[Tensor, Tensor]:
    """Match every candidate of the mixture with those of the image.

    Args:
        previous, current: of :func:`candidates`.
        config: eta, eta_occlusion.
        pairs: [B] int64, to which the number of pairs is added.

    Returns:
        Bits [B, K, ceil(C/32)] int64: bit i of word w of the k-th listed candidate stands for the (32 w + i)-th listed
        candidate of the image; only the words of listed candidates are written. [B, C] bool, True for the image's
        Gaussians that matched.
    """
    (b, k), c = previous.index.shape, current.index.shape[1]
    bits = torch.empty(b, k, triton.cdiv(c, WORD), dtype=torch.int64, device=previous.index.device)
    matched = torch.zeros(b, c, dtype=torch.bool, device=bits.device)
    _launch_match(previous, current, config, matched, previous.image, bits, matched, pairs, False)
    return bits, matched


def _launch_match(
    previous: Candidates, current: Candidates, config: UfMStarConfig,
    match: Tensor, overlap: Tensor, bits: Tensor, matched: Tensor, pairs: Tensor, dense: bool,
) -> None:  # fmt: skip
    (b, k), c = previous.index.shape, current.index.shape[1]
    launch(
        _match, (k, b),
        previous.image, previous.index, previous.count, current.image, current.index, current.count,
        match, overlap, bits, matched, pairs, k, c,
        eta=config.eta, eta_occlusion=config.eta_occlusion, dense=dense, chunk=WORD, warps=1,
    )  # fmt: skip


def _geometry(mixture: GaussianMixture) -> tuple[Tensor, Tensor, Tensor]:
    return mixture.mean.contiguous(), mixture.covariance.contiguous(), mixture.weight.contiguous()


@triton.jit
def _project_listed(
    mean, covariance, weight, R, t, camera, image, index, position, count, capacity, height, width, b,
    turn: tl.constexpr, near_plane: tl.constexpr, widening: tl.constexpr, chunk: tl.constexpr,
):  # fmt: skip
    """List the candidates of one stream of one mixture; with ``turn``, it is moved by R and t first."""
    lane = tl.arange(0, chunk)
    fx, cx, fy, cy = tl.load(camera), tl.load(camera + 2), tl.load(camera + 4), tl.load(camera + 5)
    n = 0
    for first in range(0, capacity, chunk):
        k = b * capacity + first + lane
        inside = first + lane < capacity
        inside = inside & (tl.load(weight + k, mask=inside, other=0.0) > 0)
        x = tl.load(mean + 3 * k, mask=inside, other=0.0).to(tl.float64)
        y = tl.load(mean + 3 * k + 1, mask=inside, other=0.0).to(tl.float64)
        z = tl.load(mean + 3 * k + 2, mask=inside, other=0.0).to(tl.float64)
        xx, xy, xz, yy, yz, zz = load_symmetric(covariance + 9 * k, inside)
        if turn:
            x, y, z = moved(R, t, x, y, z)
            xx, xy, xz, yy, yz, zz = turned(R, xx, xy, xz, yy, yz, zz)
        inside = inside & (z > exact(near_plane, z))
        z = tl.where(inside, z, 1.0)
        u, v = fx * x / z + cx, fy * y / z + cy
        in_view = inside & (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)
        p, q, r, s = fx / z, -fx * x / (z * z), fy / z, -fy * y / (z * z)  # J = [[p, 0, q], [0, r, s]]
        rank = n + tl.cumsum(in_view.to(tl.int32), 0) - 1
        tl.store(position + k, tl.where(in_view, rank, -1), mask=first + lane < capacity)
        tl.store(index + b * capacity + rank, (first + lane).to(tl.int32), mask=in_view)
        out = image + 6 * b * capacity + rank
        tl.store(out, u, mask=in_view)
        tl.store(out + capacity, v, mask=in_view)
        tl.store(out + 2 * capacity, p * p * xx + 2 * p * q * xz + q * q * zz + widening, mask=in_view)
        tl.store(out + 3 * capacity, p * r * xy + p * s * xz + q * r * yz + q * s * zz, mask=in_view)
        tl.store(out + 4 * capacity, r * r * yy + 2 * r * s * yz + s * s * zz + widening, mask=in_view)
        tl.store(out + 5 * capacity, z, mask=in_view)
        n += tl.sum(in_view.to(tl.int32), 0)
    tl.store(count + b, n)


@triton.jit
def _project(
    mean_k, covariance_k, weight_k, R, t, mean_c, covariance_c, weight_c, camera,
    image_k, index_k, position_k, count_k, image_c, index_c, position_c, count_c, capacity_k, capacity_c, height, width,
    near_plane: tl.constexpr, widening: tl.constexpr, chunk: tl.constexpr,
):  # fmt: skip
    b = tl.program_id(0).to(tl.int64)
    R, t, camera = R + 9 * b, t + 3 * b, camera + 9 * b
    if tl.program_id(1) == 0:
        _project_listed(
            mean_k, covariance_k, weight_k, R, t, camera, image_k, index_k, position_k, count_k, capacity_k,
            height, width, b, True, near_plane, widening, chunk,
        )  # fmt: skip
    else:
        _project_listed(
            mean_c, covariance_c, weight_c, R, t, camera, image_c, index_c, position_c, count_c, capacity_c,
            height, width, b, False, near_plane, widening, chunk,
        )  # fmt: skip


@triton.jit
def _overlap(u_a, v_a, xx_a, xy_a, yy_a, u_b, v_b, xx_b, xy_b, yy_b):
    """The Bhattacharyya coefficient of image-plane Gaussians (``gaussian.bhattacharyya``)."""
    xx, xy, yy = 0.5 * (xx_a + xx_b), 0.5 * (xy_a + xy_b), 0.5 * (yy_a + yy_b)
    det = xx * yy - xy * xy
    product = (xx_a * yy_a - xy_a * xy_a) * (xx_b * yy_b - xy_b * xy_b)
    dx, dy = u_a - u_b, v_a - v_b
    squared = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / det
    return tl.exp(-squared / 8) * tl.minimum(tl.sqrt(tl.sqrt(product) / det), 1.0)


@triton.jit
def _listed(image, n, rank, mask):
    """Load u, v, xx, xy, yy of listed candidates; outside the mask u = v = 0 and the covariance is I."""
    u = tl.load(image + rank, mask=mask, other=0.0)
    v = tl.load(image + n + rank, mask=mask, other=0.0)
    xx = tl.load(image + 2 * n + rank, mask=mask, other=1.0)
    xy = tl.load(image + 3 * n + rank, mask=mask, other=0.0)
    yy = tl.load(image + 4 * n + rank, mask=mask, other=1.0)
    return u, v, xx, xy, yy


@triton.jit
def _match(
    image_k, index_k, count_k, image_c, index_c, count_c, match, overlap, bits, matched, pairs, capacity_k, capacity_c,
    eta: tl.constexpr, eta_occlusion: tl.constexpr, dense: tl.constexpr, chunk: tl.constexpr,
):  # fmt: skip
    b = tl.program_id(1).to(tl.int64)
    j = tl.program_id(0)
    n_k, n_c = tl.load(count_k + b), tl.load(count_c + b)
    if j < n_k:
        image_k, image_c = image_k + 6 * b * capacity_k, image_c + 6 * b * capacity_c
        k = tl.load(index_k + b * capacity_k + j)
        u, v, xx, xy, yy = _listed(image_k, capacity_k, j, True)
        z = tl.load(image_k + 5 * capacity_k + j)
        lane = tl.arange(0, chunk)
        one = tl.full([chunk], 1, tl.int64)
        total = 0
        for first in range(0, n_c, chunk):
            inside = first + lane < n_c
            u_c, v_c, xx_c, xy_c, yy_c = _listed(image_c, capacity_c, first + lane, inside)
            beta = _overlap(u_c, v_c, xx_c, xy_c, yy_c, u, v, xx, xy, yy)
            member = inside & (beta >= exact(eta, beta))
            if tl.sum(member.to(tl.int32), 0) > 0:
                hidden = lane < 0
                for start in range(0, n_k, chunk):
                    inside_h = start + lane < n_k
                    u_h, v_h, xx_h, xy_h, yy_h = _listed(image_k, capacity_k, start + lane, inside_h)
                    z_h = tl.load(image_k + 5 * capacity_k + start + lane, mask=inside_h, other=0.0)
                    hides = inside_h & (z_h < z)
                    overlap_h = _overlap(u_h, v_h, xx_h, xy_h, yy_h, u, v, xx, xy, yy)
                    hides = hides & (overlap_h > exact(eta_occlusion, overlap_h))
                    remaining = tl.sum(tl.where(hides, one << lane.to(tl.int64), 0), 0)
                    while remaining != 0:
                        bit, remaining = lowest_bit(remaining)
                        u_o, v_o, xx_o, xy_o, yy_o = _listed(image_k, capacity_k, start + bit, True)
                        overlap_o = _overlap(u_c, v_c, xx_c, xy_c, yy_c, u_o, v_o, xx_o, xy_o, yy_o)
                        hidden = hidden | (overlap_o >= exact(eta, overlap_o))
                member = member & ~hidden
            total += tl.sum(member.to(tl.int32), 0)
            c = tl.load(index_c + b * capacity_c + first + lane, mask=inside, other=0)
            if dense:
                pair = (b * capacity_c + c) * capacity_k + k
                tl.store(overlap + pair, beta, mask=inside)
                tl.store(match + pair, member, mask=inside)
            else:
                word = tl.sum(tl.where(member, one << lane.to(tl.int64), 0), 0)
                tl.store(bits + (b * capacity_k + j) * tl.cdiv(capacity_c, chunk) + first // chunk, word)
                tl.store(matched + b * capacity_c + c, member, mask=member)
        tl.atomic_add(pairs + b, total)
