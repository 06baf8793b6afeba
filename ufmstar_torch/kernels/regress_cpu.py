"""Dense Gaussian mixture regression on the CPU, the exact sum with bounded culling (numba).

Every 16 x 16 tile of pixels evaluates only the components that matter to it. For a tile, interval
arithmetic over the bounding box of its points gives for each component k a lower and an upper bound of the
squared Mahalanobis distance, and so bounds l_k <= pi_k N(x; mu_k, Sigma_k) <= h_k for all its points. A component is
left out when h_k <= eps D / K, with D = pi_0 + sum_k l_k, a lower bound of every pixel's denominator.
What is left out then adds up to at most eps times the denominator, which bounds the error

    |m_hat - m_hat_culled| <= 2 eps max(m_k, mu_0)

(tests/test_regress.py checks it; the 2 is for the two levels, blocks of tiles first, then tiles).
Within a tile, points are taken relative to its nearest point, so that float32 loses nothing to the distance
from the camera, and nothing to a far outlier among its pixels either.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
import torch
from numba import njit, types
from numba.extending import overload
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.kernels.regress_points_cpu import at_points, compiled, distribute_points, prepare
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.regress import Regression, regress_pixels
from ufmstar_torch.regress import distribute as distribute_reference
from ufmstar_torch.regress import regress as regress_reference

# The innermost loop, with multiply and add joined where the processor can: one rounding less, not one more.
contracted: Any = njit(cache=True, nogil=True, fastmath={"contract"})

# Share of the denominator that culling may leave out at each of the two levels: about the rounding of a
# sum in the dtype, so that culling is no coarser than the arithmetic itself.
EPSILON = {torch.float32: 1e-7, torch.float64: 1e-14}

_TILE = 16  # pixels; 256 points fill vector registers and still lie close together
_SHARE = 128 * 128  # pixels; below that a thread costs more than it saves
_BLOCK = 4  # tiles; a block of 64 x 64 pixels is culled first


def regress_image(
    mixture_cam: GaussianMixture,
    depth: Tensor,
    intrinsics: Tensor,
    valid: Tensor,
    config: UfMStarConfig,
    pixels: Tensor | None = None,
) -> Regression:
    """As :func:`ufmstar_torch.regress.regress_image`, for CPU tensors."""
    if pixels is not None:
        return regress_pixels(mixture_cam, depth, intrinsics, valid, config, pixels, regress)
    maps = torch.empty_like(depth, memory_format=torch.contiguous_format)
    features = torch.empty(*depth.shape, mixture_cam.features.shape[2], dtype=depth.dtype)
    m = mixture_cam
    arguments = (
        depth.detach().contiguous().numpy(),
        valid.contiguous().numpy(),
        *(
            value.detach().double().contiguous().numpy()
            for value in (intrinsics, m.mean, m.covariance, m.weight, m.disagreement, m.features)
        ),
        config.prior_weight,
        config.prior_mean,
    )
    if config.regression == "exact":
        _share_out(_exact, *arguments, EPSILON[depth.dtype], maps.numpy(), features.numpy())
    else:
        radii = (config.neighbourhood_sigmas, config.near_radius, config.far_radius)
        _share_out(_neighbourhood, *arguments, *radii, maps.numpy(), features.numpy())
    return Regression(maps, features)


def regress(mixture: GaussianMixture, points: Tensor, config: UfMStarConfig) -> Regression:
    """As :func:`ufmstar_torch.regress.regress`, for CPU tensors; components are left out where they add less
    than eps pi_0 / K to the denominator, so that the error is at most eps max(m_k, mu_0)."""
    if config.regression != "exact":
        return regress_reference(mixture, points, config)
    out = torch.empty(points.shape[:2], dtype=points.dtype)
    out_f = torch.empty(*points.shape[:2], mixture.features.shape[2], dtype=points.dtype)
    fields = (mixture.mean, mixture.covariance, mixture.weight, mixture.disagreement, mixture.features)
    at_points(
        points.detach().contiguous().numpy(), *(value.detach().double().contiguous().numpy() for value in fields),
        config.prior_weight, config.prior_mean, EPSILON[points.dtype], out.numpy(), out_f.numpy(),
    )  # fmt: skip
    return Regression(out, out_f)


def distribute(mixture: GaussianMixture, points: Tensor, values: Tensor, config: UfMStarConfig) -> Tensor:
    """As :func:`ufmstar_torch.regress.distribute`, for CPU tensors; shares are right to 1e-14."""
    if config.regression != "exact":
        return distribute_reference(mixture, points, values, config)
    out = torch.zeros(*mixture.weight.shape, values.shape[2], dtype=torch.float64)
    fields = (points, values, mixture.mean, mixture.covariance, mixture.weight)
    distribute_points(
        *(value.detach().double().contiguous().numpy() for value in fields),
        config.prior_weight, EPSILON[torch.float64], out.numpy(),
    )  # fmt: skip
    return out


def smooth(previous: Tensor, current: Tensor, alpha: float) -> tuple[Tensor, Tensor]:
    """As :func:`ufmstar_torch.regress.smooth`, for CPU tensors, in one pass."""
    memory, shown = torch.empty_like(previous), torch.empty_like(current)
    _smooth(
        *(t.detach().contiguous().view(-1).numpy() for t in (previous, current)),
        alpha,
        *(t.view(-1).numpy() for t in (memory, shown)),
    )
    return memory, shown


@compiled
def _smooth(previous, current, alpha, memory, shown):
    for i in range(previous.size):
        before, now = previous[i], memory.dtype.type(current[i])
        memory[i] = before if now != now else now if before != before else (1 - alpha) * before + alpha * now
        shown[i] = now if now != now else memory[i]


def _share_out(kernel: Any, *arguments: Any) -> None:
    """Run ``kernel`` on as many threads as torch may use, each on its share of the image.

    Threads of our own and not numba's parallel loops: those start OpenMP, which puts torch's number of
    threads back to all cores. The kernels release the GIL.
    """
    depth = arguments[0]
    shares = max(1, min(torch.get_num_threads(), depth[0].size // _SHARE))
    if shares == 1:
        kernel(*arguments, 0, 1)
        return
    with ThreadPoolExecutor(shares - 1) as pool:
        others = [pool.submit(partial(kernel, *arguments, first, shares)) for first in range(1, shares)]
        kernel(*arguments, 0, shares)
        for other in others:
            other.result()


@compiled
def _squares(centre, radius):
    """Least and greatest square of a value that lies within ``radius`` of ``centre``."""
    low = max(abs(centre) - radius, 0.0)
    high = abs(centre) + radius
    return low * low, high * high


@compiled
def _cull(candidates, count, centre, half, mean, whitening, log_peak, prior, epsilon, kept):
    """Write the components that matter inside the box centre +- half to ``kept``; return how many."""
    least = prior
    high = np.empty(count)
    for j in range(count):
        k = candidates[j]
        W = whitening[k]
        dx, dy, dz = centre[0] - mean[k, 0], centre[1] - mean[k, 1], centre[2] - mean[k, 2]
        low0, high0 = _squares(W[0] * dx, W[0] * half[0])
        low1, high1 = _squares(W[1] * dx + W[2] * dy, abs(W[1]) * half[0] + W[2] * half[1])
        reach = abs(W[3]) * half[0] + abs(W[4]) * half[1] + W[5] * half[2]
        low2, high2 = _squares(W[3] * dx + W[4] * dy + W[5] * dz, reach)
        least += math.exp(log_peak[k] - 0.5 * (high0 + high1 + high2))
        high[j] = log_peak[k] - 0.5 * (low0 + low1 + low2)
    threshold = math.log(epsilon * least / max(count, 1))
    n = 0
    for j in range(count):
        if high[j] > threshold:
            kept[n] = candidates[j]
            n += 1
    return n


@compiled
def _box(depth, valid, K, v0, v1, u0, u1, centre, half, origin):
    """Bounding box of the points of a patch of pixels, and its nearest point; False without a valid one."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for v in range(v0, v1):
        ry = (v - cy) / fy
        for u in range(u0, u1):
            if not valid[v, u]:
                continue
            z = np.float64(depth[v, u])
            x, y = (u - cx) / fx * z, ry * z
            low[0], high[0] = min(low[0], x), max(high[0], x)
            low[1], high[1] = min(low[1], y), max(high[1], y)
            if z < low[2]:
                origin[0], origin[1], origin[2] = x, y, z
            low[2], high[2] = min(low[2], z), max(high[2], z)
    if low[2] > high[2]:
        return False
    for i in range(3):
        centre[i] = 0.5 * (low[i] + high[i])
        # Rounding of the bounds, and of points computed in float32.
        half[i] = 0.5 * (high[i] - low[i]) * (1 + 1e-6) + 1e-12
    return True


