"""Correspondence on the CPU (numba): candidates first, so that what is out of view costs nothing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.correspond import Correspondence
from ufmstar_torch.gaussian import PIXEL_VARIANCE
from ufmstar_torch.mixture import GaussianMixture

compiled: Any = njit(cache=True, nogil=True)


def correspond(
    previous_cam: GaussianMixture,
    current_cam: GaussianMixture,
    intrinsics: Tensor,
    size: tuple[int, int],
    config: UfMStarConfig,
) -> Correspondence:
    """As :func:`ufmstar_torch.correspond.correspond`, for CPU tensors."""
    b, k = previous_cam.weight.shape
    overlap = np.zeros((b, current_cam.capacity, k))
    match = np.zeros(overlap.shape, dtype=np.bool_)

    def arrays(mixture: GaussianMixture) -> list[np.ndarray]:
        fields = (mixture.mean, mixture.covariance, mixture.weight)
        return [value.detach().double().contiguous().numpy() for value in fields]

    camera = intrinsics.detach().double().contiguous().numpy()
    thresholds = (config.eta, config.eta_occlusion, config.near_plane, PIXEL_VARIANCE)
    previous, current = arrays(previous_cam), arrays(current_cam)
    for s in range(b):
        streams = (*(value[s] for value in previous), *(value[s] for value in current), camera[s])
        _stream(*streams, *size, *thresholds, match[s], overlap[s])
    return Correspondence(torch.from_numpy(match), torch.from_numpy(overlap))


@compiled
def _project(mean, covariance, weight, K, height, width, near, widening):
    """Indices of the candidates, and per candidate u, v, the covariance's xx, xy, yy, and the depth."""
    index = np.empty(weight.size, np.int64)
    image = np.empty((weight.size, 6))
    n = 0
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    for k in range(weight.size):
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


@compiled
def _bhattacharyya(p, q):
    """Overlap of two projected Gaussians."""
    xx, xy, yy = 0.5 * (p[2] + q[2]), 0.5 * (p[3] + q[3]), 0.5 * (p[4] + q[4])
    det = xx * yy - xy * xy
    product = (p[2] * p[4] - p[3] * p[3]) * (q[2] * q[4] - q[3] * q[3])
    dx, dy = p[0] - q[0], p[1] - q[1]
    squared = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / det
    return math.exp(-squared / 8) * min(1.0, math.sqrt(math.sqrt(product) / det))


@compiled
def _stream(
    mean_k, cov_k, weight_k, mean_c, cov_c, weight_c, K, height, width, eta, eta_occl, near, widening, match, overlap
):
    """One stream: overlaps of all candidate pairs, then the occlusion filter within each set."""
    index_k, image_k = _project(mean_k, cov_k, weight_k, K, height, width, near, widening)
    index_c, image_c = _project(mean_c, cov_c, weight_c, K, height, width, near, widening)
    members = np.empty(index_k.size, np.int64)
    for i in range(index_c.size):
        n = 0
        for j in range(index_k.size):
            beta = _bhattacharyya(image_c[i], image_k[j])
            overlap[index_c[i], index_k[j]] = beta
            if beta >= eta:
                members[n] = j
                n += 1
        for a in range(n):
            far = image_k[members[a]]
            hidden = False
            for b in range(n):
                near_one = image_k[members[b]]
                if near_one[5] < far[5] and _bhattacharyya(near_one, far) > eta_occl:
                    hidden = True
                    break
            match[index_c[i], index_k[members[a]]] = not hidden
