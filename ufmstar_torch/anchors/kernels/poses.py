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

from ufmstar_torch.anchors.kernels.cholesky import factored, inverted
from ufmstar_torch.anchors.kernels.dense import ACROSS, ACROSS_NOISE, ALONG, NOISE, SLOPE, SPEED, VALUE
from ufmstar_torch.anchors.kernels.numbers import MEDIAN_SQUARE, finite, median
from ufmstar_torch.anchors.kernels.pose_equations import CAMERA, EACH, POSE, linearised, rotated, solve
from ufmstar_torch.kernels.compile_cpu import empty, leaf, reordered, reordered_leaf
from ufmstar_torch.kernels.cpu.sample import smallest

# Number of linearisations: the correction changes the depths at which the positions are linearised.
_LINEARISATIONS = 2

# Least number of matches for an update of the running estimates.
_ENOUGH = 10
# [px] Least standard deviation of a position by errors of the refined poses.
_LEAST = 0.003
# The variance of a pixel is _PATCH times that of its match times the mean squared residual of its views, in which the
# running mean counts as one more view. The factor, fitted on tours, stands for errors that views share in the patch.
_PATCH = 2.0
# Correlation of the errors of two keyframes' relative poses: the present view contributes half of each variance.
_SHARED = 0.5
# Prior standard deviations of the camera's errors: focal length as a share, centre as a share of the width, and radial
# distortion. Share of a frame's information in an update, as frames share keyframes; weight of the prior in an update.
_CAMERA, _PART, _FADE = (0.003, 0.003, 0.003, 0.01), 0.2, 0.02


class Errors(NamedTuple):
    """Running estimates of the errors, which :func:`correct` updates.

    Attributes:
        variance: [B, 2] of w and s of a keyframe's pose, by its baseline [rad^2, m^2].
        unexplained: [B] variance of a position that errors of poses and camera do not explain [px^2].
        camera: [4] errors of the camera.
        covariance: [4, 4] of ``camera``.
        disagreement: [1] mean squared residual of a view, over its variance.
    """

    variance: NDArray[np.float64]
    unexplained: NDArray[np.float64]
    camera: NDArray[np.float64]
    covariance: NDArray[np.float64]
    disagreement: NDArray[np.float64]


@reordered
def correct(pixel, accepted, measured, views, K, K_inverse, depth, trusted, memory, errors, rho, variance, off):
    """Correct inverse depths for the most likely errors, by ``ROUNDS`` rounds of Student-t weights with the depths
    eliminated, and update the running estimates.

    Args:
        pixel: [M, 2] (u, v).
        accepted: [M] bool, True for the pixels to use, each measured in at least one view.
        measured: their matches (``dense.Measured``).
        views: V keyframes (``dense.Views``).
        K, K_inverse: [3, 3] [px].
        depth: median of the scene [m].
        trusted: False = the camera's errors are not updated.
        memory: share of the running estimates that remains after a frame.
        errors: see :class:`Errors`.
        rho, variance: overwritten for accepted pixels, [M] inverse depth [1/m] and its variance [1/m^2]. Where the
            equations are singular, the variance is infinite, and nothing is updated.
        off: overwritten likewise, [M] largest squared distance of a match from its epipolar line, over its variance,
            of all views; NaN where no view measures it.
    """
    found, count = empty(len(accepted), np.int64), 0
    for n in range(len(accepted)):
        if accepted[n]:
            found[count], rho[n], variance[n], off[n] = n, measured.rho[n], np.inf, np.nan
            count += 1
    if count == 0:
        return
    found, each, shares, view_count = found[:count], measured.each, views.share, len(views.share)
    size = POSE * view_count + CAMERA
    changes, by_view = empty((2, view_count, EACH, count), np.float64), empty((6, view_count, count), np.float64)
    change, across_change, offset, weight, shift = changes[0], changes[1], by_view[0], by_view[1], by_view[2]
    across_weight, residual, across_residual = by_view[3], by_view[4], by_view[5]
    R, t, by_match = empty((3, 3), np.float64), empty(3, np.float64), empty((2, 2, EACH), np.float64)
    moved, one = by_match[0], by_match[1]
    by, rows, delta = empty((2, EACH, count), np.float64), empty((4, count), np.float64), empty(count, np.float64)
    A, r, weighted = empty((size, size), np.float64), empty(size, np.float64), empty((size, count), np.float64)
    mean_change, values = empty((size, count), np.float64), empty((view_count + 1) * count, np.float64)
    precision, right_side = empty((size, size), np.float64), empty(size, np.float64)
    error, covariance = empty(size, np.float64), empty((size, size), np.float64)
    camera_precision, camera_posterior = empty((CAMERA, CAMERA), np.float64), empty((CAMERA, CAMERA), np.float64)
    square, mean = empty((CAMERA, CAMERA), np.float64), empty(CAMERA, np.float64)
    _prior(errors, shares, views.image.shape[2], square, camera_precision, precision, right_side)
    for i in range(count):
        delta[i] = 0.0
        for k in range(view_count):
            for c in range(EACH):
                change[k, c, i] = across_change[k, c, i] = 0.0
    _weigh(found, each, rho, errors.unexplained, shares, offset, weight, shift, across_weight)
    for _ in range(_LINEARISATIONS):
        for k in range(view_count):
            rotated(views.H[k], views.b[k], K, K_inverse, R, t)
            _linearise(k, pixel, found, each, rho, delta, weight[k], R, t, K, moved, one, change[k], across_change[k])
        if not solve(
            change, offset, weight, across_change, shift, across_weight, precision, right_side, error, covariance,
            mean_change, delta, residual, across_residual, by, rows, A, r, weighted,
        ):  # fmt: skip
            return
    for i in range(size):
        for j in range(size):
            if not finite(covariance[i, j]):  # never store NaN
                return
    learn_poses(error, covariance, shares, depth, K[0, 0], memory, errors)
    if trusted:
        width = views.image.shape[2]
        learn_camera(error, covariance, width, errors, camera_precision, camera_posterior, square, mean)
    learn_noise(found, measured, shares, residual, across_residual, memory, values, errors)
    common = rows[0]
    _common_variance(covariance, mean_change, rows[1], common)
    for i in range(count):
        rho[found[i]] += delta[i]
    _spread(found, measured.agreed, weight, across_weight, residual, across_residual, errors, common, variance, off)


