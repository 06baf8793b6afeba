"""Triangulation of tracks on the CPU (numba): a track after the other, all in registers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ufmstar_torch.triangulate import DAMPING, STEPS, Triangulated

compiled: Any = njit(cache=True, nogil=True)


def triangulate(
    pixel: NDArray[np.float64], seen: NDArray[np.bool_], T_world_cam: NDArray[np.float64], K: NDArray[np.float64]
) -> Triangulated:
    """As :func:`ufmstar_torch.triangulate.triangulate`."""
    n = len(pixel)
    point, covariance = np.empty((n, 3)), np.empty((n, 3, 3))
    error, ahead = np.empty(n), np.empty(n, dtype=np.bool_)
    origin = T_world_cam[:, :3, 3].mean(0)
    centre = T_world_cam[:, :3, 3] - origin
    rotation = np.ascontiguousarray(T_world_cam[:, :3, :3])
    _tracks(pixel, seen, rotation, centre, K, DAMPING, STEPS, point, covariance, error, ahead)
    return Triangulated(point + origin, covariance, error, ahead)


@compiled
def _tracks(pixel, seen, R, centre, K, damping, steps, point, covariance, error, ahead):
    normal, right, inverse = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    fx, fy, skew, cx, cy = K[0, 0], K[1, 1], K[0, 1], K[0, 2], K[1, 2]
    row_u, row_v, ray = np.empty(3), np.empty(3), np.empty(3)
    for n in range(pixel.shape[0]):
        X = point[n]
        for step in range(-1, steps + 1):
            for i in range(3):
                right[i] = 0.0
                for j in range(3):
                    normal[i, j] = 0.0
            squares, count, front = 0.0, 0, True
            for w in range(pixel.shape[1]):
                if not seen[n, w]:
                    continue
                count += 1
                if step < 0:  # the point nearest to all rays
                    b = (pixel[n, w, 1] - cy) / fy
                    a = (pixel[n, w, 0] - cx - skew * b) / fx
                    length = (a * a + b * b + 1) ** 0.5
                    for i in range(3):
                        ray[i] = (R[w, i, 0] * a + R[w, i, 1] * b + R[w, i, 2]) / length
                    for i in range(3):
                        for j in range(3):
                            across = (1.0 if i == j else 0.0) - ray[i] * ray[j]
                            normal[i, j] += across
                            right[i] += across * centre[w, j]
                    continue
                x, y, z = 0.0, 0.0, 0.0
                for i in range(3):
                    offset = X[i] - centre[w, i]
                    x += R[w, i, 0] * offset
                    y += R[w, i, 1] * offset
                    z += R[w, i, 2] * offset
                front = front and z > 0
                if abs(z) <= 1e-9:
                    z = 1e-9
                u, v = (fx * x + skew * y) / z, fy * y / z
                du, dv = u + cx - pixel[n, w, 0], v + cy - pixel[n, w, 1]
                squares += du * du + dv * dv
                for i in range(3):
                    row_u[i] = (fx * R[w, i, 0] + skew * R[w, i, 1] - u * R[w, i, 2]) / z
                    row_v[i] = (fy * R[w, i, 1] - v * R[w, i, 2]) / z
                for i in range(3):
                    right[i] += row_u[i] * du + row_v[i] * dv
                    for j in range(3):
                        normal[i, j] += row_u[i] * row_u[j] + row_v[i] * row_v[j]
            scale = damping * max(normal[0, 0] + normal[1, 1] + normal[2, 2], 2.2250738585072014e-308)
            for i in range(3):
                normal[i, i] += scale
            if step == steps:
                error[n] = (squares / max(2 * count, 1)) ** 0.5
                ahead[n] = front
                _inverse(normal, covariance[n])
                continue
            _inverse(normal, inverse)
            for i in range(3):
                change = inverse[i, 0] * right[0] + inverse[i, 1] * right[1] + inverse[i, 2] * right[2]
                X[i] = change if step < 0 else X[i] - change


@compiled
def _inverse(S, out):
    """Of a symmetric positive definite 3x3, by cofactors."""
    a, b, c = S[0, 0], S[0, 1], S[0, 2]
    d, e, f = S[1, 1], S[1, 2], S[2, 2]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * A + b * B + c * C
    out[0, 0], out[0, 1], out[0, 2] = A / determinant, B / determinant, C / determinant
    out[1, 1], out[1, 2], out[2, 2] = (
        (a * f - c * c) / determinant,
        (b * c - a * e) / determinant,
        (a * d - b * b) / determinant,
    )
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
