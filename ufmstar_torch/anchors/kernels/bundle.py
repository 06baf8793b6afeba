"""Normal equations of a bundle adjustment, inverse depths eliminated, for ``anchors.bundle``; on the CPU (numba).

View W is the newest. A track with the ray n in view W lies in view k at

    q = Exp(-w_k) R_k^T (rho (C_W + s_W - C_k - s_k) + R_W Exp(w_W) n),

up to scale. ``tests/oracle_bundle.py`` is the same in NumPy, its Jacobian by differences.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.kernels.cholesky import factored, inverted, substituted
from ufmstar_torch.kernels.compile_cpu import empty, reordered

# Parameters of a pose's error: a rotation about the camera's axes [rad] and a shift along the world's [m].
POSE = 6
# Limits of inverse depths, as multiples of the scene's.
FAR, NEAR = 0.02, 20.0
# Least depth of a point in a view, over its depth in the newest view; nearer points are not used.
_AHEAD = 1e-3


def inverse_depths(
    ray: NDArray[np.float64], precision: NDArray[np.float64], T_world_cam: NDArray[np.float64],
    prior: float, student: float, steps: int,
) -> NDArray[np.float64]:  # fmt: skip
    """[N] inverse depths by Gauss-Newton steps with fixed poses; arguments as :func:`equations`."""
    rho = np.full(len(ray), prior)
    rotation, translation = _between(T_world_cam)
    _inverse_depths(ray, precision, rotation, translation, prior, student, steps, rho)
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
        prior: prior mean of ``rho`` [1/m]; its prior standard deviation is twice as large.
        student: degrees of freedom of the positions' distribution.

    Returns:
        A [6 W, 6 W] and b [6 W] of A d = b for the errors d of the poses; h [N, 6 W] and
        v [N]: a track's inverse depth changes by v - h d.
    """
    n, views = precision.shape
    size = POSE * (views + 1)
    A, b, h, v = np.zeros((size, size)), np.zeros(size), np.zeros((n, size)), np.zeros(n)
    rotation, translation = _between(T_world_cam)
    to_view = np.ascontiguousarray(T_world_cam[:, :3, :3].transpose(0, 2, 1))
    _equations(ray, precision, rotation, translation, to_view, rho, prior, student, A, b, h, v)
    return A, b, h, v


