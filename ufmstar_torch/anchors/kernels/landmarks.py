"""Landmarks in an image: their patches, and whether another view shows them at their predicted pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.kernels.dense import (
    COUNT,
    FARTHEST,
    LARGEST_SCALE,
    MARGIN,
    SIDE,
    WIDE,
    normalised,
    sampled,
    zncc,
)
from ufmstar_torch.gaussians.camera import inverse_intrinsics
from ufmstar_torch.kernels.compile_cpu import empty, reordered

# Least ZNCC of a landmark's patch with an image that shows it.
SHOWN = 0.8


def patches(image: NDArray[np.uint8], pixel: NDArray[np.float64]) -> NDArray[np.float32]:
    """[N, SIDE, SIDE] the windows around pixels [N, 2], ``MARGIN`` from the border or more, of mean 0 and length 1."""
    out = np.zeros((len(pixel), COUNT), np.float32)
    _patches(image, pixel, out)
    return out.reshape(-1, SIDE, SIDE)


@reordered
def _patches(image, pixel, out):
    height, width = image.shape
    flat, template = image.reshape(image.size), empty(WIDE * WIDE, np.float32)
    corner, share = empty(WIDE * WIDE, np.uint32), empty((2, WIDE * WIDE), np.float32)
    along_u, along_v = empty(COUNT, np.float32), empty(COUNT, np.float32)
    for n in range(len(pixel)):
        if sampled(flat, width, height, pixel[n, 0], pixel[n, 1], 1.0, 0.0, 0.0, 1.0, corner, share, template):
            normalised(template, out[n], along_u, along_v)


def sight(
    image: NDArray[np.uint8],
    point: NDArray[np.float64],
    pose: NDArray[np.float64],
    sigma: NDArray[np.float64],
    patch: NDArray[np.float32],
    used: NDArray[np.bool_],
    T_world_cam: NDArray[np.float64],
    K: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Predict the pixels of landmarks in an image, and compare their patches there.

    Args:
        image: [H, W] uint8.
        point: [N, 3] in the world [m].
        pose: [N, 4, 4] of the cameras that measured them [m].
        sigma: [N] relative standard deviation of the distance from these cameras.
        patch: [N, SIDE, SIDE], see :func:`patches`.
        used: [N] mask of the landmarks.
        T_world_cam: [4, 4] of the image [m].
        K: [3, 3] [px].

    Returns:
        pixel [N, 2]; depth [N] [m]; its standard deviation [N] [m]; and 1 where the image shows the landmark, -1 where
        it shows something else, 0 outside the image or where the view differs too much for a comparison.
    """
    n = len(point)
    pixel, depth, spread, shown = np.zeros((n, 2)), np.zeros(n), np.zeros(n), np.zeros(n, np.int64)
    camera = (np.ascontiguousarray(K @ T_world_cam[:3, :3].T), np.ascontiguousarray(T_world_cam[:3, 3]))
    patch = patch.reshape(n, COUNT)
    _sight(image, point, pose, sigma, patch, used, *camera, inverse_intrinsics(K), pixel, depth, spread, shown)
    return pixel, depth, spread, shown


@reordered
def _sight(image, point, pose, sigma, patch, used, P, centre, K_inverse, pixel, depth, spread, shown):
    height, width = image.shape
    flat, template = image.reshape(image.size), empty(WIDE * WIDE, np.float32)
    corner, share = empty(WIDE * WIDE, np.uint32), empty((2, WIDE * WIDE), np.float32)
    window = empty(COUNT, np.float32)
    p, error, rotated, homography = (
        empty(3, np.float64),
        empty(3, np.float64),
        empty((3, 3), np.float64),
        empty((3, 3), np.float64),
    )
    for n in np.flatnonzero(used):
        for i in range(3):
            p[i] = 0.0
            for j in range(3):
                p[i] += P[i, j] * (point[n, j] - centre[j])
        z = p[2]  # the last row of K is (0, 0, 1)
        if z <= 1e-3:
            continue
        p /= z
        if not (MARGIN <= p[0] < width - MARGIN and MARGIN <= p[1] < height - MARGIN):
            continue
        depth_before = 0.0
        for i in range(3):
            depth_before += (point[n, i] - pose[n, i, 3]) * pose[n, i, 2]
        # Derivative by a pixel of the view that measured it, and shift by one standard deviation, in this image.
        for i in range(3):
            error[i] = 0.0
            for j in range(3):
                error[i] += P[i, j] * (point[n, j] - pose[n, j, 3]) * sigma[n]
                rotated[i, j] = P[i, 0] * pose[n, 0, j] + P[i, 1] * pose[n, 1, j] + P[i, 2] * pose[n, 2, j]
        for i in range(3):
            for j in range(3):
                homography[i, j] = 0.0
                for k in range(3):
                    homography[i, j] += rotated[i, k] * K_inverse[k, j] * (depth_before / z)
        a, b = homography[0, 0] - p[0] * homography[2, 0], homography[0, 1] - p[0] * homography[2, 1]
        c, d = homography[1, 0] - p[1] * homography[2, 0], homography[1, 1] - p[1] * homography[2, 1]
        determinant = a * d - b * c
        shift_u, shift_v = (error[0] - p[0] * error[2]) / z, (error[1] - p[1] * error[2]) / z
        pixel[n, 0], pixel[n, 1], depth[n], spread[n] = p[0], p[1], z, abs(error[2])
        if not 1 / LARGEST_SCALE**2 < determinant < LARGEST_SCALE**2 or shift_u**2 + shift_v**2 > FARTHEST**2:
            continue
        if not sampled(flat, width, height, p[0], p[1], a, b, c, d, corner, share, template):
            continue
        for j in range(SIDE):
            for i in range(SIDE):
                window[j * SIDE + i] = template[(j + 1) * WIDE + i + 1]
        shown[n] = 1 if zncc(patch[n], window) > SHOWN else -1
