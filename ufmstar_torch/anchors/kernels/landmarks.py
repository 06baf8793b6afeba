"""Landmarks in an image: their patches, and whether another view shows them at their predicted pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.kernels.check import CERTAIN
from ufmstar_torch.anchors.kernels.dense import cells, steepest
from ufmstar_torch.anchors.kernels.numbers import MEDIAN_SQUARE, median
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
from ufmstar_torch.kernels.compile_cpu import empty, leaf, reordered, reordered_leaf

# Least ZNCC of a landmark's patch with an image that shows it.
SHOWN = 0.8


# A landmark is measured again when the camera has moved by the share _DUE of its depth, times 1 plus the number of
# confirmations, at most _LONGEST.
_DUE, _LONGEST = 0.04, 4
# Failures in a row, beyond the number of confirmations, after which a landmark is deleted.
FAILURES = 3
# See :func:`settle`.
_SIGMAS, _SHARE = 3.5, 0.01
# Standard deviation of an inverse depth, as a share of it, by the scale of the poses, which no image determines.
SCALE = 0.005
# Least number of measurements for an update of running estimates; steps of the bisection in :func:`_beyond`.
_ENOUGH, _STEPS = 10, 8


class Columns(NamedTuple):
    """Landmarks by slot, which the functions here overwrite.

    Attributes:
        point: [N, 3] in the world [m].
        pose: [N, 4, 4] of the cameras that measured them [m].
        sigma: [N] relative standard deviation of the distance from these cameras.
        patch: [N, SIDE, SIDE] the windows around their pixels there, of mean 0 and length 1; 0 without contrast.
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


class Sighted(NamedTuple):
    """Pixels of an image that are measured, or predicted by landmarks: at most one in a cell.

    Attributes:
        slot: [n] the landmarks in the image, by row and column of their cells.
        pixel: [N, 2] (u, v) of these landmarks, and then of the largest gradient in every other cell.
        rho: [N] predicted inverse depth [1/m]; 0 without a landmark.
        variance: [N] of ``rho`` [1/m^2]; 1 without a landmark.
        searched: [M] indices of the pixels to measure: landmarks that are due, and all without a landmark.
        compared: [m, 2] pixels of all landmarks whose patch was compared with the image.
        hidden: [m] bool, True where the image shows something else there.
    """

    slot: NDArray[np.int64]
    pixel: NDArray[np.float64]
    rho: NDArray[np.float64]
    variance: NDArray[np.float64]
    searched: NDArray[np.int64]
    compared: NDArray[np.float64]
    hidden: NDArray[np.bool_]


def sight(
    landmarks: Columns, frame: int, image: NDArray[np.uint8], T_world_cam: NDArray[np.float64], K: NDArray[np.float64],
    cell: int,
) -> Sighted:  # fmt: skip
    """Find the landmarks that an image shows, at most one in a cell, count failures of those it should show, and choose
    a pixel in every cell without a landmark.

    Each cell retains the landmark with the most confirmations; among equals, the one with the least uncertainty.

    Args:
        landmarks: see :class:`Columns`.
        frame: index of the image.
        image: [H, W] uint8.
        T_world_cam: [4, 4] of the image [m].
        K: [3, 3] [px].
        cell: side of a cell [px].
    """
    count, shape = len(landmarks.point), cells(image.shape, cell)
    size = shape[0] * shape[1]
    (rho, variance), (slot, searched) = np.empty((2, size)), np.empty((2, size), np.int64)
    pixel, compared, hidden = np.empty((size, 2)), np.empty((count, 2)), np.empty(count, np.bool_)
    result = Sighted(slot, pixel, rho, variance, searched, compared, hidden)
    camera = T_world_cam, K, inverse_intrinsics(K)
    n, all_pixels, m, tests = _sight(landmarks, frame, image, *camera, cell, shape, result)
    columns = slot[:n], pixel[:all_pixels], rho[:all_pixels], variance[:all_pixels], searched[:m]
    return Sighted(*columns, compared[:tests], hidden[:tests])


