"""Matches of two posed views: how far they lie from where the poses allow the points of a scene to be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Share of the median depth: the position of a nearer point in an image is not computed but bounded.
NEAREST = 1e-3
# Share of the way to the image plane of the earlier camera up to which a point may lie.
_AHEAD = 0.98


def off_lines(
    position: NDArray, before: NDArray, T: NDArray, T_before: NDArray, K: NDArray, near: float, far: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Compute how far matches lie from the part of the epipolar line on which points of a scene can lie.

    Without parallax, that is a point; a match that moved the wrong way, or not at all, lies beyond its end.

    Args:
        position: [N, 2] (u, v) in the present view [px].
        before: [N, 2] in an earlier one.
        T: [4, 4] camera-to-world of the present view [m].
        T_before: [N, 4, 4] of the earlier ones.
        K: [3, 3] [px].
        near, far: range of the depths [m].

    Returns:
        [N] distances [px], [N] inverse depths of the nearest points of the whole lines [1/m], [N] baselines [m].
    """
    rays = np.concatenate([position, np.ones((len(position), 1))], axis=1) @ np.linalg.inv(K).T
    into = T_before[:, :3, :3].transpose(0, 2, 1)
    moved = (into @ (T[:3, 3] - T_before[:, :3, 3])[..., None])[..., 0]
    x, b = (into @ (T[:3, :3] @ rays.T).T[..., None])[..., 0] @ K.T, moved @ K.T

    # In front of the earlier camera too: 1/z < x_z/-b_z.
    most = np.where(b[:, 2] < 0, _AHEAD * x[:, 2] / np.maximum(-b[:, 2], 1e-12), np.inf)

    def seen(depth: float) -> NDArray[np.float64]:
        point = x + b * np.minimum(1 / depth, most)[:, None]
        return np.asarray(point[:, :2] / np.maximum(point[:, 2:], NEAREST))

    start = seen(near)
    way, from_start = seen(far) - start, before - start
    share = (from_start * way).sum(1) / np.maximum(np.square(way).sum(1), 1e-12)
    off = from_start - share.clip(0, 1)[:, None] * way
    speed = b[:, :2] - before * b[:, 2:]
    rho = ((before * x[:, 2:] - x[:, :2]) * speed).sum(1) / np.maximum(np.square(speed).sum(1), 1e-12)
    return np.linalg.norm(off, axis=1), rho, np.linalg.norm(moved, axis=1)


def median(values: NDArray[np.float64]) -> float:
    """The median of values [N], N at least 1; ``np.median`` takes five times as long for some hundred."""
    ordered, n = np.sort(values), len(values)
    return float(ordered[(n - 1) // 2] + ordered[n // 2]) / 2


def weighted_median(values: NDArray[np.float64], weight: NDArray[np.float64]) -> float:
    """The median of values [N] with weights [N]."""
    order = values.argsort()
    return float(values[order[np.searchsorted(weight[order].cumsum(), weight.sum() / 2)]])