@reordered_leaf
def _linearise(k, pixel, found, each, rho, delta, weight, R, t, K, moved, one, change, across_change):
    """Write the derivatives of the matches in view k, along its lines and across [10, N]; ``moved`` and ``one`` are
    buffers [2, 10]."""
    for i in range(len(found)):
        n = found[i]
        if weight[i] > 0:
            along, slope, over = each[n, k, ALONG : ALONG + 2], each[n, k, SLOPE], 1 / each[n, k, SPEED]
            linearised(pixel[n], rho[n] + delta[i], along, slope, R, t, K, moved, one[0], one[1])
            for c in range(EACH):
                change[c, i], across_change[c, i] = one[0, c] * over, one[1, c]


@reordered_leaf
def _spread(found, agreed, weight, across_weight, residual, across_residual, errors, common, variance, off):
    """Write variances and distances from the lines, as :func:`correct`."""
    for i in range(len(found)):
        n, most, dispersion = found[i], 0.0, errors.disagreement[0]
        for k in range(len(weight)):
            most = max(most, weight[k, i])
            dispersion += residual[k, i]
            if across_weight[k, i] > 0:
                ratio = across_residual[k, i] * across_weight[k, i]
                off[n] = ratio if np.isnan(off[n]) else max(off[n], ratio)
        variance[n] = _PATCH * (dispersion / max(agreed[n], 1)) / most + common[i]


@reordered_leaf
def _weigh(found, each, rho, unexplained, shares, offset, weight, shift, across_weight):
    """Write the distances [V, N] of the matches from the inverse depths ``rho``, along the lines [1/m] and across [px],
    and their inverse variances; 0 where a view shows no match."""
    for i in range(offset.shape[1]):
        n = found[i]
        for k in range(len(offset)):
            value, speed, slope, across = each[n, k, VALUE], each[n, k, SPEED], each[n, k, SLOPE], each[n, k, ACROSS]
            used, shows, noise = np.isfinite(value), np.isfinite(across), unexplained[shares[k]]
            offset[k, i], shift[k, i] = value - rho[n] if used else 0.0, across if shows else 0.0
            scale = (1 + slope * slope) / (speed * speed)
            weight[k, i] = 1 / (each[n, k, NOISE] / (speed * speed) + noise * scale) if used else 0.0
            across_weight[k, i] = 1 / (each[n, k, ACROSS_NOISE] + noise) if shows else 0.0


@reordered_leaf
def _common_variance(covariance, mean_change, row, common):
    """Write the variances [N] that the errors of poses and camera, of covariance [S, S], add to the inverse depths,
    which change with them by ``mean_change`` [S, N]; ``row`` is a buffer [N]."""
    for i in range(len(common)):
        common[i] = 0.0
    for p in range(len(covariance)):
        row[:] = 0.0
        for q in range(len(covariance)):
            for i in range(len(common)):
                row[i] += covariance[p, q] * mean_change[q, i]
        for i in range(len(common)):
            common[i] += row[i] * mean_change[p, i]


