"""Which components matter in a box of points, on the CPU (numba): culling in three levels, and its error.

A component k adds w_k(x) = pi_k N(x; mu_k, Sigma_k) to the denominator D(x) = pi_0 + sum_k w_k(x) of a point x.

1. Image: w_k(x) exceeds a threshold in an ellipsoid only. Its silhouette has a bounding box of pixels.
   Those that level 2 leaves out in a box around all points of the image go at once, which changes no bit.
2. Block of 32 x 32 pixels: for the components whose silhouette meets the image, interval arithmetic over the bounding
   box of the block's points gives l_k <= w_k(x) <= h_k.
3. Tile of 8 x 8 pixels: the same, for the components that the block keeps.

Each level leaves out the components with h_k <= (eps / 3n) max(max_j l_j, pi_0 / 1000), with n components at that level
(level 1: max_j l_j = 0). max_j l_j and pi_0 are parts of the denominator, so that the components left out add up to
d(x) <= eps max(max_j w_j(x), pi_0 / 1000) <= eps D(x). The error is d/D times the difference of two averages of m_k
and mu_0:

    |m_hat - m_hat_culled| <= eps max(m_k, mu_0),

and eps / 1000 max(m_k, mu_0) at a point that no component explains (every w_j <= pi_0 / 1000). The factor 1000 keeps
the *relative* error small there, where m_hat itself is small. What the arithmetic rounds off comes on top; the bounds
contain their own rounding. tests/test_regress.py checks the bound.
"""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import kernel, leaf
from ufmstar_torch.kernels.regress_points_cpu import prepare
from ufmstar_torch.kernels.regress_vectors_cpu import TERMS, bounds, largest
from ufmstar_torch.kernels.vectors_cpu import LANES

_PRIOR = 1e-3  # share of the prior in a threshold
FIELDS = 10  # of a component: mean (3), whitening (6), log2 of the peak
_LOG2_E = math.log2(math.e)


