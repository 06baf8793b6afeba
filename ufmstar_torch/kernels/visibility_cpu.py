"""Selects the components of a mixture that a frame can see, on the CPU (numba), before all other computation.

A component matters to a frame where its mean projects into the image, so that it can match, or where its density
exceeds what the regression leaves out at its first level (``regress_cull_cpu``), so that it can be summed. All of it
lies in an ellipsoid around the mean, which reaches r sqrt(n^T Sigma n) along a direction n, with

    r^2 = 2 log(peak / least).

A component is left out where the ellipsoid lies behind the camera, or in front of it and outside of one of the sides of
the viewing pyramid, with room for rounding: both the matching and the regression would leave it out themselves, so
that no bit of the result depends on it. The test takes no root, no quotient but one and no logarithm: the peak's
logarithm is bounded from above by the bits of a float64. Several components are tested at a time.
"""

from __future__ import annotations

import math

from ufmstar_torch.kernels.compile_cpu import leaf
from ufmstar_torch.kernels.regress_cull_cpu import negligible
from ufmstar_torch.kernels.rigid_cpu import COVARIANCE, WEIGHT, gather, padded
from ufmstar_torch.kernels.vectors_cpu import vectors

GROUP = 64  # slots at a time, a multiple of LANES
_LOG2_PEAK = -1.5 * math.log2(2 * math.pi)
_FLAT = 1e-13  # share of tr^3 below which a determinant may be rounding: such a component is kept
_ROUNDING = 1e-9  # of a spread
_WIDER = 1.01  # [px] beyond the first and the last pixel


@leaf
def reached(motion, mean, covariance, weight, K, size, prior_weight, epsilon, more, index, group, kept, planes):
    """Write the slots that a frame can reach to ``index`` [K] in increasing order; return how many these are, and how
    many are occupied.

    Args:
        motion: [3, 4] from the mixture's frame into the camera's.
        mean, covariance, weight: of the mixture [K, ...].
        size: H, W.
        prior_weight, epsilon: of the regression; epsilon = 0 takes every occupied slot.
        more: how many components the frame may add.
        group, kept, planes: [13, 64], [64] and [6, 4], scratch.
    """
    occupied = 0
    for k in range(weight.size):
        index[occupied] = k
        occupied += weight[k] > 0
    if epsilon == 0:
        return occupied, occupied
    # Outside: n . x > 0; and log2 of the least density that counts.
    _plane(planes, 0, motion, -K[0, 0], 0.0, -(K[0, 2] + _WIDER))
    _plane(planes, 1, motion, K[0, 0], 0.0, K[0, 2] + 1 - size[1] - _WIDER)
    _plane(planes, 2, motion, 0.0, -K[1, 1], -(K[1, 2] + _WIDER))
    _plane(planes, 3, motion, 0.0, K[1, 1], K[1, 2] + 1 - size[0] - _WIDER)
    _plane(planes, 4, motion, 0.0, 0.0, -1.0)
    planes[5, 0] = negligible(prior_weight, epsilon, occupied + more)
    n = 0
    for first in range(0, occupied, GROUP):
        count = min(GROUP, occupied - first)
        gather(index, first, count, mean, covariance, weight, group)
        _within(planes, padded(count), group, kept)
        for i in range(count):
            index[n] = index[first + i]
            n += kept[i] > 0
    return n, occupied


@leaf
def _plane(planes, i, motion, x, y, z):
    """Plane i through the camera, of the normal (x, y, z) in its axes, in the mixture's coordinates."""
    for j in range(4):
        planes[i, j] = x * motion[0, j] + y * motion[1, j] + z * motion[2, j]


@vectors
def _within(code, planes, n, group, kept):
    """Write 0 to ``kept`` [64] where a component lies behind the camera, or in front of it and outside of a side, for
    certain, else 1.

    Args:
        planes: [6, 4] the planes, the camera's own the last, and log2 of the least density that counts.
        n: of the components, a multiple of a vector's length.
        group: [13, 64] the components by field.
    """
    normals = [[planes.one(4 * i + j) for j in range(4)] for i in range(5)]
    least = planes.one(20)
    with code.loop(n, code.lanes) as at:
        mean = [group.load(at, i * GROUP) for i in range(3)]
        xx, xy, xz, _, yy, yz, _, _, zz = (group.load(at, (COVARIANCE + i) * GROUP) for i in range(9))
        trace, weight = xx + yy + zz, group.load(at, WEIGHT * GROUP)
        det = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
        peak = (weight * weight).over(det).log2_above() * 0.5 + (_LOG2_PEAK + 0.05)
        square = ((peak - least) * (2 * math.log(2.0))).at_least(0.0) * 1.001
        square = (det > trace * trace * trace * _FLAT).select(square, math.inf)
        beyond, spread = [], []
        for x, y, z, offset in normals:
            beyond.append(x * mean[0] + y * mean[1] + z * mean[2] + offset)
            value = x * x * xx + y * y * yy + z * z * zz + (x * y * xy + x * z * xz + y * z * yz) * 2.0
            spread.append(value + (x * x + y * y + z * z) * trace * _ROUNDING)
        none = weight * 0.0
        outside = (beyond[4] > 0.0).select(none + 1.0, none)
        for side in range(4):
            outside = (beyond[side] * beyond[side].size() > square * spread[side]).select(none + 1.0, outside)
        outside = (beyond[4] * beyond[4] > square * spread[4]).select(outside, none)
        kept.store(none + 1.0 - outside, at)