def exp_(t):
    """exp(t) for t <= 88 in t's own precision; compiled code only (see the overload)."""
    return math.exp(t)


@overload(exp_, inline="always")
def _exp_overload(t):
    if t is not types.float32:
        return lambda t: math.exp(t)

    def exp32(t):
        # 2^n e^r with |r| <= ln(2)/2: Cody-Waite reduction and the Taylor polynomial of degree 7 (2e-7
        # relative), as code without branches, which the compiler turns into vector instructions.
        t = t if t > np.float32(-87.0) else np.float32(-87.0)
        n = np.floor(t * np.float32(1.4426950408889634) + np.float32(0.5))
        r = (t - n * np.float32(0.693145751953125)) - n * np.float32(1.42860682030941723212e-6)
        p = np.float32(1.0 / 5040.0)
        p = p * r + np.float32(1.0 / 720.0)
        p = p * r + np.float32(1.0 / 120.0)
        p = p * r + np.float32(1.0 / 24.0)
        p = p * r + np.float32(1.0 / 6.0)
        p = p * r + np.float32(0.5)
        p = p * r + np.float32(1.0)
        p = p * r + np.float32(1.0)
        scale = np.int32((np.int32(n) + np.int32(127)) << np.int32(23))
        return p * scale.view(np.float32)

    return exp32


