"""Gaussian mixture regression on a GPU: the exact sum with culling in two levels.

The bound is that of ``kernels.cpu.regress_cull``: a component is omitted where its density is at most
(eps / 3n) max(max_j l_j, pi_0 / 1000), with a lower bound l_j of each density. The first level is the image: a program
per stream lists the components whose silhouette meets it. The second level is a tile of 16 x 16 pixels, with a program
each. Chosen pixels are processed in groups of 256 instead of tiles.

The paper's neighbourhood (``config.regression``) omits by distance instead: a tile sums the components whose boxes come
within the far radius of one of its points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.kernels.triton.launch import launch, power_of_two
from ufmstar_torch.kernels.triton.listing import EPSILON, FIELDS, PRIOR, prepare
from ufmstar_torch.kernels.triton.matrices import lowest_bit
from ufmstar_torch.steps.regress import HALF, Regression

_SIDE = 16  # pixels of a tile
_CHUNK = 32  # components bounded at a time, the bits of a mask
_UNMEASURED = {"paper": 0, "relative": 1, "nan": 2}


@dataclass(frozen=True)
class FrameRegression:
    """Maps of step 5 and of the moving average.

    Attributes:
        disagreement: M [B, H, W] [m^2] after the moving average, NaN where not valid.
        features: [B, H, W, F].
        measured: [B, H, W], see ``unmeasured``.
        memory: [B, H, W] of the moving average.
    """

    disagreement: Tensor
    features: Tensor
    measured: Tensor
    memory: Tensor


def regress_frame(
    mixture: GaussianMixture,
    to_camera: tuple[Tensor, Tensor],
    frame: FrameInput,
    memory: Tensor,
    config: UfMStarConfig,
    counts: Tensor,
) -> FrameRegression:
    """Compute regression, unmeasured pixels and moving average of a frame in two launches.

    Args:
        mixture: M_i, [B, K].
        to_camera: R and t from the mixture's frame to the camera frame.
        frame: of B streams.
        memory: of the moving average.
        config: of UfM*.
        counts: [7, B] int64 (``append``), to which unmeasured pixels are added.
    """
    depth, average = frame.depth.contiguous(), config.ema_alpha < 1.0
    if average and memory.shape != depth.shape:
        memory = memory.new_full(depth.shape, torch.nan)
    updated = torch.empty_like(memory) if average else memory
    channels = mixture.features.shape[2]
    maps, measured = torch.empty_like(depth), torch.empty_like(depth)
    features = depth.new_empty(*depth.shape, channels)
    camera = frame.intrinsics.to(torch.float64).contiguous()
    listed = prepare(mixture, camera, frame.size, depth.dtype, config, to_camera)
    _launch(
        mixture, listed, depth, frame.valid, camera, depth, maps, features, config, subset=False,
        stepped=(mixture.views, _informative(frame), memory, updated, measured, counts),
        alpha=config.ema_alpha if average else 1.0,
    )  # fmt: skip
    return FrameRegression(maps, features, measured, updated)


def regress_image(
    mixture_cam: GaussianMixture,
    depth: Tensor,
    intrinsics: Tensor,
    valid: Tensor,
    config: UfMStarConfig,
    pixels: Tensor | None = None,
) -> Regression:
    """As ``steps.regress.regress_image``."""
    maps = depth.new_empty(depth.shape if pixels is None else pixels.shape)
    features = depth.new_empty(*maps.shape, mixture_cam.features.shape[2])
    camera = intrinsics.to(torch.float64).contiguous()
    listed = prepare(mixture_cam, camera, (depth.shape[1], depth.shape[2]), depth.dtype, config)
    chosen = depth if pixels is None else pixels.contiguous()
    subset = pixels is not None
    _launch(mixture_cam, listed, depth.contiguous(), valid, camera, chosen, maps, features, config, subset=subset)
    return Regression(maps, features)


def _launch(
    mixture: GaussianMixture, listed: tuple[Tensor, ...], depth: Tensor, valid: Tensor, camera: Tensor, pixels: Tensor,
    maps: Tensor, features: Tensor, config: UfMStarConfig, *, subset: bool, stepped: tuple[Tensor, ...] | None = None,
    alpha: float = 1.0,
) -> None:  # fmt: skip
    b, height, width = depth.shape
    chosen = pixels.shape[1] if subset else 0
    channels = mixture.features.shape[2]
    near = config.regression == "neighbourhood"
    tiles = triton.cdiv(height, _SIDE) * triton.cdiv(width, _SIDE)
    launch(
        _regress, (triton.cdiv(chosen, _SIDE * _SIDE) if subset else tiles, b),
        depth, valid.contiguous(), camera, pixels, *listed, mixture.disagreement.contiguous(),
        mixture.features.contiguous(), maps, features, *(stepped or (mixture.views, *5 * [depth])),
        height, width, chosen, mixture.capacity, b, fused=True,
        prior=config.prior_weight, prior_total=config.prior_weight * config.prior_mean,
        least=math.log2(PRIOR * config.prior_weight), share=math.log2(EPSILON[depth.dtype] / 3) - 0.01,
        slack=16 * torch.finfo(depth.dtype).eps, channels=channels, padded=power_of_two(channels), side=_SIDE,
        chunk=_CHUNK, subset=subset, stepped=stepped is not None, alpha=alpha, mode=_UNMEASURED[config.unmeasured],
        relative=config.unmeasured_relative, half=HALF, near=near, stride=FIELDS[near],
        near_radius=config.near_radius, far_radius=config.far_radius,
    )  # fmt: skip


def _informative(frame: FrameInput) -> Tensor:
    """[B] 1 for the streams whose image shows something, else 0."""
    ones = torch.ones_like(frame.fault)
    return ones if frame.informative is None else ones * frame.informative


@triton.jit
def mixed(running, newest, alpha: tl.constexpr):
    """Update the moving average; NaN values are skipped."""
    average = (1 - alpha) * running + alpha * newest
    return tl.where(newest != newest, running, tl.where(running != running, newest, average))


@triton.jit
def _pixels(pixels, b, height, width, chosen, side: tl.constexpr, subset: tl.constexpr):
    """The program's pixels: row, column, whether they exist, and their index in the image and in the output."""
    lane = tl.arange(0, side * side)
    if subset:
        position = tl.program_id(0) * (side * side) + lane
        inside = position < chosen
        target = b * chosen + position
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
    return v, u, inside, source, target


