"""The normal equations of ``anchors.dense_poses``: errors of the keyframes' poses and of the camera, depths eliminated.

On the CPU (numba). A point of the image, the ray n = K^-1 x, lies in a keyframe at q = R n + rho t, up to scale. With the
errors (w, s) of the keyframe's pose and (f, cx, cy, k) of the camera it moves in the keyframe by J (w, s, f, cx, cy, k):
q becomes q + w x q + rho s; f is a share of the focal length, cx and cy are pixels, and k is the coefficient of a radial
distortion, x (1 + k r^2). ``tests/oracle_dense.py`` has the same by differences, and the equations with the depths.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.kernels.dense_cpu import Views, compiled

# Numbers of a pose and of the camera.
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
    """How the errors move the matches.

    Args:
        pixel: [N, 2] (u, v).
        rho: [N] [1/m].
        along: [N, V, 2] unit direction of the line in the view.
        slope: [N, V] by how much an error across the line moves the match along it.
        views: V of them.
        K: [3, 3] [px].

    Returns:
        [N, V, 10] by the errors of the pose (rad, m) and of the camera (1, px, px, 1): of the position that a search
        along the line returns [px], and of the position across the line [px].
    """
    shape = (*slope.shape, EACH)
    on_line, across = np.zeros(shape), np.zeros(shape)
    _linearised(pixel, rho, along, slope, views.H, views.b, K, np.linalg.inv(K), on_line, across)
    return on_line, across


@compiled
def _linearised(pixel, rho, along, slope, H, b, K, K_inverse, on_line, across):
    fx, fy = K[0, 0], K[1, 1]
    moved = np.empty((2, EACH))
    for k in range(len(H)):
        R, t = K_inverse @ H[k] @ K, K_inverse @ b[k]
        for n in range(len(pixel)):
            x, y = (pixel[n, 0] - K[0, 2]) / fx, (pixel[n, 1] - K[1, 2]) / fy
            z = R[2, 0] * x + R[2, 1] * y + R[2, 2] + rho[n] * t[2]
            over = 1 / z
            p = (R[0, 0] * x + R[0, 1] * y + R[0, 2] + rho[n] * t[0]) * over
            q = (R[1, 0] * x + R[1, 1] * y + R[1, 2] + rho[n] * t[1]) * over
            moved[0, 0], moved[0, 1], moved[0, 2] = -p * q * fx, (1 + p * p) * fx, -q * fx
            moved[1, 0], moved[1, 1], moved[1, 2] = -(1 + q * q) * fy, p * q * fy, p * fy
            per = rho[n] * over
            moved[0, 3], moved[0, 4], moved[0, 5] = per * fx, 0.0, -p * per * fx
            moved[1, 3], moved[1, 4], moved[1, 5] = 0.0, per * fy, -q * per * fy
            # In the view, of the ray's x and y.
            ux, uy = (R[0, 0] - p * R[2, 0]) * over * fx, (R[0, 1] - p * R[2, 1]) * over * fx
            vx, vy = (R[1, 0] - q * R[2, 0]) * over * fy, (R[1, 1] - q * R[2, 1]) * over * fy
            here, there = x * x + y * y, p * p + q * q
            moved[0, 6], moved[1, 6] = p * fx - x * ux - y * uy, q * fy - x * vx - y * vy
            moved[0, 7], moved[1, 7] = 1 - ux / fx, -vx / fx
            moved[0, 8], moved[1, 8] = -uy / fy, 1 - vy / fy
            moved[0, 9] = there * p * fx - here * (x * ux + y * uy)
            moved[1, 9] = there * q * fy - here * (x * vx + y * vy)
            eu, ev = along[n, k, 0], along[n, k, 1]
            for c in range(EACH):
                across[n, k, c] = eu * moved[1, c] - ev * moved[0, c]
                on_line[n, k, c] = eu * moved[0, c] + ev * moved[1, c] + slope[n, k] * across[n, k, c]


@compiled
def equations(change, value, weight, across_change, across, across_weight, A, r, mean_change, mean):
    """Add N pixels to the normal equations A d = r of the errors d, [6 V + 4], their inverse depths eliminated.

    Args:
        change: [N, V, 10] of the inverse depth that a view shows, by the errors.
        value: [N, V] what it shows, from any origin [1/m].
        weight: [N, V] its precision [m^2]; 0 = nothing.
        across_change, across, across_weight: the same across the line [px].
        A, r: are added to.
        mean_change, mean: [N, 6 V + 4] and [N], the weighted means over the views, are written.
    """
    count, views, _ = change.shape
    size = POSE * views + CAMERA
    place = np.empty(EACH, np.int64)
    for n in range(count):
        total = weighted = 0.0
        row = mean_change[n]
        row[:] = 0
        for k in range(views):
            w, a = weight[n, k], across_weight[n, k]
            if w == 0 and a == 0:
                continue
            for c in range(EACH):
                place[c] = POSE * k + c if c < POSE else POSE * views + c - POSE
            total += w
            weighted += w * value[n, k]
            for c in range(EACH):
                by, by_across = w * change[n, k, c], a * across_change[n, k, c]
                row[place[c]] += by
                r[place[c]] += by * value[n, k] + by_across * across[n, k]
                for d in range(c + 1):
                    A[place[c], place[d]] += by * change[n, k, d] + by_across * across_change[n, k, d]
        if total == 0:
            continue
        mean[n] = weighted / total
        for c in range(size):
            r[c] -= row[c] * mean[n]
            by = row[c] / total
            for d in range(c + 1):
                A[c, d] -= by * row[d]
        for c in range(size):
            row[c] /= total
    for c in range(size):
        for d in range(c):
            A[d, c] = A[c, d]
