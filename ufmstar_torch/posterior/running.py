"""The posterior's memory of a stream: sums with a half-life, the mean slopes, the last frame's coefficients, and the
quantiles of errors at held-out anchors.

Frames with anchors update these ratios:

- amplitude: scale of the variance of the network's error
- roughness: variance of y between neighbouring pixels
- noise: factor by which the anchors' stated variances are too small
- unseen: increase of the error's variance with the distance from evidence
- wrong: probability that the local correction does not hold
- inlier: factor by which the variance is too small where the correction holds
- between: squared scale of e, by which surfaces differ (``motion``)
- centre: c, the constant about which most surfaces lie (``motion``); the only ratio that may be negative
- calibration: mean z^2 of held-out anchors

Each ratio is the quotient of two sums that fade towards a prior, so that few anchors change it little.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.kernels.compile_cpu import empty, leaf, part
from ufmstar_torch.posterior.config import PosteriorConfig
from ufmstar_torch.posterior.distribution import LEVELS

Floats = NDArray[np.float64]
FEATURES = 4  # 1, log d - m_0, u and v from -1 to 1
SLOPES = FEATURES - 1
_MATRIX = FEATURES * FEATURES
# Limits of the quantiles at held-out anchors over the normal ones.
LEAST_FACTOR, LARGEST_FACTOR = 0.1, 10.0
# Limits of stored values, beyond what any run reaches: of m_0, the log of the largest accepted depth
# (``frame.DEPTH_RANGE``); of all values, which count anchors and frames or are squares of logs.
LARGEST_LOG, LARGEST = 14.0, 1e9


RATIOS = 9
AMPLITUDE, ROUGHNESS, NOISE, UNSEEN, WRONG, INLIER, BETWEEN, CENTRE, CALIBRATION = range(RATIOS)


# A pointer to the numbers: compiled code with an argument for each of them would take longer to compile.
_RECORD = np.dtype((np.record, [(name, np.float64) for name in PosteriorConfig.__annotations__]))


@functools.lru_cache(maxsize=4)  # a posterior has the same config in every frame
def constants(config: PosteriorConfig) -> Any:
    """The settings and constants of a config as numbers by name, for compiled code."""
    return np.array(tuple(float(getattr(config, name)) for name in PosteriorConfig.__annotations__), _RECORD)[()]


@functools.lru_cache(maxsize=4)
def priors(config: PosteriorConfig) -> Floats:
    """[4, R] value and weight [anchors] of each ratio's prior, and the limits of the ratio. The calibration has no
    prior."""
    weight = config.prior_weight
    columns = {
        AMPLITUDE: (1.0, weight, 0.1, 100.0),
        ROUGHNESS: (config.roughness**2, weight, 0.01**2, 0.2**2),
        NOISE: (1.0, weight, 0.25, 16.0),
        UNSEEN: (config.unseen, weight, 0.0, 16.0),
        WRONG: (config.wrong, weight, config.wrong / 10, 10 * config.wrong),
        INLIER: (1.0, weight, 0.05, 4.0),
        BETWEEN: (config.between**2, weight, 0.03**2, 1.0),
        CENTRE: (0.0, 0.0, -LARGEST_LOG, LARGEST_LOG),
        CALIBRATION: (0.0, 0.0, 0.0, 1e6),
    }
    return np.ascontiguousarray(np.array([columns[ratio] for ratio in range(RATIOS)]).T)


_POSE = 12
_PARTS = (3, 2 * RATIOS, SLOPES, FEATURES, _MATRIX, 1 + len(LEVELS), _POSE)
SIZE = sum(_PARTS)


class Memory(NamedTuple):
    """The memory of one stream. Zeros are the start.

    Attributes:
        frames: [3] number of frames with anchors; m_0 of the last frame; and the share of its view whose scale no
            evidence has confirmed (``overlap``).
        sums: [2, R] numerators and denominators of the ratios.
        slopes: [3] mean of the slopes in the coefficients over the frames with anchors, with the half-life and with
            ``slope_weight`` frames of 0.
        coefficients: [4] of the features in the last frame.
        covariance: [4, 4] of the coefficients.
        intervals: [4] (``conformal.adapt``).
        pose: [12] first three rows of the last frame's pose [4, 4], camera-to-world [m].
    """

    frames: Floats
    sums: Floats
    slopes: Floats
    coefficients: Floats
    covariance: Floats
    intervals: Floats
    pose: Floats


def views(packed: Floats) -> Memory:
    """The parts of a memory [SIZE], which share its numbers."""
    ends = np.cumsum(_PARTS)
    frames, sums, slopes, b, covariance, intervals, pose = (
        packed[end - size : end] for size, end in zip(_PARTS, ends.tolist(), strict=True)
    )
    return Memory(frames, sums.reshape(2, RATIOS), slopes, b, covariance.reshape(FEATURES, FEATURES), intervals, pose)


def require(packed: Tensor) -> None:
    """Raise a ValueError if no anchors can have led to the memory [B, SIZE]."""
    frames, sums, _, _, covariance, intervals, _ = packed.split(_PARTS, 1)
    matrix = covariance.reshape(-1, FEATURES, FEATURES)
    counts = torch.cat([frames[:, :1], sums], 1)[:, [i for i in range(1 + 2 * RATIOS) if i != 1 + CENTRE]]
    scale = matrix.abs().amax((1, 2)).clamp(1e-300, 1e300)
    low = torch.linalg.eigvalsh(matrix / scale[:, None, None])[:, 0]
    scored, factors = intervals[:, 0], intervals[:, 1:]
    faults = {
        f"values beyond {LARGEST:g}": packed.abs() > LARGEST,
        "negative sums": counts < 0,
        "a mean log depth out of range": frames[:, 1].abs() > LARGEST_LOG,
        "a share outside of [0, 1]": (frames[:, 2] - 0.5).abs() > 0.5,
        "a covariance with negative eigenvalues": low < -1e-6,
        "a number of frames with scores that is not whole": (scored < 0) | (scored != scored.round()),
        "quantiles beyond a factor of 10": factors.abs() > math.log(LARGEST_FACTOR) + 1e-9,
    }
    if names := [name for name, bad in faults.items() if bool(bad.any())]:
        raise ValueError(f"posterior holds impossible values: {', '.join(names)}")


@leaf
def _before(memory, priors, ratio):
    """Numerator and denominator of a ratio; the prior's before the first frame."""
    if memory.frames[0] == 0:
        return priors[0, ratio] * priors[1, ratio], priors[1, ratio]
    return memory.sums[0, ratio], memory.sums[1, ratio]


