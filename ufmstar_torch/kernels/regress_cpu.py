"""Gaussian mixture regression on the CPU (numba): the entry points, and the paper's neighbourhood.

The exact sum at every pixel is in ``regress_tiles_cpu``, at points of any kind in ``regress_points_cpu``. Both leave
out components that cannot matter, and state the error.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.kernels.regress_points_cpu import at_points, compiled, distribute_points, prepare
from ufmstar_torch.kernels.regress_tiles_cpu import exact
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.regress import Regression, regress_pixels
from ufmstar_torch.regress import distribute as distribute_reference
from ufmstar_torch.regress import regress as regress_reference

# Share of the denominator that culling may leave out: about the rounding of a sum in the dtype, so that culling is no
# coarser than the arithmetic itself. 1e-6 for float32 saves a thirtieth of the time.
EPSILON = {torch.float32: 1e-7, torch.float64: 1e-14}

_SHARE = 128 * 128  # pixels; below that a thread costs more than it saves


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
        _share_out(exact, *arguments, EPSILON[depth.dtype], maps.numpy(), features.numpy())
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