@triton.jit
def _extent(values, usable, some):
    """Least and greatest usable value; 0 unless there is ``some``."""
    low = tl.min(tl.where(usable, values, float("inf")), 0)
    high = tl.max(tl.where(usable, values, -float("inf")), 0)
    return tl.where(some, low, 0.0), tl.where(some, high, 0.0)


@triton.jit
def _side(extent, fields, slack: tl.constexpr):
    """Centre, and half the length with a margin for rounding, of a side of a box, in the dtype of the fields."""
    low, high = extent
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    half = half + slack * (half + tl.abs(centre))
    return centre.to(fields.dtype.element_ty), half.to(fields.dtype.element_ty)


@triton.jit
def _bounds(means, fields, capacity, j, listed, box, slack: tl.constexpr):
    """log2 of lower and upper bounds of the densities of components j in the box c +- h; -1e30 if not ``listed``."""
    cx, cy, cz, hx, hy, hz = box
    real = fields.dtype.element_ty
    mx = tl.load(means + j, mask=listed, other=0.0).to(real)
    my = tl.load(means + capacity + j, mask=listed, other=0.0).to(real)
    mz = tl.load(means + 2 * capacity + j, mask=listed, other=0.0).to(real)
    a = tl.load(fields + j, mask=listed, other=0.0)
    b = tl.load(fields + capacity + j, mask=listed, other=0.0)
    c = tl.load(fields + 2 * capacity + j, mask=listed, other=0.0)
    d = tl.load(fields + 3 * capacity + j, mask=listed, other=0.0)
    e = tl.load(fields + 4 * capacity + j, mask=listed, other=0.0)
    f = tl.load(fields + 5 * capacity + j, mask=listed, other=0.0)
    peak = tl.load(fields + 6 * capacity + j, mask=listed, other=-1e30)
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
def _gap(means, fields, capacity, j, origin, point):
    """Largest distance along an axis of points, relative to their origin, from the box of component j."""
    x_0, y_0, z_0 = origin
    x, y, z = point
    real = fields.dtype.element_ty
    dx = tl.abs(x - (tl.load(means + j) - x_0).to(real)) - tl.load(fields + 7 * capacity + j)
    dy = tl.abs(y - (tl.load(means + capacity + j) - y_0).to(real)) - tl.load(fields + 8 * capacity + j)
    dz = tl.abs(z - (tl.load(means + 2 * capacity + j) - z_0).to(real)) - tl.load(fields + 9 * capacity + j)
    return tl.maximum(dx, tl.maximum(dy, dz))