@reordered_leaf
def _prior(errors, shares, width, square, camera_precision, precision, right_side):
    """Write the precision [S, S] of the errors of V keyframes and of the camera, S = 6 V + 4, its product [S] with
    their mean, and the camera's part [4, 4]; ``square`` is a buffer [4, 4]."""
    views, first = len(shares), POSE * len(shares)
    for i in range(len(precision)):
        right_side[i] = 0.0
        for j in range(len(precision)):
            precision[i, j] = 0.0
    # The inverse of the correlation of V errors, each two of which correlate by _SHARED.
    alone, other = 1 / (1 - _SHARED), _SHARED / (1 - _SHARED) / (1 - _SHARED + _SHARED * views)
    for k in range(views):
        for m in range(views):
            for c in range(POSE):
                part = 0 if c < 3 else 1
                product = errors.variance[shares[k], part] * errors.variance[shares[m], part]
                inverse = alone - other if k == m else -other
                precision[POSE * k + c, POSE * m + c] = inverse / np.sqrt(product)
    if not inverse_of(errors.covariance, square, camera_precision):
        for i in range(CAMERA):
            for j in range(CAMERA):
                camera_precision[i, j] = 1 / camera_variance(i, width) if i == j else 0.0
    for i in range(CAMERA):
        for j in range(CAMERA):
            precision[first + i, first + j] = camera_precision[i, j]
        # K includes the first three errors.
        right_side[first + i] = camera_precision[i, CAMERA - 1] * errors.camera[CAMERA - 1]


@reordered_leaf
def inverse_of(A, factor, inverse):
    """Write the inverse of a symmetric positive definite A [n, n]; ``factor`` is a buffer [n, n]. False where A is
    not positive definite."""
    for i in range(len(A)):
        for j in range(i + 1):
            factor[i, j] = A[i, j]
    if not factored(factor):
        return False
    inverted(factor, inverse)
    return True


@reordered_leaf
def learn_poses(error, covariance, shares, depth, focal, memory, errors):
    """Update the variances of the poses' errors by those of a frame."""
    for k in range(len(shares)):
        for part in range(2):
            before, square, remaining = errors.variance[shares[k], part], 0.0, 0.0
            for c in range(POSE * k + 3 * part, POSE * k + 3 * part + 3):
                square += error[c] * error[c]
                remaining += covariance[c, c]
            determined = 3 - remaining / before  # how many of 3 components
            step = (1 - memory) * (square - determined * before) / max(determined, 1.0)
            least = (_LEAST / focal) ** 2 * (depth * depth if part == 1 else 1.0)
            errors.variance[shares[k], part] = max(before + step, least)


@reordered_leaf
def learn_camera(error, covariance, width, errors, precision, posterior, square, mean):
    """Update the camera's errors, whose ``precision`` [4, 4] before the frame is overwritten; the other arguments are
    buffers."""
    first = len(error) - CAMERA
    for i in range(CAMERA):
        for j in range(CAMERA):
            square[i, j] = covariance[first + i, first + j]
    if not factored(square):
        return
    inverted(square, posterior)
    for i in range(CAMERA):
        mean[i] = 0.0
        for j in range(CAMERA):
            measured = error[first + j] + (errors.camera[j] if j < CAMERA - 1 else 0.0)
            mean[i] += (1 - _PART) * precision[i, j] * errors.camera[j] + _PART * posterior[i, j] * measured
    for i in range(CAMERA):
        for j in range(CAMERA):
            precision[i, j] = (1 - _FADE) * ((1 - _PART) * precision[i, j] + _PART * posterior[i, j])
        precision[i, i] += _FADE / camera_variance(i, width)
    if not inverse_of(precision, square, errors.covariance):
        return
    for i in range(CAMERA):
        errors.camera[i] = 0.0
        for j in range(CAMERA):
            errors.camera[i] += (1 - _FADE) * errors.covariance[i, j] * mean[j]


@leaf
def camera_variance(i, width):
    """Prior variance of an error of the camera, by its index."""
    return (_CAMERA[i] * (width if i == 1 or i == 2 else 1)) ** 2


@reordered_leaf
def learn_noise(found, measured, shares, residual, across_residual, memory, values, errors):
    """Update the variance that errors do not explain, and the disagreement of views; ``values`` [(V + 1) N] is a
    buffer."""
    views, count = residual.shape
    compared = 0
    for k in range(views):
        for i in range(count):
            n = found[i]
            if measured.agreed[n] > 1 and np.isfinite(measured.each[n, k, VALUE]):
                values[compared] = residual[k, i]
                compared += 1
    if compared < _ENOUGH:
        return
    newest = median(values, compared)
    errors.disagreement[0] = memory * errors.disagreement[0] + (1 - memory) * newest / MEDIAN_SQUARE
    for k in range(views):
        shows = 0
        for i in range(count):
            if np.isfinite(measured.each[found[i], k, ACROSS_NOISE]):
                values[shows], values[count + shows] = across_residual[k, i], measured.each[found[i], k, ACROSS_NOISE]
                shows += 1
        if shows < _ENOUGH:
            continue
        middle = shows // 2
        square, noise = smallest(values, shows, middle), smallest(values[count:], shows, middle)
        unexplained = max(square / MEDIAN_SQUARE - noise, _LEAST * _LEAST)
        errors.unexplained[shares[k]] = memory * errors.unexplained[shares[k]] + (1 - memory) * unexplained
