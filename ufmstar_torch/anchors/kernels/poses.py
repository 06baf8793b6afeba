"""Errors of the keyframes' poses and of the camera by least squares, for ``anchors.dense_poses``.

On the CPU (numba). A point of the image, the ray n = K^-1 x, lies in a keyframe at q = R n + rho t, up to scale. With
the errors (w, s) of the keyframe's pose and (f, cx, cy, k) of the camera, it moves in the keyframe: q becomes
q + w x q + rho s; f is a share of the focal length, cx and cy are pixels, and k is the coefficient of a radial
distortion, x (1 + k r^2). ``tests/oracle_dense.py`` has the same by differences, and the equations with the depths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.kernels.cholesky import factored, inverted, reduced
from ufmstar_torch.anchors.kernels.dense import Views
from ufmstar_torch.gaussians.camera import inverse_intrinsics
from ufmstar_torch.kernels.compile_cpu import empty, leaf, reordered

# Rounds of Student-t weights, and their degrees of freedom.
ROUNDS, STUDENT = 3, 4.0

# Parameters of a pose and of the camera.
POSE, CAMERA = 6, 4
EACH = POSE + CAMERA


def linearised(
    pixel: NDArray[np.float64],
    rho: NDArray[np.float64],
    along: NDArray[np.float64],
    slope: NDArray[np.float64],
    views: Views,
    K: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Derivatives of the matches' positions by the errors.

    Args:
        pixel: [N, 2] (u, v).
        rho: [N] [1/m].
        along: [N, V, 2] unit direction of the line in the view.
        slope: [N, V] shift of the match along the line per unit of error across it.
        views: V keyframes.
        K: [3, 3] [px].

    Returns:
        [N, V, 10] by the errors of the pose (rad, m) and of the camera (1, px, px, 1): of the position that a search
        along the line returns [px], and of the position across the line [px].
    """
    shape = (*slope.shape, EACH)
    on_line, across = np.zeros(shape), np.zeros(shape)
    _linearised(pixel, rho, along, slope, views.H, views.b, K, inverse_intrinsics(K), on_line, across)
    return on_line, across


@reordered
def _linearised(pixel, rho, along, slope, H, b, K, K_inverse, on_line, across):
    fx, fy = K[0, 0], K[1, 1]
    change, R, t = empty((2, EACH), np.float64), empty((3, 3), np.float64), empty(3, np.float64)
    for k in range(len(H)):
        _rotated(H[k], b[k], K, K_inverse, R, t)
        for n in range(len(pixel)):
            x, y = (pixel[n, 0] - K[0, 2]) / fx, (pixel[n, 1] - K[1, 2]) / fy
            z = R[2, 0] * x + R[2, 1] * y + R[2, 2] + rho[n] * t[2]
            over = 1 / z
            p = (R[0, 0] * x + R[0, 1] * y + R[0, 2] + rho[n] * t[0]) * over
            q = (R[1, 0] * x + R[1, 1] * y + R[1, 2] + rho[n] * t[1]) * over
            change[0, 0], change[0, 1], change[0, 2] = -p * q * fx, (1 + p * p) * fx, -q * fx
            change[1, 0], change[1, 1], change[1, 2] = -(1 + q * q) * fy, p * q * fy, p * fy
            per = rho[n] * over
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
            eu, ev = along[n, k, 0], along[n, k, 1]
            for c in range(EACH):
                across[n, k, c] = eu * change[1, c] - ev * change[0, c]
                on_line[n, k, c] = eu * change[0, c] + ev * change[1, c] + slope[n, k] * across[n, k, c]


@leaf
def _rotated(H, b, K, K_inverse, R, t):
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


@dataclass(frozen=True, eq=False)
class Shown:
    """Positions of N pixels along and across their lines in V views.

    Attributes:
        change: [N, V, 10] derivative of ``value`` by the errors.
        value: [N, V] inverse depth, from an arbitrary origin for each pixel [1/m].
        variance: [N, V] of ``value`` [1/m^2]; infinite where a view measures nothing.
        across_change, across, across_variance: the same of the position across the line [px].
    """

    change: NDArray[np.float64]
    value: NDArray[np.float64]
    variance: NDArray[np.float64]
    across_change: NDArray[np.float64]
    across: NDArray[np.float64]
    across_variance: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Solution:
    """Errors and depths.

    Attributes:
        error: [6 V + 4] of the poses, one after the other, and of the camera.
        covariance: [6 V + 4, 6 V + 4] of the errors.
        rho: [N] inverse depth from its origin [1/m]; 0 where no view measures it.
        common: [N] variance of ``rho`` from the remaining errors [1/m^2].
        residual: [N, V] squared residual of ``value``, over its variance.
        across_residual: [N, V] squared residual of ``across`` [px^2].
    """

    error: NDArray[np.float64]
    covariance: NDArray[np.float64]
    rho: NDArray[np.float64]
    common: NDArray[np.float64]
    residual: NDArray[np.float64]
    across_residual: NDArray[np.float64]


def solved(shown: Shown, precision: NDArray[np.float64], start: NDArray[np.float64]) -> Solution:
    """The most likely errors for a prior of mean ``start`` [6 V + 4] and precision [6 V + 4, 6 V + 4], by ``ROUNDS``
    rounds of Student-t weights with the depths eliminated."""
    n, v = shown.value.shape
    size = len(start)
    error, covariance, mean_change = np.zeros(size), np.zeros((size, size)), np.zeros((n, size))
    rho, residual, across_residual = np.zeros(n), np.zeros((n, v)), np.zeros((n, v))
    _solved(
        *(shown.change, shown.value, 1 / shown.variance),
        *(shown.across_change, shown.across, 1 / shown.across_variance),
        *(precision, precision @ start, error, covariance, mean_change, rho, residual, across_residual),
    )
    common = (mean_change @ covariance * mean_change).sum(1)
    return Solution(error, covariance, rho, common, residual, across_residual)


@reordered
def _solved(
    change, value, weight, across_change, across, across_weight,
    precision, right_side, error, covariance, mean_change, rho, residual, across_residual,
):  # fmt: skip
    count, views, _ = change.shape
    size = len(error)
    mean, total, view_error = empty(count, np.float64), empty(count, np.float64), empty(EACH, np.float64)
    A, r, by_view = empty((size, size), np.float64), empty(size, np.float64), empty((EACH, EACH), np.float64)
    weighted = empty((count, size), np.float64)
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
            covariance[0, 0] = np.nan
            return
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


@reordered
def _equations(
    change, value, weight, residual, across_change, across, across_weight, across_residual, student,
    A, r, mean_change, mean, total, by_view, weighted,
):  # fmt: skip
    """Add the pixels to the normal equations A d = r, and write the precision-weighted means over the views.
    ``student`` = 0: weights without Student's t. ``total``, ``by_view`` and ``weighted`` are buffers."""
    count, views, _ = change.shape
    size = len(r)
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
