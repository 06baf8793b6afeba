"""Distances of matches from the epipolar lines of their poses, for ``anchors.epipolar``; on the CPU (numba)."""

from __future__ import annotations

import numpy as np

from ufmstar_torch.kernels.compile_cpu import reordered

# Limit of the inverse depth, as a share of that at which a point reaches the earlier camera's focal plane.
_AHEAD = 0.98


@reordered
def from_lines(position, before, T, T_before, K, K_inverse, nearest, farthest, least, distance, rho, baseline):
    """Write the results of ``anchors.epipolar.off_lines``, for inverse depths ``nearest`` and ``farthest``,
    and depths of at least ``least``."""
    for n in range(len(position)):
        u, v, P = before[n, 0], before[n, 1], T_before[n]
        x = K_inverse[0, 0] * position[n, 0] + K_inverse[0, 1] * position[n, 1] + K_inverse[0, 2]
        y = K_inverse[1, 1] * position[n, 1] + K_inverse[1, 2]
        wx, wy = T[0, 0] * x + T[0, 1] * y + T[0, 2], T[1, 0] * x + T[1, 1] * y + T[1, 2]
        wz = T[2, 0] * x + T[2, 1] * y + T[2, 2]
        sx, sy, sz = T[0, 3] - P[0, 3], T[1, 3] - P[1, 3], T[2, 3] - P[2, 3]
        baseline[n] = np.sqrt(sx * sx + sy * sy + sz * sz)
        # The ray and the shift in the earlier camera, then in its pixels.
        xz, bz = P[0, 2] * wx + P[1, 2] * wy + P[2, 2] * wz, P[0, 2] * sx + P[1, 2] * sy + P[2, 2] * sz
        xy, by = P[0, 1] * wx + P[1, 1] * wy + P[2, 1] * wz, P[0, 1] * sx + P[1, 1] * sy + P[2, 1] * sz
        xx, bx = P[0, 0] * wx + P[1, 0] * wy + P[2, 0] * wz, P[0, 0] * sx + P[1, 0] * sy + P[2, 0] * sz
        xx, bx = K[0, 0] * xx + K[0, 1] * xy + K[0, 2] * xz, K[0, 0] * bx + K[0, 1] * by + K[0, 2] * bz
        xy, by = K[1, 1] * xy + K[1, 2] * xz, K[1, 1] * by + K[1, 2] * bz
        # The point must lie in front of the earlier camera, too: 1/z < x_z/-b_z.
        most = _AHEAD * xz / max(-bz, 1e-12) if bz < 0 else np.inf
        near, far = min(nearest, most), min(farthest, most)
        near_z, far_z = max(xz + near * bz, least), max(xz + far * bz, least)
        start_u, start_v = (xx + near * bx) / near_z, (xy + near * by) / near_z
        du, dv = (xx + far * bx) / far_z - start_u, (xy + far * by) / far_z - start_v
        share = ((u - start_u) * du + (v - start_v) * dv) / max(du * du + dv * dv, 1e-12)
        share = min(max(share, 0.0), 1.0)
        off_u, off_v = u - start_u - share * du, v - start_v - share * dv
        distance[n] = np.sqrt(off_u * off_u + off_v * off_v)
        speed_u, speed_v = bx - u * bz, by - v * bz
        square = max(speed_u * speed_u + speed_v * speed_v, 1e-12)
        rho[n] = ((u * xz - xx) * speed_u + (v * xz - xy) * speed_v) / square
