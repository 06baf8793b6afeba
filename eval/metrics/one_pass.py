"""All sums of a sequence's metrics in one pass over the pixels, compiled for the processor.

It adds up what the metrics' own ``update`` adds up. Counts are equal, and sums to rounding: each is added in the order
of the pixels. A pixel whose figure lies within rounding of the border of two bins may be counted in the other one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.eval.metrics.pixels import require_variance
from ufmstar_torch.eval.metrics.ranking import HIGH, LOW
from ufmstar_torch.kernels.compile_cpu import kernel

_RANGE = math.log(HIGH / LOW)
_LOG_TWO_PI = math.log(2 * math.pi)


def add_in_one_pass(
    metrics: Mapping[str, Any], depth: Tensor, variance: Tensor | None, target: Tensor, valid: Tensor | None
) -> None:
    """Add frames to the metrics of a ``SequenceMetrics``, by the names of their classes.

    Args:
        metrics: with their states on the CPU.
        depth, variance, target, valid: as ``SequenceMetrics.update`` takes them, checked, on the CPU.
    """
    single = all(value.dtype == torch.float32 for value in (depth, variance, target) if value is not None)

    def flat(value: Tensor) -> NDArray[Any]:
        return value.detach().to(torch.float32 if single else torch.float64).flatten().numpy()

    d, g = flat(depth), flat(target)
    use = np.zeros(0, np.bool_) if valid is None else valid.flatten().numpy()
    with_truth, judged, hits, ratio, relative, squared = accuracy_sums(d, g, use, metrics["Delta1"].tolerance)
    metrics["Delta1"].add(hits=hits, hits_ratio=ratio, pixels=judged, with_truth=with_truth)
    metrics["AbsRel"].add(total=relative, pixels=judged)
    metrics["RMSE"].add(total=squared, pixels=judged)
    if "NLL" not in metrics:
        return
    v = flat(require_variance(variance, "the negative log-likelihood"))
    interval, quantile, entropy = metrics["ECEDelta"], metrics["ECEQuantile"], metrics["EntropyHistogram"]
    judged, nll, likely, total, spread = uncertainty_sums(
        d, v, g, use, interval.delta, quantile.thresholds.numpy(), entropy.edges.numpy(),
        _exchanged(interval, "confidence", "accurate", "pixels"), *_exchanged(quantile, "at_or_below"),
        *_exchanged(entropy, "counts"),
    )  # fmt: skip
    metrics["NLL"].add(total=nll, pixels=likely, with_truth=with_truth)
    quantile.add(pixels=judged)
    entropy.add(total=total, pixels=spread)
    if "Sparsification" not in metrics:
        return
    by = partial(_exchanged, metrics["Sparsification"])
    ranking_sums(
        d, v, g, use, by("count", "squared", "relative"), by("count_squared", "sum_squared"),
        by("count_relative", "sum_relative"), *_exchanged(metrics["SpearmanCorrelation"], "joint"),
    )  # fmt: skip


def _exchanged(metric: Any, *names: str) -> tuple[NDArray[Any], ...]:
    """States to add to: copies that are the metric's own from now on. Others may hold the previous ones."""
    copies = {name: getattr(metric, name).clone() for name in names}
    for name, value in copies.items():
        setattr(metric, name, value)
    return tuple(value.numpy() for value in copies.values())


@kernel
def accuracy_sums(depth: Any, target: Any, use: Any, tolerance: float) -> tuple[int, int, int, int, float, float]:
    """Sums over the pixels with ground truth and a finite depth.

    Args:
        depth: [P] d [m].
        target: [P] g [m]; NaN, infinite or <= 0 = none.
        use: [P] bool, or [0] = everywhere.
        tolerance: of delta1.

    Returns:
        Pixels with ground truth, those of them with a finite depth, hits of delta1 in both definitions, and the sums of
        |d - g| / g and (d - g)^2 [m^2].
    """
    with_truth, judged, hits, hits_ratio, relative, squared = 0, 0, 0, 0, 0.0, 0.0
    for i in range(len(depth)):
        g = np.float64(target[i])
        if not (g > 0 and g < np.inf) or (len(use) and not use[i]):
            continue
        with_truth += 1
        d = np.float64(depth[i])
        if not np.isfinite(d):
            continue
        judged += 1
        error = abs(d - g)
        hits += int(error <= tolerance * g)
        hits_ratio += int(d > 0 and max(d / g, g / d) < 1 + tolerance)
        relative += error / g
        squared += error * error
    return with_truth, judged, hits, hits_ratio, relative, squared


