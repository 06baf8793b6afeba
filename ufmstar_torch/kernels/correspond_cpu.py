"""Correspondence on the CPU (numba) as a list of pairs: what is out of view costs nothing, and no matrix is formed."""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import part


@part
def matches(slots, mean_k, cov_k, weight_k, mean_c, cov_c, weight_c, K, height, width, eta, eta_occl, near, widening):
    """The matched pairs of one stream, as :func:`ufmstar_torch.correspond.correspond` states them.

    Components k [K] and c [C] are in the camera frame, float64. Of the k only ``slots`` [n], increasing, are looked at.

    Returns:
        c [P], k [P] and the overlap beta_ck [P] of every pair, in increasing c and then k.
    """
    index_k, image_k = _project(slots, mean_k, cov_k, weight_k, K, height, width, near, widening)
    index_c, image_c = _project(np.arange(weight_c.size), mean_c, cov_c, weight_c, K, height, width, near, widening)
    limit, limit_occl = _limit(eta), _limit(eta_occl)
    members, overlap = np.empty(index_k.size, np.int64), np.empty(index_k.size)
    c, k, beta = np.empty(64, np.int64), np.empty(64, np.int64), np.empty(64)
    pairs = 0
    for i in range(index_c.size):
        n = 0
        for j in range(index_k.size):
            if _far(image_c[i], image_k[j], limit):
                continue
            overlap[n] = _bhattacharyya(image_c[i], image_k[j])
            members[n] = j
            n += overlap[n] >= eta
        for a in range(n):
            if _hidden(image_k, members, n, a, eta_occl, limit_occl):
                continue
            if pairs == c.size:
                c, k, beta = _longer(c), _longer(k), _longer(beta)
            c[pairs], k[pairs], beta[pairs] = index_c[i], index_k[members[a]], overlap[a]
            pairs += 1
    return c[:pairs], k[:pairs], beta[:pairs]


@part
def _limit(eta):
    """Of the squared distance from which on the overlap is certainly below eta, with room for rounding."""
    return -8 * math.log(eta) * (1 + 1e-9) + 1e-9


@part
def _longer(values):
    out = np.empty(2 * values.size, values.dtype)
    for i in range(values.size):
        out[i] = values[i]
    return out


@part
def _hidden(image, members, n, a, eta_occl, limit):
    """Whether a nearer member covers member ``a``."""
    far = image[members[a]]
    for b in range(n):
        near = image[members[b]]
        if near[5] < far[5] and not _far(near, far, limit) and _bhattacharyya(near, far) > eta_occl:
            return True
    return False


@part
def _project(slots, mean, covariance, weight, K, height, width, near, widening):
    """Indices of the candidates among ``slots``, and per candidate u, v, the covariance's xx, xy, yy, and the depth."""
    index = np.empty(slots.size, np.int64)
    image = np.empty((slots.size, 6))
    n = 0
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    for k in slots:
        x, y, z = mean[k]
        if not (weight[k] > 0 and z > near):
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        if not (u >= -0.5 and u < width - 0.5 and v >= -0.5 and v < height - 0.5):
            continue
        S = covariance[k]
        a, b, c, d = fx / z, -fx * x / (z * z), fy / z, -fy * y / (z * z)  # A = [[a, 0, b], [0, c, d]]
        index[n] = k
        image[n, 0], image[n, 1], image[n, 5] = u, v, z
        image[n, 2] = a * a * S[0, 0] + 2 * a * b * S[0, 2] + b * b * S[2, 2] + widening
        image[n, 3] = a * c * S[0, 1] + a * d * S[0, 2] + b * c * S[2, 1] + b * d * S[2, 2]
        image[n, 4] = c * c * S[1, 1] + 2 * c * d * S[1, 2] + d * d * S[2, 2] + widening
        n += 1
    return index[:n], image[:n]


@part
def _far(p, q, limit):
    """Whether two projected Gaussians are too far apart: d^T S^-1 d >= d_x^2 / S_xx, S their mean covariance."""
    dx, dy = p[0] - q[0], p[1] - q[1]
    return dx * dx > limit * 0.5 * (p[2] + q[2]) or dy * dy > limit * 0.5 * (p[4] + q[4])


@part
def _bhattacharyya(p, q):
    """Overlap of two projected Gaussians."""
    xx, xy, yy = 0.5 * (p[2] + q[2]), 0.5 * (p[3] + q[3]), 0.5 * (p[4] + q[4])
    det = xx * yy - xy * xy
    product = (p[2] * p[4] - p[3] * p[3]) * (q[2] * q[4] - q[3] * q[3])
    dx, dy = p[0] - q[0], p[1] - q[1]
    squared = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / det
    return math.exp(-squared / 8) * min(1.0, math.sqrt(math.sqrt(product) / det))
