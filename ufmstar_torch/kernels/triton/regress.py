"""Gaussian mixture regression on a GPU: the exact sum with culling in two levels.

The bound is that of ``kernels.regress_tiles_cpu``: a component is left out where its density is at most
(eps / 3n) max(max_j l_j, pi_0 / 1000), l_j a lower bound of the densities there. Here the levels are the image (a
program per stream lists the components whose silhouette meets it) and a tile of 16 x 16 pixels (a program). Of chosen
pixels, 256 in their order take the place of a tile.
"""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.kernels.triton.launch import launch, power_of_two
from ufmstar_torch.kernels.triton.matrices import load_symmetric, lowest_bit, moved, turned
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.regress import Regression
from ufmstar_torch.regress import regress_image as reference

# As the CPU's: share of the denominator that culling may leave out, and that of the prior in a threshold.
EPSILON = {torch.float32: 1e-7, torch.float64: 1e-14}
_PRIOR = 1e-3
_LOG2_E = tl.constexpr(math.log2(math.e))
_HALF_LOG_TWO_PI_CUBED = tl.constexpr(1.5 * math.log(2 * math.pi))
_SIDE = 16  # pixels of a tile
_CHUNK = 32  # components bounded at a time: the bits of a mask
_SLOTS = 128  # slots of the mixture prepared at a time


def regress_image(
    mixture_cam: GaussianMixture,
    depth: Tensor,
    intrinsics: Tensor,
    valid: Tensor,
    config: UfMStarConfig,
    pixels: Tensor | None = None,
) -> Regression:
    """As :func:`ufmstar_torch.regress.regress_image`; ``config.regression == "neighbourhood"`` runs there."""
    if config.regression != "exact":
        return reference(mixture_cam, depth, intrinsics, valid, config, pixels)
    b, height, width = depth.shape
    maps = depth.new_empty(depth.shape if pixels is None else pixels.shape)
    features = depth.new_empty(*maps.shape, mixture_cam.features.shape[2])
    camera = intrinsics.to(torch.float64).contiguous()
    listed = prepare(mixture_cam, camera, (height, width), depth.dtype, config)
    tiles = triton.cdiv(height, _SIDE) * triton.cdiv(width, _SIDE)
    chosen = 0 if pixels is None else pixels.shape[1]
    channels = mixture_cam.features.shape[2]
    launch(
        _regress, (tiles if pixels is None else triton.cdiv(chosen, _SIDE * _SIDE), b),
        depth.contiguous(), valid.contiguous(), camera, depth if pixels is None else pixels.contiguous(), *listed,
        mixture_cam.disagreement.contiguous(), mixture_cam.features.contiguous(), maps, features,
        height, width, chosen, mixture_cam.capacity, fused=True,
        prior=config.prior_weight, prior_total=config.prior_weight * config.prior_mean,
        least=math.log2(_PRIOR * config.prior_weight), share=math.log2(EPSILON[depth.dtype] / 3) - 0.01,
        slack=16 * torch.finfo(depth.dtype).eps, channels=channels, padded=power_of_two(channels), side=_SIDE,
        chunk=_CHUNK, subset=pixels is not None,
    )  # fmt: skip
    return Regression(maps, features)


def smooth(previous: Tensor, current: Tensor, alpha: float) -> tuple[Tensor, Tensor]:
    """As :func:`ufmstar_torch.regress.smooth`, in one launch."""
    before, now = previous.contiguous(), current.contiguous()
    memory, shown = torch.empty_like(before), torch.empty_like(now)
    launch(_smooth, (triton.cdiv(now.numel(), 1024),), before, now, memory, shown, now.numel(), alpha=alpha, chunk=1024)
    return memory, shown


