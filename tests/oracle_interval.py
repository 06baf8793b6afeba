"""Intervals of a mixture of normal distributions, and their correction, for one pixel or stream, with math alone."""

from __future__ import annotations

import itertools
import math

NORMAL = {0.5: 0.6744897501960817, 0.9: 1.6448536269514722, 0.99: 2.5758293035489004}
TRANSFER = {0.5: 0.88, 0.9: 1.1, 0.99: 1.02}


def phi(z: float) -> float:
    return math.erfc(-z / math.sqrt(2)) / 2


def probability_below(components, x: float) -> float:
    """The probability that a positive depth is below x; ``components`` are (weight, mean, variance)."""

    def below(x: float) -> float:
        return sum(w * phi((x - mean) / math.sqrt(variance)) for w, mean, variance in components)

    return (below(x) - below(0.0)) / (1 - below(0.0))


def inverse(function, value: float, low: float, high: float) -> float:
    """The argument at which an increasing function has the value, by bisection."""
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if function(middle) < value else (low, middle)
    return (low + high) / 2


def standard(components, x: float) -> float:
    return inverse(phi, probability_below(components, x), -12.0, 12.0)


def corrected(z: float, quantiles) -> float:
    """The normal z of a mixture's z; ``quantiles``: |z| at 50, 90, 99 %."""
    knots, size = [(0.0, 0.0), *zip(quantiles, NORMAL.values(), strict=True)], abs(z)
    for (x0, y0), (x1, y1) in itertools.pairwise(knots):
        if size <= x1:
            return math.copysign(y0 + (size - x0) / (x1 - x0) * (y1 - y0), z)
    return math.copysign(size * knots[-1][1] / knots[-1][0], z)


def probability_nearer(components, x: float, quantiles) -> float:
    return phi(corrected(standard(components, x), quantiles))


def interval(components, level: float, quantiles) -> tuple[float, float]:
    ends = []
    for tail in ((1 - level) / 2, (1 + level) / 2):
        ends.append(inverse(lambda x, t=tail: probability_nearer(components, x, quantiles) - t, 0.0, 1e-9, 1e3))
    return ends[0], ends[1]


def updated(state, scores, weights):
    """The state [frames, log ratios] after a frame with scores."""
    if sum(weights) <= 0:
        return list(state)
    frames, after = state[0] + 1, []
    step = max(0.1, 1 / (frames + 3)) * len(scores) / (len(scores) + 20)
    for (level, normal), log in zip(NORMAL.items(), state[1:], strict=True):
        above = sum(w for s, w in zip(scores, weights, strict=True) if s > normal * math.exp(log)) / sum(weights)
        slope = 2 * normal * math.exp(-normal * normal / 2) / math.sqrt(2 * math.pi)
        after.append(min(max(log + step * (above - (1 - level)) / slope, math.log(0.1)), math.log(10)))
    return [frames, *after]


def weights(distance, area, everywhere):
    """Weights that give the scores the image's distances from evidence."""
    bounds = [-1.0, 0.015, 0.05, 0.12, 0.25, math.inf]
    result = []
    for one, a in zip(distance, area, strict=True):
        low, high = next((lo, hi) for lo, hi in itertools.pairwise(bounds) if lo < one <= hi)
        wanted = sum(low < x <= high for x in everywhere) / len(everywhere)
        shown = sum(x for d, x in zip(distance, area, strict=True) if low < d <= high) / sum(area)
        result.append(a * min(wanted / shown, 10.0))
    return result


def quantiles(state):
    levels = zip(NORMAL.values(), state[1:], TRANSFER.values(), strict=True)
    values = [z * math.exp(log / 2) * f for z, log, f in levels]
    return [max(values[: i + 1]) if state[0] >= 3 else math.nan for i in range(3)]
