"""Landmarks in an image: their patches, and whether another view shows them at their predicted pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.kernels.windows import (
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


# A landmark is measured again when the camera has moved by the share _DUE of its depth, times 1 plus the number of
# confirmations, at most _LONGEST.
_DUE, _LONGEST = 0.04, 4
# Failures in a row, beyond the number of confirmations, after which a landmark is deleted.
FAILURES = 3


class Columns(NamedTuple):
    """Landmarks by slot, which the functions here overwrite.

    Attributes:
        point: [N, 3] in the world [m].
        pose: [N, 4, 4] of the cameras that measured them [m].
        sigma: [N] relative standard deviation of the distance from these cameras.
        patch: [N, SIDE, SIDE] the windows around their pixels there, of mean 0 and, with enough contrast, length 1.
        used: [N] bool, False = a free slot.
        confirmed: [N] number of later views that confirmed the landmark.
        failed: [N] number of failures in a row.
        seen: [N] last image that showed it.
    """

    point: NDArray[np.float64]
    pose: NDArray[np.float64]
    sigma: NDArray[np.float64]
    patch: NDArray[np.float32]
    used: NDArray[np.bool_]
    confirmed: NDArray[np.int64]
    failed: NDArray[np.int64]
    seen: NDArray[np.int64]


def store(
    landmarks: Columns, slot: NDArray[np.int64], frame: int, image: NDArray[np.uint8], pixel: NDArray[np.float64],
    rho: NDArray[np.float64], variance: NDArray[np.float64], T_world_cam: NDArray[np.float64], K: NDArray[np.float64],
) -> None:  # fmt: skip
    """Write landmarks to the slots [n], as a view measured them.

    Args:
        landmarks, slot: where to.
        frame: index of the image.
        image: [H, W] uint8.
        pixel: [n, 2] (u, v), ``MARGIN`` from the border or more.
        rho: [n] > 0 [1/m].
        variance: [n] of ``rho`` [1/m^2].
        T_world_cam: [4, 4] [m].
        K: [3, 3] [px].
    """
    _store(landmarks, slot, frame, image, pixel, rho, variance, T_world_cam, inverse_intrinsics(K))


@reordered
def _store(landmarks, slot, frame, image, pixel, rho, variance, T, K_inverse):
    height, width = image.shape
    flat, template, patch = image.reshape(image.size), empty(WIDE * WIDE, np.float32), empty(COUNT, np.float32)
    corner, share = empty(WIDE * WIDE, np.uint32), empty((2, WIDE * WIDE), np.float32)
    along_u, along_v = empty(COUNT, np.float32), empty(COUNT, np.float32)
    for k in range(len(slot)):
        n, u, v = slot[k], pixel[k, 0], pixel[k, 1]
        x, y = K_inverse[0, 0] * u + K_inverse[0, 1] * v + K_inverse[0, 2], K_inverse[1, 1] * v + K_inverse[1, 2]
        for i in range(3):
            landmarks.point[n, i] = (T[i, 0] * x + T[i, 1] * y + T[i, 2]) / rho[k] + T[i, 3]
        for i in range(4):
            for j in range(4):
                landmarks.pose[n, i, j] = T[i, j]
        shown = sampled(flat, width, height, u, v, 1.0, 0.0, 0.0, 1.0, corner, share, template)
        if shown:
            normalised(template, patch, along_u, along_v)
        for j in range(SIDE):
            for i in range(SIDE):
                landmarks.patch[n, j, i] = patch[j * SIDE + i] if shown else np.float32(0)
        landmarks.sigma[n] = np.sqrt(variance[k]) / rho[k]
        landmarks.used[n], landmarks.failed[n], landmarks.seen[n] = True, 0, frame


class Seen(NamedTuple):
    """Landmarks in an image; N = all of the memory.

    Attributes:
        pixel: [N, 2] predicted (u, v).
        depth: [N] predicted [m].
        spread: [N] standard deviation of ``depth`` [m].
        shown: [N] 1 where the image shows the landmark, -1 where it shows something else, 0 outside the image or where
            the view differs too much for a comparison.
        slot: [n] the landmark of each cell, by row and column.
        due: [n] bool, True where it must be measured again.
    """

    pixel: NDArray[np.float64]
    depth: NDArray[np.float64]
    spread: NDArray[np.float64]
    shown: NDArray[np.int64]
    slot: NDArray[np.int64]
    due: NDArray[np.bool_]


def sight(
    landmarks: Columns,
    frame: int,
    image: NDArray[np.uint8],
    T_world_cam: NDArray[np.float64],
    K: NDArray[np.float64],
    cell: int,
) -> Seen:
    """Find the landmarks that an image shows, at most one in a cell, and count failures of those it should show.

    Each cell retains the landmark with the most confirmations; among equals, the one with the least uncertainty.

    Args:
        landmarks: see :class:`Columns`.
        frame: index of the image.
        image: [H, W] uint8.
        T_world_cam: [4, 4] of the image [m].
        K: [3, 3] [px].
        cell: side of a cell [px].
    """
    n, shape = len(landmarks.point), (-(-image.shape[0] // cell), -(-image.shape[1] // cell))
    pixel, depth, spread, shown = np.zeros((n, 2)), np.zeros(n), np.zeros(n), np.zeros(n, np.int64)
    best, slot, due = np.full(shape, -1), np.zeros(n, np.int64), np.zeros(n, np.bool_)
    camera = (np.ascontiguousarray(K @ T_world_cam[:3, :3].T), np.ascontiguousarray(T_world_cam[:3, 3]))
    _sight(landmarks, image, *camera, inverse_intrinsics(K), pixel, depth, spread, shown)
    count = _keep(landmarks, frame, camera[1], cell, pixel, depth, spread, shown, best, slot, due)
    return Seen(pixel, depth, spread, shown, slot[:count], due[:count])


@reordered
def _keep(landmarks, frame, centre, cell, pixel, depth, spread, shown, best, slot, due):
    """Count successes and failures, and write the landmark of each cell; return their number."""
    used, confirmed, failed, seen = landmarks.used, landmarks.confirmed, landmarks.failed, landmarks.seen
    for n in range(len(shown)):
        if shown[n] < 0:
            failed[n] += 1
            if failed[n] > FAILURES + confirmed[n]:
                used[n] = False
        if shown[n] <= 0:
            continue
        seen[n], failed[n] = frame, 0
        row, column = int(pixel[n, 1]) // cell, int(pixel[n, 0]) // cell
        other = best[row, column]
        if (
            other < 0
            or confirmed[n] > confirmed[other]
            or (confirmed[n] == confirmed[other] and spread[n] / depth[n] < spread[other] / depth[other])
        ):
            best[row, column] = n
        else:
            other = n
        if other >= 0:
            used[other] = False
    count = 0
    for row in range(best.shape[0]):
        for column in range(best.shape[1]):
            n = best[row, column]
            if n < 0:
                continue
            square = 0.0
            for i in range(3):
                square += (landmarks.pose[n, i, 3] - centre[i]) ** 2
            slot[count], due[count] = n, np.sqrt(square) >= _DUE * depth[n] * min(1 + confirmed[n], _LONGEST)
            count += 1
    return count


@reordered
def _sight(landmarks, image, P, centre, K_inverse, pixel, depth, spread, shown):
    point, pose, sigma, patch = landmarks.point, landmarks.pose, landmarks.sigma, landmarks.patch
    height, width = image.shape
    flat, template = image.reshape(image.size), empty(WIDE * WIDE, np.float32)
    corner, share = empty(WIDE * WIDE, np.uint32), empty((2, WIDE * WIDE), np.float32)
    window, other = empty(COUNT, np.float32), empty(COUNT, np.float32)
    p, error, rotated, homography = (
        empty(3, np.float64),
        empty(3, np.float64),
        empty((3, 3), np.float64),
        empty((3, 3), np.float64),
    )
    for n in range(len(point)):
        if not landmarks.used[n]:
            continue
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
        for j in range(SIDE):
            for i in range(SIDE):
                other[j * SIDE + i] = patch[n, j, i]
        shown[n] = 1 if zncc(other, window) > SHOWN else -1