def prepare(
    mixture: GaussianMixture,
    camera: Tensor,
    size: tuple[int, int],
    dtype: torch.dtype,
    config: UfMStarConfig,
    motion: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The components that can matter in the image, listed in their order.

    Args:
        mixture: [B, K].
        camera: [B, 3, 3] float64 [px].
        size: H and W [px].
        dtype: of the regression.
        config: of UfM*.
        motion: R [B, 3, 3] and t [B, 3] float64 from the mixture's frame into the camera's; None = it is there.

    Returns:
        Means [B, 3, K] float64 [m]; whitening and log2 of the peak [B, 7, K] in ``dtype``; index [B, K] int32 into the
        mixture; their number [B] int32.
    """
    b, capacity, device = mixture.streams, mixture.capacity, mixture.mean.device
    if motion is None:
        eye = torch.eye(3, dtype=torch.float64, device=device).repeat(b, 1, 1)
        motion = eye, torch.zeros(b, 3, dtype=torch.float64, device=device)
    means = torch.empty(b, 3, capacity, dtype=torch.float64, device=device)
    fields = torch.empty(b, 7, capacity, dtype=dtype, device=device)
    index = torch.empty(b, capacity, dtype=torch.int32, device=device)
    count = torch.empty(b, dtype=torch.int32, device=device)
    launch(
        _prepare, (b,),
        mixture.mean.contiguous(), mixture.covariance.contiguous(), mixture.weight.contiguous(), *motion, camera,
        means, fields, index, count, capacity, *size,
        share=math.log2(EPSILON[dtype] / 3) - 0.01 + math.log2(_PRIOR * config.prior_weight), chunk=_SLOTS,
    )  # fmt: skip
    return means, fields, index, count


@triton.jit
def mixed(before, now, alpha: tl.constexpr):
    """The new memory of the moving average; NaN is no value."""
    both = (1 - alpha) * before + alpha * now
    return tl.where(now != now, before, tl.where(before != before, now, both))


@triton.jit
def _smooth(previous, current, memory, shown, count, alpha: tl.constexpr, chunk: tl.constexpr):
    i = tl.program_id(0) * chunk + tl.arange(0, chunk)
    now = tl.load(current + i, mask=i < count, other=0.0).to(memory.dtype.element_ty)
    kept = mixed(tl.load(previous + i, mask=i < count, other=0.0), now, alpha)
    tl.store(memory + i, kept, mask=i < count)
    tl.store(shown + i, tl.where(now != now, now, kept).to(shown.dtype.element_ty), mask=i < count)


@triton.jit
def whitened(xx, xy, xz, yy, yz, zz):
    """Inverse Cholesky factor (rows, 6 numbers) and its determinant's inverse, as ``regress_points_cpu.prepare``."""
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
    """Whether the ellipsoid's silhouette lies beside the image along one axis; see ``regress_tiles_cpu._meets``."""
    half_b = m * z - square * smz
    root = tl.sqrt(tl.maximum(half_b * half_b - a * (m * m - square * smm), 0.0))
    root += 1e-9 * (tl.abs(half_b) + root)
    p, q = (half_b - root) / a * focal + centre, (half_b + root) / a * focal + centre
    return (tl.maximum(p, q) < -1) | (tl.minimum(p, q) > size)


@triton.jit
def _prepare(
    mean, covariance, weight, R, t, camera, means, fields, index, count, capacity, height, width,
    share: tl.constexpr, chunk: tl.constexpr,
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
        there = first + lane < capacity
        w = tl.load(weight + k, mask=there, other=0.0).to(tl.float64)
        there = there & (w > 0)
        x = tl.load(mean + 3 * k, mask=there, other=0.0).to(tl.float64)
        y = tl.load(mean + 3 * k + 1, mask=there, other=0.0).to(tl.float64)
        z = tl.load(mean + 3 * k + 2, mask=there, other=0.0).to(tl.float64)
        x, y, z = moved(R, t, x, y, z)
        xx, xy, xz, yy, yz, zz = load_symmetric(covariance + 9 * k, 1, there)
        xx, yy, zz = tl.where(there, xx, 1.0), tl.where(there, yy, 1.0), tl.where(there, zz, 1.0)
        xx, xy, xz, yy, yz, zz = turned(R, xx, xy, xz, yy, yz, zz)
        i00, i10, i11, i20, i21, i22, det = whitened(xx, xy, xz, yy, yz, zz)
        peak = tl.log(tl.where(there, w, 1.0) / det) - _HALF_LOG_TWO_PI_CUBED

        square = 2 * (peak - limit / _LOG2_E) * (1 + 1e-6)
        least = 1e-14 * tl.maximum(xx, tl.maximum(yy, zz))
        szz = square * (zz + least)
        a = z * z - szz
        behind = (square <= 0) | ((z < 0) & (a > 1e-6 * szz))
        anywhere = a <= 1e-6 * szz
        a = tl.where(behind | anywhere, 1.0, a)
        beside = _outside(x, z, xx + least, xz, square, a, tl.load(camera), tl.load(camera + 2), width)
        beside = beside | _outside(y, z, yy + least, yz, square, a, tl.load(camera + 4), tl.load(camera + 5), height)
        seen = there & (anywhere | ~beside) & ~behind

        at = n + tl.cumsum(seen.to(tl.int32), 0) - 1
        tl.store(index + b * capacity + at, (first + lane).to(tl.int32), mask=seen)
        out = means + 3 * b * capacity + at
        tl.store(out, x, mask=seen)
        tl.store(out + capacity, y, mask=seen)
        tl.store(out + 2 * capacity, z, mask=seen)
        out = fields + 7 * b * capacity + at
        scale = tl.sqrt(w * 0.0 + 0.5 * _LOG2_E)
        tl.store(out, i00 * scale, mask=seen)
        tl.store(out + capacity, i10 * scale, mask=seen)
        tl.store(out + 2 * capacity, i11 * scale, mask=seen)
        tl.store(out + 3 * capacity, i20 * scale, mask=seen)
        tl.store(out + 4 * capacity, i21 * scale, mask=seen)
        tl.store(out + 5 * capacity, i22 * scale, mask=seen)
        tl.store(out + 6 * capacity, peak * _LOG2_E, mask=seen)
        n += tl.sum(seen.to(tl.int32), 0)
    tl.store(count + b, n)


@triton.jit
def _bounds(means, fields, capacity, j, there, cx, cy, cz, hx, hy, hz, slack: tl.constexpr):
    """log2 of bounds of the densities of components j in the box centre +- half; nothing for those not ``there``."""
    real = fields.dtype.element_ty
    mx = tl.load(means + j, mask=there, other=0.0).to(real)
    my = tl.load(means + capacity + j, mask=there, other=0.0).to(real)
    mz = tl.load(means + 2 * capacity + j, mask=there, other=0.0).to(real)
    a = tl.load(fields + j, mask=there, other=0.0)
    b = tl.load(fields + capacity + j, mask=there, other=0.0)
    c = tl.load(fields + 2 * capacity + j, mask=there, other=0.0)
    d = tl.load(fields + 3 * capacity + j, mask=there, other=0.0)
    e = tl.load(fields + 4 * capacity + j, mask=there, other=0.0)
    f = tl.load(fields + 5 * capacity + j, mask=there, other=0.0)
    peak = tl.load(fields + 6 * capacity + j, mask=there, other=-1e30)
    dx, dy, dz = cx - mx, cy - my, cz - mz
    wx, wy, wz = hx + slack * tl.abs(mx), hy + slack * tl.abs(my), hz + slack * tl.abs(mz)
    y0, r0 = tl.abs(a * dx), a * wx
    y1, r1 = tl.abs(b * dx + c * dy), tl.abs(b) * wx + c * wy
    y2, r2 = tl.abs(d * dx + e * dy + f * dz), tl.abs(d) * wx + tl.abs(e) * wy + f * wz
    p0, p1, p2 = y0 + r0, y1 + r1, y2 + r2
    lower = peak - (p0 * p0 + p1 * p1 + p2 * p2)
    lower = tl.where(lower > -1e30, lower, -1e30)  # infinity and NaN, from a far outlier, bound nothing
    q0, q1, q2 = y0 - r0, y1 - r1, y2 - r2
    q0, q1, q2 = tl.where(q0 > 0, q0, 0.0), tl.where(q1 > 0, q1, 0.0), tl.where(q2 > 0, q2, 0.0)
    return lower, peak - (q0 * q0 + q1 * q1 + q2 * q2)


@triton.jit
def _regress(
    depth, valid, camera, pixels, means, fields, index, count, m, features, out, out_f,
    height, width, chosen, capacity,
    prior: tl.constexpr, prior_total: tl.constexpr, least: tl.constexpr, share: tl.constexpr, slack: tl.constexpr,
    channels: tl.constexpr, padded: tl.constexpr, side: tl.constexpr, chunk: tl.constexpr, subset: tl.constexpr,
):  # fmt: skip
    real = depth.dtype.element_ty
    b = tl.program_id(1).to(tl.int64)
    lane = tl.arange(0, side * side)
    camera, index = camera + 9 * b, index + b * capacity
    means, fields = means + 3 * b * capacity, fields + 7 * b * capacity
    if subset:
        place = tl.program_id(0) * (side * side) + lane
        inside = place < chosen
        target = b * chosen + place
        source = tl.load(pixels + target, mask=inside, other=0).to(tl.int64)
        v, u = source // width, source % width
        source += b * height * width
    else:
        tile = tl.program_id(0)
        across = tl.cdiv(width, side)
        v, u = tile // across * side + lane // side, tile % across * side + lane % side
        inside = (v < height) & (u < width)
        source = (b * height + v) * width + u
        target = source
    ok = inside & (tl.load(valid + source, mask=inside, other=0) != 0)
    z = tl.load(depth + source, mask=ok, other=0.0).to(tl.float64)
    x = (u - tl.load(camera + 2)) / tl.load(camera) * z
    y = (v - tl.load(camera + 5)) / tl.load(camera + 4) * z
    some = tl.sum(ok.to(tl.int32), 0) > 0
    n = tl.where(some, tl.load(count + b), 0)

    # The box of the points, and the nearest of them as their origin.
    inf = float("inf")
    x_low, x_high = tl.min(tl.where(ok, x, inf), 0), tl.max(tl.where(ok, x, -inf), 0)
    y_low, y_high = tl.min(tl.where(ok, y, inf), 0), tl.max(tl.where(ok, y, -inf), 0)
    z_low, z_high = tl.min(tl.where(ok, z, inf), 0), tl.max(tl.where(ok, z, -inf), 0)
    x_low, x_high = tl.where(some, x_low, 0.0), tl.where(some, x_high, 0.0)
    y_low, y_high = tl.where(some, y_low, 0.0), tl.where(some, y_high, 0.0)
    z_low, z_high = tl.where(some, z_low, 0.0), tl.where(some, z_high, 0.0)
    cx, cy, cz = 0.5 * (x_low + x_high), 0.5 * (y_low + y_high), 0.5 * (z_low + z_high)
    hx, hy, hz = 0.5 * (x_high - x_low), 0.5 * (y_high - y_low), 0.5 * (z_high - z_low)
    hx, hy, hz = hx + slack * (hx + tl.abs(cx)), hy + slack * (hy + tl.abs(cy)), hz + slack * (hz + tl.abs(cz))
    cx, cy, cz, hx, hy, hz = cx.to(real), cy.to(real), cz.to(real), hx.to(real), hy.to(real), hz.to(real)
    nearest = tl.min(tl.where(ok & (z == z_low), lane, side * side), 0)
    x_0, y_0 = tl.sum(tl.where(lane == nearest, x, 0.0), 0), tl.sum(tl.where(lane == nearest, y, 0.0), 0)
    x, y, z = (x - x_0).to(real), (y - y_0).to(real), (z - z_low).to(real)

    part = tl.arange(0, chunk)
    greatest = tl.full([chunk], least, real)
    for first in range(0, n, chunk):
        lower, _ = _bounds(means, fields, capacity, first + part, first + part < n, cx, cy, cz, hx, hy, hz, slack)
        greatest = tl.maximum(greatest, lower)
    threshold = tl.max(greatest, 0) + share - tl.log2(tl.maximum(n, 1).to(real))

    evidence = tl.full([side * side], prior, real)
    total = tl.full([side * side], prior_total, real)
    f = tl.arange(0, padded)
    sums = tl.zeros([side * side, padded], real)
    for first in range(0, n, chunk):
        there = first + part < n
        _, upper = _bounds(means, fields, capacity, first + part, there, cx, cy, cz, hx, hy, hz, slack)
        bits = tl.where(there & (upper > threshold), tl.full([chunk], 1, tl.int64) << part.to(tl.int64), 0)
        left = tl.sum(bits, 0)
        while left != 0:
            bit, left = lowest_bit(left)
            j = first + bit
            dx = x - (tl.load(means + j) - x_0).to(real)
            dy = y - (tl.load(means + capacity + j) - y_0).to(real)
            dz = z - (tl.load(means + 2 * capacity + j) - z_low).to(real)
            y0 = tl.load(fields + j) * dx
            y1 = tl.load(fields + capacity + j) * dx + tl.load(fields + 2 * capacity + j) * dy
            y2 = tl.load(fields + 3 * capacity + j) * dx + tl.load(fields + 4 * capacity + j) * dy
            y2 += tl.load(fields + 5 * capacity + j) * dz
            w = tl.exp2(tl.load(fields + 6 * capacity + j) - (y0 * y0 + y1 * y1 + y2 * y2))
            k = b * capacity + tl.load(index + j)
            evidence += w
            total += w * tl.load(m + k).to(real)
            if channels > 0:
                value = tl.load(features + k * channels + f, mask=f < channels, other=0.0).to(real)
                sums += w[:, None] * value[None, :]
    nan = float("nan")
    tl.store(out + target, tl.where(ok, total / evidence, nan), mask=inside)
    if channels > 0:
        values = tl.where(ok[:, None], sums / evidence[:, None], nan)
        tl.store(
            out_f + target[:, None] * channels + f[None, :], values, mask=inside[:, None] & (f < channels)[None, :]
        )
