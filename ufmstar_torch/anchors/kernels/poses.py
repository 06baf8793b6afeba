"""Errors of the keyframes' poses and of the camera by least squares, for ``anchors.dense_poses``.

On the CPU (numba). A point of the image, the ray n = K^-1 x, lies in a keyframe at q = R n + rho t, up to scale. With
the errors (w, s) of the keyframe's pose and (f, cx, cy, k) of the camera, it moves in the keyframe: q becomes
q + w x q + rho s; f is a share of the focal length, cx and cy are pixels, and k is the coefficient of a radial
distortion, x (1 + k r^2). ``tests/oracle_dense.py`` has the same by differences, and the equations with the depths.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.kernels.cholesky import factored, inverted, reduced
from ufmstar_torch.anchors.kernels.dense import Measured, Views
from ufmstar_torch.gaussians.camera import inverse_intrinsics
from ufmstar_torch.kernels.compile_cpu import empty, leaf, reordered, reordered_leaf

# Rounds of Student-t weights, and their degrees of freedom.
ROUNDS, STUDENT = 3, 4.0
# Number of linearisations: the correction changes the depths at which the positions are linearised.
_LINEARISATIONS = 2

# Parameters of a pose and of the camera.
POSE, CAMERA = 6, 4
EACH = POSE + CAMERA


class Corrected(NamedTuple):
    """Errors of V poses and of the camera, and the depths of N pixels without them.

    Attributes:
        error: [6 V + 4] of the poses, one after the other, and of the camera.
        covariance: [6 V + 4, 6 V + 4] of the errors; NaN where the equations are singular.
        rho: [N] inverse depth [1/m].
        match: [N] least variance of an inverse depth in a view by its match [1/m^2]; infinite without a match.
        common: [N] variance of ``rho`` from the remaining errors [1/m^2].
        residual: [N, V] squared residual of the inverse depth in each view, over its variance; 0 without a match.
        across_residual: [N, V] squared distance from the line [px^2]; 0 where the match does not show it.
        off_line: [N] largest ``across_residual`` over its variance; NaN where no view shows it.
    """

    error: NDArray[np.float64]
    covariance: NDArray[np.float64]
    rho: NDArray[np.float64]
    match: NDArray[np.float64]
    common: NDArray[np.float64]
    residual: NDArray[np.float64]
    across_residual: NDArray[np.float64]
    off_line: NDArray[np.float64]


def corrected(
    pixel: NDArray[np.float64], found: NDArray[np.int64], measured: Measured, views: Views, K: NDArray[np.float64],
    unexplained: NDArray[np.float64], precision: NDArray[np.float64], start: NDArray[np.float64],
) -> Corrected:  # fmt: skip
    """The most likely errors by ``ROUNDS`` rounds of Student-t weights, with the depths eliminated.

    Args:
        pixel: [M, 2] (u, v).
        found: [N] indices of the pixels to use, each measured in at least one view.
        measured: matches of the M pixels.
        views: V keyframes.
        K: [3, 3] [px].
        unexplained: [V] variance of a position that errors of poses and camera do not explain [px^2].
        precision, start: [6 V + 4, 6 V + 4] and [6 V + 4] of the errors' prior.
    """
    n, v, size = len(found), len(views.H), len(start)
    error, covariance, rho, (match, common) = (
        np.zeros(size),
        np.zeros((size, size)),
        measured.rho[found],
        np.zeros((2, n)),
    )
    residual, across_residual, off_line = np.zeros((n, v)), np.zeros((n, v)), np.full(n, np.nan)
    columns = measured.value, measured.noise, measured.along, measured.speed, measured.slope
    across = measured.across, measured.across_noise
    cameras = views.H, views.b, K, inverse_intrinsics(K)
    results = Corrected(error, covariance, rho, match, common, residual, across_residual, off_line)
    _correct(pixel, found, *columns, *across, *cameras, unexplained, precision, precision @ start, *results)
    return results


@reordered
def _correct(
    pixel, found, value, noise, along, speed, slope, across, across_noise, H, b, K, K_inverse,
    unexplained, precision, right_side, error, covariance, rho, match, common, residual, across_residual, off_line,
):  # fmt: skip
    count, views, size = len(found), len(H), len(error)
    change, across_change = empty((count, views, EACH), np.float64), empty((count, views, EACH), np.float64)
    offset, weight = empty((count, views), np.float64), empty((count, views), np.float64)
    shift, across_weight = empty((count, views), np.float64), empty((count, views), np.float64)
    R, t, moved, delta = (
        empty((3, 3), np.float64), empty(3, np.float64), empty((2, EACH), np.float64), empty(count, np.float64),
    )  # fmt: skip
    mean, total, view_error = empty(count, np.float64), empty(count, np.float64), empty(EACH, np.float64)
    A, r, by_view = empty((size, size), np.float64), empty(size, np.float64), empty((EACH, EACH), np.float64)
    weighted, mean_change = empty((count, size), np.float64), empty((count, size), np.float64)
    for i in range(count):
        n, delta[i] = found[i], 0.0
        for k in range(views):
            used, shows = np.isfinite(value[n, k]), np.isfinite(value[n, k]) and np.isfinite(across[n, k])
            offset[i, k], shift[i, k] = value[n, k] - rho[i] if used else 0.0, across[n, k] if shows else 0.0
            scale = (1 + slope[n, k] * slope[n, k]) / (speed[n, k] * speed[n, k])
            weight[i, k] = 1 / (noise[n, k] / (speed[n, k] * speed[n, k]) + unexplained[k] * scale) if used else 0.0
            across_weight[i, k] = 1 / (across_noise[n, k] + unexplained[k]) if shows else 0.0
            for c in range(EACH):
                change[i, k, c] = across_change[i, k, c] = 0.0
    for _ in range(_LINEARISATIONS):
        for k in range(views):
            rotated(H[k], b[k], K, K_inverse, R, t)
            for i in range(count):
                n = found[i]
                if weight[i, k] > 0:
                    linearised(
                        pixel[n], rho[i] + delta[i], along[n, k], slope[n, k], R, t, K, moved,
                        change[i, k], across_change[i, k],
                    )  # fmt: skip
                    for c in range(EACH):
                        change[i, k, c] /= speed[n, k]
        if not solve(
            change, offset, weight, across_change, shift, across_weight, precision, right_side, error, covariance,
            mean_change, delta, residual, across_residual, mean, total, view_error, A, r, by_view, weighted,
        ):  # fmt: skip
            covariance[0, 0] = np.nan
            return
    for i in range(count):
        rho[i] += delta[i]
        most = 0.0
        for k in range(views):
            most = max(most, weight[i, k])
            if across_weight[i, k] > 0:
                ratio = across_residual[i, k] * across_weight[i, k]
                off_line[i] = ratio if np.isnan(off_line[i]) else max(off_line[i], ratio)
        match[i] = 1 / most
        for p in range(size):
            row = 0.0
            for q in range(size):
                row += covariance[p, q] * mean_change[i, q]
            common[i] += row * mean_change[i, p]


@reordered_leaf
def linearised(pixel, rho, along, slope, R, t, K, change, on_line, across):
    """Write the derivatives of a match's position by the errors of the pose (rad, m) and of the camera (1, px, px, 1):
    ``on_line`` [10] of the position that a search along the line returns, ``across`` [10] of that across the line [px].

    Args:
        pixel: [2] (u, v).
        rho: inverse depth [1/m].
        along: [2] unit direction of the line in the view.
        slope: shift of the match along the line per unit of error across it.
        R, t: of the view, see :func:`rotated`.
        K: [3, 3] [px].
        change: [2, 10] buffer.
    """
    fx, fy = K[0, 0], K[1, 1]
    x, y = (pixel[0] - K[0, 2]) / fx, (pixel[1] - K[1, 2]) / fy
    over = 1 / (R[2, 0] * x + R[2, 1] * y + R[2, 2] + rho * t[2])
    p = (R[0, 0] * x + R[0, 1] * y + R[0, 2] + rho * t[0]) * over
    q = (R[1, 0] * x + R[1, 1] * y + R[1, 2] + rho * t[1]) * over
    change[0, 0], change[0, 1], change[0, 2] = -p * q * fx, (1 + p * p) * fx, -q * fx
    change[1, 0], change[1, 1], change[1, 2] = -(1 + q * q) * fy, p * q * fy, p * fy
    per = rho * over
    change[0, 3], change[0, 4], change[0, 5] = per * fx, 0.0, -p * per * fx
    change[1, 3], change[1, 4], change[1, 5] = 0.0, per * fy, -q * per * fy
    # Derivatives of the position in the view by the ray's x and y.
    ux, uy = (R[0, 0] - p * R[2, 0]) * over * fx, (R[0, 1] - p * R[2, 1]) * over * fx
    vx, vy = (R[1, 0] - q * R[2, 0]) * over * fy, (R[1, 1] - q * R[2, 1]) * over * fy
    r2, r2_view = x * x + y * y, p * p + q * q
    change[0, 6], change[1, 6] = p * fx - x * ux - y * uy, q * fy - x * vx - y * vy
    change[0, 7], change[1, 7] = 1 - ux / fx, -vx / fx
    change[0, 8], change[1, 8] = -uy / fy, 1 - vy / fy
    change[0, 9] = r2_view * p * fx - r2 * (x * ux + y * uy)
    change[1, 9] = r2_view * q * fy - r2 * (x * vx + y * vy)
    for c in range(EACH):
        across[c] = along[0] * change[1, c] - along[1] * change[0, c]
        on_line[c] = along[0] * change[0, c] + along[1] * change[1, c] + slope * across[c]


@leaf
def rotated(H, b, K, K_inverse, R, t):
    """Write R = K^-1 H K and t = K^-1 b; K and its inverse have the last row (0, 0, 1)."""
    for i in range(3):
        t[i] = K_inverse[i, 0] * b[0] + K_inverse[i, 1] * b[1] + K_inverse[i, 2] * b[2]
        x, y, z = (
            K_inverse[i, 0] * H[0, 0] + K_inverse[i, 1] * H[1, 0] + K_inverse[i, 2] * H[2, 0],
            K_inverse[i, 0] * H[0, 1] + K_inverse[i, 1] * H[1, 1] + K_inverse[i, 2] * H[2, 1],
            K_inverse[i, 0] * H[0, 2] + K_inverse[i, 1] * H[1, 2] + K_inverse[i, 2] * H[2, 2],
        )
        R[i, 0], R[i, 1] = x * K[0, 0], x * K[0, 1] + y * K[1, 1]
        R[i, 2] = x * K[0, 2] + y * K[1, 2] + z


@reordered_leaf
def solve(
    change, value, weight, across_change, across, across_weight, precision, right_side, error, covariance,
    mean_change, rho, residual, across_residual, mean, total, view_error, A, r, by_view, weighted,
):  # fmt: skip
    """The most likely errors of N pixels in V views, and the depths; False if the equations are singular.

    Args:
        change: [N, V, 10] derivative of ``value`` by the errors.
        value: [N, V] inverse depth, from an arbitrary origin for each pixel [1/m].
        weight: [N, V] inverse of the variance of ``value`` [m^2]; 0 where a view measures nothing.
        across_change, across, across_weight: the same of the position across the line [px].
        precision, right_side: [6 V + 4, 6 V + 4] of the prior, and its product with the prior's mean.
        error, covariance: overwritten, [6 V + 4] and [6 V + 4, 6 V + 4].
        mean_change: overwritten, [N, 6 V + 4] derivative of a pixel's weighted mean by the errors.
        rho: overwritten, [N] inverse depth from its origin; 0 where no view measures it.
        residual: overwritten, [N, V] squared residual of ``value``, over its variance.
        across_residual: overwritten, [N, V] squared residual of ``across``.
        mean, total, view_error, A, r, by_view, weighted: buffers.
    """
    count, views, size = change.shape[0], change.shape[1], len(error)
    for iteration in range(ROUNDS):
        for i in range(size):
            r[i] = right_side[i]
            for j in range(size):
                A[i, j] = precision[i, j]
        student = 0.0 if iteration == 0 else STUDENT
        _equations(
            *(change, value, weight, residual, across_change, across, across_weight, across_residual, student),
            *(A, r, mean_change, mean, total, by_view, weighted),
        )
        if not factored(A):
            return False
        inverted(A, covariance)
        for i in range(size):
            error[i] = 0.0
            for j in range(size):
                error[i] += covariance[i, j] * r[j]
        for n in range(count):
            change_of_mean = 0.0
            for i in range(size):
                change_of_mean += mean_change[n, i] * error[i]
            rho[n] = mean[n] - change_of_mean
        for k in range(views):
            for c in range(EACH):
                view_error[c] = error[POSE * (k if c < POSE else views - 1) + c]
            for n in range(count):
                e, e_across = value[n, k] - rho[n], across[n, k]
                for c in range(EACH):
                    e -= change[n, k, c] * view_error[c]
                    e_across -= across_change[n, k, c] * view_error[c]
                residual[n, k], across_residual[n, k] = e * e * weight[n, k], e_across * e_across
    return True


@reordered_leaf
def _equations(
    change, value, weight, residual, across_change, across, across_weight, across_residual, student,
    A, r, mean_change, mean, total, by_view, weighted,
):  # fmt: skip
    """Add the pixels to the normal equations A d = r, and write the precision-weighted means over the views.
    ``student`` = 0: weights without Student's t. ``total``, ``by_view`` and ``weighted`` are buffers."""
    count, views, size = change.shape[0], change.shape[1], len(r)
    for n in range(count):
        mean[n] = total[n] = 0.0
        for i in range(size):
            mean_change[n, i] = 0.0
    for k in range(views):
        first, camera = POSE * k, POSE * (views - 1)  # added to c: its index among the errors
        for c in range(EACH):
            for d in range(EACH):
                by_view[c, d] = 0.0
        for n in range(count):
            w, a = weight[n, k], across_weight[n, k]
            if w == 0 and a == 0:
                continue
            if student > 0:
                w *= (student + 1) / (student + residual[n, k])
                a *= (student + 1) / (student + across_residual[n, k] * a)
            total[n] += w
            mean[n] += w * value[n, k]
            for c in range(EACH):
                index = c + (first if c < POSE else camera)
                by, by_across = w * change[n, k, c], a * across_change[n, k, c]
                mean_change[n, index] += by
                r[index] += by * value[n, k] + by_across * across[n, k]
                for d in range(c + 1):  # a lower triangle, which :func:`factored` reads
                    by_view[c, d] += by * change[n, k, d] + by_across * across_change[n, k, d]
        for c in range(EACH):
            for d in range(c + 1):
                A[c + (first if c < POSE else camera), d + (first if d < POSE else camera)] += by_view[c, d]
    for n in range(count):
        over = 1 / total[n] if total[n] > 0 else 0.0
        mean[n] *= over
        for i in range(size):
            weighted[n, i] = mean_change[n, i]
            mean_change[n, i] *= over
            r[i] -= weighted[n, i] * mean[n]
    reduced(A, weighted, mean_change)
