"""Second moments of a log-normal error and probabilities of a normal mixture, element by element (numba)."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch.special import ndtri

from ufmstar_torch.kernels.compile_cpu import kernel, part
from ufmstar_torch.posterior.distribution import TAIL
from ufmstar_torch.posterior.running import Floats

# Least variance of y whose distribution is computed.
LEAST_VARIANCE = 1e-12
# Standard deviations beyond which the normal distribution function is 0 or 1 in float64.
_FARTHEST = 8.3


@kernel
def moments(variance, p, offset, wide, limit, widest, total, inlier):
    """Write both results [n] of :func:`ufmstar_torch.posterior.scene.second_moments`."""
    for i in range(variance.size):
        inlier[i] = _moment(min(variance[i], widest), 0.0, limit)
        tail = _moment(wide[i], min(max(offset[i], -limit), limit), limit)
        total[i] = (1 - p[i]) * inlier[i] + p[i] * tail


@part
def _moment(variance, offset, limit):
    """E[(e^n - 1)^2 | |n| <= ``limit``], n ~ N(-offset, variance)."""
    sigma = math.sqrt(max(variance, LEAST_VARIANCE))
    low, high = (offset - limit) / sigma, (offset + limit) / sigma
    mass, first, second = _mass(low, high), _mass(low - sigma, high - sigma), _mass(low - 2 * sigma, high - 2 * sigma)
    q = math.exp(-offset)
    moment = q * q * math.exp(2 * variance) * second - 2 * q * math.exp(variance / 2) * first + mass
    return max(moment / mass, 0.0)


@part
def _mass(low, high):
    """Probability of the normal distribution between two values."""
    if low < -_FARTHEST and high > _FARTHEST:
        return 1.0
    return normal_below(high) - normal_below(low)


@part
def normal_below(x):
    """The normal distribution function."""
    return 0.5 * math.erfc(-x * math.sqrt(0.5))


def score(error: Floats, p: Floats, moment: Floats, inlier: Floats) -> Floats:
    """|z| [N] of held-out anchors.

    Args:
        error: [N] log of the depth over the posterior's.
        p: [N] probability that the posterior's local correction does not hold.
        moment, inlier: [N] second moment of the relative error, and the same if the local correction holds.
    """
    below = np.empty(len(error))
    _conditional(np.exp(error), p, moment, inlier, below)
    z: Floats = ndtri(torch.from_numpy(below).clamp_(TAIL, 1 - TAIL)).abs().numpy()
    return z


@kernel
def _conditional(ratio, p, moment, inlier, out):
    """Write the CDF [n] at ``ratio`` of a positive depth over its mean: a mixture of two normal distributions of mean
    1, of weight 1 - ``p`` with the variance ``inlier``, and with the second moment ``moment`` in total."""
    for i in range(ratio.size):
        elsewhere = max((moment[i] - (1 - p[i]) * inlier[i]) / max(p[i], 1e-12), inlier[i])
        first, second = 1 / math.sqrt(inlier[i]), 1 / math.sqrt(elsewhere)
        zero = (1 - p[i]) * normal_below(-first) + p[i] * normal_below(-second)
        x = ratio[i] - 1
        below = (1 - p[i]) * normal_below(x * first) + p[i] * normal_below(x * second)
        out[i] = (below - zero) / (1 - zero)
