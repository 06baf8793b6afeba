"""Landmarks in an image: their patches, and whether another view shows them where they should be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.kernels.dense_cpu import (
    COUNT,
    FARTHEST,
    FIRST,
    LARGEST_SCALE,
    LEAST_CONTRAST,
    MARGIN,
    SIDE,
    compiled,
    normalised,
    warped,
)

# Least ZNCC of a landmark's patch with the image that shows it.
SHOWN = 0.8


def patches(image: NDArray[np.uint8], pixel: NDArray[np.float64]) -> NDArray[np.float32]:
    """[N, SIDE, SIDE] the windows around pixels [N, 2], ``MARGIN`` from the border or more, of mean 0 and length 1."""
    out = np.zeros((len(pixel), SIDE, SIDE), np.float32)
    _patches(image, pixel, out)
    return out


@compiled
def _patches(image, pixel, out):
    template, along_u = np.empty((SIDE + 2, SIDE + 2), np.float32), np.empty((SIDE, SIDE), np.float32)
    along_v, H, b = np.empty((SIDE, SIDE), np.float32), np.eye(3), np.zeros(3)
    for n in range(len(pixel)):
        if warped(image, pixel[n, 0], pixel[n, 1], H, b, 0.0, template):
            normalised(template, out[n], along_u, along_v)


def sight(
    image: NDArray[np.uint8],
    point: NDArray[np.float64],
    pose: NDArray[np.float64],
    sigma: NDArray[np.float64],
    patch: NDArray[np.float32],
    T_world_cam: NDArray[np.float64],
    K: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Where an image shows landmarks.

    Args:
        image: [H, W] uint8.
        point: [N, 3] in the world [m].
        pose: [N, 4, 4] of the cameras that measured them [m].
        sigma: [N] of the distance from those, as a share.
        patch: [N, SIDE, SIDE], see :func:`patches`.
        T_world_cam: [4, 4] of the image [m].
        K: [3, 3] [px].

    Returns:
        pixel [N, 2]; depth [N] [m]; its standard deviation [N] [m]; and 1 where the image shows the landmark, -1 where
        it should and does not, 0 beside the image or where the view differs too much to be compared.
    """
    n = len(point)
    pixel, depth, spread, shown = np.zeros((n, 2)), np.zeros(n), np.zeros(n), np.zeros(n, np.int64)
    camera = (np.ascontiguousarray(K @ T_world_cam[:3, :3].T), np.ascontiguousarray(T_world_cam[:3, 3]))
    _sight(image, point, pose, sigma, patch, *camera, np.linalg.inv(K), pixel, depth, spread, shown)
    return pixel, depth, spread, shown


@compiled
def _sight(image, point, pose, sigma, patch, P, centre, K_inverse, pixel, depth, spread, shown):
    height, width = image.shape
    one = np.float32(1)
    p, error, rotated, into = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(point)):
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
        before = 0.0
        for i in range(3):
            before += (point[n, i] - pose[n, i, 3]) * pose[n, i, 2]
        # What a pixel of the view that measured it is here, and what its standard deviation is.
        for i in range(3):
            error[i] = 0.0
            for j in range(3):
                error[i] += P[i, j] * (point[n, j] - pose[n, j, 3]) * sigma[n]
                rotated[i, j] = P[i, 0] * pose[n, 0, j] + P[i, 1] * pose[n, 1, j] + P[i, 2] * pose[n, 2, j]
        for i in range(3):
            for j in range(3):
                into[i, j] = 0.0
                for k in range(3):
                    into[i, j] += rotated[i, k] * K_inverse[k, j] * (before / z)
        a, b = into[0, 0] - p[0] * into[2, 0], into[0, 1] - p[0] * into[2, 1]
        c, d = into[1, 0] - p[1] * into[2, 0], into[1, 1] - p[1] * into[2, 1]
        determinant = a * d - b * c
        shift_u, shift_v = (error[0] - p[0] * error[2]) / z, (error[1] - p[1] * error[2]) / z
        pixel[n, 0], pixel[n, 1], depth[n], spread[n] = p[0], p[1], z, abs(error[2])
        if not 1 / LARGEST_SCALE**2 < determinant < LARGEST_SCALE**2 or shift_u**2 + shift_v**2 > FARTHEST**2:
            continue
        far_u, far_v = (abs(a) + abs(b)) * -FIRST, (abs(c) + abs(d)) * -FIRST
        if not (far_u <= p[0] < width - 1 - far_u and far_v <= p[1] < height - 1 - far_v):
            continue
        total = squares = cross = np.float32(0)
        for j in range(SIDE):
            for i in range(SIDE):
                su, sv = p[0] + a * (i + FIRST) + b * (j + FIRST), p[1] + c * (i + FIRST) + d * (j + FIRST)
                iu, iv = int(su), int(sv)
                fu, fv = np.float32(su - iu), np.float32(sv - iv)
                upper = (one - fu) * np.float32(image[iv, iu]) + fu * np.float32(image[iv, iu + 1])
                lower = (one - fu) * np.float32(image[iv + 1, iu]) + fu * np.float32(image[iv + 1, iu + 1])
                value = (one - fv) * upper + fv * lower
                total += value
                squares += value * value
                cross += patch[n, j, i] * value
        deviation = squares - total * total / np.float32(COUNT)
        alike = deviation > COUNT * LEAST_CONTRAST * LEAST_CONTRAST and cross > SHOWN * np.sqrt(deviation)
        shown[n] = 1 if alike else -1
