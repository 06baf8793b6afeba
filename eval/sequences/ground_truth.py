"""Resampling of maps from one pinhole camera to another: ground truth at the prediction's pixels, registration.

For ``truth_at``, both cameras have the same pose; only focal length, principal point and size differ. This covers
resizing and cropping of one image, and depth maps with separate intrinsics (ScanNet's 640x480 depth and 1296x968
colour, whose export also ignores the few millimetres between the cameras). Depth along the optical axis is equal in
both cameras. ``register_depth`` moves a depth map to a camera with another pose (7-Scenes: 2.5 cm apart).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.sequences.frame import Frame, FrameError, Size
from ufmstar_torch.eval.sequences.intrinsics import scale_intrinsics

# [px] Added to coordinates, so that rounding of the intrinsics does not decide about centres exactly on the border of
# two pixels (a resize by 2); it is below the accuracy of any calibration.
_BORDER = 1e-6


def resample_nearest(values: NDArray, K_from: NDArray, K_to: NDArray, size: Size) -> NDArray:
    """Resample ``values`` [H, W, ...] of the camera ``K_from`` to [h, w, ...] of the camera ``K_to`` with ``size``
    (h, w) by nearest neighbour; 0 (False) outside. Values are not interpolated, because a mean over a depth edge is on
    no surface."""
    mapping = np.asarray(K_from @ np.linalg.inv(K_to), np.float64)
    source, inside = _source(mapping.tobytes(), values.shape[:2], size)
    result = values.reshape(-1, *values.shape[2:])[source]
    return np.where(inside.reshape(*size, *[1] * (values.ndim - 2)), result, np.zeros((), values.dtype))


@lru_cache(maxsize=16)
def _source(mapping: bytes, size_from: Size, size: Size) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """For every pixel [h, w] of the second camera, the flat index of the pixel of the first one (H, W), and True if it
    is inside. ``mapping`` [3, 3] float64 maps pixels of the second camera to the first one."""
    M = np.frombuffer(mapping).reshape(3, 3)
    v, u = np.mgrid[0 : size[0], 0 : size[1]].astype(np.float64)
    return nearest_pixels(M[0, 0] * u + M[0, 1] * v + M[0, 2], M[1, 1] * v + M[1, 2], size_from)


def nearest_pixels(u: NDArray, v: NDArray, size: Size) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """For positions u, v [px] in an image of ``size`` (h, w), the flat index of the pixel that contains each, or of the
    nearest one on the border, and True if the position is inside. NaN is outside, at index 0."""
    (height, width), (column, row) = size, (np.floor(x + 0.5 + _BORDER) for x in (u, v))
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    row, column = np.nan_to_num(row).clip(0, height - 1), np.nan_to_num(column).clip(0, width - 1)
    return (row * width + column).astype(np.intp), inside


def depth_camera(frame: Frame) -> NDArray:
    """[3, 3] intrinsics of the frame's depth map [px]. Raises FrameError: depth and image have different aspect ratios,
    and the depth has no intrinsics."""
    if frame.depth_intrinsics is not None or frame.depth is None or frame.image is None:
        return frame.intrinsics if frame.depth_intrinsics is None else frame.depth_intrinsics
    try:
        return scale_intrinsics(frame.intrinsics, frame.image.shape[:2], frame.depth.shape[:2])
    except ValueError as error:
        raise FrameError(frame.name, f"the depth map has no camera: {error}") from error


def truth_at(frame: Frame, K: NDArray, size: Size) -> NDArray | None:
    """Ground truth [h, w] float32 [m] at the pixels of a prediction with camera K [3, 3] [px] and ``size`` (h, w), 0 =
    none; None without a depth map. Raises FrameError, see ``depth_camera``."""
    return None if frame.depth is None else resample_nearest(frame.depth, depth_camera(frame), K, size)


def moving_at(frame: Frame, K: NDArray, size: Size) -> NDArray[np.bool_] | None:
    """The mask of moving pixels at the pixels of a prediction, as :func:`truth_at`; None without a mask."""
    return None if frame.moving is None else resample_nearest(frame.moving, depth_camera(frame), K, size)


def register_depth(
    depth: np.ndarray, K_depth: np.ndarray, K_color: np.ndarray, T_color_depth: np.ndarray, size: Size
) -> np.ndarray:
    """Project depth [H, W] [m] (0 = invalid) into the colour camera with ``size`` (h, w), float32: points are moved by
    ``T_color_depth`` [4, 4] [m], and the nearest one is used (z-buffer). Each point fills one pixel, so pixels stay 0
    if the colour image is finer than the depth map."""
    v, u = np.nonzero(depth > 0)
    points = points_of(u, v, depth[v, u], K_depth).T
    return project(T_color_depth[:3, :3] @ points + T_color_depth[:3, 3:], K_color, size)


def points_of(u: NDArray, v: NDArray, depth: NDArray, K: NDArray) -> NDArray[np.float64]:
    """[P, 3] points in the camera's axes [m] of pixels u, v [px] with a depth [m]."""
    z, y = depth.astype(np.float64), (v - K[1, 2]) / K[1, 1]
    return np.stack([(u - K[0, 2] - K[0, 1] * y) / K[0, 0] * z, y * z, z], axis=-1)


def project(points: np.ndarray, K: np.ndarray, size: Size) -> np.ndarray:
    """The depth map of ``size`` (H, W) float32 along z [m] of points [3, N] [m] in the frame of a camera K [3, 3] [px]:
    the nearest point in each pixel, 0 = none."""
    ahead = points[:, points[2] > 0]
    u, v, z = K @ ahead
    index, inside = nearest_pixels(u / z, v / z, size)
    depth = np.full(size, np.inf)
    np.minimum.at(depth.reshape(-1), index[inside], z[inside])
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32)
