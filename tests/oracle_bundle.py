"""Bundle adjustment as a dense least-squares problem in all unknowns at once, its Jacobian by differences (NumPy)."""

from __future__ import annotations

import numpy as np


def rotation(w):
    """exp([w]x) by its series."""
    cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    result, term = np.eye(3), np.eye(3)
    for n in range(1, 30):
        term = term @ cross / n
        result = result + term
    return result


def moved(pose, error):
    """A pose [4, 4] after a rotation about its own axes and a shift along the world's."""
    result = pose.copy()
    result[:3, :3] = pose[:3, :3] @ rotation(error[:3])
    result[:3, 3] += error[3:]
    return result


def projected(ray, rho, newest, view):
    """Project a point on a ray of the newest view to a view's plane at depth 1."""
    point = newest[:3, 3] + newest[:3, :3] @ np.append(ray, 1) / rho
    x, y, z = view[:3, :3].T @ (point - view[:3, 3])
    return np.array([x / z, y / z])


def residuals(ray, precision, poses, rho, prior, student, unknowns):
    """Whitened residuals for the unknowns (errors of the poses, changes of rho), with Student weights at the start."""
    views = len(poses)
    now = [moved(pose, unknowns[6 * k : 6 * k + 6]) for k, pose in enumerate(poses)]
    out = []
    for n in range(len(ray)):
        changed = rho[n] + unknowns[6 * views + n]
        out.append((prior - changed) / (2 * prior))
        for k in range(views - 1):
            start = ray[n, k] - projected(ray[n, -1], rho[n], poses[-1], poses[k])
            p = precision[n, k]
            p = p * (student + 2) / (student + p * (start @ start))
            out.extend(np.sqrt(p) * (ray[n, k] - projected(ray[n, -1], changed, now[-1], now[k])))
    return np.array(out)


def step(ray, precision, poses, rho, prior, student, information, pose_precision):
    """Gauss-Newton step [6 W + N] of ``information`` times the squared residuals, and the poses' prior about 0."""
    size = 6 * len(poses) + len(rho)
    arguments = ray, precision, poses, rho, prior, student
    J = np.zeros((len(residuals(*arguments, np.zeros(size))), size))
    for c in range(size):
        for sign in (1, -1):
            unknowns = np.zeros(size)
            unknowns[c] = sign * 1e-5
            J[:, c] += sign * residuals(*arguments, unknowns) / 2e-5
    A = information * J.T @ J
    A[np.arange(6 * len(poses)), np.arange(6 * len(poses))] += pose_precision
    return -np.linalg.solve(A, information * J.T @ residuals(*arguments, np.zeros(size)))
