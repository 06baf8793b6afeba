"""Which components of a mixture a frame can reach, on the CPU (numba), before anything else is computed of them.

A component matters to a frame where its mean projects into the image, so that it can match, or where its density
exceeds what the regression leaves out at its first level (``regress_cull_cpu``), so that it can be summed. All of it
lies in an ellipsoid around the mean, which reaches r sqrt(n^T Sigma n) along a direction n, with

    r^2 = 2 log(peak / least).

A component is left out where the ellipsoid lies behind the camera, or in front of it and outside of one of the sides of
the viewing pyramid, with room for rounding: both the matching and the regression would leave it out themselves, so
that no bit of the result depends on it. The test takes no root and no logarithm: the peak's logarithm is bounded from
above by the bits of a float64.
"""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import leaf, part
from ufmstar_torch.kernels.regress_cull_cpu import negligible

_LOG2_PEAK = -1.5 * math.log2(2 * math.pi)
_MANTISSA = 0.0861  # log2(1 + f) <= f + .0861
_FLAT = 1e-13  # share of tr^3 below which a determinant may be rounding: such a component is kept
_ROUNDING = 1e-9  # of a spread
_WIDER = 1.01  # [px] beyond the first and the last pixel


@part
def reached(motion, mean, covariance, weight, K, size, prior_weight, epsilon, more):
    """Slots [n] in increasing order that a frame can reach, and how many are occupied.

    Args:
        motion: [3, 4] from the mixture's frame into the camera's.
        mean, covariance, weight: of the mixture [K, ...].
        size: H, W.
        prior_weight, epsilon: of the regression; epsilon = 0 takes every occupied slot.
        more: how many components the frame may add.
    """
    index, occupied = np.empty(weight.size, np.int64), 0
    for k in range(weight.size):
        index[occupied] = k
        occupied += weight[k] > 0
    if epsilon == 0:
        return index[:occupied], occupied
    least = negligible(prior_weight, epsilon, occupied + more)
    planes = np.empty((5, 4))  # outside: n . x > 0
    _plane(planes, 0, motion, -K[0, 0], 0.0, -(K[0, 2] + _WIDER))
    _plane(planes, 1, motion, K[0, 0], 0.0, K[0, 2] + 1 - size[1] - _WIDER)
    _plane(planes, 2, motion, 0.0, -K[1, 1], -(K[1, 2] + _WIDER))
    _plane(planes, 3, motion, 0.0, K[1, 1], K[1, 2] + 1 - size[0] - _WIDER)
    _plane(planes, 4, motion, 0.0, 0.0, -1.0)
    n = 0
    for i in range(occupied):
        index[n] = index[i]
        n += not _outside(planes, mean, covariance, weight, index[i], least)
    return index[:n], occupied


@leaf
def _plane(planes, i, motion, x, y, z):
    """Plane i through the camera, of the normal (x, y, z) in its axes, in the mixture's coordinates."""
    for j in range(4):
        planes[i, j] = x * motion[0, j] + y * motion[1, j] + z * motion[2, j]


@leaf
def _outside(planes, mean, covariance, weight, k, least):
    """Whether component k lies behind the camera, or in front of it and outside of a side, for certain."""
    z = -_beyond(planes, 4, mean, k)
    worst, side = 0.0, 4
    if z > 0:
        for i in range(4):
            beyond = _beyond(planes, i, mean, k)
            if beyond > 0 and beyond * beyond > worst * _spread(planes, i, covariance, k):
                worst, side = beyond * beyond / _spread(planes, i, covariance, k), i
        if side == 4:
            return False
    square, depth = _square_radius(covariance, weight, k, least), _spread(planes, 4, covariance, k)
    return z * z > square * depth and (z < 0 or worst > square)


@leaf
def _beyond(planes, i, mean, k):
    """How far the mean of component k lies outside of a plane, times the length of its normal."""
    x, y, z = np.float64(mean[k, 0]), np.float64(mean[k, 1]), np.float64(mean[k, 2])
    return planes[i, 0] * x + planes[i, 1] * y + planes[i, 2] * z + planes[i, 3]


@leaf
def _spread(planes, i, covariance, k):
    """n^T Sigma n of a plane's normal, a little more than rounding leaves of it."""
    x, y, z = planes[i, 0], planes[i, 1], planes[i, 2]
    a, b, c = np.float64(covariance[k, 0, 0]), np.float64(covariance[k, 1, 1]), np.float64(covariance[k, 2, 2])
    d, e, f = np.float64(covariance[k, 0, 1]), np.float64(covariance[k, 0, 2]), np.float64(covariance[k, 1, 2])
    value = x * x * a + y * y * b + z * z * c + 2 * (x * y * d + x * z * e + y * z * f)
    return value + _ROUNDING * (x * x + y * y + z * z) * (a + b + c)


@leaf
def _square_radius(covariance, weight, k, least):
    """r^2 of the ellipsoid outside of which the density of component k is certainly below 2^least."""
    a, b, c = np.float64(covariance[k, 0, 0]), np.float64(covariance[k, 1, 1]), np.float64(covariance[k, 2, 2])
    d, e, f = np.float64(covariance[k, 0, 1]), np.float64(covariance[k, 0, 2]), np.float64(covariance[k, 1, 2])
    trace = a + b + c
    det = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
    if not det > _FLAT * trace * trace * trace:
        return np.inf
    ratio = np.float64(np.float64(weight[k]) ** 2 / det)
    log2 = np.float64(ratio.view(np.int64)) * 2.0**-52 - 1023 + _MANTISSA
    peak = 0.5 * log2 + _LOG2_PEAK + 0.05
    return max((peak - least) * (2 * math.log(2.0)), 0.0) * 1.001
