"""Components behind all that a frame sees, on the CPU (numba); the reference is ``ufmstar_torch.occlude``."""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import leaf, part
from ufmstar_torch.occlude import BLOCK, NEGLIGIBLE

_HALF_LOG_TWO_PI_CUBED = 1.5 * math.log(2 * math.pi)


@part
def visible(slots, weight, mean, covariance, K, depth, ratio, prior_weight):
    """Of the components ``slots`` [n] in the camera frame those that are not hidden, in their order; the others' weight
    becomes 0.

    Args:
        depth: [H, W], 0 where there is none.
        ratio: ``config.occlusion_depth``.
    """
    grid = np.empty(((depth.shape[0] + BLOCK - 1) // BLOCK, (depth.shape[1] + BLOCK - 1) // BLOCK))
    _see(depth, grid)
    least = np.inf
    for i in range(grid.size):
        least = min(least, grid[i // grid.shape[1], i % grid.shape[1]])
    limit = math.log(NEGLIGIBLE * prior_weight) + _HALF_LOG_TWO_PI_CUBED
    kept, n = np.empty(slots.size, np.int64), 0
    for k in slots:
        kept[n] = k
        if mean[k, 2] > ratio * least and _hidden(mean, covariance, weight, k, K, grid, ratio, limit):
            weight[k] = 0
        else:
            n += 1
    return kept[:n]


@leaf
def _see(depth, grid):
    """The depth that every block sees: the largest; infinite where less than half of its pixels have one."""
    for block in range(grid.size):
        row, column = block // grid.shape[1], block % grid.shape[1]
        v1, u1 = min((row + 1) * BLOCK, depth.shape[0]), min((column + 1) * BLOCK, depth.shape[1])
        some, most = 0, depth.dtype.type(0)
        for v in range(row * BLOCK, v1):
            for u in range(column * BLOCK, u1):
                z = depth[v, u]
                some += z > 0
                most = z if z > most else most
        pixels = (v1 - row * BLOCK) * (u1 - column * BLOCK)
        grid[row, column] = most if 2 * some >= pixels else np.inf


@leaf
def _hidden(mean, covariance, weight, k, K, grid, ratio, limit):
    """Whether component k is hidden, or projects nowhere into the image."""
    a, b, c = covariance[k, 0, 0], covariance[k, 1, 1], covariance[k, 2, 2]
    d, e, f = covariance[k, 1, 0], covariance[k, 2, 0], covariance[k, 2, 1]
    l00 = math.sqrt(a)
    l10, l20 = d / l00, e / l00
    l11 = math.sqrt(b - l10 * l10)
    l21 = (f - l20 * l10) / l11
    l22 = math.sqrt(c - l20 * l20 - l21 * l21)
    square = max(2 * (math.log(weight[k] / (l00 * l11 * l22)) - limit), 0.0)
    z = mean[k, 2]
    near, far = z - math.sqrt(square * c), -np.inf
    if not near > 0:
        return False
    left, right = _outline(mean[k, 0], z, square, a, e, c, K[0, 0], K[0, 2], grid.shape[1])
    top, bottom = _outline(mean[k, 1], z, square, b, f, c, K[1, 1], K[1, 2], grid.shape[0])
    for row in range(top, bottom):
        for column in range(left, right):
            far = max(far, grid[row, column])
    return near > far and z > ratio * far


@leaf
def _outline(x, z, square, sxx, sxz, szz, focal, centre, blocks):
    """The first block along an axis of the image that the ellipsoid's outline meets, and the one behind the last."""
    a, half_b = z * z - square * szz, x * z - square * sxz
    root = math.sqrt(max(half_b * half_b - a * (x * x - square * sxx), 0.0))
    low = ((half_b - root) / a * focal + centre + 0.5) / BLOCK
    high = ((half_b + root) / a * focal + centre + 0.5) / BLOCK
    if not (low <= blocks and high >= 0):
        return 0, 0
    return max(math.ceil(low) - 1, 0), min(math.floor(high) + 1, blocks)