@reordered
def _sight(landmarks, frame, image, T, K, K_inverse, cell, shape, out):
    count = len(landmarks.point)
    pixel, depth, spread = empty((count, 2), np.float64), empty(count, np.float64), empty(count, np.float64)
    shown, best = empty(count, np.int64), empty(shape, np.int64)
    flat, template = image.reshape(image.size), empty(WIDE * WIDE, np.float32)
    corner, share = empty(WIDE * WIDE, np.uint32), empty((2, WIDE * WIDE), np.float32)
    window, other = empty(COUNT, np.float32), empty(COUNT, np.float32)
    vectors, P = empty((2, 3), np.float64), empty((3, 3, 3), np.float64)
    size = image.shape[1], image.shape[0]
    _predict(
        landmarks, flat, size, T, K, K_inverse, pixel, depth, spread, shown,
        corner, share, template, window, other, vectors[0], vectors[1], P[0], P[1], P[2],
    )  # fmt: skip
    _keep(landmarks, frame, cell, pixel, depth, spread, shown, best)
    landmark_count = due = compared = 0
    for n in range(count):
        if shown[n] != 0:
            out.compared[compared, 0], out.compared[compared, 1] = pixel[n, 0], pixel[n, 1]
            out.hidden[compared] = shown[n] < 0
            compared += 1
    for row in range(best.shape[0]):
        for column in range(best.shape[1]):
            n = best[row, column]
            if n < 0:
                continue
            square = 0.0
            for i in range(3):
                square += (landmarks.pose[n, i, 3] - T[i, 3]) ** 2
            out.slot[landmark_count], out.rho[landmark_count] = n, 1 / depth[n]
            out.pixel[landmark_count, 0], out.pixel[landmark_count, 1] = pixel[n, 0], pixel[n, 1]
            out.variance[landmark_count] = (spread[n] / (depth[n] * depth[n])) ** 2
            if np.sqrt(square) >= _DUE * depth[n] * min(1 + landmarks.confirmed[n], _LONGEST):
                out.searched[due] = landmark_count
                due += 1
            landmark_count += 1
    found = landmark_count
    for row in range(best.shape[0]):
        for column in range(best.shape[1]):
            if best[row, column] < 0 and steepest(image, cell, row, column, out.pixel[found]):
                out.rho[found], out.variance[found], out.searched[due] = 0.0, 1.0, found
                found += 1
                due += 1
    return landmark_count, found, due, compared


@reordered_leaf
def _keep(landmarks, frame, cell, pixel, depth, spread, shown, best):
    """Count successes and failures, and write the landmark of each cell [R, C], -1 = none."""
    used, confirmed, failed, seen = landmarks.used, landmarks.confirmed, landmarks.failed, landmarks.seen
    best[:] = -1
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


@reordered_leaf
def _predict(
    landmarks, flat, size, T, K, K_inverse, pixel, depth, spread, shown,
    corner, share, template, window, other, p, error, P, rotated, homography,
):  # fmt: skip
    """Write where landmarks lie in the camera T [4, 4]: (u, v) [N, 2] [px], depth [N] and its standard deviation [N]
    [m]; and [N] 1 where the image shows the landmark, -1 where it shows something else, 0 outside the image or where
    the view differs too much for a comparison. The second line of arguments are buffers."""
    point, pose, sigma, patch = landmarks.point, landmarks.pose, landmarks.sigma, landmarks.patch
    width, height = size
    for i in range(3):
        for j in range(3):
            P[i, j] = K[i, 0] * T[j, 0] + K[i, 1] * T[j, 1] + K[i, 2] * T[j, 2]
    for n in range(len(point)):
        shown[n] = 0
        if not landmarks.used[n]:
            continue
        for i in range(3):
            p[i] = 0.0
            for j in range(3):
                p[i] += P[i, j] * (point[n, j] - T[j, 3])
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


