"""Points from tracks in several posed views: position, covariance, reprojection error, and the test of their depth.

On the CPU (numba), float64, some tracks at a time, each in a lane of the processor's vectors. The start is the point
nearest to all rays; a few Gauss-Newton steps on the reprojection error follow, whose normal matrix is the information
on the point: Cov X = sigma^2 (J^T J)^-1. ``tests/oracle_triangulate.py`` is the same in NumPy.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.kernels.compile_cpu import empty, kernel, part

# From the rays' nearest point the reprojection error converges quadratically; three steps reach rounding on all but the
# worst geometry, which the tests of parallax refuse anyway.
STEPS = 3
# Added to the normal matrix's diagonal, relative to its trace, so that rays without parallax stay solvable; their huge
# variance then shows.
DAMPING = 1e-12


# NumPy's error model: divisions are not tested for zero, and degenerate geometry gives a covariance that is not finite.


class Triangulated(NamedTuple):
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
        seen: [N, W] mask of valid positions; at least two of each track.
        T_world_cam: [W, 4, 4] poses of the views.
        K: [3, 3] [px].
    """
    n = len(pixel)
    result = Triangulated(np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n), np.empty(n, dtype=np.bool_))
    _tracks(pixel, seen, T_world_cam, K, DAMPING, STEPS, *result)
    return result


# Tracks that are computed at once: a few vectors of any processor. Rows of a buffer: the points, the normal equations
# (upper triangle and right side), the sums of squared residuals, and 1 where in front of all views.
_LANES = 16
_X, _Y, _Z, _N00, _N01, _N02, _N11, _N12, _N22, _R0, _R1, _R2, _SQUARES, _FRONT = (i * _LANES for i in range(14))


@kernel
def _tracks(pixel, seen, T, K, damping, steps, point, covariance, error, ahead):
    views = seen.shape[1]
    to_image, to_ray = empty((views, 3, 3), np.float64), empty((views, 3, 3), np.float64)
    centre, origin = empty((views, 3), np.float64), empty(3, np.float64)
    _cameras(T, K, to_image, to_ray, centre, origin)
    obs, work, inverse = (
        empty((views, 3 * _LANES), np.float64), empty(14 * _LANES, np.float64), empty((3, 3), np.float64),
    )  # fmt: skip
    for first in range(0, seen.shape[0], _LANES):
        count = min(_LANES, seen.shape[0] - first)
        for w in range(views):
            for lane in range(_LANES):
                n = first + min(lane, count - 1)
                u, v = (pixel[n, w, 0] - K[0, 2], pixel[n, w, 1] - K[1, 2]) if seen[n, w] else (0.0, 0.0)
                obs[w, lane], obs[w, _LANES + lane], obs[w, 2 * _LANES + lane] = u, v, 1.0 if seen[n, w] else 0.0
        _nearest(obs, to_ray, centre, work)
        for step in range(steps + 1):
            for lane in range(count):
                _inverse(work, lane, damping, inverse)
                r0, r1, r2 = work[_R0 + lane], work[_R1 + lane], work[_R2 + lane]
                for i in range(3):
                    change = inverse[i, 0] * r0 + inverse[i, 1] * r1 + inverse[i, 2] * r2
                    at = i * _LANES + lane
                    work[at] = change if step == 0 else work[at] - change
            for lane in range(count, _LANES):
                for i in range(3):
                    work[i * _LANES + lane] = work[i * _LANES + count - 1]
            _linearised(obs, to_image, centre, work)
        for lane in range(count):
            n, shown = first + lane, 0
            for w in range(views):
                shown += seen[n, w]
            for i in range(3):
                point[n, i] = work[i * _LANES + lane] + origin[i]
            error[n] = (work[_SQUARES + lane] / max(2 * shown, 1)) ** 0.5
            ahead[n] = work[_FRONT + lane] > 0
            _inverse(work, lane, damping, covariance[n])


@part
def _cameras(T, K, to_image, to_ray, centre, origin):
    """Write the matrices and centres of views with poses [W, 4, 4]. Pixels are counted from the principal point.
    ``to_image`` [W, 3, 3] maps an offset from a camera to (u z, v z, z) in its image, ``to_ray`` [W, 3, 3] a pixel
    (u, v, 1) to the direction of its ray. ``centre`` [W, 3] is relative to the mean of the centres, ``origin`` [3]."""
    fx, fy, skew = K[0, 0], K[1, 1], K[0, 1]
    for i in range(3):
        total = 0.0
        for w in range(len(T)):
            total += T[w, i, 3]
        origin[i] = total / len(T)
    for w in range(len(T)):
        for i in range(3):
            centre[w, i] = T[w, i, 3] - origin[i]
            to_image[w, 0, i] = fx * T[w, i, 0] + skew * T[w, i, 1]
            to_image[w, 1, i], to_image[w, 2, i] = fy * T[w, i, 1], T[w, i, 2]
            to_ray[w, i, 0] = T[w, i, 0] / fx
            to_ray[w, i, 1], to_ray[w, i, 2] = T[w, i, 1] / fy - T[w, i, 0] * (skew / (fx * fy)), T[w, i, 2]


