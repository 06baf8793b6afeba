"""First level of the culling: a program per stream lists the components that can contribute to an image.

It compares the image with the silhouette of the ellipsoid outside of which a component's density is below a threshold.
"""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.kernels.triton.launch import launch
from ufmstar_torch.kernels.triton.matrices import load_symmetric, moved, turned

# As on the CPU: share of the denominator that culling may omit, and share of the prior in the threshold.
EPSILON = {torch.float32: 1e-7, torch.float64: 1e-14}
PRIOR = 1e-3
# Numbers of a listed component: without and with the extent of the neighbourhood.
FIELDS = {False: 7, True: 10}
_LOG2_E = tl.constexpr(math.log2(math.e))
_HALF_LOG_TWO_PI_CUBED = tl.constexpr(1.5 * math.log(2 * math.pi))
_SLOTS = 128  # slots of the mixture processed together


def prepare(
    mixture: GaussianMixture,
    camera: Tensor,
    size: tuple[int, int],
    dtype: torch.dtype,
    config: UfMStarConfig,
    motion: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """List the components that can contribute to the image, in slot order.

    With ``config.regression == "neighbourhood"`` all components are listed: one whose density is negligible at a point
    still decides the radius of its neighbourhood.

    Args:
        mixture: [B, K].
        camera: [B, 3, 3] float64 [px].
        size: H and W [px].
        dtype: of the regression.
        config: of UfM*.
        motion: R [B, 3, 3] and t [B, 3] float64 from the mixture's frame to the camera's; None = identity.

    Returns:
        Means [B, 3, K] float64 [m]; whitening and log2 of the peak [B, 7, K] in ``dtype``, with the neighbourhood also
        half the sides of the boxes [m], [B, 10, K]; index [B, K] int32 into the mixture; their number [B] int32.
    """
    b, capacity, device = mixture.streams, mixture.capacity, mixture.mean.device
    if motion is None:
        eye = torch.eye(3, dtype=torch.float64, device=device).repeat(b, 1, 1)
        motion = eye, torch.zeros(b, 3, dtype=torch.float64, device=device)
    means = torch.empty(b, 3, capacity, dtype=torch.float64, device=device)
    near = config.regression == "neighbourhood"
    fields = torch.empty(b, FIELDS[near], capacity, dtype=dtype, device=device)
    index = torch.empty(b, capacity, dtype=torch.int32, device=device)
    count = torch.empty(b, dtype=torch.int32, device=device)
    launch(
        _prepare, (b,),
        mixture.mean.contiguous(), mixture.covariance.contiguous(), mixture.weight.contiguous(), *motion, camera,
        means, fields, index, count, capacity, *size,
        share=math.log2(EPSILON[dtype] / 3) - 0.01 + math.log2(PRIOR * config.prior_weight), chunk=_SLOTS,
        near=near, stride=FIELDS[near], sigmas=config.neighbourhood_sigmas,
    )  # fmt: skip
    return means, fields, index, count


@triton.jit
def whitened(xx, xy, xz, yy, yz, zz):
    """Inverse Cholesky factor (rows, 6 numbers) and the factor's determinant (``regress_cull.whiten``)."""
    least = 1e-14 * tl.maximum(xx, tl.maximum(yy, zz))
    l00 = tl.sqrt(tl.maximum(xx, least))
    l10, l20 = xy / l00, xz / l00
    l11 = tl.sqrt(tl.maximum(yy - l10 * l10, least))
    l21 = (yz - l20 * l10) / l11
    l22 = tl.sqrt(tl.maximum(zz - l20 * l20 - l21 * l21, least))
    i00, i11, i22 = 1.0 / l00, 1.0 / l11, 1.0 / l22
    i10, i21 = -l10 / (l00 * l11), -l21 / (l11 * l22)
    return i00, i10, i11, -(l20 * i00 + l21 * i10) / l22, i21, i22, l00 * l11 * l22


@triton.jit
def _outside(m, z, smm, smz, square, a, focal, centre, size):
    """True if the silhouette of the ellipsoid (x - mu)^T S^-1 (x - mu) = square lies outside the image along one axis.

    The silhouette lies between the tangent planes x = s z, (mu_x - s mu_z)^2 = square (S_xx - 2 s S_xz + s^2 S_zz).
    """
    half_b = m * z - square * smz
    root = tl.sqrt(tl.maximum(half_b * half_b - a * (m * m - square * smm), 0.0))
    root += 1e-9 * (tl.abs(half_b) + root)
    p, q = (half_b - root) / a * focal + centre, (half_b + root) / a * focal + centre
    return (tl.maximum(p, q) < -1) | (tl.minimum(p, q) > size)


@triton.jit
def _prepare(
    mean, covariance, weight, R, t, camera, means, fields, index, count, capacity, height, width,
    share: tl.constexpr, chunk: tl.constexpr, near: tl.constexpr, stride: tl.constexpr, sigmas: tl.constexpr,
):  # fmt: skip
    b = tl.program_id(0).to(tl.int64)
    lane = tl.arange(0, chunk)
    R, t, camera = R + 9 * b, t + 3 * b, camera + 9 * b
    occupied = 0
    for first in range(0, capacity, chunk):
        k = first + lane
        occupied += tl.sum((tl.load(weight + b * capacity + k, mask=k < capacity, other=0.0) > 0).to(tl.int32), 0)
    limit = share - tl.log2(tl.maximum(occupied, 1).to(tl.float64))
    n = 0
    for first in range(0, capacity, chunk):
        k = b * capacity + first + lane
        inside = first + lane < capacity
        w = tl.load(weight + k, mask=inside, other=0.0).to(tl.float64)
        inside = inside & (w > 0)
        x = tl.load(mean + 3 * k, mask=inside, other=0.0).to(tl.float64)
        y = tl.load(mean + 3 * k + 1, mask=inside, other=0.0).to(tl.float64)
        z = tl.load(mean + 3 * k + 2, mask=inside, other=0.0).to(tl.float64)
        x, y, z = moved(R, t, x, y, z)
        xx, xy, xz, yy, yz, zz = load_symmetric(covariance + 9 * k, inside)
        xx, yy, zz = tl.where(inside, xx, 1.0), tl.where(inside, yy, 1.0), tl.where(inside, zz, 1.0)
        xx, xy, xz, yy, yz, zz = turned(R, xx, xy, xz, yy, yz, zz)
        i00, i10, i11, i20, i21, i22, det = whitened(xx, xy, xz, yy, yz, zz)
        peak = tl.log(tl.where(inside, w, 1.0) / det) - _HALF_LOG_TWO_PI_CUBED

        square = 2 * (peak - limit / _LOG2_E) * (1 + 1e-6)
        least = 1e-14 * tl.maximum(xx, tl.maximum(yy, zz))
        szz = square * (zz + least)
        a = z * z - szz
        behind = (square <= 0) | ((z < 0) & (a > 1e-6 * szz))
        anywhere = a <= 1e-6 * szz
        a = tl.where(behind | anywhere, 1.0, a)
        outside = _outside(x, z, xx + least, xz, square, a, tl.load(camera), tl.load(camera + 2), width)
        outside = outside | _outside(y, z, yy + least, yz, square, a, tl.load(camera + 4), tl.load(camera + 5), height)
        seen = inside if near else inside & (anywhere | ~outside) & ~behind

        rank = n + tl.cumsum(seen.to(tl.int32), 0) - 1
        tl.store(index + b * capacity + rank, (first + lane).to(tl.int32), mask=seen)
        out = means + 3 * b * capacity + rank
        tl.store(out, x, mask=seen)
        tl.store(out + capacity, y, mask=seen)
        tl.store(out + 2 * capacity, z, mask=seen)
        out = fields + stride * b * capacity + rank
        scale = tl.sqrt(w * 0.0 + 0.5 * _LOG2_E)
        tl.store(out, i00 * scale, mask=seen)
        tl.store(out + capacity, i10 * scale, mask=seen)
        tl.store(out + 2 * capacity, i11 * scale, mask=seen)
        tl.store(out + 3 * capacity, i20 * scale, mask=seen)
        tl.store(out + 4 * capacity, i21 * scale, mask=seen)
        tl.store(out + 5 * capacity, i22 * scale, mask=seen)
        tl.store(out + 6 * capacity, peak * _LOG2_E, mask=seen)
        if near:
            tl.store(out + 7 * capacity, sigmas * tl.sqrt(xx), mask=seen)
            tl.store(out + 8 * capacity, sigmas * tl.sqrt(yy), mask=seen)
            tl.store(out + 9 * capacity, sigmas * tl.sqrt(zz), mask=seen)
        n += tl.sum(seen.to(tl.int32), 0)
    tl.store(count + b, n)
