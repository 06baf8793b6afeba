"""Maps of one pinhole camera as another one sees them: ground truth at the prediction's pixels, registration.

For ``truth_at`` and what it uses, both cameras stand at the same place and look the same way; only focal length,
principal point and size differ. That covers resizing and cropping of one image, and depth maps with intrinsics of
their own (ScanNet's 640x480 depth beside 1296x968 colour, where the export leaves the millimetres between the two
cameras out as well). A depth along the optical axis keeps its value from one such camera to the other.
``register_depth`` moves a depth map to a camera at another place (7-Scenes, whose cameras lie 2.5 cm apart).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.sequences.frame import Frame, FrameError, Size
from ufmstar_torch.eval.sequences.intrinsics import scale_intrinsics

# [px] Centres that fall on the border of two pixels by construction (a resize by 2) must not be sent to
# either side by the rounding of the intrinsics; it is below the accuracy of any calibration.
_BORDER = 1e-6


def resample_nearest(values: NDArray, K_from: NDArray, K_to: NDArray, size: Size) -> NDArray:
    """Every pixel [h, w, ...] of a camera ``K_to`` with ``size`` (h, w) takes the value of the pixel of the camera
    ``K_from`` that its ray falls into, of ``values`` [H, W, ...]; 0 (False) where that does not look. Values are
    copied, never mixed: a mean over a depth edge lies on no surface."""
    mapping = np.asarray(K_from @ np.linalg.inv(K_to), np.float64)
    source, inside = _source(mapping.tobytes(), values.shape[:2], size)
    result = values.reshape(-1, *values.shape[2:])[source]
    return np.where(inside.reshape(*size, *[1] * (values.ndim - 2)), result, np.zeros((), values.dtype))


@lru_cache(maxsize=16)
def _source(mapping: bytes, size_from: Size, size: Size) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """For every pixel [h, w] of the second camera, the pixel of the first one (H, W), counted along its rows, and
    whether there is one. ``mapping`` [3, 3] float64 takes pixels of the second camera to the first one."""
    M = np.frombuffer(mapping).reshape(3, 3)
    v, u = np.mgrid[0 : size[0], 0 : size[1]].astype(np.float64)
    column = np.floor(M[0, 0] * u + M[0, 1] * v + M[0, 2] + 0.5 + _BORDER).astype(np.intp)
    row = np.floor(M[1, 1] * v + M[1, 2] + 0.5 + _BORDER).astype(np.intp)
    height, width = size_from
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return row.clip(0, height - 1) * width + column.clip(0, width - 1), inside


def depth_camera(frame: Frame) -> NDArray:
    """[3, 3] intrinsics of the frame's depth map [px]. Raises FrameError: depth and image have aspect ratios of their
    own, and no intrinsics are known for the depth."""
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


def register_depth(
    depth: np.ndarray, K_depth: np.ndarray, K_color: np.ndarray, T_color_depth: np.ndarray, size: Size
) -> np.ndarray:
    """Depth [H, W] [m] (0 = invalid) as the colour camera with ``size`` (h, w) sees it, float32: points are moved by
    ``T_color_depth`` [4, 4] [m] into the colour camera, the nearest one wins (z-buffer). Each point fills the one pixel
    it falls on, so where the colour image is finer than the depth map, pixels stay 0."""
    v, u = np.nonzero(depth > 0)
    z = depth[v, u].astype(np.float64)
    points = np.linalg.inv(K_depth) @ np.stack([u * z, v * z, z])
    return project(T_color_depth[:3, :3] @ points + T_color_depth[:3, 3:], K_color, size)


def project(points: np.ndarray, K: np.ndarray, size: Size) -> np.ndarray:
    """The depth map, ``size`` (H, W) float32 along z [m], of points [3, N] in the frame of a camera K [3, 3] [m, px]:
    each pixel takes the nearest one that falls on it, 0 = none."""
    x, y, z = points[:, points[2] > 0]
    column = np.rint((K[0, 0] * x + K[0, 1] * y) / z + K[0, 2])
    row = np.rint(K[1, 1] * y / z + K[1, 2])
    inside = (column >= 0) & (column < size[1]) & (row >= 0) & (row < size[0])
    depth = np.full(size, np.inf)
    np.minimum.at(depth, (row[inside].astype(np.intp), column[inside].astype(np.intp)), z[inside])
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32)
