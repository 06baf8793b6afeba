"""Second moments of a log-normal error, and mixtures of two normal distributions of a relative depth (numba)."""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, leaf, part
from ufmstar_torch.kernels.cpu.sample import smallest

# Least variance of y whose distribution is computed.
LEAST_VARIANCE = 1e-12
# Standard deviations beyond which the normal distribution function is 0 or 1 in float64.
_FARTHEST = 8.3
# Quantile of the variance of inliers over the image that limits it.
_TYPICAL = 0.7
# Least ratio of the variances of another surface and of the evidence's.
_APART = 16.0


@leaf
def second_moments(config, variance, p, offset, wide):
    """Variances over the squared depth: in total, and if the local correction holds. With probability ``p`` the local
    correction ``offset`` does not hold, and y has the variance ``wide`` instead of ``variance``."""
    limit = math.log(config.farthest)
    inlier = _moment(min(variance, config.widest), 0.0, limit)
    tail = _moment(wide, min(max(offset, -limit), limit), limit)
    return (1 - p) * inlier + p * tail, inlier


@leaf
def _moment(variance, offset, limit):
    """E[(e^n - 1)^2 | |n| <= ``limit``], n ~ N(-offset, variance)."""
    sigma = math.sqrt(max(variance, LEAST_VARIANCE))
    low, high = (offset - limit) / sigma, (offset + limit) / sigma
    mass, first, second = _mass(low, high), _mass(low - sigma, high - sigma), _mass(low - 2 * sigma, high - 2 * sigma)
    q = math.exp(-offset)
    moment = q * q * math.exp(2 * variance) * second - 2 * q * math.exp(variance / 2) * first + mass
    return max(moment / mass, 0.0)


@leaf
def _mass(low, high):
    """Probability of the normal distribution between two values."""
    if low < -_FARTHEST and high > _FARTHEST:
        return 1.0
    return normal_below(high) - normal_below(low)


@leaf
def normal_below(x):
    """The normal distribution function."""
    return 0.5 * math.erfc(-x * math.sqrt(0.5))


@leaf
def below(ratio, p, moment, inlier):
    """CDF at ``ratio`` of a positive depth over its mean: a mixture of two normal distributions of mean 1, of weight
    1 - ``p`` with the variance ``inlier``, and with the second moment ``moment`` in total."""
    elsewhere = max((moment - (1 - p) * inlier) / max(p, 1e-12), inlier)
    first, second = 1 / math.sqrt(inlier), 1 / math.sqrt(elsewhere)
    zero = (1 - p) * normal_below(-first) + p * normal_below(-second)
    x = ratio - 1
    return ((1 - p) * normal_below(x * first) + p * normal_below(x * second) - zero) / (1 - zero)


@part
def divide(variance, inlier, p):
    """Change the variance of the inliers and the probability of the others, for a mixture of the same total variance V
    whose inliers have at most the quantile ``_TYPICAL`` of their variance over the image:

        V_1' = min(V_1, quantile),      V_2' = max(V_2, ``_APART`` V_1'),      p' = max(p, (V - V_1')/(V_2' - V_1')).

    Where the field is uncertain, most errors remain those of a surface with evidence, and some are those of another.
    One wide normal distribution would not separate them.

    Args:
        variance: [n] total.
        inlier: [n] V_1; changed.
        p: [n] probability of another surface; changed.
    """
    n, ordered = inlier.size, empty(inlier.size, np.float64)
    for i in range(n):
        ordered[i] = inlier[i]
    most = quantile(ordered, _TYPICAL)
    for i in range(n):
        elsewhere = max((variance[i] - (1 - p[i]) * inlier[i]) / max(p[i], 1e-12), inlier[i])
        inlier[i] = min(inlier[i], most)
        excess = max(elsewhere, _APART * inlier[i]) - inlier[i]
        p[i] = max(p[i], min(max((variance[i] - inlier[i]) / max(excess, 1e-12), 0.0), 1.0))


@leaf
def quantile(values, share):
    """The quantile of values [n], as ``np.quantile``; reorders them."""
    n, position = values.size, share * (values.size - 1)
    lower = int(position)
    value, upper = smallest(values, n, lower), np.inf
    for i in range(lower + 1, n):  # the next value: the smaller ones were sorted to the left
        upper = min(upper, values[i])
    return value + (position - lower) * (upper - value) if position > lower else value
