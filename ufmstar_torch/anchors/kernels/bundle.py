"""A bundle adjustment of a window of views, inverse depths eliminated, for ``anchors.bundle``; on the CPU (numba).

View W is the newest. A track with the ray n in view W lies in view k at

    q = Exp(-w_k) R_k^T (rho (C_W + s_W - C_k - s_k) + R_W Exp(w_W) n),

up to scale. ``tests/oracle_bundle.py`` is the same in NumPy, its Jacobian by differences.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.kernels.cholesky import factored, inverted, reduced, substituted
from ufmstar_torch.anchors.kernels.epipolar import FAR as FAR_DEPTH
from ufmstar_torch.anchors.kernels.epipolar import NEAR as NEAR_DEPTH
from ufmstar_torch.anchors.kernels.epipolar import matched, off_lines, on_lines
from ufmstar_torch.anchors.kernels.numbers import finite, median
from ufmstar_torch.kernels.compile_cpu import empty, leaf, reordered, reordered_leaf, reordered_part

# Parameters of a pose's error: a rotation about the camera's axes [rad] and a shift along the world's [m].
POSE = 6
# Limits of inverse depths, as multiples of the scene's.
FAR, NEAR = 0.02, 20.0
# Least depth of a point in a view, over its depth in the newest view; nearer points are not used.
_AHEAD = 1e-3
# [px] Standard deviation of a position by tracking from one view to the next (.25 to .4 on recordings and tours).
_TRACKING = 0.35
# A corner's position v views ago has 1 + _DRIFT (v - 1) times the variance of its position one view ago.
_DRIFT = 0.6
# Information of a position as a share of that of an independent one: errors of neighbouring corners are correlated, and
# so are those of a corner in several views. On tours .3 is best with noisy poses, .05 with a rolling shutter.
_INFORMATION = 0.15
# Degrees of freedom of a position's distribution; Gauss-Newton steps; earlier steps on inverse depths alone.
_STUDENT, _STEPS, _DEPTH_STEPS = 4.0, 4, 6
# [px^2] Least mean square of a jump, as shifts of a position.
_SHIFT = 1.0
# Least number of corners for a refinement.
_ENOUGH = 8
# [px] Limits of the standard deviations of a position by errors of the poses.
_LEAST, _LARGEST = 0.003, 20.0
# Share of the running estimates that remains after a frame.
_MEMORY = 0.8
# Least share of the tracks that do not fit the input poses, for them to be taken for tracks of things that move, which
# the poses would follow; below .2 on recordings of still scenes. Least number of tracks that is judged.
_MOVING, _FEWEST = 0.25, 8


class Learnt(NamedTuple):
    """Running estimates of the input poses' errors, which :func:`refine` updates.

    Attributes:
        variance: [2] of a position by a pose's rotation and by its shift [px^2].
        last_error: [2, 3] of the last pose, as shifts of a position [px].
        numbers: [5] the number of pose errors in the variance; ``correlated``, ``shared``, the largest recent score and
            the variance by the time offset, see ``bundle.PoseRefinement``.
    """

    variance: NDArray[np.float64]
    last_error: NDArray[np.float64]
    numbers: NDArray[np.float64]


COUNT, CORRELATED, SHARED, SCORE, BY_OFFSET = range(5)  # of :attr:`Learnt.numbers`


@reordered
def refine(pixel, seen, stated, K, K_inverse, depth, shift, most, learnt, poses, prior, error, covariance):
    """The most likely poses of W views, and what their errors teach.

    Args:
        pixel: [N, W, 2] positions (u, v) of corners; the newest view is the last.
        seen: [N, W] bool, True where the view shows the corner.
        stated: [W, 4, 4] input poses, camera-to-world [m].
        K, K_inverse: [3, 3] [px].
        depth: prior mean of the corners' depths [m]; the prior standard deviation of an inverse depth is 2/depth.
        shift: [W, 6] by which the input poses are corrected first, see :func:`move`.
        most: score, chi-squared with six degrees of freedom, above which the newest pose starts another trajectory.
        learnt: see :class:`Learnt`.
        poses: [W, 4, 4] overwritten.
        prior: [6 W] precision of the poses' errors, overwritten.
        error, covariance: [6 W] errors of the poses beyond the shift, and [6 W, 6 W], overwritten.

    Returns:
        1; 0 = the poses cannot be refined; -1 = the newest pose starts another trajectory.
    """
    count, views = seen.shape
    numbers, unit = learnt.numbers, empty(2, np.float64)  # w [rad] and s [m] that shift a position by a pixel
    unit[0], unit[1] = 1 / K[0, 0], depth / K[0, 0]
    for k in range(views):
        for c in range(POSE):
            part = 0 if c < 3 else 1
            prior[POSE * k + c] = 1 / (learnt.variance[part] * unit[part] ** 2)
            error[POSE * k + c] = 0.0
        for i in range(4):
            for j in range(4):
                poses[k, i, j] = stated[k, i, j]
    numbers[SHARED] = 0.0
    score, by_poses, still = empty(1, np.float64), empty(count, np.float64), empty(count, np.bool_)
    score[0] = np.nan
    _static(pixel, seen, stated, K, K_inverse, depth, still)
    tracks = _refine(pixel, seen, still, poses, K, depth, shift, prior, most, error, covariance, by_poses, score)
    if finite(score[0]):
        numbers[SCORE] = max(score[0], _MEMORY * numbers[SCORE])
    if tracks <= 0:
        return tracks
    total = 0.0
    for k in range(views):
        for i in range(3):
            for j in range(4):
                total += abs(poses[k, i, j])
    for i in range(POSE * views):
        for j in range(POSE * views):
            total += abs(covariance[i, j])
    if not finite(total):
        return 0
    numbers[SHARED], numbers[BY_OFFSET] = median(by_poses, tracks), 0.0
    numbers[COUNT] += 1
    share, first, product = max(1 - _MEMORY, 1 / (numbers[COUNT] + 1)), POSE * (views - 1), 0.0  # at first the mean
    for part in range(2):
        # How many of 3 components the images determine.
        determined = square = 0.0
        for c in range(3):
            i = first + 3 * part + c
            off = error[i] / unit[part]
            square += off * off
            determined += 1 - covariance[i, i] / unit[part] ** 2 / learnt.variance[part]
            product += off * learnt.last_error[part, c] / 3
            learnt.last_error[part, c] = off
            numbers[BY_OFFSET] += (shift[views - 1, 3 * part + c] / unit[part]) ** 2 / 3
        variance = learnt.variance[part] + share * (square - determined * learnt.variance[part]) / max(determined, 1.0)
        learnt.variance[part] = min(max(variance, _LEAST**2 / 2), _LARGEST**2 / 2)
    numbers[CORRELATED] = max(_MEMORY * numbers[CORRELATED] + (1 - _MEMORY) * product, 0.0)
    return 1


@reordered_part
def _static(pixel, seen, stated, K, K_inverse, depth, still):
    """Which tracks [N] refine the poses: the largest group that fits them between its first view and the newest. All,
    where few do not fit: their Student-t weights suffice."""
    count, last = len(seen), seen.shape[1] - 1
    track, first, order = empty(count, np.int64), empty(count, np.int64), empty(count, np.int64)
    distance, rho, weight = empty(count, np.float64), empty(count, np.float64), empty(count, np.float64)
    newest, size, fits = empty((count, 2), np.float64), empty(2, np.float64), empty(count, np.bool_)
    size[0], size[1] = 2 * K[0, 2], 2 * K[1, 2]
    for n in range(count):
        still[n] = True
    tracks, fitting = matched(seen, track, first), 0
    if tracks < _FEWEST:
        return
    found, cameras = (track[:tracks], first[:tracks]), (stated, K, K_inverse, NEAR_DEPTH * depth, FAR_DEPTH * depth)
    off_lines(pixel, *found, *cameras, newest, distance, rho, weight)
    for i in range(tracks):
        distance[i] /= _TRACKING * np.sqrt(1 + _DRIFT * (last - 1 - first[i]))
    on_lines(distance[:tracks], newest, size, 1.0, fits, weight, order)
    for i in range(tracks):
        fitting += fits[i]
    if fitting <= (1 - _MOVING) * tracks:
        for i in range(tracks):
            still[track[i]] = fits[i]


@reordered_part
def _refine(pixel, seen, still, poses, K, depth, shift, prior, most, error, covariance, by_poses, score):
    """Number of corners that refined the poses; 0 = they cannot be refined, -1 = the newest starts a trajectory."""
    views = seen.shape[1]
    ray, precision = empty((len(seen), views, 2), np.float64), empty((len(seen), views - 1), np.float64)
    tracks = _tracks(pixel, seen, still, K, ray, precision)
    if tracks < _ENOUGH:
        return 0
    size, start = POSE * views, 1 / depth
    rotation, translation = empty((views - 1, 3, 3), np.float64), empty((views - 1, 3), np.float64)
    to_view, rho, v = empty((views, 3, 3), np.float64), empty(tracks, np.float64), empty(tracks, np.float64)
    A, b = empty((size, size), np.float64), empty(size, np.float64)
    h, weighted = empty((tracks, size), np.float64), empty((tracks, size), np.float64)
    derivative = empty((2, 2, POSE), np.float64)
    block, other, x = empty((POSE, POSE), np.float64), empty((POSE, POSE), np.float64), empty(POSE, np.float64)
    for k in range(views):
        for c in range(POSE):
            b[POSE * k + c] = shift[k, c]
    move(b, poses)
    between(poses, rotation, translation, to_view)
    inverse_depths(ray, precision, rotation, translation, start, _STUDENT, _DEPTH_STEPS, rho)
    for step in range(_STEPS):
        if step > 0:
            between(poses, rotation, translation, to_view)
        equations(
            ray, precision, rotation, translation, to_view, rho, start, _STUDENT, A, b, h, v, weighted, derivative
        )
        for i in range(size):
            b[i] *= _INFORMATION
            for j in range(i + 1):
                A[i, j] *= _INFORMATION
        if step == 0:
            square = _jump(A, b, prior, depth / K[0, 0], 1 / K[0, 0], block, other, x, score)
            if square < 0:
                return 0
            if square > 3 * _SHIFT and score[0] > most:
                return -1
        for i in range(size):
            b[i] -= prior[i] * error[i]
            A[i, i] += prior[i]
        if not factored(A):
            return 0
        substituted(A, b)
        move(b, poses)
        for i in range(size):
            error[i] += b[i]
        for n in range(tracks):
            change = v[n]
            for i in range(size):
                change -= h[n, i] * b[i]
            rho[n] = min(max(rho[n] + change, FAR * start), NEAR * start)
    inverted(A, covariance)
    for n in range(tracks):
        by_poses[n] = 0.0
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += covariance[i, j] * h[n, j]
            by_poses[n] += total * h[n, i]
    return tracks


@leaf
def _tracks(pixel, seen, still, K, ray, precision):
    """Write x and y on the plane at depth 1, and the precision in the earlier views, of the still corners that the
    newest view and another one show; return their number."""
    views, tracks = seen.shape[1], 0
    for n in range(len(seen)):
        others = 0
        for k in range(views - 1):
            others += seen[n, k]
        if not (still[n] and seen[n, views - 1]) or others == 0:
            continue
        for k in range(views):
            ray[tracks, k, 0] = (pixel[n, k, 0] - K[0, 2]) / K[0, 0]
            ray[tracks, k, 1] = (pixel[n, k, 1] - K[1, 2]) / K[1, 1]
            if k < views - 1:
                full = (K[0, 0] / _TRACKING) ** 2 / (1 + _DRIFT * (views - 2 - k))
                precision[tracks, k] = full if seen[n, k] else 0.0
        tracks += 1
    return tracks


@leaf
def _jump(A, b, prior, metres, radians, block, other, x, score):
    """Write the score of the newest pose's error, from its block of the equations A d = b, and return the sum of the
    squares of the error's components, as shifts of a position [px^2]; -1 = singular."""
    first = len(b) - POSE
    for i in range(POSE):
        for j in range(i + 1):
            block[i, j] = block[j, i] = A[first + i, first + j]
    for i in range(POSE):
        x[i] = b[first + i]
        for j in range(i + 1):  # earlier views have errors, too
            other[i, j] = block[i, j]
            for k in range(POSE):
                other[i, j] += 2 * block[i, k] * block[k, j] / prior[first + k]
    if not (factored(other) and factored(block)):
        return -1.0
    substituted(other, x)
    total = square = 0.0
    for i in range(POSE):
        total += x[i] * b[first + i]
        x[i] = b[first + i]
    substituted(block, x)
    for i in range(POSE):
        square += (x[i] / (radians if i < 3 else metres)) ** 2
    score[0] = total
    return square


