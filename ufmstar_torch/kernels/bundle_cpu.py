"""Normal equations of a bundle adjustment, inverse depths eliminated, for ``anchors.bundle``; on the CPU (numba).

View W is the newest. A track whose ray there is n lies in view k at

    q = Exp(-w_k) R_k^T (rho (C_W + s_W - C_k - s_k) + R_W Exp(w_W) n),

up to scale. ``tests/oracle_bundle.py`` is the same in NumPy, its Jacobian by differences.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.kernels.compile_cpu import reordered

# Numbers of a pose's error: a rotation about the camera's axes [rad] and a shift along the world's [m].
POSE = 6
# Inverse depths lie between these multiples of that of the scene.
FAR, NEAR = 0.02, 20.0
# A point this near to a view's image plane, over its distance from the newest view, is not used.
_AHEAD = 1e-3


def inverse_depths(
    ray: NDArray[np.float64], precision: NDArray[np.float64], T_world_cam: NDArray[np.float64],
    prior: float, student: float, steps: int,
) -> NDArray[np.float64]:  # fmt: skip
    """[N] inverse depths by Gauss-Newton steps with poses that are held fixed; arguments as :func:`equations`."""
    rho = np.full(len(ray), prior)
    into, moved = _between(T_world_cam)
    _inverse_depths(ray, precision, into, moved, prior, student, steps, rho)
    return rho


def equations(
    ray: NDArray[np.float64], precision: NDArray[np.float64], T_world_cam: NDArray[np.float64],
    rho: NDArray[np.float64], prior: float, student: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:  # fmt: skip
    """The tracks' part of the normal equations of a Gauss-Newton step.

    Args:
        ray: [N, W, 2] x and y of the tracks' positions on the plane at depth 1; the newest view is the last.
        precision: [N, W-1] of a position in the earlier views; 0 where a view does not show the track.
        T_world_cam: [W, 4, 4] camera-to-world [m].
        rho: [N] inverse depths in the newest view [1/m].
        prior: mean of ``rho`` before the images, of which its standard deviation is twice as much [1/m].
        student: degrees of freedom of the positions' distribution.

    Returns:
        A [6 W, 6 W] and b [6 W] of A d = b for the errors d of the poses; h [N, 6 W] and
        v [N]: a track's inverse depth changes by v - h d.
    """
    n, views = precision.shape
    size = POSE * (views + 1)
    A, b, h, v = np.zeros((size, size)), np.zeros(size), np.zeros((n, size)), np.zeros(n)
    into, moved = _between(T_world_cam)
    to_view = np.ascontiguousarray(T_world_cam[:, :3, :3].transpose(0, 2, 1))
    _equations(ray, precision, into, moved, to_view, rho, prior, student, A, b, h, v)
    return A, b, h, v


def moved(T_world_cam: NDArray[np.float64], error: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses [W, 4, 4] rotated about their own axes [rad] and shifted along the world's [m] by ``error`` [6 W]."""
    result = T_world_cam.copy()
    _move(error, result)
    return result


def _between(T_world_cam: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """R_k^T R_W [W-1, 3, 3] and R_k^T (C_W - C_k) [W-1, 3]."""
    R, C = T_world_cam[:, :3, :3], T_world_cam[:, :3, 3]
    into = R[:-1].transpose(0, 2, 1)
    return np.ascontiguousarray(into @ R[-1]), ((C[-1] - C[:-1])[:, None] @ R[:-1])[:, 0]


@reordered
def _move(error, poses):
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


@reordered
def _inverse_depths(ray, precision, into, moved, prior, student, steps, rho):
    for n in range(len(ray)):
        x, y = ray[n, -1, 0], ray[n, -1, 1]
        for _ in range(steps):
            weight = 0.25 / (prior * prior)
            above = weight * (prior - rho[n])
            for k in range(precision.shape[1]):
                if precision[n, k] == 0:
                    continue
                R, t = into[k], moved[k]
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


@reordered
def _equations(ray, precision, into, moved, to_view, rho, prior, student, A, b, h, v):
    views = precision.shape[1]
    last = POSE * views
    # By the newest pose and by view k's: rows u and v.
    by_newest, other, weighted = np.empty((2, POSE)), np.empty((2, POSE)), np.empty(h.shape)
    for n in range(len(ray)):
        x, y = ray[n, -1, 0], ray[n, -1, 1]
        row = h[n]
        total = 0.25 / (prior * prior)
        above = total * (prior - rho[n])
        for k in range(views):
            R, t, to = into[k], moved[k], to_view[k]
            z = R[2, 0] * x + R[2, 1] * y + R[2, 2] + rho[n] * t[2]
            if precision[n, k] == 0 or z < _AHEAD:
                continue
            over = 1 / z
            u = (R[0, 0] * x + R[0, 1] * y + R[0, 2] + rho[n] * t[0]) * over
            w = (R[1, 0] * x + R[1, 1] * y + R[1, 2] + rho[n] * t[1]) * over
            right, down = ray[n, k, 0] - u, ray[n, k, 1] - w
            p = precision[n, k]
            p *= (student + 2) / (student + p * (right * right + down * down))
            for i in range(2):
                at = u if i == 0 else w
                r0, r1, r2 = R[i, 0] - at * R[2, 0], R[i, 1] - at * R[2, 1], R[i, 2] - at * R[2, 2]
                # R [n]x with n = (x, y, 1), negative: the change by w of the newest view.
                by_newest[i, 0], by_newest[i, 1], by_newest[i, 2] = (
                    (r2 * y - r1) * over,
                    (r0 - r2 * x) * over,
                    (r1 * x - r0 * y) * over,
                )
                for c in range(3):
                    by_newest[i, 3 + c] = rho[n] * (to[i, c] - at * to[2, c]) * over
                    other[i, 3 + c] = -by_newest[i, 3 + c]
            # [q]x: the change by w_k.
            other[0, 0], other[0, 1], other[0, 2] = u * w, -(1 + u * u), w
            other[1, 0], other[1, 1], other[1, 2] = 1 + w * w, -u * w, -u
            du, dv = (t[0] - u * t[2]) * over, (t[1] - w * t[2]) * over
            total += p * (du * du + dv * dv)
            above += p * (du * right + dv * down)
            first = POSE * k
            for c in range(POSE):
                by_own, by_own_v = p * by_newest[0, c], p * by_newest[1, c]
                by, by_v = p * other[0, c], p * other[1, c]
                row[last + c] += by_own * du + by_own_v * dv
                row[first + c] += by * du + by_v * dv
                b[last + c] += by_own * right + by_own_v * down
                b[first + c] += by * right + by_v * down
                for d in range(POSE):
                    A[last + c, first + d] += by_own * other[0, d] + by_own_v * other[1, d]
                for d in range(c + 1):
                    A[last + c, last + d] += by_own * by_newest[0, d] + by_own_v * by_newest[1, d]
                    A[first + c, first + d] += by * other[0, d] + by_v * other[1, d]
        v[n] = above / total
        weighted[n] = row
        row /= total
    for c in range(last + POSE):
        for d in range(c):
            A[d, c] = A[c, d]
    A -= weighted.T @ h
    b -= weighted.T @ v
