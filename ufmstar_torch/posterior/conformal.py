"""Corrects the levels of intervals by the errors at held-out anchors: adaptive conformal inference.

The score of a held-out anchor is |z|, its error in the posterior's mixture expressed in standard deviations of a normal
distribution (``distribution``). For each level L, t_L is tracked so that the share 1 - L of the scores exceeds it
(Gibbs and Candes, "Adaptive Conformal Inference Under Distribution Shift", 2021, with the quantile as the adapted
value):

    log t_L <- log t_L + step (share of the frame's scores above t_L - (1 - L)) / slope,

with step = max(rate, 1/(n + 3)). n counts frames with scores.
``slope`` is the change of the share per unit of log t for a normal distribution, so that
all levels adapt at the same rate; the constant rate forgets old frames. A frame with few scores takes a smaller step.

Anchors lie on textured surfaces, and a held-out one is farther from the others than most pixels are. Each score
therefore has as weight the share of the image at its distance from evidence, relative to the share of the scores there.
At pixels the quantile is

    ``TRANSFER`` normal value (t_L/normal value)^``TRUST``.

Over tours, the quantile at a clip's pixels varies less than that at its held-out anchors and does not follow it. So
half of the change of log t_L counts: a large error at the anchors widens the intervals, noise changes them little.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Floats = NDArray[np.float64]
LEVELS: Final = (0.5, 0.9, 0.99)
# |z| of the normal distribution at the levels, and twice |z| times its density there: d level / d log |z|.
NORMAL: Final = (0.6744897501960817, 1.6448536269514722, 2.5758293035489004)
_SLOPE: Final = np.array([2 * z * math.exp(-z * z / 2) / math.sqrt(2 * math.pi) for z in NORMAL])
# Factors from the scores' quantiles to the pixels', fitted on tours (docs/measure_thresholds.py --fit), and exponent of
# the scores' quantiles over the normal ones.
TRANSFER: Final = (0.91, 1.11, 1.05)
TRUST: Final = 0.5
RATE: Final = 0.1  # step of the adaptation in frames with many scores
PRIOR: Final = 3.0  # number of frames that the start counts for
FEW: Final = 20.0  # number of scores of a frame at which its step is halved
LEAST_FRAMES: Final = 3  # frames with scores before intervals exist
# Limits of t_L over its normal value.
LEAST, LARGEST = 0.1, 10.0
SIZE: Final = 1 + len(LEVELS)
# As arrays: |z| at the levels of the normal distribution, the same at pixels, and the shares beyond the levels.
_NORMAL, _AT_PIXELS, _BEYOND = np.array(NORMAL), np.multiply(NORMAL, TRANSFER), 1 - np.array(LEVELS)
# Bounds of the classes of distance from evidence in which scores are weighted [image widths].
DISTANCES: Final = (0.015, 0.05, 0.12, 0.25)
# Largest weight of a score over the mean.
MOST_WEIGHT: Final = 10.0


def after_frame(states: Tensor, scores: Sequence[Tensor]) -> Tensor:
    """The states [B, 4] after a frame with ``scores``, for each stream [2, M] scores and weights; () = unchanged."""
    if not scores:
        return states
    rows = [updated(s, *one.numpy()) for s, one in zip(states.cpu().numpy(), scores, strict=True)]
    return torch.from_numpy(np.stack(rows)).to(states.device)


def require(states: Tensor) -> None:
    """Raise a ValueError if no scores can have led to the states [B, 4]."""
    frames, logs = states[:, 0], states[:, 1:]
    if bool((frames < 0).any() | (frames != frames.round()).any() | (logs.abs() > math.log(LARGEST) + 1e-9).any()):
        raise ValueError("intervals holds impossible values: a number of frames, and logs of factors from .1 to 10")


def updated(state: Floats, scores: Floats, weights: Floats) -> Floats:
    """The state of one stream after a frame.

    Args:
        state: [4] number of frames with scores, and log(t_L / normal value) by level; zeros at the start.
        scores: [N] |z| of the frame's held-out anchors.
        weights: [N] not negative.

    Returns:
        [4] unchanged if no score has a weight.
    """
    total = weights.sum()
    if not total > 0:
        return state
    frames, logs = state[0] + 1, state[1:]
    above = ((scores[:, None] > _NORMAL * np.exp(logs)) * weights[:, None]).sum(0) / total
    step = max(RATE, 1 / (frames + PRIOR)) * len(scores) / (len(scores) + FEW)
    logs = logs + step * (above - _BEYOND) / _SLOPE
    return np.concatenate([[frames], logs.clip(math.log(LEAST), math.log(LARGEST))])


def image_weights(distance: Floats, area: Floats, everywhere: Floats) -> Floats:
    """Weights of scores that make their distances from evidence distributed as those of the image.

    Args:
        distance: [N] from evidence [image widths].
        area: [N] weights by area of the image, not negative.
        everywhere: [M] distances of nodes spread evenly over the image.

    Returns:
        [N] weights; zeros without a score that has an area.
    """
    kind, count = np.searchsorted(DISTANCES, distance), len(DISTANCES) + 1
    shown = np.bincount(kind, area, count)
    wanted = np.bincount(np.searchsorted(DISTANCES, everywhere), minlength=count) / max(len(everywhere), 1)
    ratio = wanted * shown.sum() / np.where(shown > 0, shown, np.inf)
    weights: Floats = area * np.minimum(ratio, MOST_WEIGHT)[kind]
    return weights


def quantiles(state: Tensor) -> Tensor:
    """[B, 3] |z| at the levels for pixels, increasing; NaN before ``LEAST_FRAMES`` frames with scores.

    Args:
        state: [B, 4] as in :func:`updated`.
    """
    if state.device.type == "meta":
        return state.new_empty(len(state), len(LEVELS))
    values = state.cpu().numpy()
    at_pixels = np.maximum.accumulate(np.exp(TRUST * values[:, 1:]) * _AT_PIXELS, axis=1)
    return torch.from_numpy(np.where(values[:, :1] >= LEAST_FRAMES, at_pixels, np.nan)).to(state.device)


def normal_where_missing(quantiles: Tensor | None, variance: Tensor) -> Tensor:
    """[B, 3] the quantiles, the normal distribution's where they are NaN or None; ``variance``: [B, ...]."""
    if quantiles is None:
        return variance.new_tensor(NORMAL).expand(len(variance), len(NORMAL))
    return torch.where(quantiles.isnan(), quantiles.new_tensor(NORMAL), quantiles)