@leaf
def write_ratios(memory, priors, out):
    """Write the ratios [R] of a :class:`Memory`, within their limits; ``priors`` [4, R] of :func:`priors`."""
    for ratio in range(RATIOS):
        above, below = _before(memory, priors, ratio)
        value = above / max(below, 1e-12) if below > 0 else priors[0, ratio]
        out[ratio] = min(max(value, priors[2, ratio]), priors[3, ratio])


@leaf
def after_frame(memory, priors, ratio, above, below, config):
    """Numerator and denominator of a ratio after a frame that adds ``above`` and ``below`` to them."""
    (before, n), (value, weight) = _before(memory, priors, ratio), (priors[0, ratio], priors[1, ratio])
    fade = 0.5 ** (1 / config.half_life)
    n = fade * n + (1 - fade) * weight + below
    total = fade * before + (1 - fade) * weight * value + above
    return min(max(total, priors[2, ratio] * n), priors[3, ratio] * n), n


def restart(memory: Memory, config: PosteriorConfig) -> None:
    """Return to the initial coefficients and slopes: wrong poses can have corrupted them. The ratios depend on network
    and scene and remain."""
    memory.slopes[:], memory.coefficients[:], memory.frames[2] = 0, 0, 0
    memory.covariance[:] = np.diag(config.prior_variance) if memory.frames[0] > 0 else 0


@leaf
def _prior_variance(feature, config):
    """Variance of a coefficient before the first anchor."""
    if feature == 0:
        return config.prior_sigma**2
    return config.slope_sigma**2 if feature == 1 else config.tilt_sigma**2


@part
def expected(memory, mean, config):
    """Predict coefficients [4] and covariance [4, 4] for a frame whose m_0 is ``mean``.

    The constant follows a random walk from the last frame, which stops adding variance at the prior's. The slopes
    revert to the variance before the first anchor, that in log d to 0: what anchors showed of one surface is no
    evidence of the network's shape on another. Those in u and v revert to their mean over the stream.
    """
    b, covariance = empty(FEATURES, np.float64), empty((FEATURES, FEATURES), np.float64)
    started, rate, shift = memory.frames[0] > 0, config.reversion, mean - memory.frames[1]
    for f in range(FEATURES):
        b[f] = memory.coefficients[f]
        for g in range(FEATURES):
            covariance[f, g] = memory.covariance[f, g]
        if not started:
            covariance[f, f] = _prior_variance(f, config)
    if not started:
        return b, covariance
    b[0] += shift * b[1]
    for g in range(FEATURES):
        covariance[0, g] += shift * covariance[1, g]
    for f in range(FEATURES):
        covariance[f, 0] += shift * covariance[f, 1]
    for f in range(1, FEATURES):
        b[f] = (1 - rate) * b[f] + (rate * memory.slopes[f - 1] if f > 1 else 0.0)
        for g in range(FEATURES):
            covariance[f, g] *= 1 - rate
            covariance[g, f] *= 1 - rate
    prior = _prior_variance(0, config)
    covariance[0, 0] += config.drift**2 * min(max(1 - covariance[0, 0] / prior, 0.0), 1.0)
    for f in range(1, FEATURES):
        covariance[f, f] += (1 - (1 - rate) ** 2) * _prior_variance(f, config)
    return b, covariance


@leaf
def learn(memory, sums, mean, b, covariance, priors, config):
    """Change the memory after a frame with anchors: with the ``sums`` [2, R] for the ratios, m_0 = ``mean``, and the
    coefficients [4] and their covariance."""
    for ratio in range(RATIOS):
        above, below = after_frame(memory, priors, ratio, sums[0, ratio], sums[1, ratio], config)
        sums[0, ratio], sums[1, ratio] = above, below
    for ratio in range(RATIOS):
        memory.sums[0, ratio], memory.sums[1, ratio] = sums[0, ratio], sums[1, ratio]
    memory.frames[0] += 1
    rate = math.log(2.0) / config.half_life
    weight = math.expm1(-rate * memory.frames[0]) / math.expm1(-rate)  # of the frames with anchors, 1 of the last
    for f in range(SLOPES):
        memory.slopes[f] += (b[1 + f] - memory.slopes[f]) / (weight + config.slope_weight)
    _store(memory, mean, b, covariance)


@leaf
def drift(memory, mean, b, covariance, config):
    """Change the memory after a frame without anchors, with m_0 = ``mean`` and what was :func:`expected` for it. The
    mean slopes revert, too."""
    for f in range(SLOPES):
        memory.slopes[f] *= 1 - config.reversion
    _store(memory, mean, b, covariance)


@leaf
def _store(memory, mean, b, covariance):
    memory.frames[1] = mean
    for f in range(FEATURES):
        memory.coefficients[f] = b[f]
        for g in range(FEATURES):
            memory.covariance[f, g] = covariance[f, g]
