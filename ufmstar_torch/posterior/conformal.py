"""Corrects the levels of intervals by the errors at held-out anchors: adaptive conformal inference.

The score of a held-out anchor is |z|, its error in the posterior's mixture expressed in standard deviations of a normal
distribution (``distribution``). For each level L, t_L is tracked so that the share 1 - L of the scores exceeds it
(Gibbs and Candes, "Adaptive Conformal Inference Under Distribution Shift", 2021, with the quantile as the adapted
value):

    log t_L <- log t_L + step (share of the frame's scores above t_L - (1 - L)) / slope,

with step = max(rate, 1/(n + 3)). n counts frames with scores; the constant rate forgets old ones. ``slope`` is the
change of the share per unit of log t for a normal distribution, so that all levels adapt at the same rate.

A held-out anchor is farther from the others than most pixels are. Each score therefore has as weight the share of the
image at its distance from evidence, relative to the share of the scores there.
At pixels the quantile is

    ``TRANSFER`` normal value (t_L/normal value)^``TRUST``.

Over tours, the quantile at a clip's pixels varies less than that at its held-out anchors and does not follow it. So
half of the change of log t_L counts: a large error at the anchors widens the intervals, noise changes them little.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from ufmstar_torch.kernels.compile_cpu import leaf
from ufmstar_torch.posterior.distribution import LEVELS, NORMAL, TAIL
from ufmstar_torch.posterior.moments import normal_below
from ufmstar_torch.posterior.running import LARGEST_FACTOR, LEAST_FACTOR

# Twice |z| times its normal density at the levels: d level / d log |z|.
_SLOPE: Final = tuple(2 * z * math.exp(-z * z / 2) / math.sqrt(2 * math.pi) for z in NORMAL)
# Factors from the scores' quantiles to the pixels', fitted on tours (docs/measure_thresholds.py --fit), and exponent of
# the scores' quantiles over the normal ones.
TRANSFER: Final = (0.88, 1.1, 1.02)
TRUST: Final = 0.5
RATE: Final = 0.1  # step of the adaptation in frames with many scores
PRIOR: Final = 3.0  # number of frames that the start counts for
FEW: Final = 20.0  # number of scores of a frame at which its step is halved
LEAST_FRAMES: Final = 3  # frames with scores before intervals exist
# Upper bounds of the classes of distance from evidence in which scores are weighted [image widths].
DISTANCES: Final = (0.015, 0.05, 0.12, 0.25, math.inf)
MOST_WEIGHT: Final = 10.0  # largest weight of a score over the mean


@leaf
def adapt(state, below, weights):
    """Change the state of one stream after a frame.

    Args:
        state: [4] number of frames with scores, and log(t_L / normal value) by level; zeros at the start. Unchanged if
            no score has a weight.
        below: [M] CDF of the posterior at the frame's held-out anchors, whose scores are |z| of it.
        weights: [M] not negative.
    """
    total = 0.0
    for k in range(weights.size):
        total += weights[k]
    if not total > 0:
        return
    state[0] += 1
    step = max(RATE, 1 / (state[0] + PRIOR)) * below.size / (below.size + FEW)
    for i in range(len(LEVELS)):
        tail, above = normal_below(-NORMAL[i] * math.exp(state[1 + i])), 0.0
        for k in range(below.size):
            if tail > TAIL and (below[k] < tail or 1 - below[k] < tail):
                above += weights[k]
        log = state[1 + i] + step * (above / total - (1 - LEVELS[i])) / _SLOPE[i]
        state[1 + i] = min(max(log, math.log(LEAST_FACTOR)), math.log(LARGEST_FACTOR))


@leaf
def weigh(distance, area, everywhere, weights):
    """Write weights of scores that make their distances from evidence distributed as those of the image.

    Args:
        distance: [M] from evidence [image widths].
        area: [M] weights by area of the image, not negative.
        everywhere: [n] distances of nodes spread evenly over the image.
        weights: [M] written; zeros if no score has an area.
    """
    total, low = 0.0, -math.inf
    for k in range(area.size):
        total += area[k]
    for i in range(len(DISTANCES)):
        high, shown, wanted = DISTANCES[i], 0.0, 0
        for k in range(area.size):
            shown += area[k] if low < distance[k] <= high else 0.0
        for k in range(everywhere.size):
            wanted += low < everywhere[k] <= high
        ratio = wanted / everywhere.size * total / shown if shown > 0 else 0.0
        for k in range(area.size):
            if low < distance[k] <= high:
                weights[k] = area[k] * min(ratio, MOST_WEIGHT)
        low = high


@leaf
def quantiles(state, out):
    """Write |z| at the levels for pixels, increasing, to ``out`` [3], from the state [4] of :func:`adapt`; NaN
    before ``LEAST_FRAMES`` frames with scores."""
    largest = 0.0
    for i in range(len(LEVELS)):
        largest = max(largest, math.exp(TRUST * state[1 + i]) * NORMAL[i] * TRANSFER[i])
        out[i] = largest if state[0] >= LEAST_FRAMES else np.nan