@kernel
def in_view(slots, occupied, mean, covariance, weight, m, features, K, depth, prior_weight, prior_mean, epsilon):
    """The components of a mixture [K, ...] that can matter in an image, as :func:`exact` takes them.

    Args:
        slots: [n] increasing, the only ones that are looked at.
        occupied: how many components the mixture has, others than those included.
        depth: [H, W], not positive where there is none.

    Returns:
        Indices [n], fields [n, 10], the same in the dtype of ``depth`` and by field [10, n and more], the terms of the
        sum [n, TERMS], and the settings: prior weight and mean, epsilon, log2 of the least threshold,
        and how many components level 1 left.
    """
    height, width = depth.shape
    index, whitening, log_peak = prepare(slots.copy(), mean, covariance, weight)
    least, limit = math.log2(_PRIOR * prior_weight), negligible(prior_weight, epsilon, occupied)
    fields, constants = np.empty((index.size, FIELDS)), np.empty((index.size, TERMS), depth.dtype)
    n = _visible(mean, covariance, index, whitening, log_peak, K, height, width, limit, fields, constants, m, features)
    packed, kept = np.empty((FIELDS, _padded(n)), depth.dtype), np.empty(n, np.int64)
    _pack(fields, n, packed)
    z = _farthest(depth, np.empty(1, depth.dtype))
    left, top = (0 - K[0, 2]) / K[0, 0] * z, (0 - K[1, 2]) / K[1, 1] * z
    right, bottom = (width - 1 - K[0, 2]) / K[0, 0] * z, (height - 1 - K[1, 2]) / K[1, 1] * z
    box = min(left, 0.0), min(top, 0.0), 0.0, max(right, 0.0), max(bottom, 0.0), z
    settings, work = (prior_weight, prior_mean, epsilon, least, n), np.empty(8 + packed.shape[1], depth.dtype)
    # Blocks take n components; a few more lower the threshold by more than what rounding can make of two boxes.
    chosen = cull(packed, n, n + n // 64 + 1, box, settings, work, kept)
    for i in range(chosen):
        k = kept[i]
        index[i] = index[k]
        for j in range(FIELDS):
            fields[i, j] = fields[k, j]
        for j in range(TERMS):
            constants[i, j] = constants[k, j]
    packed = np.empty((FIELDS, _padded(chosen)), depth.dtype)
    _pack(fields, chosen, packed)
    return index[:chosen], fields, packed, constants, settings


@leaf
def _pack(fields, n, packed):
    """The fields [n, 10] by field, and behind them components that are nowhere."""
    for i in range(FIELDS):
        for k in range(n):
            packed[i, k] = fields[k, i]
    pad(packed, n)


@leaf
def _farthest(depth, work):
    """The largest depth; ``work`` is scratch."""
    flat = depth.reshape(-1)
    n = flat.size - flat.size % (4 * LANES)
    work[0] = 0
    largest(flat, n, work)
    most = work[0]
    for i in range(n, flat.size):
        most = flat[i] if flat[i] > most else most
    return np.float64(most)


@leaf
def negligible(prior_weight, epsilon, count):
    """log2 of the density that one of ``count`` components must exceed somewhere in an image to be looked at."""
    return _limit(epsilon, count) + math.log2(_PRIOR * prior_weight)


@leaf
def _limit(epsilon, count):
    """log2 of the share of a lower bound that one component may add at one level, a little less for rounding."""
    return math.log2(epsilon / (3 * max(count, 1))) - 0.01


@leaf
def _padded(n):
    """A multiple, not below n, of what a vector loop takes at a time: its remainder would take as long again."""
    return (n + LANES - 1) // LANES * LANES


@leaf
def pad(packed, n):
    """Fill the fields behind n components up to the padded number with those of one that is nowhere."""
    for j in range(n, _padded(n)):
        for i in range(FIELDS - 1):
            packed[i, j] = 0
        packed[FIELDS - 1, j] = -1e30


@leaf
def _visible(mean, covariance, index, whitening, log_peak, K, height, width, limit, fields, constants, m, features):
    """Write the fields of the components whose density can exceed 2^limit at a pixel of the image.

    The fields are mean, whitening and log2 of the peak: 2^(peak - |whitening (x - mean)|^2) is the density.
    ``constants`` are the terms of the sum. The indices of these components move to the head of
    ``index``; returns how many there are.
    """
    scale, n = math.sqrt(0.5 * _LOG2_E), 0
    for k in range(index.size):
        square = 2 * (log_peak[k] - limit / _LOG2_E) * (1 + 1e-6)
        if not _meets(mean, covariance, index[k], square, K, height, width):
            continue
        for i in range(3):
            fields[n, i] = mean[index[k], i]
        for i in range(6):
            fields[n, 3 + i] = whitening[k, i] * scale
        fields[n, 9] = log_peak[k] * _LOG2_E
        for i in range(6):
            constants[n, i] = fields[n, 3 + i]
        constants[n, 6], constants[n, 7] = fields[n, 9], m[index[k]]
        for g in range(min(3, features.shape[1])):
            constants[n, 8 + g] = features[index[k], features.shape[1] - 1 - g]
        index[n] = index[k]
        n += 1
    return n


@leaf
def _meets(mean, covariance, k, square, K, height, width):
    """Whether the ellipsoid (x - mu)^T S^-1 (x - mu) = square can have a point in the view.

    Its silhouette lies between the planes x = s z (and y = s z) that touch it, (mu_x - s mu_z)^2 =
    square (S_xx - 2 s S_xz + s^2 S_zz): a quadratic equation in s. One that reaches z = 0 may be anywhere.
    """
    sxx, syy, szz = covariance[k, 0, 0], covariance[k, 1, 1], covariance[k, 2, 2]
    z = mean[k, 2]
    least = 1e-14 * max(sxx, syy, szz)  # as in prepare
    szz = square * (szz + least)
    a = z * z - szz
    if square <= 0 or (z < 0 and a > 1e-6 * szz):
        return False  # its peak is too low, or it lies behind the camera
    if a <= 1e-6 * szz:
        return True
    for axis in range(2):
        x, sx = mean[k, axis], covariance[k, axis, axis] + least
        half_b = x * z - square * covariance[k, axis, 2]
        root = math.sqrt(max(half_b * half_b - a * (x * x - square * sx), 0.0))
        root += 1e-9 * (abs(half_b) + root)
        p = (half_b - root) / a * K[axis, axis] + K[axis, 2]
        q = (half_b + root) / a * K[axis, axis] + K[axis, 2]
        if max(p, q) < -1 or min(p, q) > (width if axis == 0 else height):
            return False
    return True


@leaf
def cull(packed, n, level, box, settings, work, kept):
    """Write those of the n packed components that matter in the box (low, high) to ``kept``; return how many.

    ``level`` is how many components the level has, whose share of a threshold each may add.
    ``work`` is scratch for 8 numbers and one for each component.
    """
    real = packed.dtype.type
    epsilon, least = settings[2], settings[3]
    slack = 16 * np.finfo(packed.dtype).eps
    for i in range(3):
        centre, half = 0.5 * (box[i] + box[3 + i]), 0.5 * (box[3 + i] - box[i])
        work[i], work[3 + i] = centre, half + slack * (half + abs(centre))
    work[6], work[7] = slack, least
    upper = work[8:]
    bounds(packed, packed.shape[1], _padded(n), work, upper)
    threshold = work[7] + real(_limit(epsilon, level))
    count = 0
    for j in range(n):
        kept[count] = j
        count += upper[j] > threshold
    return count
