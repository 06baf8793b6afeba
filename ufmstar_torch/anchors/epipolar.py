"""Distances of matches between two posed views from their epipolar lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ufmstar_torch.gaussians.camera import inverse_intrinsics

# Least depth of a projected point, as a share of the median depth; the depth of nearer points is raised to it.
NEAREST = 1e-3
# Range of a scene's depths over the median, in which corners' points must lie. The upper limit is far above the median,
# which is inaccurate at first.
NEAR, FAR = 1 / 50, 10.0
# Cells of the image per axis; matches of each cell have the same total weight.
_CELLS = 6
# The standard deviation of most matches is that by the quantile _MOST of their distances, _MOST_QUANTILE of a standard
# normal one. Farther than _FARTHEST times it from their lines are matches on things that move, which leave their lines
# as a group.
_MOST, _MOST_QUANTILE, _FARTHEST = 0.3, 0.3853, 6.0


def off_lines(
    position: NDArray, before: NDArray, T: NDArray, T_before: NDArray, K: NDArray, near: float, far: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Compute the distances of matches from the segment of the epipolar line between two depths.

    Without parallax, the segment is a point. A match that moved in the wrong direction, or not at all, lies beyond an
    end of it.

    Args:
        position: [N, 2] (u, v) in the present view [px].
        before: [N, 2] in an earlier view.
        T: [4, 4] camera-to-world of the present view [m].
        T_before: [N, 4, 4] of the earlier views [m].
        K: [3, 3] [px].
        near, far: range of the depths [m].

    Returns:
        [N] distances [px], [N] inverse depths of the nearest points on the whole lines [1/m], [N] baselines [m].
    """
    from ufmstar_torch.anchors.kernels.epipolar import from_lines  # compiles when it is first needed

    distance, rho, baseline = np.zeros((3, len(position)))
    cameras = T, T_before, K, inverse_intrinsics(K)
    from_lines(position, before, *cameras, 1 / near, 1 / far, NEAREST, distance, rho, baseline)
    return distance, rho, baseline


def on_lines(
    distance: NDArray[np.float64], pixel: NDArray[np.float64], size: ArrayLike, least: float
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """The largest group of matches that lie on their epipolar lines: those nearer than six standard deviations of the
    nearest 30 %, by area.

    Args:
        distance: [N] from the lines, over the standard deviation of tracking or in pixels.
        pixel: [N, 2] (u, v).
        size: [2] width and height of the image [px].
        least: of the standard deviation, in the unit of ``distance``.

    Returns:
        [N] True in the group; [N] weights by area, as a moving object may have most of the corners.
    """
    cell = (pixel * _CELLS / np.asarray(size)).astype(np.int64).clip(0, _CELLS - 1) @ [1, _CELLS]
    weight: NDArray[np.float64] = 1 / np.bincount(cell)[cell]
    sigma = max(weighted_quantile(distance, weight, _MOST) / _MOST_QUANTILE, least)
    return distance <= _FARTHEST * sigma, weight


def median(values: NDArray[np.float64]) -> float:
    """The median of values [N], N at least 1; ``np.median`` takes five times as long for a few hundred."""
    ordered, n = np.sort(values), len(values)
    return float(ordered[(n - 1) // 2] + ordered[n // 2]) / 2


def weighted_quantile(values: NDArray[np.float64], weight: NDArray[np.float64], share: float) -> float:
    """The quantile ``share`` of values [N] with weights [N]."""
    order = values.argsort()
    return float(values[order[np.searchsorted(weight[order].cumsum(), weight.sum() * share)]])