@triton.jit
def _box_gap(means, fields, capacity, j, listed, box):
    """Largest distance along an axis between the box c +- h and those of components j."""
    cx, cy, cz, hx, hy, hz = box
    real = fields.dtype.element_ty
    dx = tl.abs(cx - tl.load(means + j, mask=listed, other=0.0).to(real)) - hx
    dy = tl.abs(cy - tl.load(means + capacity + j, mask=listed, other=0.0).to(real)) - hy
    dz = tl.abs(cz - tl.load(means + 2 * capacity + j, mask=listed, other=0.0).to(real)) - hz
    dx -= tl.load(fields + 7 * capacity + j, mask=listed, other=0.0)
    dy -= tl.load(fields + 8 * capacity + j, mask=listed, other=0.0)
    dz -= tl.load(fields + 9 * capacity + j, mask=listed, other=0.0)
    return tl.maximum(dx, tl.maximum(dy, dz))


@triton.jit
def _density(means, fields, capacity, j, origin, point):
    """Density of component j, times its weight, at points relative to their origin."""
    x_0, y_0, z_0 = origin
    x, y, z = point
    real = fields.dtype.element_ty
    dx = x - (tl.load(means + j) - x_0).to(real)
    dy = y - (tl.load(means + capacity + j) - y_0).to(real)
    dz = z - (tl.load(means + 2 * capacity + j) - z_0).to(real)
    y0 = tl.load(fields + j) * dx
    y1 = tl.load(fields + capacity + j) * dx + tl.load(fields + 2 * capacity + j) * dy
    y2 = tl.load(fields + 3 * capacity + j) * dx + tl.load(fields + 4 * capacity + j) * dy
    y2 += tl.load(fields + 5 * capacity + j) * dz
    return tl.exp2(tl.load(fields + 6 * capacity + j) - (y0 * y0 + y1 * y1 + y2 * y2))


@triton.jit
def _bits(flags, chunk: tl.constexpr):
    """The flags [chunk] as the bits of a number."""
    return tl.sum(tl.where(flags, tl.full([chunk], 1, tl.int64) << tl.arange(0, chunk).to(tl.int64), 0), 0)


@triton.jit
def _radius(
    means, fields, capacity, n, box, origin, point,
    near_radius: tl.constexpr, far_radius: tl.constexpr, chunk: tl.constexpr,
):  # fmt: skip
    """The radius of each point's neighbourhood: the near one if it reaches the box of a component, else the far one."""
    part = tl.arange(0, chunk)
    least_gap = tl.full(point[0].shape, float("inf"), fields.dtype.element_ty)
    for first in range(0, n, chunk):
        listed = first + part < n
        listed &= _box_gap(means, fields, capacity, first + part, listed, box) <= far_radius
        remaining = _bits(listed, chunk)
        while remaining != 0:
            bit, remaining = lowest_bit(remaining)
            least_gap = tl.minimum(least_gap, _gap(means, fields, capacity, first + bit, origin, point))
    return tl.where(least_gap <= near_radius, near_radius, far_radius)


@triton.jit
def _threshold(
    means, fields, capacity, n, box, least: tl.constexpr, share: tl.constexpr, slack: tl.constexpr, chunk: tl.constexpr
):
    """log2 of the density below which a component is negligible in the box."""
    part = tl.arange(0, chunk)
    real = fields.dtype.element_ty
    greatest = tl.full([chunk], least, real)
    for first in range(0, n, chunk):
        lower, _ = _bounds(means, fields, capacity, first + part, first + part < n, box, slack)
        greatest = tl.maximum(greatest, lower)
    return tl.max(greatest, 0) + share - tl.log2(tl.maximum(n, 1).to(real))


@triton.jit
def _finished(
    value, measured_share, usable, inside, source, target, depth, running, memory, measured, counts, b, streams,
    alpha: tl.constexpr, mode: tl.constexpr, relative: tl.constexpr, half: tl.constexpr,
):  # fmt: skip
    """Write and count the measured shares; replace M where no two views were compared (``unmeasured``), and apply the
    moving average. Returns M."""
    nan = float("nan")
    if mode == 1:
        size = relative * tl.load(depth + source, mask=usable, other=0.0)
        value += tl.maximum(1 - measured_share, 0.0) * (size * size)
    if mode == 2:
        value = tl.where(measured_share < half, nan, value)
    tl.store(measured + target, tl.where(usable, measured_share, nan), mask=inside)
    tl.atomic_add(counts + 6 * streams + b, tl.sum((usable & (measured_share < half)).to(tl.int32), 0))
    value = tl.where(usable, value, nan)
    if alpha < 1.0:
        newest = value.to(memory.dtype.element_ty)
        averaged = mixed(tl.load(running + target, mask=inside, other=0.0), newest, alpha)
        tl.store(memory + target, averaged, mask=inside)
        value = tl.where(newest != newest, newest, averaged).to(depth.dtype.element_ty)
    return value


