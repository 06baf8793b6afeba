"""Points as a camera sees them: registration of a depth map to the colour camera beside it."""

from __future__ import annotations

import numpy as np

from ufmstar_torch.eval.sequences.frame import Size


def register_depth(
    depth: np.ndarray, K_depth: np.ndarray, K_color: np.ndarray, T_color_depth: np.ndarray, size: Size
) -> np.ndarray:
    """Depth as the colour camera sees it: points are forward-warped, the nearest one wins (z-buffer).

    Each point fills the one pixel it falls on, so where the colour image is finer than the depth map, and
    at the edges that only the colour camera sees, pixels stay 0.

    Args:
        depth: [H, W] of the depth camera [m], 0 = invalid.
        K_depth: [3, 3] [px].
        K_color: [3, 3] [px].
        T_color_depth: [4, 4] takes points of the depth camera into the colour camera [m].
        size: (H, W) of the result.

    Returns:
        ``size`` float32 depth along the colour camera's z [m], 0 = invalid.
    """
    v, u = np.nonzero(depth > 0)
    z = depth[v, u].astype(np.float64)
    points = np.linalg.inv(K_depth) @ np.stack([u * z, v * z, z])
    return project(T_color_depth[:3, :3] @ points + T_color_depth[:3, 3:], K_color, size)


def project(points: np.ndarray, K: np.ndarray, size: Size) -> np.ndarray:
    """The depth map of points: each pixel takes the nearest one that falls on it.

    Args:
        points: [3, N] in the camera's frame [m].
        K: [3, 3] of the camera [px].
        size: (H, W) of its images.

    Returns:
        ``size`` float32 depth along z [m], 0 where there is none.
    """
    x, y, z = points[:, points[2] > 0]
    column = np.rint((K[0, 0] * x + K[0, 1] * y) / z + K[0, 2])
    row = np.rint(K[1, 1] * y / z + K[1, 2])
    inside = (column >= 0) & (column < size[1]) & (row >= 0) & (row < size[0])
    depth = np.full(size, np.inf)
    np.minimum.at(depth, (row[inside].astype(np.intp), column[inside].astype(np.intp)), z[inside])
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32)