@reordered
def settle(landmarks, frame, image, T, K_inverse, sighted, agreed, accepted, rho, variance, trusted, memory, numbers):
    """Confirm or refute landmarks by new measurements, store these, and update the running estimates.

    Two measurements confirm each other if they differ by at most ``_SIGMAS`` standard deviations and the share
    ``_SHARE`` of the inverse depth, added in quadrature.

    Args:
        landmarks: see :class:`Columns`.
        frame: index of the image.
        image: [H, W] uint8.
        T: [4, 4] camera-to-world [m].
        K_inverse: [3, 3] inverse of the intrinsics.
        sighted: see :class:`Sighted`; the first K pixels, inverse depths and variances are overwritten by those of the
            pixels with a depth.
        agreed, accepted, rho, variance: [M] of the searched pixels: number of agreeing views, whether the measurement
            is reliable, inverse depth [1/m] and its variance [1/m^2].
        trusted: False = poses and images contradict each other; no measurement is used.
        memory: share of the running estimates that remains after a frame.
        numbers: [2], updated: ``apart`` of :class:`ufmstar_torch.anchors.dense_memory.Memory`, and the median depth of
            the scene [m].

    Returns:
        K, and the number of refuted landmarks.
    """
    landmark_count, total = len(sighted.slot), len(sighted.rho)
    before, spread = empty(total, np.float64), empty(total, np.float64)
    measured, storable, valid = empty(total, np.bool_), empty(total, np.bool_), empty(total, np.bool_)
    squares, variances, values = empty(total, np.float64), empty(total, np.float64), empty(total, np.float64)
    height, width = image.shape
    flat, template, patch = image.reshape(image.size), empty(WIDE * WIDE, np.float32), empty(COUNT, np.float32)
    corner, share = empty(WIDE * WIDE, np.uint32), empty((2, WIDE * WIDE), np.float32)
    along_u, along_v = empty(COUNT, np.float32), empty(COUNT, np.float32)
    window = corner, share, template, patch, along_u, along_v
    for n in range(total):
        measured[n] = storable[n] = False
        before[n], spread[n] = sighted.rho[n], sighted.variance[n]
        valid[n] = trusted and n < landmark_count
    for i in range(len(accepted)):
        if not (accepted[i] and trusted):
            continue
        n, scale = sighted.searched[i], SCALE * rho[i]
        storable[n] = agreed[i] > 1 or variance[i] < (CERTAIN * rho[i]) ** 2
        if rho[i] > np.sqrt(variance[i] + scale * scale):
            measured[n], sighted.rho[n], sighted.variance[n] = True, rho[i], variance[i] + scale * scale
    compared = refuted = 0
    apart = numbers[0]
    for n in range(landmark_count):
        if not measured[n]:
            continue
        slot, new, noise, square = sighted.slot[n], sighted.rho[n], sighted.variance[n], before[n] * before[n]
        difference, sum_ = (new - before[n]) ** 2, spread[n] + noise
        squares[compared], variances[compared] = difference / square, sum_ / square
        compared += 1
        if difference <= _SIGMAS**2 * (sum_ + apart * square) + _SHARE**2 * square:
            landmarks.confirmed[slot] += 1
            old, more = 1 / spread[n], 1 / noise
            sighted.rho[n] = (before[n] * old + new * more) / (old + more)
            # Measurements share keyframes and patches: merging them does not reduce the smaller variance.
            sighted.variance[n] = min(spread[n], noise)
            _store(landmarks, slot, frame, flat, width, height, sighted, n, T, K_inverse, window)
        else:
            refuted += 1
            valid[n] = False
            _refute(landmarks, slot)
    if compared >= _ENOUGH:
        numbers[0] = memory * apart + (1 - memory) * _beyond(squares[:compared], variances[:compared], values)
    for n in range(landmark_count, total):
        valid[n] = measured[n]
    _store_new(landmarks, frame, flat, width, height, sighted, measured, storable, T, K_inverse, window)
    found = _move_up(sighted, valid, values)
    if found >= _ENOUGH:
        numbers[1] *= np.exp((1 - memory) * np.log(median(values, found) / numbers[1]))
    return found, refuted


