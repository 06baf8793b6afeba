"""Gaussian mixture regression at points of any kind on the CPU (numba), the exact sum with culling that costs no bit.

A component is left out at a point where it would add less than eps pi_0 / K to the denominator. Outside of an
axis-aligned box around its mean that is so everywhere: points are sorted by place, and each handful of neighbours
looks only at the components whose boxes meet its own.
"""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, kernel, part, zeros

_LEAF = 16  # points; below that choosing components costs more than it saves
HALF_LOG_TWO_PI_CUBED = 1.5 * math.log(2 * math.pi)


@part
def prepare(index, mean, covariance, weight):
    """Of some occupied components [n]: index, inverse Cholesky factor (row by row, 6 numbers) and log peak density."""
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
def slots_in_use(weight):
    """Indices of positive weights; ``np.flatnonzero`` takes longer to compile."""
    index, n = empty(weight.size, np.int64), 0
    for k in range(weight.size):
        index[n] = k
        n += weight[k] > 0
    return index[:n]


@kernel
def at_points(points, mean, covariance, weight, m, features, prior_weight, prior_mean, epsilon, out, out_f):
    """Regress m [K] and features [K, F] at points [P, 3] into out [P] and out_f [F, P]; NaN where a point is not
    finite."""
    index, whitening, log_peak = prepare(slots_in_use(weight), mean, covariance, weight)
    limit = math.log(epsilon * prior_weight / max(index.size, 1))
    boxes = _boxes(mean, covariance, index, log_peak, limit)
    everyone = np.arange(points.shape[0])
    near = _touched(points, everyone, np.arange(index.size), boxes)
    order, leaf = _by_place(points, everyone, near.size)
    sums = zeros(features.shape[1], np.float64)
    for first in range(0, order.size, leaf):
        kept = _touched(points, order[first : first + leaf], near, boxes)
        for p in order[first : first + leaf]:
            x, y, z = np.float64(points[p, 0]), np.float64(points[p, 1]), np.float64(points[p, 2])
            evidence, total = prior_weight, prior_weight * prior_mean
            sums[:] = 0
            for j in kept:
                k, W = index[j], whitening[j]
                dx, dy, dz = x - mean[k, 0], y - mean[k, 1], z - mean[k, 2]
                y0, y1, y2 = W[0] * dx, W[1] * dx + W[2] * dy, W[3] * dx + W[4] * dy + W[5] * dz
                exponent = log_peak[j] - 0.5 * (y0 * y0 + y1 * y1 + y2 * y2)
                if exponent < limit:
                    continue
                w = math.exp(exponent)
                evidence += w
                total += w * m[k]
                for g in range(sums.size):
                    sums[g] += w * features[k, g]
            known = x + y + z
            out[p] = total / evidence if known - known == 0 else np.nan
            for g in range(sums.size):
                out_f[g, p] = sums[g] / evidence if known - known == 0 else np.nan


@part
def _boxes(mean, covariance, index, log_peak, limit):
    """Per component the box [2, 3] (least and greatest corner) outside of which it adds less than ``limit``.

    log_peak - q/2 >= limit is an ellipsoid q <= r^2, which spans r sqrt(Sigma_ii) along axis i. The boxes are a
    millionth larger, far more than the rounding of q: culling by them changes no bit of the result. A component whose
    peak is too low has an empty box.
    """
    boxes = empty((index.size, 2, 3), np.float64)
    for j in range(index.size):
        S, square = covariance[index[j]], 2 * (log_peak[j] - limit)
        least = 1e-14 * max(S[0, 0], S[1, 1], S[2, 2])  # as in prepare
        for i in range(3):
            half = math.sqrt(square * (S[i, i] + least)) * (1 + 1e-6) if square >= 0 else -np.inf
            boxes[j, 0, i], boxes[j, 1, i] = mean[index[j], i] - half, mean[index[j], i] + half
    return boxes


@part
def _touched(points, chosen, candidates, boxes):
    """Those candidates, in their order, whose box meets the bounding box of the chosen points."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for p in chosen:
        for i in range(3):
            value = np.float64(points[p, i])
            if value - value == 0:
                low[i], high[i] = min(low[i], value), max(high[i], value)
    kept = empty(candidates.size, np.int64)
    n = 0
    for j in candidates:
        x = boxes[j, 0, 0] <= high[0] and low[0] <= boxes[j, 1, 0]
        y = boxes[j, 0, 1] <= high[1] and low[1] <= boxes[j, 1, 1]
        if x and y and boxes[j, 0, 2] <= high[2] and low[2] <= boxes[j, 1, 2]:
            kept[n] = j
            n += 1
    return kept[:n]


@part
def _by_place(points, everyone, components):
    """Points in the order of a k-d tree, and how many of them, next to each other, make a leaf.

    The more components there are, the more a leaf's own selection of them saves; a level of the tree costs a
    point about as much as some tens of components.
    """
    order, leaf = everyone.copy(), max(everyone.size, 1)
    levels = min(6, components // 64)
    while levels > 0 and leaf > _LEAF:
        levels -= 1
        for first in range(0, order.size, leaf):
            widest, axis = -1.0, 0
            for i in range(3):
                low, high = np.inf, -np.inf
                for p in order[first : first + leaf]:
                    value = np.float64(points[p, i])
                    if value - value == 0:
                        low, high = min(low, value), max(high, value)
                if high - low > widest:
                    widest, axis = high - low, i
            _sort_along(points, axis, order[first : first + leaf])
        leaf = (leaf + 1) // 2
    return order, leaf


@part
def _sort_along(points, axis, order):
    """Sort numbers of points by a coordinate, NaN last, in place (heapsort): ``np.argsort``, and a slice assignment,
    take seconds to compile."""
    n = order.size
    for first in range(n // 2 - 1, -1, -1):
        _sift(points, axis, order, first, n)
    for last in range(n - 1, 0, -1):
        order[0], order[last] = order[last], order[0]
        _sift(points, axis, order, 0, last)


@part
def _sift(points, axis, order, root, n):
    """Let the root of a heap of n numbers sink to its place."""
    while 2 * root + 1 < n:
        child = 2 * root + 1
        if child + 1 < n and _before(points[order[child], axis], points[order[child + 1], axis]):
            child += 1
        if not _before(points[order[root], axis], points[order[child], axis]):
            return
        order[root], order[child] = order[child], order[root]
        root = child


@part
def _before(a, b):
    return a < b or (b != b and a == a)
