"""The loops over pixels: what a frame adds to the states of each metric, compiled for the processor.

Every loop takes depth d [m], variance v [m^2] and ground truth g [m], [P] float64 each, and a mask ``use`` [P] (True =
use), then the metric's constants, then the states of the metric (0-d arrays for scalars), to which it adds. g counts
where it is positive and finite, d where it is finite, v where it is finite and >= 0.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ufmstar_torch.kernels.compile_cpu import kernel, part

# Variances and squared errors [m^2] between (0.1 mm)^2 and (100 m)^2 are distinguished; 0 and what is
# smaller share the bin below, what is larger the bin above. Relative errors use the same bins.
LOW, HIGH = 1e-8, 1e4
_RANGE = math.log(HIGH / LOW)
_LOG_TWO_PI = math.log(2 * math.pi)


@kernel
def add_delta1(
    depth: Any, variance: Any, target: Any, use: Any, tolerance: float,
    hits: Any, hits_ratio: Any, pixels: Any, with_truth: Any,
) -> None:  # fmt: skip
    """Hits |d - g| <= tolerance g, hits max(d/g, g/d) < 1 + tolerance, pixels, and those with any ground truth."""
    for i in range(len(depth)):
        d, g = depth[i], target[i]
        if use[i] and _is_truth(g):
            with_truth[()] += 1
            if np.isfinite(d):
                pixels[()] += 1
                hits[()] += int(abs(d - g) <= tolerance * g)
                hits_ratio[()] += int(d > 0 and max(d / g, g / d) < 1 + tolerance)


@kernel
def add_errors(
    depth: Any, variance: Any, target: Any, use: Any, squared: bool, total: Any, pixels: Any
) -> None:  # fmt: skip
    """The sum of (d - g)^2 [m^2] or |d - g| / g, and the number of pixels."""
    added = 0.0
    for i in range(len(depth)):
        d, g = depth[i], target[i]
        if use[i] and _is_truth(g) and np.isfinite(d):
            error = abs(d - g)
            added += error * error if squared else error / g
            pixels[()] += 1
    total[()] += added


@kernel
def add_nll(
    depth: Any, variance: Any, target: Any, use: Any, total: Any, pixels: Any, with_truth: Any
) -> None:  # fmt: skip
    """The sum of the NLL over v > 0, the number of these pixels, and that of all with ground truth."""
    added = 0.0
    for i in range(len(depth)):
        d, v, g = depth[i], variance[i], target[i]
        if use[i] and _is_truth(g):
            with_truth[()] += 1
            if _is_prediction(d, v) and v > 0:
                added += gaussian_nll(d, v, g)
                pixels[()] += 1
    total[()] += added


@kernel
def add_entropy(
    depth: Any, variance: Any, target: Any, use: Any, edges: Any, counts: Any, total: Any, pixels: Any
) -> None:  # fmt: skip
    """Counts [E + 1] of the entropy between rising, equally spaced edges [E] [nats], its sum over v > 0, and the number
    of these pixels. Ground truth is not needed."""
    added = 0.0
    for i in range(len(depth)):
        d, v = depth[i], variance[i]
        if use[i] and _is_prediction(d, v):
            h = 0.5 * (_LOG_TWO_PI + 1.0 + math.log(v)) if v > 0 else -np.inf
            counts[_entropy_bin(h, edges)] += 1
            if v > 0:
                added += h
                pixels[()] += 1
    total[()] += added


@kernel
def add_ece_delta(
    depth: Any, variance: Any, target: Any, use: Any, delta: float, confidence: Any, accurate: Any, pixels: Any
) -> None:  # fmt: skip
    """Count by bin [B] of the confidence: its sum, the pixels with |g - d| <= delta |d|, and all pixels. Bin b is
    [b/B, (b+1)/B); a confidence of exactly 1 belongs to the last."""
    for i in range(len(depth)):
        d, v, g = depth[i], variance[i], target[i]
        if use[i] and _is_truth(g) and _is_prediction(d, v):
            share = interval_confidence(d, v, delta)
            b = min(int(share * len(pixels)), len(pixels) - 1)
            confidence[b] += share
            accurate[b] += abs(g - d) <= delta * abs(d)
            pixels[b] += 1


@kernel
def add_ece_quantile(
    depth: Any, variance: Any, target: Any, use: Any, thresholds: Any, at_or_below: Any, pixels: Any
) -> None:  # fmt: skip
    """Pixels whose ground truth lies at or below d + sqrt(v) thresholds [L], rising, and all pixels. Where v = 0 every
    quantile is d itself."""
    first = np.zeros(len(thresholds) + 1, np.int64)
    for i in range(len(depth)):
        d, v, g = depth[i], variance[i], target[i]
        if use[i] and _is_truth(g) and _is_prediction(d, v):
            z = (g - d) / math.sqrt(v) if v > 0 else -np.inf if g <= d else np.inf
            first[np.searchsorted(thresholds, z)] += 1
            pixels[()] += 1
    below = 0
    for level in range(len(thresholds)):
        below += first[level]
        at_or_below[level] += below


@kernel
def add_sparsification(
    depth: Any, variance: Any, target: Any, use: Any, count: Any, count_squared: Any, count_relative: Any,
    squared: Any, relative: Any, sum_squared: Any, sum_relative: Any,
) -> None:  # fmt: skip
    """Add by bin [bins + 2] of v: pixels, (d - g)^2 [m^2], |d - g| / g; pixels and sums by bin of these errors, too."""
    bins = len(count) - 2
    for i in range(len(depth)):
        d, v, g = depth[i], variance[i], target[i]
        if use[i] and _is_truth(g) and _is_prediction(d, v):
            e = abs(d - g)
            s, r = e * e, e / g
            b = log_bin(v, bins)
            count[b] += 1
            squared[b] += s
            relative[b] += r
            b = log_bin(s, bins)
            count_squared[b] += 1
            sum_squared[b] += s
            b = log_bin(r, bins)
            count_relative[b] += 1
            sum_relative[b] += r


@kernel
def add_joint(depth: Any, variance: Any, target: Any, use: Any, joint: Any) -> None:
    """Pixels by bins of v and of (d - g)^2 [bins + 2, bins + 2]."""
    bins = len(joint) - 2
    for i in range(len(depth)):
        d, v, g = depth[i], variance[i], target[i]
        if use[i] and _is_truth(g) and _is_prediction(d, v):
            joint[log_bin(v, bins), log_bin((d - g) * (d - g), bins)] += 1


@kernel
def add_nll_by_error(
    depth: Any, variance: Any, target: Any, use: Any, count: Any, nll: Any
) -> None:  # fmt: skip
    """Add the pixels and their NLL by bin [bins + 2] of (d - g)^2, over v > 0."""
    for i in range(len(depth)):
        d, v, g = depth[i], variance[i], target[i]
        if use[i] and _is_truth(g) and _is_prediction(d, v) and v > 0:
            b = log_bin((d - g) * (d - g), len(count) - 2)
            count[b] += 1
            nll[b] += gaussian_nll(d, v, g)


@part
def _is_truth(g: float) -> bool:
    return g > 0 and g < np.inf


@part
def _is_prediction(d: float, v: float) -> bool:
    return np.isfinite(d) and v >= 0 and v < np.inf


@part
def gaussian_nll(d: float, v: float, g: float) -> float:
    """(g - d)^2 / (2 v) + 0.5 ln(2 pi v), v > 0 [nats]."""
    return (g - d) * (g - d) / (2 * v) + 0.5 * (_LOG_TWO_PI + math.log(v))


@part
def interval_confidence(d: float, v: float, delta: float) -> float:
    """Mass of N(d, v) on [(1 - delta) d, (1 + delta) d] = erf(delta |d| / sqrt(2 v)).

    v = 0 is a point mass at d, which the interval holds: 1. A depth d <= 0 mirrors the interval.
    """
    return math.erf(delta * abs(d) / (math.sqrt(2.0) * math.sqrt(v))) if v > 0 else 1.0


@part
def log_bin(value: float, bins: int) -> int:
    """Bin in [0, bins + 1] of a value >= 0: 0 below ``LOW``, bins + 1 from ``HIGH`` on."""
    if value < LOW:
        return 0
    at = math.log(value / LOW) * (bins / _RANGE)
    return bins + 1 if at >= bins else int(at) + 1


@part
def _entropy_bin(h: float, edges: Any) -> int:
    """The number of bin edges that are at most h."""
    if not h >= edges[0]:
        return 0
    if h >= edges[-1]:
        return len(edges)
    b = min(int((h - edges[0]) / (edges[1] - edges[0])) + 1, len(edges) - 1)
    while h < edges[b - 1]:
        b -= 1
    while h >= edges[b]:
        b += 1
    return b