@compiled
def _points(depth, valid, K, v0, v1, u0, u1, origin, x, y, z):
    """Points of a patch relative to ``origin``, in the arrays' precision; pixels that are not valid give NaN."""
    i = 0
    for v in range(v0, v1):
        ry = (v - K[1, 2]) / K[1, 1]
        for u in range(u0, u1):
            d = np.float64(depth[v, u]) if valid[v, u] else np.nan
            x[i] = (u - K[0, 2]) / K[0, 0] * d - origin[0]
            y[i] = ry * d - origin[1]
            z[i] = d - origin[2]
            i += 1
    return i


@contracted
def _accumulate(coefficient, x, y, z, evidence, total, density):
    """Add one component to n points: its density to ``evidence``, times m to ``total``.

    coefficient: mean (3), whitening (6), log peak, m, 1/2, all in the points' precision.
    """
    mx, my, mz = coefficient[0], coefficient[1], coefficient[2]
    a, b, c = coefficient[3], coefficient[4], coefficient[5]
    d, e, f = coefficient[6], coefficient[7], coefficient[8]
    log_peak, m, half = coefficient[9], coefficient[10], coefficient[11]
    for i in range(x.size):
        dx, dy, dz = x[i] - mx, y[i] - my, z[i] - mz
        y0, y1, y2 = a * dx, b * dx + c * dy, d * dx + e * dy + f * dz
        w = exp_(log_peak - half * (y0 * y0 + y1 * y1 + y2 * y2))
        density[i] = w
        evidence[i] += w
        total[i] += w * m


@compiled
def _tile(
    depth, valid, K, v0, v1, u0, u1, origin, kept, n, index, local, log_peak, m, features, prior, prior_mean,
    out, out_f,
):  # fmt: skip
    """Regress one tile; ``local`` holds mean and whitening of the occupied components."""
    count = (v1 - v0) * (u1 - u0)
    x, y, z = np.empty(count, out.dtype), np.empty(count, out.dtype), np.empty(count, out.dtype)
    _points(depth, valid, K, v0, v1, u0, u1, origin, x, y, z)
    evidence, total = np.full(count, prior, out.dtype), np.full(count, prior * prior_mean, out.dtype)
    density = np.empty(count, out.dtype)
    sums = np.zeros((out_f.shape[2], count), out.dtype)
    coefficient = np.empty(12, out.dtype)
    coefficient[11] = 0.5
    for j in range(n):
        k = kept[j]
        for i in range(3):
            coefficient[i] = local[k, i] - origin[i]
        for i in range(6):
            coefficient[3 + i] = local[k, 3 + i]
        coefficient[9], coefficient[10] = log_peak[k], m[index[k]]
        _accumulate(coefficient, x, y, z, evidence, total, density)
        for g in range(sums.shape[0]):
            coefficient[10] = features[index[k], g]
            for i in range(count):
                sums[g, i] += density[i] * coefficient[10]
    i = 0
    for v in range(v0, v1):
        for u in range(u0, u1):
            out[v, u] = total[i] / evidence[i] if x[i] == x[i] else np.nan
            for g in range(sums.shape[0]):
                out_f[v, u, g] = sums[g, i] / evidence[i] if x[i] == x[i] else np.nan
            i += 1


