"""Selects the components that matter in a box of points, on the CPU (numba): culling in two levels, and its error.

A component k adds w_k(x) = pi_k N(x; mu_k, Sigma_k) to the denominator D(x) = pi_0 + sum_k w_k(x) of a point x.

1. Block of 32 x 32 pixels: interval arithmetic over the bounding box of the block's points gives l_k <= w_k(x) <= h_k.
   Components that the box around all points of the image excludes are left out first. Every block would exclude them,
   so that no bit changes.
2. Tile of 8 x 8 pixels: the same, for the components that the block keeps.

A component adds h_k at most to the denominator and h_k m_k to the numerator N(x) = pi_0 mu_0 + sum_k w_k(x) m_k. Each
level, with n components, leaves out those with

    h_k <= (eps / 2n) d  and  h_k m_k <= (eps / 2n) max(max_j l_j m_j, pi_0 mu_0, m_0 d),  d = max(max_j l_j, pi_0).

d is a part of D, and the other maxima are parts of N or, with m_0 = 1e-12 m^2, of m_0 D. All components left out add up
to at most eps D and eps max(N, m_0 D):

    |m_hat - m_hat_culled| <= eps/(1 - eps) max(m_hat, m_0),

and an average of other features is off by eps/(1 - eps) times the largest difference of two of them. Rounding of the
sums adds to it; the bounds contain their own rounding. tests/test_regress.py checks the bound.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.kernels.compile_cpu import empty, kernel, leaf
from ufmstar_torch.kernels.cpu.regress_vectors import TERMS, bounds, largest
from ufmstar_torch.kernels.cpu.rigid import COVARIANCE, WEIGHT, padded
from ufmstar_torch.kernels.cpu.vectors import LANES

HALF_LOG_TWO_PI_CUBED = 1.5 * math.log(2 * math.pi)
FIELDS = 10  # of a component: mean (3), whitening (6), log2 of the peak
ROWS = FIELDS + 1  # and, where components are culled, log2 of m
_BOX = 9  # numbers of a box and its bounds
_LEAST = 1e-12  # m_0 [m^2]
_LOG2_LEAST = math.log2(_LEAST)
_LOG2_E = math.log2(math.e)
_SCALE = math.sqrt(0.5 * _LOG2_E)
# Rows of :func:`whiten`, the last of which is the peak.
WHITENED, PEAK = 7, 6


class Settings(NamedTuple):
    """Settings of the sum over the components of a mixture.

    Attributes:
        prior_weight, prior_mean: of the prior.
        epsilon: of the culling for the image and for anchors.
        error: of the culling for maps, at least epsilon.
        least, least_product: log2 of the prior's parts of the denominator and of the numerator.
    """

    prior_weight: float
    prior_mean: float
    epsilon: float
    error: float
    least: float
    least_product: float


class Seen(NamedTuple):
    """A stream's mixture: n components by field [13, n and more] in the camera's frame (``rigid``), their
    disagreement [n] and features [n, F]."""

    components: NDArray[np.float64]
    disagreement: NDArray[np.float64]
    features: NDArray[np.float64]


class View(NamedTuple):
    """The components that can matter in an image.

    Attributes:
        slot: [n] of the components in the mixture.
        fields: [n, 10] mean, whitening and log2 of the peak.
        packed: [10, n and more] the same by field, padded (``rigid.padded``), in the depth's dtype.
        terms: [n, TERMS] of the sum, in the depth's dtype.
        among: number of all components of the mixture.
        settings: of the sum.
    """

    slot: NDArray[np.int64]
    fields: NDArray[np.float64]
    packed: NDArray[np.floating]
    terms: NDArray[np.floating]
    among: int
    settings: Settings


@functools.lru_cache(maxsize=16)
def settings_of(prior_weight: float, prior_mean: float, epsilon: float, error: float) -> Settings:
    """The settings of the sum with a prior."""
    least = math.log2(prior_weight), math.log2(prior_weight * max(prior_mean, _LEAST))
    return Settings(prior_weight, prior_mean, epsilon, error, *least)


@kernel
def in_view(components, m, features, depth, K, settings):
    """The components that can matter in an image: the first four fields of a :class:`View`, with room for all
    components, and the number of those.

    Args:
        components, m, features: of the mixture (:class:`Seen`).
        depth: [H, W], not positive where invalid.
        K: [3, 3].
        settings: of the sum.
    """
    height, width = depth.shape
    n = m.size
    index, fields = empty(n, np.int64), empty((n, FIELDS), np.float64)
    packed, constants = empty((ROWS, components.shape[1]), depth.dtype), empty((n, TERMS), depth.dtype)
    whitened = empty((WHITENED, components.shape[1]), np.float64)
    every = empty(n, np.int64)
    whiten(components, n, whitened)
    for k in range(n):
        every[k] = k
        for i in range(6):
            whitened[i, k] *= _SCALE
        whitened[PEAK, k] = (math.log(whitened[PEAK, k]) - HALF_LOG_TWO_PI_CUBED) * _LOG2_E
    _pack(components, whitened, m, every, n, packed)
    work, whole = empty(_BOX + packed.shape[1], depth.dtype), depth.size // LANES * LANES
    work[0] = 0
    largest(depth, whole, work)
    z = np.float64(work[0])
    for i in range(whole, depth.size):
        z = max(z, np.float64(depth[i // width, i % width]))
    left, top = (0 - K[0, 2]) / K[0, 0] * z, (0 - K[1, 2]) / K[1, 1] * z
    right, bottom = (width - 1 - K[0, 2]) / K[0, 0] * z, (height - 1 - K[1, 2]) / K[1, 1] * z
    box = min(left, 0.0), min(top, 0.0), 0.0, max(right, 0.0), max(bottom, 0.0), z
    # Blocks divide their threshold by n. A larger divisor makes this one lower in spite of rounding of the boxes.
    chosen = cull(packed, n, limit(settings.epsilon, n + n // 64 + 1), box, settings, work, index)
    _terms(components, whitened, index, chosen, m, features, fields, constants)
    _pack(components, whitened, m, index, chosen, packed)
    return index, fields, packed, constants, chosen


@leaf
def _pack(components, whitened, m, index, n, packed):
    """The fields of the first n chosen components by field, padded with components of density 0.

    The fields are mean, whitening, log2 of the peak and of m: 2^(peak - |whitening (x - mean)|^2) is the density.
    """
    for i in range(3):
        for k in range(n):
            packed[i, k] = components[i, index[k]]
    for i in range(3, FIELDS):
        for k in range(n):
            packed[i, k] = whitened[i - 3, index[k]]
    for k in range(n):
        packed[FIELDS, k] = math.log2(max(m[index[k]], _LEAST))
    pad(packed, n)


@leaf
def _terms(components, whitened, index, count, m, features, fields, constants):
    """Write the fields [n, 10] of the chosen components, and the terms of the sum."""
    for i in range(count):
        k = index[i]
        for j in range(3):
            fields[i, j] = components[j, k]
        for j in range(7):
            fields[i, 3 + j] = constants[i, j] = whitened[j, k]
        constants[i, 7] = m[k]
        for g in range(min(3, features.shape[1])):
            constants[i, 8 + g] = features[k, features.shape[1] - 1 - g]


@leaf
def pad(packed, n):
    """Fill the fields after n components up to the padded number with components of density 0."""
    for j in range(n, padded(n)):
        for i in range(ROWS):
            packed[i, j] = 0
        packed[FIELDS - 1, j] = -1e30


@leaf
def whiten(components, n, whitened):
    """Write the inverse Cholesky factor (row by row, 6 numbers) of the first n components by field, and weight over its
    determinant."""
    for k in range(n):
        xx, yy, zz = components[COVARIANCE, k], components[COVARIANCE + 4, k], components[COVARIANCE + 8, k]
        least = max(xx, yy, zz) * 1e-14  # the pivots of fused covariances are far above it
        l00 = math.sqrt(max(xx, least))
        l10, l20 = components[COVARIANCE + 3, k] / l00, components[COVARIANCE + 6, k] / l00
        l11 = math.sqrt(max(yy - l10 * l10, least))
        l21 = (components[COVARIANCE + 7, k] - l20 * l10) / l11
        l22 = math.sqrt(max(zz - l20 * l20 - l21 * l21, least))
        a, c, f = 1 / l00, 1 / l11, 1 / l22
        b, e = -l10 / (l00 * l11), -l21 / (l11 * l22)
        whitened[0, k], whitened[1, k], whitened[2, k] = a, b, c
        whitened[3, k], whitened[4, k], whitened[5, k] = -(l20 * a + l21 * b) / l22, e, f
        whitened[PEAK, k] = components[WEIGHT, k] / (l00 * l11 * l22)


@leaf
def limit(epsilon, count):
    """log2 of the share of a sum that one of ``count`` components may add at one level, with a margin for rounding."""
    return math.log2(epsilon / (2 * max(count, 1))) - 0.01


@leaf
def cull(packed, n, share, box, settings, work, retained):
    """Write those of the n packed components that matter in the box (low, high) to ``retained``; return their number.

    ``share`` is the level's :func:`limit`. ``work`` is scratch for 9 numbers and one for each component.
    """
    real = packed.dtype.type
    slack = 16 * (2.0**-23 if packed.itemsize == 4 else 2.0**-52)
    for i in range(3):
        centre, half = 0.5 * (box[i] + box[3 + i]), 0.5 * (box[3 + i] - box[i])
        work[i], work[3 + i] = centre, half + slack * (half + abs(centre))
    work[6], work[7], work[8] = slack, settings.least, settings.least_product
    upper = work[_BOX:]
    bounds(packed, packed.shape[1], padded(n), work, upper)
    density, product = work[7] + real(share), max(work[8], work[7] + real(_LOG2_LEAST)) + real(share)
    count = 0
    for j in range(n):
        retained[count] = j
        count += (upper[j] > density) | (upper[j] + packed[FIELDS, j] > product)
    return count
