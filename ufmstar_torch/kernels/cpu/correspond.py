"""Correspondence by overlap on the CPU (numba), as a list of pairs.

Segments are processed one by one. Few candidates of the mixture overlap with a segment, and occlusion is tested among
those only.
"""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, leaf, part
from ufmstar_torch.kernels.cpu.rigid import COVARIANCE, WEIGHT


@part
def matches(fields, n, fields_c, n_c, K, height, width, thresholds):
    """The matched pairs of one stream, as :func:`ufmstar_torch.steps.correspond.correspond` states them.

    The n components k and the n_c components c are in the camera frame, by field [13, n and more] (``rigid``).

    Returns:
        c and k [2, P] and the overlap beta_ck [P] of every pair, in increasing c and then k.
    """
    eta, eta_occl, near, widening = thresholds
    image, image_c = empty((6, n), np.float64), empty((6, n_c), np.float64)
    index, index_c = empty(n, np.int64), empty(n_c, np.int64)
    count = _project(fields, n, K, height, width, near, widening, index, image)
    count_c = _project(fields_c, n_c, K, height, width, near, widening, index_c, image_c)
    limit, limit_occl = _limit(eta), _limit(eta_occl)
    members, overlap = empty(count, np.int64), empty(count, np.float64)
    found, beta, pairs = empty((2, 64), np.int64), empty(64, np.float64), 0
    for i in range(count_c):
        m = _overlapping(image_c, i, image, count, eta, limit, members, overlap)
        for a in range(m):
            if _hidden(image, members, m, a, eta_occl, limit_occl):
                continue
            if pairs == beta.size:
                found, beta = _resized(found, pairs, 2 * pairs), _longer(beta)
            found[0, pairs], found[1, pairs], beta[pairs] = index_c[i], index[members[a]], overlap[a]
            pairs += 1
    return _resized(found, pairs, pairs), beta[:pairs]


@part
def _limit(eta):
    """The squared distance beyond which the overlap is below eta, with a margin for rounding."""
    return -8 * math.log(eta) * (1 + 1e-9) + 1e-9


@part
def _resized(pairs, n, room):
    """The first n pairs [2, ...], with room for more."""
    out = empty((2, room), np.int64)
    for i in range(n):
        out[0, i], out[1, i] = pairs[0, i], pairs[1, i]
    return out


@part
def _longer(values):
    out = empty(2 * values.size, values.dtype)
    for i in range(values.size):
        out[i] = values[i]
    return out


@leaf
def _overlapping(image_c, i, image, count, eta, limit, members, overlap):
    """Write those of the first ``count`` whose overlap with projected Gaussian i is at least eta, and their overlaps;
    return their number."""
    n = 0
    for j in range(count):
        if not _far(image_c, i, image, j, limit):
            overlap[n] = _bhattacharyya(image_c, i, image, j)
            members[n] = j
            n += overlap[n] >= eta
    return n


@leaf
def _hidden(image, members, n, a, eta_occl, limit):
    """True if a nearer member covers member ``a``."""
    far = members[a]
    for b in range(n):
        near = members[b]
        if image[5, near] >= image[5, far] or _far(image, near, image, far, limit):
            continue
        if _bhattacharyya(image, near, image, far) > eta_occl:
            return True
    return False


@leaf
def _project(fields, n, K, height, width, near, widening, index, image):
    """Write the indices of the candidates among n components, and their u, v, the covariance's xx, xy, yy and the depth
    [6, n]; return their number."""
    count = 0
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    for k in range(n):
        x, y, z = fields[0, k], fields[1, k], fields[2, k]
        if not (fields[WEIGHT, k] > 0 and z > near):
            continue
        if abs(fx * x + (cx - 0.5 * width) * z) > (0.5 * width + 1) * z:
            continue  # outside by a pixel or more: skip the division
        u, v = fx * x / z + cx, fy * y / z + cy
        if not (u >= -0.5 and u < width - 0.5 and v >= -0.5 and v < height - 0.5):
            continue
        xx, xy, xz = fields[COVARIANCE, k], fields[COVARIANCE + 1, k], fields[COVARIANCE + 2, k]
        yy, yz, zy, zz = (
            fields[COVARIANCE + 4, k], fields[COVARIANCE + 5, k], fields[COVARIANCE + 7, k], fields[COVARIANCE + 8, k],
        )  # fmt: skip
        a, b, c, d = fx / z, -fx * x / (z * z), fy / z, -fy * y / (z * z)  # A = [[a, 0, b], [0, c, d]]
        index[count] = k
        image[0, count], image[1, count], image[5, count] = u, v, z
        image[2, count] = a * a * xx + 2 * a * b * xz + b * b * zz + widening
        image[3, count] = a * c * xy + a * d * xz + b * c * zy + b * d * zz
        image[4, count] = c * c * yy + 2 * c * d * yz + d * d * zz + widening
        count += 1
    return count


@leaf
def _far(one, i, other, j, limit):
    """True if two projected Gaussians are too far apart: d^T S^-1 d >= d_x^2 / S_xx, S their mean covariance."""
    dx, dy, half = one[0, i] - other[0, j], one[1, i] - other[1, j], limit * 0.5
    return dx * dx > half * (one[2, i] + other[2, j]) or dy * dy > half * (one[4, i] + other[4, j])


@leaf
def _bhattacharyya(one, i, other, j):
    """Overlap of two projected Gaussians."""
    xx, xy, yy = 0.5 * (one[2, i] + other[2, j]), 0.5 * (one[3, i] + other[3, j]), 0.5 * (one[4, i] + other[4, j])
    det = xx * yy - xy * xy
    product = (one[2, i] * one[4, i] - one[3, i] * one[3, i]) * (other[2, j] * other[4, j] - other[3, j] * other[3, j])
    dx, dy = one[0, i] - other[0, j], one[1, i] - other[1, j]
    squared = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / det
    return math.exp(-squared / 8) * min(1.0, math.sqrt(math.sqrt(product) / det))
