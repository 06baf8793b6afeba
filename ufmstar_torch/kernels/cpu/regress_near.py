"""The paper's neighbourhood regression on the CPU (numba)."""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, kernel, part
from ufmstar_torch.kernels.cpu.regress_cull import HALF_LOG_TWO_PI_CUBED, PEAK, WHITENED, whiten
from ufmstar_torch.kernels.cpu.rigid import COVARIANCE


@kernel
def near(depth, K, pixels, components, m, features, settings, out, out_f, first, shares):
    """Regress one stream at pixels [n], indices into the flattened image [H, W], into out [n] and out_f [F, n]; NaN
    where the depth is not positive. Of the pixels, cut into ``shares``, only the share ``first`` is computed.

    ``settings``: prior weight and mean, standard deviations of an extent, near and far radius.
    """
    prior_weight, prior_mean, sigmas, near_radius, far_radius = settings
    log_peak, local, extent = _prepared(components, m.size, sigmas)
    gaps, nearest, sums = empty(m.size, np.float64), empty(m.size, np.int64), empty(features.shape[1], np.float64)
    for i in range(first * pixels.size // shares, (first + 1) * pixels.size // shares):
        v = pixels[i] // depth.shape[1]
        u = pixels[i] - v * depth.shape[1]
        z, value = np.float64(depth[v, u]), np.nan
        if z > 0:
            x, y = (u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z
            value = _point(
                x, y, z, log_peak, local, extent, m, features, prior_weight, prior_mean, near_radius, far_radius, gaps,
                nearest, sums,
            )  # fmt: skip
        out[i] = value
        for g in range(sums.size):
            out_f[g, i] = sums[g] if z > 0 else np.nan


@part
def _prepared(components, n, sigmas):
    """Log peak density [n], mean and whitening [n, 9], and half the sides of the components' boxes [n, 3]."""
    log_peak, local, extent = empty(n, np.float64), empty((n, 9), np.float64), empty((n, 3), np.float64)
    whitened = empty((WHITENED, n), np.float64)
    whiten(components, n, whitened)
    for k in range(n):
        log_peak[k] = math.log(whitened[PEAK, k]) - HALF_LOG_TWO_PI_CUBED
        for i in range(3):
            local[k, i] = components[i, k]
            extent[k, i] = sigmas * math.sqrt(components[COVARIANCE + 4 * i, k])
        for i in range(6):
            local[k, 3 + i] = whitened[i, k]
    return log_peak, local, extent


@part
def _point(
    x, y, z, log_peak, local, extent, m, features, prior_weight, prior_mean, near_radius, far_radius, gaps,
    nearest, sums,
):  # fmt: skip
    """The regression at one point; writes its features to ``sums`` [F]."""
    count, least = 0, np.inf
    for k in range(m.size):
        gap = abs(z - local[k, 2]) - extent[k, 2]
        gap = max(gap, abs(x - local[k, 0]) - extent[k, 0], abs(y - local[k, 1]) - extent[k, 1])
        if gap <= far_radius:
            gaps[count], nearest[count] = gap, k
            count += 1
            least = min(least, gap)
    radius = near_radius if least <= near_radius else far_radius
    evidence, total = prior_weight, prior_weight * prior_mean
    for g in range(sums.size):
        sums[g] = 0.0
    for j in range(count):
        if gaps[j] > radius:
            continue
        k = nearest[j]
        dx, dy, dz = x - local[k, 0], y - local[k, 1], z - local[k, 2]
        y0 = local[k, 3] * dx
        y1 = local[k, 4] * dx + local[k, 5] * dy
        y2 = local[k, 6] * dx + local[k, 7] * dy + local[k, 8] * dz
        w = math.exp(log_peak[k] - 0.5 * (y0 * y0 + y1 * y1 + y2 * y2))
        evidence += w
        total += w * m[k]
        for g in range(sums.size):
            sums[g] += w * features[k, g]
    for g in range(sums.size):
        sums[g] /= evidence
    return total / evidence