def corrected(size: Tensor, quantiles: Tensor) -> Tensor:
    """|z| of the normal distribution for |z| = ``size`` [B, ...]: linear between 0 and the ``quantiles`` [3, B, ...],
    proportional beyond the last."""
    return _linear(size, quantiles, _normal(quantiles))


def uncorrected(size: Tensor, quantiles: Tensor) -> Tensor:
    """Inverse of :func:`corrected`."""
    return _linear(size, _normal(quantiles), quantiles)


def _normal(quantiles: Tensor) -> Tensor:
    """``NORMAL`` in the shape of ``quantiles`` [3, B, ...]."""
    return quantiles.new_tensor(NORMAL).view(-1, *[1] * (quantiles.dim() - 1)).expand_as(quantiles)


def _linear(x: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """The increasing function with the value 0 at 0 and ``end`` at ``start`` [3, B, ...]: linear between, proportional
    beyond. NaN where ``end`` or ``start`` is."""
    result, left, bottom = x * (end[-1] / start[-1]), torch.zeros_like(start[0]), torch.zeros_like(end[0])
    for right, top in zip(start, end, strict=True):
        share = (x - left) / (right - left).clamp_min(1e-12)  # two quantiles may be equal
        result = torch.where((x >= left) & (x <= right), bottom + share * (top - bottom), result)
        left, bottom = right, top
    return result + 0 * (start + end).sum(0)