@reordered_leaf
def between(poses, rotation, translation, to_view):
    """Write R_k^T R_W [W-1, 3, 3], R_k^T (C_W - C_k) [W-1, 3] and R_k^T [W, 3, 3] of poses [W, 4, 4]."""
    last = len(poses) - 1
    for k in range(last + 1):
        for i in range(3):
            for j in range(3):
                to_view[k, i, j] = poses[k, j, i]
    for k in range(last):
        for i in range(3):
            translation[k, i] = 0.0
            for j in range(3):
                translation[k, i] += poses[k, j, i] * (poses[last, j, 3] - poses[k, j, 3])
                rotation[k, i, j] = 0.0
                for m in range(3):
                    rotation[k, i, j] += poses[k, m, i] * poses[last, m, j]


@reordered_leaf
def move(error, poses):
    """Rotate poses [W, 4, 4] about their own axes [rad] and shift them along the world's [m] by ``error`` [6 W]."""
    for k in range(len(poses)):
        x, y, z = error[POSE * k], error[POSE * k + 1], error[POSE * k + 2]
        half = 0.5 * np.sqrt(x * x + y * y + z * z)
        sinc = np.sin(half) / half if half > 0 else 1.0
        first, second = sinc * np.cos(half), 0.5 * sinc * sinc  # sin(a)/a and (1 - cos(a))/a^2 of the angle a
        for i in range(3):
            a, b, c = poses[k, i, 0], poses[k, i, 1], poses[k, i, 2]
            p, q, r = b * z - c * y, c * x - a * z, a * y - b * x  # the row times [w]x
            poses[k, i, 0] += first * p + second * (q * z - r * y)
            poses[k, i, 1] += first * q + second * (r * x - p * z)
            poses[k, i, 2] += first * r + second * (p * y - q * x)
            poses[k, i, 3] += error[POSE * k + 3 + i]