@kernel
def uncertainty_sums(
    depth: Any, variance: Any, target: Any, use: Any, delta: float, thresholds: Any, edges: Any,
    intervals: tuple[Any, Any, Any], at_or_below: Any, entropies: Any,
) -> tuple[int, float, int, float, int]:  # fmt: skip
    """Sums that need a variance.

    Args:
        depth, target, use: as :func:`accuracy_sums`.
        variance: [P] v [m^2].
        delta: of the interval, relative to the depth.
        thresholds: [L] standard normal quantiles, rising.
        edges: [E] of the entropy's bins, rising by equal steps [nats].
        intervals: per bin of the confidence [B]: the sum of the confidence, accurate pixels, pixels; added to.
        at_or_below: [L] pixels at or below each quantile; added to.
        entropies: [E + 1] counts; added to.

    Returns:
        Pixels with ground truth and a usable prediction; sum and number of the NLL; sum and number of the entropy.
    """
    confidences, accurate, pixels = intervals
    first = np.zeros(len(thresholds) + 1, np.int64)
    judged, nll, likely, entropy, spread = 0, 0.0, 0, 0.0, 0
    for i in range(len(depth)):
        d, v, g = np.float64(depth[i]), np.float64(variance[i]), np.float64(target[i])
        if not (np.isfinite(d) and v >= 0 and v < np.inf) or (len(use) and not use[i]):
            continue
        log_v = math.log(v) if v > 0 else -np.inf
        h = 0.5 * (_LOG_TWO_PI + 1.0 + log_v)
        entropies[_entropy_bin(h, edges)] += 1
        if v > 0:
            entropy += h
            spread += 1
        if not (g > 0 and g < np.inf):
            continue
        judged += 1
        error, confidence, z = g - d, 1.0, -np.inf if g <= d else np.inf
        if v > 0:
            sigma = math.sqrt(v)
            z = error / sigma
            nll += error * error / (2 * v) + 0.5 * (_LOG_TWO_PI + log_v)
            likely += 1
            confidence = math.erf(delta * abs(d) / (math.sqrt(2.0) * sigma))
        first[np.searchsorted(thresholds, z)] += 1
        b = min(int(confidence * len(pixels)), len(pixels) - 1)
        confidences[b] += confidence
        accurate[b] += abs(error) <= delta * abs(d)
        pixels[b] += 1
    below = 0
    for level in range(len(thresholds)):
        below += first[level]
        at_or_below[level] += below
    return judged, nll, likely, entropy, spread


@kernel
def ranking_sums(
    depth: Any, variance: Any, target: Any, use: Any, by_variance: tuple[Any, Any, Any], by_squared: tuple[Any, Any],
    by_relative: tuple[Any, Any], joint: Any,
) -> None:  # fmt: skip
    """Sums by bins of the logarithm of variance, squared error and relative error.

    Args:
        depth, variance, target, use: as :func:`uncertainty_sums`.
        by_variance: [bins + 2] pixels, squared [m^2] and relative errors; added to.
        by_squared: [bins + 2] pixels and squared errors by squared error; added to.
        by_relative: [bins + 2] pixels and relative errors by relative error; added to.
        joint: [fewer + 2, fewer + 2] pixels by variance and squared error; added to.
    """
    count, squared, relative = by_variance
    bins, fewer = len(count) - 2, len(joint) - 2
    for i in range(len(depth)):
        d, v, g = np.float64(depth[i]), np.float64(variance[i]), np.float64(target[i])
        if not (np.isfinite(d) and v >= 0 and v < np.inf and g > 0 and g < np.inf) or (len(use) and not use[i]):
            continue
        e = abs(d - g)
        s, r = e * e, e / g
        at_v, at_s, at_r = _position(v), _position(s), _position(r)
        b = _bin(at_v, bins)
        count[b] += 1
        squared[b] += s
        relative[b] += r
        b = _bin(at_s, bins)
        by_squared[0][b] += 1
        by_squared[1][b] += s
        b = _bin(at_r, bins)
        by_relative[0][b] += 1
        by_relative[1][b] += r
        joint[_bin(at_v, fewer), _bin(at_s, fewer)] += 1


@kernel
def _position(value: float) -> float:
    """In the range of the bins, 0 to 1; -1 below it."""
    return math.log(value / LOW) if value >= LOW else -1.0


@kernel
def _bin(position: float, bins: int) -> int:
    """``ranking.log_bin`` of a position."""
    at = position * (bins / _RANGE)
    return 0 if position < 0 else bins + 1 if at >= bins else int(at) + 1


@kernel
def _entropy_bin(h: float, edges: Any) -> int:
    """How many edges are at or below h."""
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
