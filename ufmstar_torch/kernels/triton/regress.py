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
    *,
    smooth: bool,
) -> FrameRegression:
    """Compute regression, unmeasured pixels and moving average of a frame in two launches.

    Args:
        mixture: M_i, [B, K].
        to_camera: R and t from the mixture's frame to the camera frame.
        frame: of B streams.
        memory: of the moving average.
        config: of UfM*.
        counts: [8, B] int64 (``append``), to which valid and unmeasured pixels are added.
        smooth: whether to average.
    """
    depth, average = frame.depth.contiguous(), smooth and config.ema_alpha < 1.0
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
def _bounds(means, fields, capacity, j, listed, cx, cy, cz, hx, hy, hz, slack: tl.constexpr):
    """log2 of lower and upper bounds of the densities of components j in the box c +- h; -1e30 if not ``listed``."""
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
def _gap(means, fields, capacity, j, x_0, y_0, z_0, x, y, z):
    """Largest distance along an axis of points from the box of component j; (x_0, y_0, z_0) is their origin."""
    real = fields.dtype.element_ty
    dx = tl.abs(x - (tl.load(means + j) - x_0).to(real)) - tl.load(fields + 7 * capacity + j)
    dy = tl.abs(y - (tl.load(means + capacity + j) - y_0).to(real)) - tl.load(fields + 8 * capacity + j)
    dz = tl.abs(z - (tl.load(means + 2 * capacity + j) - z_0).to(real)) - tl.load(fields + 9 * capacity + j)
    return tl.maximum(dx, tl.maximum(dy, dz))