@part
def _nearest(obs, to_ray, centre, work):
    """Normal equations of the points nearest to all rays."""
    for i in range(_N00, work.size):
        work[i] = 0.0
    for w in range(obs.shape[0]):
        m00, m01, m02 = to_ray[w, 0, 0], to_ray[w, 0, 1], to_ray[w, 0, 2]
        m10, m11, m12 = to_ray[w, 1, 0], to_ray[w, 1, 1], to_ray[w, 1, 2]
        m20, m21, m22 = to_ray[w, 2, 0], to_ray[w, 2, 1], to_ray[w, 2, 2]
        c0, c1, c2 = centre[w, 0], centre[w, 1], centre[w, 2]
        for i in range(_LANES):
            u, v, seen = obs[w, i], obs[w, _LANES + i], obs[w, 2 * _LANES + i]
            x, y, z = m00 * u + m01 * v + m02, m10 * u + m11 * v + m12, m20 * u + m21 * v + m22
            share = seen / (x * x + y * y + z * z)
            a00, a01, a02 = seen - share * x * x, -share * x * y, -share * x * z
            a11, a12, a22 = seen - share * y * y, -share * y * z, seen - share * z * z
            work[_N00 + i] += a00
            work[_N01 + i] += a01
            work[_N02 + i] += a02
            work[_N11 + i] += a11
            work[_N12 + i] += a12
            work[_N22 + i] += a22
            work[_R0 + i] += a00 * c0 + a01 * c1 + a02 * c2
            work[_R1 + i] += a01 * c0 + a11 * c1 + a12 * c2
            work[_R2 + i] += a02 * c0 + a12 * c1 + a22 * c2


@part
def _linearised(obs, to_image, centre, work):
    """Normal equations of a Gauss-Newton step from the points; the sums of squared residuals [px^2], and whether the
    points lie in front of all views."""
    for i in range(_N00, work.size):
        work[i] = 1.0 if i >= _FRONT else 0.0
    for w in range(obs.shape[0]):
        p00, p01, p02 = to_image[w, 0, 0], to_image[w, 0, 1], to_image[w, 0, 2]
        p10, p11, p12 = to_image[w, 1, 0], to_image[w, 1, 1], to_image[w, 1, 2]
        p20, p21, p22 = to_image[w, 2, 0], to_image[w, 2, 1], to_image[w, 2, 2]
        c0, c1, c2 = centre[w, 0], centre[w, 1], centre[w, 2]
        for i in range(_LANES):
            x, y, z, seen = work[_X + i] - c0, work[_Y + i] - c1, work[_Z + i] - c2, obs[w, 2 * _LANES + i]
            depth = p20 * x + p21 * y + p22 * z
            work[_FRONT + i] = work[_FRONT + i] if depth > 0 or seen == 0 else 0.0
            over = 1 / depth if abs(depth) > 1e-9 else 1e9
            u, v = (p00 * x + p01 * y + p02 * z) * over, (p10 * x + p11 * y + p12 * z) * over
            du, dv, over = seen * (u - obs[w, i]), seen * (v - obs[w, _LANES + i]), seen * over
            a0, a1, a2 = (p00 - u * p20) * over, (p01 - u * p21) * over, (p02 - u * p22) * over
            b0, b1, b2 = (p10 - v * p20) * over, (p11 - v * p21) * over, (p12 - v * p22) * over
            work[_SQUARES + i] += du * du + dv * dv
            work[_R0 + i] += a0 * du + b0 * dv
            work[_R1 + i] += a1 * du + b1 * dv
            work[_R2 + i] += a2 * du + b2 * dv
            work[_N00 + i] += a0 * a0 + b0 * b0
            work[_N01 + i] += a0 * a1 + b0 * b1
            work[_N02 + i] += a0 * a2 + b0 * b2
            work[_N11 + i] += a1 * a1 + b1 * b1
            work[_N12 + i] += a1 * a2 + b1 * b2
            work[_N22 + i] += a2 * a2 + b2 * b2


@part
def _inverse(work, lane, damping, out):
    """The inverse of a damped normal matrix, symmetric and positive definite, by cofactors."""
    n00, n11, n22 = work[_N00 + lane], work[_N11 + lane], work[_N22 + lane]
    more = damping * max(n00 + n11 + n22, 2.2250738585072014e-308)
    a, b, c = n00 + more, work[_N01 + lane], work[_N02 + lane]
    d, e, f = n11 + more, work[_N12 + lane], n22 + more
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    over = 1 / (a * A + b * B + c * C)
    out[0, 0], out[0, 1], out[0, 2] = A * over, B * over, C * over
    out[1, 1], out[1, 2], out[2, 2] = (a * f - c * c) * over, (b * c - a * e) * over, (a * d - b * b) * over
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
