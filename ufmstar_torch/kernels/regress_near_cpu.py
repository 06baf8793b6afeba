"""The paper's neighbourhood regression on the CPU (numba), at every pixel and at points."""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, kernel, part
from ufmstar_torch.kernels.regress_cull_cpu import HALF_LOG_TWO_PI_CUBED


@kernel
def near_image(
    depth, K, mean, covariance, weight, m, features, prior_weight, prior_mean, sigmas, near, far, out, out_f,
    first, shares,
):  # fmt: skip
    """One stream, depth [H, W] into out [H, W] and out_f [F, H, W]; of the rows every ``shares``-th, from ``first``."""
    index, log_peak, local, extent = _components(mean, covariance, weight, sigmas)
    gaps, kept, sums = empty(index.size, np.float64), empty(index.size, np.int64), empty(features.shape[1], np.float64)
    for v in range(first, depth.shape[0], shares):
        for u in range(depth.shape[1]):
            if depth[v, u] > 0:
                z = np.float64(depth[v, u])
                x, y = (u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z
                out[v, u] = _point(
                    x, y, z, index, log_peak, local, extent, m, features, prior_weight, prior_mean, near, far, gaps,
                    kept, sums,
                )  # fmt: skip
            else:
                out[v, u] = np.nan
            for g in range(sums.size):
                out_f[g, v, u] = sums[g] if depth[v, u] > 0 else np.nan


@kernel
def near_points(points, mean, covariance, weight, m, features, prior_weight, prior_mean, sigmas, near, far, out, out_f):
    """At points [P, 3] into out [P] and out_f [F, P]; NaN where a point is not finite."""
    index, log_peak, local, extent = _components(mean, covariance, weight, sigmas)
    gaps, kept, sums = empty(index.size, np.float64), empty(index.size, np.int64), empty(features.shape[1], np.float64)
    for p in range(points.shape[0]):
        x, y, z = np.float64(points[p, 0]), np.float64(points[p, 1]), np.float64(points[p, 2])
        known = x + y + z
        finite = known - known == 0
        value = _point(
            x, y, z, index, log_peak, local, extent, m, features, prior_weight, prior_mean, near, far, gaps, kept, sums
        )
        out[p] = value if finite else np.nan
        for g in range(sums.size):
            out_f[g, p] = sums[g] if finite else np.nan


@part
def _components(mean, covariance, weight, sigmas):
    """Occupied components: index, log peak density, mean and whitening [K, 9], and half the sides of their boxes."""
    index, whitening, log_peak = _prepare(_slots_in_use(weight), mean, covariance, weight)
    local, extent = empty((index.size, 9), np.float64), empty((index.size, 3), np.float64)
    for k in range(index.size):
        for i in range(3):
            local[k, i] = mean[index[k], i]
            extent[k, i] = sigmas * math.sqrt(covariance[index[k], i, i])
        for i in range(6):
            local[k, 3 + i] = whitening[k, i]
    return index, log_peak, local, extent


@part
def _prepare(index, mean, covariance, weight):
    """Index, inverse Cholesky factor (row by row, 6 numbers) and log peak density of some occupied components [n]."""
    whitening = empty((index.size, 6), np.float64)
    log_peak = empty(index.size, np.float64)
    for i in range(index.size):
        S = covariance[index[i]]
        least = 1e-14 * max(S[0, 0], S[1, 1], S[2, 2])  # fusion keeps pivots far above it
        l00 = math.sqrt(max(S[0, 0], least))
        l10, l20 = S[1, 0] / l00, S[2, 0] / l00
        l11 = math.sqrt(max(S[1, 1] - l10 * l10, least))
        l21 = (S[2, 1] - l20 * l10) / l11
        l22 = math.sqrt(max(S[2, 2] - l20 * l20 - l21 * l21, least))
        whitening[i, 0] = 1 / l00
        whitening[i, 1], whitening[i, 2] = -l10 / (l00 * l11), 1 / l11
        whitening[i, 4], whitening[i, 5] = -l21 / (l11 * l22), 1 / l22
        whitening[i, 3] = -(l20 * whitening[i, 0] + l21 * whitening[i, 1]) / l22
        log_peak[i] = math.log(weight[index[i]] / (l00 * l11 * l22)) - HALF_LOG_TWO_PI_CUBED
    return index, whitening, log_peak


@part
def _slots_in_use(weight):
    """Indices of positive weights; ``np.flatnonzero`` takes longer to compile."""
    index, n = empty(weight.size, np.int64), 0
    for k in range(weight.size):
        index[n] = k
        n += weight[k] > 0
    return index[:n]


@part
def _point(x, y, z, index, log_peak, local, extent, m, features, prior_weight, prior_mean, near, far, gaps, kept, sums):
    """The regression at one point; its features are left in ``sums`` [F]."""
    count, least = 0, np.inf
    for k in range(index.size):
        gap = abs(z - local[k, 2]) - extent[k, 2]
        gap = max(gap, abs(x - local[k, 0]) - extent[k, 0], abs(y - local[k, 1]) - extent[k, 1])
        if gap <= far:
            gaps[count], kept[count] = gap, k
            count += 1
            least = min(least, gap)
    radius = near if least <= near else far
    evidence, total = prior_weight, prior_weight * prior_mean
    for g in range(sums.size):
        sums[g] = 0.0
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
    for g in range(sums.size):
        sums[g] /= evidence
    return total / evidence