@compiled
def _block(depth, valid, K, v_low, u_low, components, index, local, log_peak, m, features, prior, epsilon, out, out_f):
    """Regress a block of tiles with the components that matter to it."""
    height, width = depth.shape
    v_high, u_high = min(height, v_low + _TILE * _BLOCK), min(width, u_low + _TILE * _BLOCK)
    centre, half, origin = np.zeros(3), np.zeros(3), np.zeros(3)
    near, kept = np.empty(components.size, np.int64), np.empty(components.size, np.int64)
    mean, whitening = local[:, :3], local[:, 3:]
    weight, prior_mean = prior
    count = 0
    if _box(depth, valid, K, v_low, v_high, u_low, u_high, centre, half, origin):
        count = _cull(components, components.size, centre, half, mean, whitening, log_peak, weight, epsilon, near)
    for v0 in range(v_low, v_high, _TILE):
        for u0 in range(u_low, u_high, _TILE):
            v1, u1 = min(v_high, v0 + _TILE), min(u_high, u0 + _TILE)
            n = 0
            if _box(depth, valid, K, v0, v1, u0, u1, centre, half, origin):
                n = _cull(near, count, centre, half, mean, whitening, log_peak, weight, epsilon, kept)
            _tile(
                depth, valid, K, v0, v1, u0, u1, origin, kept, n, index, local, log_peak, m, features,
                weight, prior_mean, out, out_f,
            )  # fmt: skip


@compiled
def _exact(
    depth, valid, K, mean, covariance, weight, m, features, prior_weight, prior_mean, epsilon, out, out_f, first, shares
):
    """All streams; of their blocks of tiles every ``shares``-th, from ``first`` on."""
    height, width = depth.shape[1:]
    side = _TILE * _BLOCK
    rows, columns = (height + side - 1) // side, (width + side - 1) // side
    for b in range(depth.shape[0]):
        index, whitening, log_peak = prepare(mean[b], covariance[b], weight[b])
        local = np.hstack((mean[b][index], whitening))
        components = np.arange(index.size)
        for block in range(first, rows * columns, shares):
            _block(
                depth[b], valid[b], K[b], block // columns * side, block % columns * side, components, index, local,
                log_peak, m[b], features[b], (prior_weight, prior_mean), epsilon, out[b], out_f[b],
            )  # fmt: skip


@compiled
def _pixel(x, y, z, count, gaps, kept, radius, index, local, log_peak, m, features, evidence, total, sums):
    """Sum over the kept components whose gap is at most ``radius``; returns evidence and total."""
    for j in range(count):
        if gaps[j] > radius:
            continue
        k = kept[j]
        dx, dy, dz = x - local[k, 0], y - local[k, 1], z - local[k, 2]
        y0 = local[k, 3] * dx
        y1 = local[k, 4] * dx + local[k, 5] * dy
        y2 = local[k, 6] * dx + local[k, 7] * dy + local[k, 8] * dz
        w = math.exp(log_peak[k] - 0.5 * (y0 * y0 + y1 * y1 + y2 * y2))
        evidence += w
        total += w * m[index[k]]
        for g in range(sums.size):
            sums[g] += w * features[index[k], g]
    return evidence, total


@compiled
def _near_row(depth, valid, K, v, components, extent, index, local, log_peak, m, features, prior, radii, out, out_f):
    """One row of pixels with the paper's neighbourhood."""
    near, far = radii
    gaps, kept = np.empty(components.size), np.empty(components.size, np.int64)
    sums = np.zeros(features.shape[1])
    for u in range(depth.shape[1]):
        out[v, u] = np.nan
        out_f[v, u] = np.nan
        if not valid[v, u]:
            continue
        z = np.float64(depth[v, u])
        x, y = (u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z
        count, least = 0, np.inf
        for k in components:
            gap = abs(z - local[k, 2]) - extent[k, 2]
            gap = max(gap, abs(x - local[k, 0]) - extent[k, 0], abs(y - local[k, 1]) - extent[k, 1])
            if gap <= far:
                gaps[count], kept[count] = gap, k
                count += 1
                least = min(least, gap)
        sums[:] = 0
        evidence, total = _pixel(
            x, y, z, count, gaps, kept, near if least <= near else far, index, local, log_peak, m, features,
            prior[0], prior[0] * prior[1], sums,
        )  # fmt: skip
        out[v, u] = total / evidence
        out_f[v, u] = sums / evidence


@compiled
def _neighbourhood(
    depth, valid, K, mean, covariance, weight, m, features, prior_weight, prior_mean, sigmas, near, far, out, out_f,
    first, shares,
):  # fmt: skip
    """All streams; of their rows every ``shares``-th, from ``first`` on."""
    for b in range(depth.shape[0]):
        index, whitening, log_peak = prepare(mean[b], covariance[b], weight[b])
        local = np.hstack((mean[b][index], whitening))
        extent = np.empty((index.size, 3))
        for k in range(index.size):
            for i in range(3):
                extent[k, i] = sigmas * math.sqrt(covariance[b, index[k], i, i])
        components = np.arange(index.size)
        for v in range(first, depth.shape[1], shares):
            _near_row(
                depth[b], valid[b], K[b], v, components, extent, index, local, log_peak, m[b], features[b],
                (prior_weight, prior_mean), (near, far), out[b], out_f[b],
            )  # fmt: skip
