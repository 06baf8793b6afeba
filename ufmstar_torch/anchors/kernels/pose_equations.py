"""The equations of ``poses``: derivatives of a match by the errors of a pose and of the camera, and the most likely
errors (numba)."""

from __future__ import annotations

from ufmstar_torch.anchors.kernels.cholesky import factored, inverted
from ufmstar_torch.kernels.compile_cpu import leaf, reordered_leaf

# Rounds of Student-t weights, and their degrees of freedom.
ROUNDS, STUDENT = 3, 4.0
# Parameters of a pose and of the camera.
POSE, CAMERA = 6, 4
EACH = POSE + CAMERA


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
    mean_change, rho, residual, across_residual, by, rows, A, r, weighted,
):  # fmt: skip
    """The most likely errors of N pixels in V views, S = 6 V + 4, and the depths; False if the equations are singular.

    Args:
        change: [V, 10, N] derivative of ``value`` by the errors.
        value: [V, N] inverse depth, from an arbitrary origin for each pixel [1/m].
        weight: [V, N] inverse of the variance of ``value`` [m^2]; 0 where a view measures nothing.
        across_change, across, across_weight: the same of the position across the line [px].
        precision, right_side: [S, S] of the prior, and its product with the prior's mean.
        error, covariance: overwritten, [S] and [S, S].
        mean_change: overwritten, [S, N] derivative of a pixel's weighted mean by the errors.
        rho: overwritten, [N] inverse depth from its origin; 0 where no view measures it.
        residual: overwritten, [V, N] squared residual of ``value``, over its variance.
        across_residual: overwritten, [V, N] squared residual of ``across``.
        by, rows, A, r, weighted: buffers, [2, 10, N], [4, N], [S, S], [S], [S, N].
    """
    views, count, size = len(value), len(rho), len(error)
    mean = rows[0]
    for iteration in range(ROUNDS):
        for i in range(size):
            r[i] = right_side[i]
            for j in range(size):
                A[i, j] = precision[i, j]
        student = 0.0 if iteration == 0 else STUDENT
        _equations(
            *(change, value, weight, residual, across_change, across, across_weight, across_residual, student),
            *(A, r, mean_change, by, rows, weighted),
        )
        if not factored(A):
            return False
        inverted(A, covariance)
        for i in range(size):
            error[i] = 0.0
            for j in range(size):
                error[i] += covariance[i, j] * r[j]
        for n in range(count):
            rho[n] = mean[n]
        for i in range(size):
            for n in range(count):
                rho[n] -= mean_change[i, n] * error[i]
        for k in range(views):
            off, off_across = residual[k], across_residual[k]
            for n in range(count):
                off[n] = value[k, n] - rho[n]
                off_across[n] = across[k, n]
            for c in range(EACH):
                e = error[POSE * (k if c < POSE else views - 1) + c]
                for n in range(count):
                    off[n] -= change[k, c, n] * e
                for n in range(count):
                    off_across[n] -= across_change[k, c, n] * e
            for n in range(count):
                off[n] = off[n] * off[n] * weight[k, n]
                off_across[n] *= off_across[n]
    return True


# Loops over all pixels, each with one result, so that they are vectorised.
@reordered_leaf
def _equations(
    change, value, weight, residual, across_change, across, across_weight, across_residual, student,
    A, r, mean_change, by, rows, weighted,
):  # fmt: skip
    """Add the pixels to the normal equations A d = r (lower triangle), and write the precision-weighted means over the
    views: ``mean_change`` and ``rows[0]``. ``student`` = 0: weights without Student's t."""
    views, count, size = len(value), len(rows[0]), len(r)
    mean, total, w, a = rows[0], rows[1], rows[2], rows[3]
    for n in range(count):
        mean[n] = total[n] = 0.0
    for i in range(size):
        for n in range(count):
            mean_change[i, n] = 0.0
    for k in range(views):
        first, camera = POSE * k, POSE * (views - 1)  # added to c: its index among the errors
        for n in range(count):
            w[n], a[n] = weight[k, n], across_weight[k, n]
            if student > 0:
                w[n] *= (student + 1) / (student + residual[k, n])
                a[n] *= (student + 1) / (student + across_residual[k, n] * a[n])
            total[n] += w[n]
            mean[n] += w[n] * value[k, n]
        for c in range(EACH):
            at, along, over = c + (first if c < POSE else camera), by[0, c], by[1, c]
            for n in range(count):
                along[n] = w[n] * change[k, c, n]
            for n in range(count):
                over[n] = a[n] * across_change[k, c, n]
            for n in range(count):
                mean_change[at, n] += along[n]
            right = 0.0
            for n in range(count):
                right += along[n] * value[k, n] + over[n] * across[k, n]
            r[at] += right
            for d in range(c + 1):  # a lower triangle, which :func:`factored` reads
                product = 0.0
                for n in range(count):
                    product += along[n] * change[k, d, n] + over[n] * across_change[k, d, n]
                A[at, d + (first if d < POSE else camera)] += product
    for n in range(count):
        total[n] = 1 / total[n] if total[n] > 0 else 0.0
        mean[n] *= total[n]
    for i in range(size):
        right = 0.0
        for n in range(count):
            weighted[i, n] = mean_change[i, n]
        for n in range(count):
            mean_change[i, n] *= total[n]
        for n in range(count):
            right += weighted[i, n] * mean[n]
        r[i] -= right
        for j in range(i + 1):
            product = 0.0
            for n in range(count):
                product += weighted[i, n] * mean_change[j, n]
            A[i, j] -= product