@reordered_leaf
def _store_new(landmarks, frame, flat, width, height, sighted, measured, storable, T, K_inverse, window):
    """Store measured pixels without a landmark in free slots, and then in those of the oldest landmarks."""
    free, count = 0, len(landmarks.used)
    for n in range(len(sighted.slot), len(measured)):
        if not (measured[n] and storable[n]):
            continue
        while free < count and landmarks.used[free]:
            free += 1
        slot = free if free < count else _oldest(landmarks)
        if free < count or landmarks.seen[slot] != frame:
            landmarks.confirmed[slot] = 0
            _store(landmarks, slot, frame, flat, width, height, sighted, n, T, K_inverse, window)


@leaf
def _refute(landmarks, slot):
    """Count a refutation of a landmark as two failures, and remove a landmark with too many of them."""
    landmarks.failed[slot] += 2
    if landmarks.confirmed[slot] == 0 or landmarks.failed[slot] > FAILURES + landmarks.confirmed[slot]:
        landmarks.used[slot] = False


@leaf
def _oldest(landmarks):
    """The slot of the landmark that no image has shown for longest."""
    slot = 0
    for i in range(1, len(landmarks.seen)):
        if landmarks.seen[i] < landmarks.seen[slot]:
            slot = i
    return slot


@leaf
def _move_up(sighted, valid, depth):
    """Move the valid pixels to the front, and write their depths [m]; returns their number."""
    found = 0
    for n in range(len(valid)):
        if valid[n]:
            sighted.pixel[found, 0], sighted.pixel[found, 1] = sighted.pixel[n, 0], sighted.pixel[n, 1]
            sighted.rho[found], sighted.variance[found] = sighted.rho[n], sighted.variance[n]
            depth[found] = 1 / sighted.rho[n]
            found += 1
    return found


@reordered_leaf
def _beyond(square, variance, values):
    """Variance to add to the stated ones [n] so that the normalised squared differences [n] have the median of a normal
    one. ``values`` is a buffer."""
    low, high = 1e-7, 0.3**2
    for step in range(_STEPS + 1):
        middle = low if step == 0 else np.sqrt(low * high)
        for i in range(len(square)):
            values[i] = square[i] / (variance[i] + middle)
        if median(values, len(square)) > MEDIAN_SQUARE:
            low = middle
        elif step == 0:
            return 0.0
        else:
            high = middle
    return high


@reordered_leaf
def _store(landmarks, slot, frame, flat, width, height, sighted, n, T, K_inverse, window):
    """Write the sighted pixel n, ``MARGIN`` from the border or more, to a slot."""
    corner, share, template, patch, along_u, along_v = window
    u, v, rho = sighted.pixel[n, 0], sighted.pixel[n, 1], sighted.rho[n]
    x, y = K_inverse[0, 0] * u + K_inverse[0, 1] * v + K_inverse[0, 2], K_inverse[1, 1] * v + K_inverse[1, 2]
    for i in range(3):
        landmarks.point[slot, i] = (T[i, 0] * x + T[i, 1] * y + T[i, 2]) / rho + T[i, 3]
    for i in range(4):
        for j in range(4):
            landmarks.pose[slot, i, j] = T[i, j]
    shown = sampled(flat, width, height, u, v, 1.0, 0.0, 0.0, 1.0, corner, share, template)
    shown = shown and normalised(template, patch, along_u, along_v)
    for j in range(SIDE):
        for i in range(SIDE):
            landmarks.patch[slot, j, i] = patch[j * SIDE + i] if shown else np.float32(0)
    landmarks.sigma[slot] = np.sqrt(sighted.variance[n]) / rho
    landmarks.used[slot], landmarks.failed[slot], landmarks.seen[slot] = True, 0, frame