@triton.jit
def _box_gap(means, fields, capacity, j, listed, cx, cy, cz, hx, hy, hz):
    """Largest distance along an axis between the box c +- h and those of components j."""
    real = fields.dtype.element_ty
    dx = tl.abs(cx - tl.load(means + j, mask=listed, other=0.0).to(real)) - hx
    dy = tl.abs(cy - tl.load(means + capacity + j, mask=listed, other=0.0).to(real)) - hy
    dz = tl.abs(cz - tl.load(means + 2 * capacity + j, mask=listed, other=0.0).to(real)) - hz
    dx -= tl.load(fields + 7 * capacity + j, mask=listed, other=0.0)
    dy -= tl.load(fields + 8 * capacity + j, mask=listed, other=0.0)
    dz -= tl.load(fields + 9 * capacity + j, mask=listed, other=0.0)
    return tl.maximum(dx, tl.maximum(dy, dz))


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
    lane = tl.arange(0, side * side)
    camera, index = camera + 9 * b, index + b * capacity
    means, fields = means + 3 * b * capacity, fields + stride * b * capacity
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
    usable = inside & (tl.load(valid + source, mask=inside, other=0) != 0)
    z = tl.load(depth + source, mask=usable, other=0.0).to(tl.float64)
    x = (u - tl.load(camera + 2)) / tl.load(camera) * z
    y = (v - tl.load(camera + 5)) / tl.load(camera + 4) * z
    any_valid = tl.sum(usable.to(tl.int32), 0) > 0
    n = tl.where(any_valid, tl.load(count + b), 0)

    # The box of the points, and the nearest point as the origin.
    inf = float("inf")
    x_low, x_high = tl.min(tl.where(usable, x, inf), 0), tl.max(tl.where(usable, x, -inf), 0)
    y_low, y_high = tl.min(tl.where(usable, y, inf), 0), tl.max(tl.where(usable, y, -inf), 0)
    z_low, z_high = tl.min(tl.where(usable, z, inf), 0), tl.max(tl.where(usable, z, -inf), 0)
    x_low, x_high = tl.where(any_valid, x_low, 0.0), tl.where(any_valid, x_high, 0.0)
    y_low, y_high = tl.where(any_valid, y_low, 0.0), tl.where(any_valid, y_high, 0.0)
    z_low, z_high = tl.where(any_valid, z_low, 0.0), tl.where(any_valid, z_high, 0.0)
    cx, cy, cz = 0.5 * (x_low + x_high), 0.5 * (y_low + y_high), 0.5 * (z_low + z_high)
    hx, hy, hz = 0.5 * (x_high - x_low), 0.5 * (y_high - y_low), 0.5 * (z_high - z_low)
    hx, hy, hz = hx + slack * (hx + tl.abs(cx)), hy + slack * (hy + tl.abs(cy)), hz + slack * (hz + tl.abs(cz))
    cx, cy, cz, hx, hy, hz = cx.to(real), cy.to(real), cz.to(real), hx.to(real), hy.to(real), hz.to(real)
    nearest = tl.min(tl.where(usable & (z == z_low), lane, side * side), 0)
    x_0, y_0 = tl.sum(tl.where(lane == nearest, x, 0.0), 0), tl.sum(tl.where(lane == nearest, y, 0.0), 0)
    x, y, z = (x - x_0).to(real), (y - y_0).to(real), (z - z_low).to(real)

    part = tl.arange(0, chunk)
    if near:
        least_gap = tl.full([side * side], inf, real)
        for first in range(0, n, chunk):
            listed = first + part < n
            listed &= _box_gap(means, fields, capacity, first + part, listed, cx, cy, cz, hx, hy, hz) <= far_radius
            remaining = tl.sum(tl.where(listed, tl.full([chunk], 1, tl.int64) << part.to(tl.int64), 0), 0)
            while remaining != 0:
                bit, remaining = lowest_bit(remaining)
                gap = _gap(means, fields, capacity, first + bit, x_0, y_0, z_low, x, y, z)
                least_gap = tl.minimum(least_gap, gap)
        radius = tl.where(least_gap <= near_radius, near_radius, far_radius)
    else:
        greatest = tl.full([chunk], least, real)
        for first in range(0, n, chunk):
            lower, _ = _bounds(means, fields, capacity, first + part, first + part < n, cx, cy, cz, hx, hy, hz, slack)
            greatest = tl.maximum(greatest, lower)
        threshold = tl.max(greatest, 0) + share - tl.log2(tl.maximum(n, 1).to(real))

    evidence = tl.full([side * side], prior, real)
    total = tl.full([side * side], prior_total, real)
    compared_sum = tl.zeros([side * side], real)
    f = tl.arange(0, padded)
    sums = tl.zeros([side * side, padded], real)
    for first in range(0, n, chunk):
        listed = first + part < n
        if near:
            listed &= _box_gap(means, fields, capacity, first + part, listed, cx, cy, cz, hx, hy, hz) <= far_radius
        else:
            _, upper = _bounds(means, fields, capacity, first + part, listed, cx, cy, cz, hx, hy, hz, slack)
            listed &= upper > threshold
        bits = tl.where(listed, tl.full([chunk], 1, tl.int64) << part.to(tl.int64), 0)
        remaining = tl.sum(bits, 0)
        while remaining != 0:
            bit, remaining = lowest_bit(remaining)
            j = first + bit
            dx = x - (tl.load(means + j) - x_0).to(real)
            dy = y - (tl.load(means + capacity + j) - y_0).to(real)
            dz = z - (tl.load(means + 2 * capacity + j) - z_low).to(real)
            y0 = tl.load(fields + j) * dx
            y1 = tl.load(fields + capacity + j) * dx + tl.load(fields + 2 * capacity + j) * dy
            y2 = tl.load(fields + 3 * capacity + j) * dx + tl.load(fields + 4 * capacity + j) * dy
            y2 += tl.load(fields + 5 * capacity + j) * dz
            w = tl.exp2(tl.load(fields + 6 * capacity + j) - (y0 * y0 + y1 * y1 + y2 * y2))
            if near:
                w = tl.where(_gap(means, fields, capacity, j, x_0, y_0, z_low, x, y, z) <= radius, w, 0.0)
            k = b * capacity + tl.load(index + j)
            evidence += w
            if stepped:
                compared_sum += w * (1 - tl.exp(-tl.load(views_k + k).to(tl.float64))).to(real)
            total += w * tl.load(m + k).to(real)
            if channels > 0:
                value = tl.load(features + k * channels + f, mask=f < channels, other=0.0).to(real)
                sums += w[:, None] * value[None, :]
    nan = float("nan")
    value = total / evidence
    if stepped:
        measured_share = compared_sum / evidence * tl.load(informative + b).to(real)
        if mode == 1:
            size = relative * tl.load(depth + source, mask=usable, other=0.0)
            value += tl.maximum(1 - measured_share, 0.0) * (size * size)
        if mode == 2:
            value = tl.where(measured_share < half, nan, value)
        tl.store(measured + target, tl.where(usable, measured_share, nan), mask=inside)
        tl.atomic_add(counts + 6 * streams + b, tl.sum(usable.to(tl.int32), 0))
        tl.atomic_add(counts + 7 * streams + b, tl.sum((usable & (measured_share < half)).to(tl.int32), 0))
        value = tl.where(usable, value, nan)
        if alpha < 1.0:
            newest = value.to(memory.dtype.element_ty)
            averaged = mixed(tl.load(running + target, mask=inside, other=0.0), newest, alpha)
            tl.store(memory + target, averaged, mask=inside)
            value = tl.where(newest != newest, newest, averaged).to(real)
    tl.store(out + target, tl.where(usable, value, nan), mask=inside)
    if channels > 0:
        values = tl.where(usable[:, None], sums / evidence[:, None], nan)
        tl.store(
            out_f + target[:, None] * channels + f[None, :], values, mask=inside[:, None] & (f < channels)[None, :]
        )
