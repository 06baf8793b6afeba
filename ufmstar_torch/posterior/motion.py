"""Motion as a second explanation of evidence: the surface moves, and its matched depth is wrong.

Where a surface moves along its epipolar line, matching measures a wrong depth. The evidence then asks for another
ratio of depth and prediction, y, than other surfaces. At a node, f is the part of y that the shared scale b . x does
not explain. Over the surfaces of a stream that stand still, f is Student-t distributed with two degrees of freedom and
the scale s ("between", learnt from held-out anchors); with motion it is normal with the variance s^2 + ``_MOVING``^2.
With these densities, the log odds of motion at a node are

    l = PRIOR + log(a + (1 - a) e^m) + ``_WEIGHT`` mean(r),
    r = (1 - distance/reach) log(N(f; s^2 + _MOVING^2)/t_2(f; s)).

m is the log likelihood ratio of the tests in the images (``anchors.motion``), and a the share of motion that passes all
tests. The mean is over neighbouring nodes of similar predicted depth, in a Gaussian window: the network bounds the
region that moves. A surface counts as still unless there is evidence of motion: the probability of motion is
P = max(0, (sigma(l) - c)/(1 - c)).

With the probability P the local correction does not hold, as on another surface: the depth is that of the prediction
with the shared scale, y - b . x is normal with the variance w (``update``). The stated depth stays that of the
evidence, which is right more often than the prediction even where P exceeds one half; its variance is the second moment
about it. So P adds to the probability p of another surface: 1 - (1 - p)(1 - P).

The constants are fitted to eight tours with six moving things each, FastDepth and the demo's network.
"""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.posterior.field import fast
from ufmstar_torch.posterior.running import Floats

# Standard deviation of log depth that motion adds.
_MOVING = 0.8
# Log odds of motion without evidence, share a, weight of the ratio's likelihood, and c.
_PRIOR, _PASSING, _WEIGHT, _CERTAIN = -1.57, 0.12, 1.06, 0.15
# Window of the mean: standard deviation and half width [nodes], and difference of log d at which a weight is halved.
_SIGMA, _HALF, _CONTRAST = 1.5, 3, 0.3


def tests_at(motion: Floats, height: int, width: int, rows: int, cols: int) -> Floats:
    """[rows cols] log likelihood ratios of motion at the nodes of a map: means of the points ``motion`` [M, 3] (u, v,
    ratio) around them, with bilinear weights; 0 where there is none."""
    finite = motion[np.isfinite(motion).all(1)]
    sums, weights = np.zeros((2, rows, cols))
    u, v = (finite[:, 0] + 0.5) / width * cols - 0.5, (finite[:, 1] + 0.5) / height * rows - 0.5
    _spread(u, v, finite[:, 2], sums, weights)
    mean: Floats = (sums / np.maximum(weights, 1e-9)).ravel()
    return mean


@fast
def _spread(u, v, value, sums, weights):
    rows, cols = sums.shape
    for k in range(len(value)):
        for i in range(max(int(v[k]), 0), min(int(v[k]) + 2, rows)):
            for j in range(max(int(u[k]), 0), min(int(u[k]) + 2, cols)):
                w = max(1 - abs(v[k] - i), 0.0) * max(1 - abs(u[k] - j), 0.0)
                sums[i, j] += w * value[k]
                weights[i, j] += w


def probability(
    offset: Floats, log_depth: Floats, away: Floats, tests: Floats, between: float, size: tuple[int, int]
) -> Floats:
    """[n] probability P that the surface at a node moves.

    Args:
        offset: [n] f.
        log_depth: [n] of the prediction.
        away: [n] distance from evidence as a share of ``reach``.
        tests: [n] from :func:`tests_at`.
        between: s^2, the squared scale of f over still surfaces.
        size: R and C of the nodes.
    """
    variance, square = between + _MOVING**2, offset**2
    moving = -(square / variance + math.log(2 * math.pi * variance)) / 2
    still = -1.5 * np.log1p(square / between / 2) - math.log(2 * math.sqrt(2 * between))
    ratio = np.maximum(1 - away, 0) * (moving - still)
    around = np.zeros(size)
    _mean_around(ratio.reshape(size), log_depth.reshape(size), around)
    odds = _PRIOR + np.log(_PASSING + (1 - _PASSING) * np.exp(tests)) + _WEIGHT * around.ravel()
    P: Floats = np.maximum(1 / (1 + np.exp(-odds.clip(-50, 50))) - _CERTAIN, 0) / (1 - _CERTAIN)
    return P


@fast
def _mean_around(value, log_depth, out):
    rows, cols = value.shape
    window = np.empty((2 * _HALF + 1, 2 * _HALF + 1))
    for i in range(-_HALF, _HALF + 1):
        for j in range(-_HALF, _HALF + 1):
            window[i + _HALF, j + _HALF] = math.exp(-(i * i + j * j) / (2 * _SIGMA * _SIGMA))
    for r in range(rows):
        for c in range(cols):
            total = weights = 0.0
            for i in range(max(r - _HALF, 0), min(r + _HALF + 1, rows)):
                for j in range(max(c - _HALF, 0), min(c + _HALF + 1, cols)):
                    jump = (log_depth[i, j] - log_depth[r, c]) / _CONTRAST
                    w = window[i - r + _HALF, j - c + _HALF] / (1 + jump * jump)
                    total += w * value[i, j]
                    weights += w
            out[r, c] = total / weights