@reordered_leaf
def inverse_depths(ray, precision, rotation, translation, prior, student, steps, rho):
    """Write the inverse depths [N] by Gauss-Newton steps with fixed poses; arguments as :func:`equations`."""
    last = precision.shape[1]
    for n in range(len(rho)):
        rho[n] = prior
        x, y = ray[n, last, 0], ray[n, last, 1]
        for _ in range(steps):
            weight = 0.25 / (prior * prior)
            above = weight * (prior - rho[n])
            for k in range(precision.shape[1]):
                if precision[n, k] == 0:
                    continue
                R, t = rotation[k], translation[k]
                z = R[2, 0] * x + R[2, 1] * y + R[2, 2] + rho[n] * t[2]
                if z < _AHEAD:
                    continue
                u = (R[0, 0] * x + R[0, 1] * y + R[0, 2] + rho[n] * t[0]) / z
                v = (R[1, 0] * x + R[1, 1] * y + R[1, 2] + rho[n] * t[1]) / z
                du, dv = (t[0] - u * t[2]) / z, (t[1] - v * t[2]) / z
                right, down = ray[n, k, 0] - u, ray[n, k, 1] - v
                p = precision[n, k]
                p *= (student + 2) / (student + p * (right * right + down * down))
                weight += p * (du * du + dv * dv)
                above += p * (du * right + dv * down)
            rho[n] = min(max(rho[n] + above / weight, FAR * prior), NEAR * prior)