def moved(T_world_cam: NDArray[np.float64], error: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses [W, 4, 4] rotated about their own axes [rad] and shifted along the world's [m] by ``error`` [6 W]."""
    result = T_world_cam.copy()
    _move(error, result)
    return result


def adjusted(
    ray: NDArray[np.float64], precision: NDArray[np.float64], T_world_cam: NDArray[np.float64],
    rho: NDArray[np.float64], prior: float, student: float, first: tuple[NDArray[np.float64], ...],
    pose_precision: NDArray[np.float64], information: float, steps: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None:  # fmt: skip
    """Gauss-Newton steps on poses and inverse depths.

    Args:
        ray, precision, T_world_cam, rho, prior, student: as :func:`equations`; poses and ``rho`` are overwritten.
        first: A, b, h and v of :func:`equations` for the first step, which are overwritten by those of the last one.
        pose_precision: [6 W] of the prior of the poses' errors, whose mean is 0.
        information: factor on A and b.
        steps: number of steps.

    Returns:
        The errors [6 W], their covariance [6 W, 6 W], and the variance [N] of ``rho`` by it. None where the equations
        are singular.
    """
    error, covariance, by_poses = np.zeros(len(pose_precision)), np.zeros_like(first[0]), np.zeros(len(rho))
    arguments = ray, precision, T_world_cam, rho, prior, student, *first, pose_precision, information, steps
    fine = _adjust(*arguments, error, covariance, by_poses)
    return (error, covariance, by_poses) if fine else None


@reordered
def _adjust(
    ray, precision, poses, rho, prior, student, A, b, h, v, pose_precision, information, steps, error, covariance,
    by_poses,
):  # fmt: skip
    views, size = len(poses), len(b)
    rotation, translation, to_view = (
        empty((views - 1, 3, 3), np.float64),
        empty((views - 1, 3), np.float64),
        empty((views, 3, 3), np.float64),
    )
    for step in range(steps):
        if step > 0:
            for k in range(views):
                for i in range(3):
                    for j in range(3):
                        to_view[k, i, j] = poses[k, j, i]
            for k in range(views - 1):
                for i in range(3):
                    translation[k, i] = 0.0
                    for j in range(3):
                        translation[k, i] += poses[k, j, i] * (poses[views - 1, j, 3] - poses[k, j, 3])
                        rotation[k, i, j] = 0.0
                        for m in range(3):
                            rotation[k, i, j] += poses[k, m, i] * poses[views - 1, m, j]
            A[:], b[:], h[:], v[:] = 0.0, 0.0, 0.0, 0.0
            _equations(ray, precision, rotation, translation, to_view, rho, prior, student, A, b, h, v)
        for i in range(size):
            b[i] = information * b[i] - pose_precision[i] * error[i]
            for j in range(i + 1):
                A[i, j] *= information
            A[i, i] += pose_precision[i]
        if not factored(A):
            return False
        substituted(A, b)
        _move(b, poses)
        for i in range(size):
            error[i] += b[i]
        for n in range(len(rho)):
            change = v[n]
            for i in range(size):
                change -= h[n, i] * b[i]
            rho[n] = min(max(rho[n] + change, FAR * prior), NEAR * prior)
    inverted(A, covariance)
    for n in range(len(rho)):
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += covariance[i, j] * h[n, j]
            by_poses[n] += total * h[n, i]
    return True


def _between(T_world_cam: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """R_k^T R_W [W-1, 3, 3] and R_k^T (C_W - C_k) [W-1, 3]."""
    R, C = T_world_cam[:, :3, :3], T_world_cam[:, :3, 3]
    inverse = R[:-1].transpose(0, 2, 1)
    return np.ascontiguousarray(inverse @ R[-1]), ((C[-1] - C[:-1])[:, None] @ R[:-1])[:, 0]


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
def _inverse_depths(ray, precision, rotation, translation, prior, student, steps, rho):
    for n in range(len(ray)):
        x, y = ray[n, -1, 0], ray[n, -1, 1]
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


@reordered
def _equations(ray, precision, rotation, translation, to_view, rho, prior, student, A, b, h, v):
    views = precision.shape[1]
    last = POSE * views
    # Derivatives of u and v (rows) by the newest pose and by view k's.
    J, J_k, weighted = empty((2, POSE), np.float64), empty((2, POSE), np.float64), empty(h.shape, np.float64)
    for n in range(len(ray)):
        x, y = ray[n, -1, 0], ray[n, -1, 1]
        row = h[n]
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
            for i in range(2):
                at = u if i == 0 else w
                r0, r1, r2 = R[i, 0] - at * R[2, 0], R[i, 1] - at * R[2, 1], R[i, 2] - at * R[2, 2]
                # -R [n]x with n = (x, y, 1): the derivative by w of the newest view.
                J[i, 0], J[i, 1], J[i, 2] = (r2 * y - r1) * over, (r0 - r2 * x) * over, (r1 * x - r0 * y) * over
                for c in range(3):
                    J[i, 3 + c] = rho[n] * (to[i, c] - at * to[2, c]) * over
                    J_k[i, 3 + c] = -J[i, 3 + c]
            # [q]x: the derivative by w_k.
            J_k[0, 0], J_k[0, 1], J_k[0, 2] = u * w, -(1 + u * u), w
            J_k[1, 0], J_k[1, 1], J_k[1, 2] = 1 + w * w, -u * w, -u
            du, dv = (t[0] - u * t[2]) * over, (t[1] - w * t[2]) * over
            total += p * (du * du + dv * dv)
            above += p * (du * right + dv * down)
            first = POSE * k
            for c in range(POSE):
                newest_u, newest_v = p * J[0, c], p * J[1, c]
                k_u, k_v = p * J_k[0, c], p * J_k[1, c]
                row[last + c] += newest_u * du + newest_v * dv
                row[first + c] += k_u * du + k_v * dv
                b[last + c] += newest_u * right + newest_v * down
                b[first + c] += k_u * right + k_v * down
                for d in range(POSE):
                    A[last + c, first + d] += newest_u * J_k[0, d] + newest_v * J_k[1, d]
                for d in range(c + 1):
                    A[last + c, last + d] += newest_u * J[0, d] + newest_v * J[1, d]
                    A[first + c, first + d] += k_u * J_k[0, d] + k_v * J_k[1, d]
        v[n] = above / total
        weighted[n] = row
        row /= total
    for c in range(last + POSE):
        for d in range(c):
            A[d, c] = A[c, d]
    A -= weighted.T @ h
    b -= weighted.T @ v
