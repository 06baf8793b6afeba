"""Which components matter in a box of points, on the CPU (numba): ``regress_tiles_cpu`` derives the bounds."""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import contracted, kernel, leaf
from ufmstar_torch.kernels.regress_points_cpu import prepare

_PRIOR = 1e-3  # share of the prior in a threshold
FIELDS = 10  # of a component: mean (3), whitening (6), log2 of the peak
_TERMS = 9  # of a component, whatever the tile: whitening (6), log2 of the peak, m, last feature
_LOG2_E = math.log2(math.e)


@kernel
def in_view(
    slots, occupied, mean, covariance, weight, m, features, K, height, width, prior_weight, prior_mean, epsilon, zero
):
    """The components of a mixture [K, ...] that can matter in an image, as :func:`exact` takes them.

    Args:
        slots: [n] increasing, the only ones that are looked at.
        occupied: how many components the mixture has, others than those included.

    Returns:
        Indices [n], fields [n, 10], the same in the dtype of ``zero`` and by field [10, n and more], the terms of the
        sum [n, 9], and the settings (prior weight and mean, epsilon, log2 of the least threshold).
    """
    index, whitening, log_peak = prepare(slots.copy(), mean, covariance, weight)
    least, limit = math.log2(_PRIOR * prior_weight), negligible(prior_weight, epsilon, occupied)
    fields, constants = np.empty((index.size, FIELDS)), np.empty((index.size, _TERMS), np.array(zero).dtype)
    n = _visible(mean, covariance, index, whitening, log_peak, K, height, width, limit, fields, constants, m, features)
    packed = np.empty((FIELDS, _padded(n)), constants.dtype)
    for i in range(FIELDS):
        for k in range(n):
            packed[i, k] = fields[k, i]
    pad(packed, n)
    return index[:n], fields, packed, constants, (prior_weight, prior_mean, epsilon, least)


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
    return (n + 15) // 16 * 16


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
        constants[n, 8] = features[index[k], features.shape[1] - 1] if features.shape[1] > 0 else 0.0
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


@contracted
def _bounds(packed, n, centre, half, slack, bounds):
    """log2 of the lower and upper bounds [2, n] of n densities in the box centre +- half.

    ``slack`` times the coordinates bounds the rounding of the distances, and widens the box by it. Infinity and NaN,
    from a far outlier, keep a component and bound nothing.
    """
    cx, cy, cz = centre
    hx, hy, hz = half
    zero, least = slack - slack, packed.dtype.type(-1e30)
    for j in range(n):
        dx, dy, dz = cx - packed[0, j], cy - packed[1, j], cz - packed[2, j]
        wx, wy, wz = hx + slack * abs(packed[0, j]), hy + slack * abs(packed[1, j]), hz + slack * abs(packed[2, j])
        a, b, c, d, e, f = packed[3, j], packed[4, j], packed[5, j], packed[6, j], packed[7, j], packed[8, j]
        y0, r0 = abs(a * dx), a * wx
        y1, r1 = abs(b * dx + c * dy), abs(b) * wx + c * wy
        y2, r2 = abs(d * dx + e * dy + f * dz), abs(d) * wx + abs(e) * wy + f * wz
        p0, p1, p2 = y0 + r0, y1 + r1, y2 + r2
        low = packed[9, j] - (p0 * p0 + p1 * p1 + p2 * p2)
        bounds[0, j] = low if low > least else least
        q0, q1, q2 = y0 - r0, y1 - r1, y2 - r2
        q0, q1, q2 = q0 if q0 > zero else zero, q1 if q1 > zero else zero, q2 if q2 > zero else zero
        bounds[1, j] = packed[9, j] - (q0 * q0 + q1 * q1 + q2 * q2)


@leaf
def _greatest(bounds, n, start):
    """The greatest of ``start`` and n lower bounds."""
    a = b = c = start  # four chains of comparisons, which do not wait for each other
    for j in range(0, n - 3, 4):
        start = bounds[0, j] if bounds[0, j] > start else start
        a = bounds[0, j + 1] if bounds[0, j + 1] > a else a
        b = bounds[0, j + 2] if bounds[0, j + 2] > b else b
        c = bounds[0, j + 3] if bounds[0, j + 3] > c else c
    for j in range(n - n % 4, n):
        start = bounds[0, j] if bounds[0, j] > start else start
    return max(max(start, a), max(b, c))


@leaf
def cull(packed, n, box, settings, bounds, kept):
    """Write the packed components that matter in the box to ``kept``; return how many."""
    real = packed.dtype.type
    x_low, y_low, z_low, x_high, y_high, z_high = box
    _, _, epsilon, least = settings
    slack = real(16 * np.finfo(packed.dtype).eps)
    cx, cy, cz = 0.5 * (x_low + x_high), 0.5 * (y_low + y_high), 0.5 * (z_low + z_high)
    hx, hy, hz = 0.5 * (x_high - x_low), 0.5 * (y_high - y_low), 0.5 * (z_high - z_low)
    hx, hy, hz = hx + slack * (hx + abs(cx)), hy + slack * (hy + abs(cy)), hz + slack * (hz + abs(cz))
    _bounds(packed, _padded(n), (real(cx), real(cy), real(cz)), (real(hx), real(hy), real(hz)), slack, bounds)
    threshold = _greatest(bounds, n, real(least)) + _limit(epsilon, n)
    count = 0
    for j in range(n):
        kept[count] = j
        count += bounds[1, j] > threshold
    return count