@reordered_leaf
def equations(
    ray, precision, rotation, translation, to_view, rho, prior, student, A, b, h, v, weighted, derivative,
):  # fmt: skip
    """The tracks' part of the normal equations of a Gauss-Newton step.

    Args:
        ray: [N, W, 2] x and y of the tracks' positions on the plane at depth 1; the newest view is the last.
        precision: [N, W-1] of a position in the earlier views; 0 where a view does not show the track.
        rotation, translation, to_view: see :func:`between`.
        rho: [N] inverse depths in the newest view [1/m].
        prior: prior mean of ``rho`` [1/m]; its prior standard deviation is twice as large.
        student: degrees of freedom of the positions' distribution.
        A, b: overwritten, the lower triangle of A [6 W, 6 W] and b [6 W] of A d = b for the errors d of the poses.
        h, v: overwritten, [N, 6 W] and [N]: a track's inverse depth changes by v - h d.
        weighted, derivative: buffers, [N, 6 W] and [2, 2, 6].
    """
    views, tracks = precision.shape[1], len(rho)
    last = POSE * views
    # Derivatives of u and v (rows) by the newest pose and by view k's.
    J, J_k = derivative[0], derivative[1]
    for i in range(last + POSE):
        b[i] = 0.0
        for j in range(i + 1):
            A[i, j] = 0.0
    for n in range(tracks):
        x, y = ray[n, views, 0], ray[n, views, 1]
        for i in range(last + POSE):
            weighted[n, i] = 0.0
        total = 0.25 / (prior * prior)
        above = total * (prior - rho[n])
        for k in range(views):
            R, t, to = rotation[k], translation[k], to_view[k]
            z = R[2, 0] * x + R[2, 1] * y + R[2, 2] + rho[n] * t[2]
            if precision[n, k] == 0 or z < _AHEAD:
                continue
            over = 1 / z
            u = (R[0, 0] * x + R[0, 1] * y + R[0, 2] + rho[n] * t[0]) * over
            w = (R[1, 0] * x + R[1, 1] * y + R[1, 2] + rho[n] * t[1]) * over
            right, down = ray[n, k, 0] - u, ray[n, k, 1] - w
            p = precision[n, k]
            p *= (student + 2) / (student + p * (right * right + down * down))
            _derivatives(R, to, x, y, rho[n], u, w, over, J, J_k)
            du, dv = (t[0] - u * t[2]) * over, (t[1] - w * t[2]) * over
            total += p * (du * du + dv * dv)
            above += p * (du * right + dv * down)
            first = POSE * k
            for c in range(POSE):
                newest_u, newest_v = p * J[0, c], p * J[1, c]
                k_u, k_v = p * J_k[0, c], p * J_k[1, c]
                weighted[n, last + c] += newest_u * du + newest_v * dv
                weighted[n, first + c] += k_u * du + k_v * dv
                b[last + c] += newest_u * right + newest_v * down
                b[first + c] += k_u * right + k_v * down
                for d in range(POSE):
                    A[last + c, first + d] += newest_u * J_k[0, d] + newest_v * J_k[1, d]
                for d in range(c + 1):
                    A[last + c, last + d] += newest_u * J[0, d] + newest_v * J[1, d]
                    A[first + c, first + d] += k_u * J_k[0, d] + k_v * J_k[1, d]
        v[n] = above / total
        for i in range(last + POSE):
            h[n, i] = weighted[n, i] / total
            b[i] -= weighted[n, i] * v[n]
    reduced(A, weighted, h)


@reordered_leaf
def _derivatives(R, to, x, y, rho, u, w, over, J, J_k):
    """Write the derivatives of a position (u, w) in a view by the errors of the newest pose and of the view's, J and
    J_k [2, 6]; (x, y) is the ray in the newest view, ``over`` is 1/z, R and ``to`` are the view's of
    :func:`between`."""
    for i in range(2):
        at = u if i == 0 else w
        r0, r1, r2 = R[i, 0] - at * R[2, 0], R[i, 1] - at * R[2, 1], R[i, 2] - at * R[2, 2]
        # -R [n]x with n = (x, y, 1): the derivative by w of the newest view.
        J[i, 0], J[i, 1], J[i, 2] = (r2 * y - r1) * over, (r0 - r2 * x) * over, (r1 * x - r0 * y) * over
        for c in range(3):
            J[i, 3 + c] = rho * (to[i, c] - at * to[2, c]) * over
            J_k[i, 3 + c] = -J[i, 3 + c]
    # [q]x: the derivative by w_k.
    J_k[0, 0], J_k[0, 1], J_k[0, 2] = u * w, -(1 + u * u), w
    J_k[1, 0], J_k[1, 1], J_k[1, 2] = 1 + w * w, -u * w, -u
