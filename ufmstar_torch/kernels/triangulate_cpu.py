"""Points from tracks seen by posed cameras: position, depth, its variance, and whether to believe them.

On the CPU (numba), float64, one track after the other, all in registers. The start is the point nearest to all rays; a
few Gauss-Newton steps on the reprojection error follow, whose normal matrix is the information on the point:
Cov X = sigma^2 (J^T J)^-1. ``tests/oracle_triangulate.py`` is the same in NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.kernels.compile_cpu import kernel, part

# From the rays' nearest point the reprojection error converges quadratically; three steps reach rounding on all but the
# worst geometry, which the tests of parallax refuse anyway.
STEPS = 3
# Added to the normal matrix's diagonal, relative to its trace, so that rays without parallax stay solvable; their huge
# variance then shows.
DAMPING = 1e-12


# NumPy's error model: no test for zero before every division, and hopeless geometry gives no exception but a covariance
# that is not finite.


@dataclass(frozen=True, eq=False)
class Triangulated:
    """N points in world coordinates.

    Attributes:
        point: [N, 3] [m].
        covariance: [N, 3, 3] [m^2] for a noise of one pixel.
        error: [N] root mean square reprojection error over the views [px].
        ahead: [N] bool, in front of every camera that saw it.
    """

    point: NDArray[np.float64]
    covariance: NDArray[np.float64]
    error: NDArray[np.float64]
    ahead: NDArray[np.bool_]


def triangulate(
    pixel: NDArray[np.float64], seen: NDArray[np.bool_], T_world_cam: NDArray[np.float64], K: NDArray[np.float64]
) -> Triangulated:
    """Points from their positions in several views of one camera.

    Args:
        pixel: [N, W, 2] positions (u, v) [px].
        seen: [N, W] which of them hold; at least two of each track.
        T_world_cam: [W, 4, 4] poses of the views.
        K: [3, 3] [px].
    """
    n = len(pixel)
    point, covariance = np.empty((n, 3)), np.empty((n, 3, 3))
    error, ahead = np.empty(n), np.empty(n, dtype=np.bool_)
    origin = T_world_cam[:, :3, 3].mean(0)
    centre, rotation = T_world_cam[:, :3, 3] - origin, T_world_cam[:, :3, :3]
    scale = np.diag([0.0, 0.0, 1.0])
    scale[:2, :2] = K[:2, :2]
    into = np.ascontiguousarray(scale @ rotation.transpose(0, 2, 1))
    out_of = np.ascontiguousarray(rotation @ np.linalg.inv(scale))
    _tracks(pixel - K[:2, 2], seen, into, out_of, centre, DAMPING, STEPS, point, covariance, error, ahead)
    return Triangulated(point + origin, covariance, error, ahead)


@kernel
def _tracks(pixel, seen, into, out_of, centre, damping, steps, point, covariance, error, ahead):
    """Pixels [N, W, 2] are counted from the principal point. ``into`` [W, 3, 3] takes an offset from a camera to
    (u z, v z, z) in its image, ``out_of`` [W, 3, 3] a pixel (u, v, 1) to the direction of its ray."""
    normal, right, inverse = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for n in range(pixel.shape[0]):
        X, squares, count, front = point[n], 0.0, 0, True
        _nearest(pixel[n], seen[n], out_of, centre, normal, right)
        for step in range(steps + 1):
            _inverse(normal, damping, inverse)
            for i in range(3):
                change = inverse[i, 0] * right[0] + inverse[i, 1] * right[1] + inverse[i, 2] * right[2]
                X[i] = change if step == 0 else X[i] - change
            squares, count, front = _linearised(X, pixel[n], seen[n], into, centre, normal, right)
        error[n] = (squares / max(2 * count, 1)) ** 0.5
        ahead[n] = front
        _inverse(normal, damping, covariance[n])


@part
def _nearest(pixel, seen, out_of, centre, normal, right):
    """Normal equations (upper triangle) of the point nearest to all rays."""
    n00 = n01 = n02 = n11 = n12 = n22 = r0 = r1 = r2 = 0.0
    for w in range(seen.shape[0]):
        if not seen[w]:
            continue
        M, u, v = out_of[w], pixel[w, 0], pixel[w, 1]
        x, y = M[0, 0] * u + M[0, 1] * v + M[0, 2], M[1, 0] * u + M[1, 1] * v + M[1, 2]
        z = M[2, 0] * u + M[2, 1] * v + M[2, 2]
        share = 1 / (x * x + y * y + z * z)
        a00, a01, a02 = 1 - share * x * x, -share * x * y, -share * x * z
        a11, a12, a22 = 1 - share * y * y, -share * y * z, 1 - share * z * z
        c0, c1, c2 = centre[w, 0], centre[w, 1], centre[w, 2]
        n00, n01, n02, n11, n12, n22 = n00 + a00, n01 + a01, n02 + a02, n11 + a11, n12 + a12, n22 + a22
        r0 += a00 * c0 + a01 * c1 + a02 * c2
        r1 += a01 * c0 + a11 * c1 + a12 * c2
        r2 += a02 * c0 + a12 * c1 + a22 * c2
    normal[0, 0], normal[0, 1], normal[0, 2] = n00, n01, n02
    normal[1, 1], normal[1, 2], normal[2, 2] = n11, n12, n22
    right[0], right[1], right[2] = r0, r1, r2


@part
def _linearised(X, pixel, seen, into, centre, normal, right):
    """Normal equations (upper triangle) of a Gauss-Newton step from X; the sum of squared residuals [px^2], how many
    views saw the point, and whether it lies in front of all of them."""
    n00 = n01 = n02 = n11 = n12 = n22 = r0 = r1 = r2 = squares = 0.0
    count, front = 0, True
    for w in range(seen.shape[0]):
        if not seen[w]:
            continue
        count += 1
        P, x, y, z = into[w], X[0] - centre[w, 0], X[1] - centre[w, 1], X[2] - centre[w, 2]
        depth = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z
        front = front and depth > 0
        over = 1 / depth if abs(depth) > 1e-9 else 1e9
        u = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z) * over
        v = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z) * over
        du, dv = u - pixel[w, 0], v - pixel[w, 1]
        a0, a1, a2 = (P[0, 0] - u * P[2, 0]) * over, (P[0, 1] - u * P[2, 1]) * over, (P[0, 2] - u * P[2, 2]) * over
        b0, b1, b2 = (P[1, 0] - v * P[2, 0]) * over, (P[1, 1] - v * P[2, 1]) * over, (P[1, 2] - v * P[2, 2]) * over
        squares += du * du + dv * dv
        r0, r1, r2 = r0 + a0 * du + b0 * dv, r1 + a1 * du + b1 * dv, r2 + a2 * du + b2 * dv
        n00, n01, n02 = n00 + a0 * a0 + b0 * b0, n01 + a0 * a1 + b0 * b1, n02 + a0 * a2 + b0 * b2
        n11, n12, n22 = n11 + a1 * a1 + b1 * b1, n12 + a1 * a2 + b1 * b2, n22 + a2 * a2 + b2 * b2
    normal[0, 0], normal[0, 1], normal[0, 2] = n00, n01, n02
    normal[1, 1], normal[1, 2], normal[2, 2] = n11, n12, n22
    right[0], right[1], right[2] = r0, r1, r2
    return squares, count, front


@part
def _inverse(S, damping, out):
    """Of a symmetric positive definite 3x3 (its upper triangle), damped, by cofactors."""
    more = damping * max(S[0, 0] + S[1, 1] + S[2, 2], 2.2250738585072014e-308)
    a, b, c = S[0, 0] + more, S[0, 1], S[0, 2]
    d, e, f = S[1, 1] + more, S[1, 2], S[2, 2] + more
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    over = 1 / (a * A + b * B + c * C)
    out[0, 0], out[0, 1], out[0, 2] = A * over, B * over, C * over
    out[1, 1], out[1, 2], out[2, 2] = (a * f - c * c) * over, (b * c - a * e) * over, (a * d - b * b) * over
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
