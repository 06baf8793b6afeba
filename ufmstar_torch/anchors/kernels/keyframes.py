"""Chooses the keyframes to compare with a view, and maps its pixels to theirs, for ``anchors.dense_keyframes``; on the
CPU (numba)."""

from __future__ import annotations

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, reordered, reordered_leaf

# Largest factor between the baseline of a keyframe and the requested one, and the logarithm of a factor that counts as
# much as a frame's age.
_MAX_FACTOR, _AGE = 2.5, 0.002
# Least share of a grid of points, _GRID on each axis, at the median depth in the present view, that a keyframe shows;
# their least depth in it, as a share of that.
_OVERLAP, _GRID, _AHEAD = 0.5, 4, 0.2


@reordered
def compare(pose, newest, count, T, K, K_inverse, size, depth, baselines, views, half):
    """Write the keyframes to compare with a view, at most one for each of B requested baselines, the shortest first.

    Args:
        pose: [R, 4, 4] camera-to-world poses in a ring [m].
        newest, count: index of the newest keyframe, and number of keyframes up to it.
        T: [4, 4] of the view [m].
        K, K_inverse: [3, 3] [px].
        size: (H, W) [px].
        depth: median of the scene [m].
        baselines: [B] as shares of ``depth``.
        views, half: ``dense.Views`` of B keyframes at the full and at half the size, overwritten but for their noise.

    Returns:
        Number of keyframes, and the longest baseline [m].
    """
    ring = len(pose)
    distance, chosen = empty(ring, np.float64), empty(len(baselines), np.float64)
    world, K_R, A, origin = (
        empty(3, np.float64), empty((3, 3), np.float64), empty((3, 3), np.float64), empty(3, np.float64),
    )  # fmt: skip
    for i in range(ring):
        square = 0.0
        for j in range(3):
            square += (pose[i, j, 3] - T[j, 3]) ** 2
        shown = (newest - i) % ring < count and _overlaps(pose[i], T, K, K_inverse, size, depth, world, K_R, origin)
        distance[i] = np.sqrt(square) / depth if shown else np.inf
    found = 0
    for index in range(len(baselines)):
        least, best = np.inf, -1
        for i in range(ring):
            mismatch = abs(np.log(max(distance[i], 1e-9) / baselines[index]))
            if mismatch < np.log(_MAX_FACTOR):
                mismatch += _AGE * ((newest - i) % ring)
                if mismatch < least:
                    least, best = mismatch, i
        if best < 0:
            continue
        at = found
        while at > 0 and chosen[at - 1] > distance[best]:
            chosen[at], views.slot[at], views.share[at] = chosen[at - 1], views.slot[at - 1], views.share[at - 1]
            at -= 1
        chosen[at], views.slot[at], views.share[at], distance[best] = distance[best], best, index, np.inf
        found += 1
    for k in range(found):
        _mapped(pose[views.slot[k]], T, K, K_inverse, K_R, A, views.H[k], views.b[k])
        half.slot[k], half.share[k] = views.slot[k], views.share[k]
        _halved(views.H[k], views.b[k], half.H[k], half.b[k])
    return found, depth * chosen[found - 1] if found > 0 else 0.0


@reordered_leaf
def _overlaps(pose, T, K, K_inverse, size, depth, world, K_R, origin):
    """True if a keyframe shows most of a grid of points of the view, at a depth."""
    height, width = size
    for i in range(3):
        origin[i] = 0.0
        for j in range(3):
            K_R[i, j] = K[i, 0] * pose[j, 0] + K[i, 1] * pose[j, 1] + K[i, 2] * pose[j, 2]
            origin[i] += K_R[i, j] * (T[j, 3] - pose[j, 3])
    inside = 0
    for row in range(_GRID):
        for column in range(_GRID):
            u, v = (column + 0.5) / _GRID * width, (row + 0.5) / _GRID * height
            x = K_inverse[0, 0] * u + K_inverse[0, 1] * v + K_inverse[0, 2]
            y = K_inverse[1, 1] * v + K_inverse[1, 2]
            for i in range(3):
                world[i] = depth * (T[i, 0] * x + T[i, 1] * y + T[i, 2])
            pu = K_R[0, 0] * world[0] + K_R[0, 1] * world[1] + K_R[0, 2] * world[2] + origin[0]
            pv = K_R[1, 0] * world[0] + K_R[1, 1] * world[1] + K_R[1, 2] * world[2] + origin[1]
            z = K_R[2, 0] * world[0] + K_R[2, 1] * world[1] + K_R[2, 2] * world[2] + origin[2]
            inside += z > _AHEAD * depth and 0 < pu < (width - 1) * z and 0 < pv < (height - 1) * z
    return inside >= _OVERLAP * _GRID * _GRID


@reordered_leaf
def _mapped(pose, T, K, K_inverse, K_R, A, H, b):
    """Write H = K R K^-1 [3, 3] and b = K t [3] of the view in a keyframe."""
    for i in range(3):
        b[i] = 0.0
        for j in range(3):
            K_R[i, j] = K[i, 0] * pose[j, 0] + K[i, 1] * pose[j, 1] + K[i, 2] * pose[j, 2]
            b[i] += K_R[i, j] * (T[j, 3] - pose[j, 3])
        for j in range(3):
            A[i, j] = K_R[i, 0] * T[0, j] + K_R[i, 1] * T[1, j] + K_R[i, 2] * T[2, j]
        for j in range(3):
            H[i, j] = A[i, 0] * K_inverse[0, j] + A[i, 1] * K_inverse[1, j] + A[i, 2] * K_inverse[2, j]


@reordered_leaf
def _halved(H, b, half_H, half_b):
    """Write the mapping between images of half the size: their pixel u is pixel 2 u + .5 here."""
    for i in range(3):
        one, shift = (0.5, -0.25) if i < 2 else (1.0, 0.0)
        half_b[i] = one * b[i] + shift * b[2]
        x, y, z = one * H[i, 0] + shift * H[2, 0], one * H[i, 1] + shift * H[2, 1], one * H[i, 2] + shift * H[2, 2]
        half_H[i, 0], half_H[i, 1], half_H[i, 2] = 2 * x, 2 * y, 0.5 * x + 0.5 * y + z