@triton.jit
def _regress(
    depth, valid, camera, pixels, means, fields, index, count, m, features, out, out_f,
    views_k, informative, running, memory, measured, counts, height, width, chosen, capacity, streams,
    prior: tl.constexpr, prior_total: tl.constexpr, least: tl.constexpr, share: tl.constexpr, slack: tl.constexpr,
    channels: tl.constexpr, padded: tl.constexpr, side: tl.constexpr, chunk: tl.constexpr, subset: tl.constexpr,
    stepped: tl.constexpr, alpha: tl.constexpr, mode: tl.constexpr, relative: tl.constexpr,
    half: tl.constexpr, near: tl.constexpr, stride: tl.constexpr, near_radius: tl.constexpr, far_radius: tl.constexpr,
):  # fmt: skip
    real = depth.dtype.element_ty
    b = tl.program_id(1).to(tl.int64)
    camera, index = camera + 9 * b, index + b * capacity
    means, fields = means + 3 * b * capacity, fields + stride * b * capacity
    v, u, inside, source, target = _pixels(pixels, b, height, width, chosen, side, subset)
    usable = inside & (tl.load(valid + source, mask=inside, other=0) != 0)
    z = tl.load(depth + source, mask=usable, other=0.0).to(tl.float64)
    x = (u - tl.load(camera + 2)) / tl.load(camera) * z
    y = (v - tl.load(camera + 5)) / tl.load(camera + 4) * z
    some = tl.sum(usable.to(tl.int32), 0) > 0
    n = tl.where(some, tl.load(count + b), 0)

    # The box of the points, and the nearest point as the origin.
    z_extent = _extent(z, usable, some)
    cx, hx = _side(_extent(x, usable, some), fields, slack)
    cy, hy = _side(_extent(y, usable, some), fields, slack)
    cz, hz = _side(z_extent, fields, slack)
    box = cx, cy, cz, hx, hy, hz
    lane, z_0 = tl.arange(0, side * side), z_extent[0]
    nearest = tl.min(tl.where(usable & (z == z_0), lane, side * side), 0)
    x_0, y_0 = tl.sum(tl.where(lane == nearest, x, 0.0), 0), tl.sum(tl.where(lane == nearest, y, 0.0), 0)
    origin, point = (x_0, y_0, z_0), ((x - x_0).to(real), (y - y_0).to(real), (z - z_0).to(real))

    if near:
        limit = _radius(means, fields, capacity, n, box, origin, point, near_radius, far_radius, chunk)
    else:
        limit = _threshold(means, fields, capacity, n, box, least, share, slack, chunk)
    part, f = tl.arange(0, chunk), tl.arange(0, padded)
    evidence = tl.full([side * side], prior, real)
    total = tl.full([side * side], prior_total, real)
    compared_sum = tl.zeros([side * side], real)
    sums = tl.zeros([side * side, padded], real)
    for first in range(0, n, chunk):
        listed = first + part < n
        if near:
            listed &= _box_gap(means, fields, capacity, first + part, listed, box) <= far_radius
        else:
            _, upper = _bounds(means, fields, capacity, first + part, listed, box, slack)
            listed &= upper > limit
        remaining = _bits(listed, chunk)
        while remaining != 0:
            bit, remaining = lowest_bit(remaining)
            j = first + bit
            w = _density(means, fields, capacity, j, origin, point)
            if near:
                w = tl.where(_gap(means, fields, capacity, j, origin, point) <= limit, w, 0.0)
            k = b * capacity + tl.load(index + j)
            evidence += w
            if stepped:
                compared_sum += w * (1 - tl.exp(-tl.load(views_k + k).to(tl.float64))).to(real)
            total += w * tl.load(m + k).to(real)
            if channels > 0:
                value = tl.load(features + k * channels + f, mask=f < channels, other=0.0).to(real)
                sums += w[:, None] * value[None, :]
    value = total / evidence
    if stepped:
        measured_share = compared_sum / evidence * tl.load(informative + b).to(real)
        value = _finished(
            value, measured_share, usable, inside, source, target, depth, running, memory, measured, counts, b, streams,
            alpha, mode, relative, half,
        )  # fmt: skip
    nan = float("nan")
    tl.store(out + target, tl.where(usable, value, nan), mask=inside)
    if channels > 0:
        values = tl.where(usable[:, None], sums / evidence[:, None], nan)
        stored = inside[:, None] & (f < channels)[None, :]
        tl.store(out_f + target[:, None] * channels + f[None, :], values, mask=stored)
