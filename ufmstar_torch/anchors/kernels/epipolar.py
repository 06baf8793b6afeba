"""Distances of matches between two posed views from their epipolar lines; on the CPU (numba)."""

from __future__ import annotations

import numpy as np

from ufmstar_torch.kernels.compile_cpu import reordered_leaf

# Least depth of a projected point, as a share of the median depth; the depth of nearer points is raised to it.
NEAREST = 1e-3
# Range of a scene's depths over the median, in which corners' points must lie. The upper limit is far above the median,
# which is inaccurate at first.
NEAR, FAR = 1 / 50, 10.0
# Limit of the inverse depth, as a share of that at which a point reaches the earlier camera's focal plane.
_AHEAD = 0.98
# Cells of the image per axis; matches of each cell have the same total weight.
_CELLS = 6
# The standard deviation of most matches is that by the quantile _MOST of their distances, _MOST_QUANTILE of a standard
# normal one. Farther than _FARTHEST times it from their lines are matches on things that move, which leave their lines
# as a group.
_MOST, _MOST_QUANTILE, _FARTHEST = 0.3, 0.3853, 6.0


@reordered_leaf
def off_line(position, before, T, P, K, K_inverse, nearest, farthest):
    """The distance of a match from the segment of the epipolar line between two depths.

    Without parallax, the segment is a point. A match that moved in the wrong direction, or not at all, lies beyond an
    end of it.

    Args:
        position, before: [2] (u, v) in the present view and in an earlier one [px].
        T, P: [4, 4] camera-to-world of the present view and of the earlier one [m].
        K, K_inverse: [3, 3] [px].
        nearest, farthest: range of the depths [m].

    Returns:
        Distance [px], inverse depth of the nearest point on the whole line [1/m], baseline [m].
    """
    u, v = before[0], before[1]
    x = K_inverse[0, 0] * position[0] + K_inverse[0, 1] * position[1] + K_inverse[0, 2]
    y = K_inverse[1, 1] * position[1] + K_inverse[1, 2]
    wx, wy = T[0, 0] * x + T[0, 1] * y + T[0, 2], T[1, 0] * x + T[1, 1] * y + T[1, 2]
    wz = T[2, 0] * x + T[2, 1] * y + T[2, 2]
    sx, sy, sz = T[0, 3] - P[0, 3], T[1, 3] - P[1, 3], T[2, 3] - P[2, 3]
    # The ray and the shift in the earlier camera, then in its pixels.
    xz, bz = P[0, 2] * wx + P[1, 2] * wy + P[2, 2] * wz, P[0, 2] * sx + P[1, 2] * sy + P[2, 2] * sz
    xy, by = P[0, 1] * wx + P[1, 1] * wy + P[2, 1] * wz, P[0, 1] * sx + P[1, 1] * sy + P[2, 1] * sz
    xx, bx = P[0, 0] * wx + P[1, 0] * wy + P[2, 0] * wz, P[0, 0] * sx + P[1, 0] * sy + P[2, 0] * sz
    xx, bx = K[0, 0] * xx + K[0, 1] * xy + K[0, 2] * xz, K[0, 0] * bx + K[0, 1] * by + K[0, 2] * bz
    xy, by = K[1, 1] * xy + K[1, 2] * xz, K[1, 1] * by + K[1, 2] * bz
    # The point must lie in front of the earlier camera, too: 1/z < x_z/-b_z.
    most = _AHEAD * xz / max(-bz, 1e-12) if bz < 0 else np.inf
    near, far = min(1 / nearest, most), min(1 / farthest, most)
    near_z, far_z = max(xz + near * bz, NEAREST), max(xz + far * bz, NEAREST)
    start_u, start_v = (xx + near * bx) / near_z, (xy + near * by) / near_z
    du, dv = (xx + far * bx) / far_z - start_u, (xy + far * by) / far_z - start_v
    share = ((u - start_u) * du + (v - start_v) * dv) / max(du * du + dv * dv, 1e-12)
    share = min(max(share, 0.0), 1.0)
    off_u, off_v = u - start_u - share * du, v - start_v - share * dv
    speed_u, speed_v = bx - u * bz, by - v * bz
    square = max(speed_u * speed_u + speed_v * speed_v, 1e-12)
    rho = ((u * xz - xx) * speed_u + (v * xz - xy) * speed_v) / square
    return np.sqrt(off_u * off_u + off_v * off_v), rho, np.sqrt(sx * sx + sy * sy + sz * sz)


@reordered_leaf
def on_lines(distance, pixel, size, least, fits, weight, order):
    """The largest group of matches that lie on their epipolar lines: those nearer than six standard deviations of the
    nearest 30 %, by area.

    Args:
        distance: [N] from the lines, over the standard deviation of tracking or in pixels.
        pixel: [N, 2] (u, v).
        size: width and height of the image [px].
        least: of the standard deviation, in the unit of ``distance``.
        fits: [N] True in the group, overwritten.
        weight: [N] by area, overwritten, as a moving object may have most of the corners.
        order: [N] buffer.
    """
    for n in range(len(distance)):
        column = min(max(int(pixel[n, 0] * _CELLS / size[0]), 0), _CELLS - 1)
        order[n] = min(max(int(pixel[n, 1] * _CELLS / size[1]), 0), _CELLS - 1) * _CELLS + column
    for n in range(len(distance)):
        count = 0
        for m in range(len(distance)):
            count += order[m] == order[n]
        weight[n], fits[n] = 1 / count, True
    sigma = max(weighted_quantile(distance, weight, fits, _MOST, order) / _MOST_QUANTILE, least)
    for n in range(len(distance)):
        fits[n] = distance[n] <= _FARTHEST * sigma


@reordered_leaf
def weighted_quantile(values, weight, chosen, share, order):
    """The quantile ``share`` of the chosen values [N], at least one, with weights [N]; ``order`` is a buffer [N]."""
    count, total = 0, 0.0
    for n in range(len(values)):
        if chosen[n]:
            order[count] = n
            count += 1
            total += weight[n]
    gap = 1
    while gap < count // 3:
        gap = 3 * gap + 1
    while gap > 0:  # Shell's sort
        for i in range(gap, count):
            n, j = order[i], i
            while j >= gap and values[order[j - gap]] > values[n]:
                order[j] = order[j - gap]
                j -= gap
            order[j] = n
        gap //= 3
    below = 0.0
    for i in range(count):
        below += weight[order[i]]
        if below >= share * total:
            return values[order[i]]
    return values[order[count - 1]]


@reordered_leaf
def matched(seen, track, first):
    """Write the tracks that the newest view and an earlier one show, and the first such view, [N] each, from
    ``seen`` [N, W]; return their number."""
    count, last = 0, seen.shape[1] - 1
    for n in range(len(seen)):
        k = 0
        while k < last and not seen[n, k]:
            k += 1
        if seen[n, last] and k < last:
            track[count], first[count] = n, k
            count += 1
    return count


@reordered_leaf
def off_lines(pixel, track, first, poses, K, K_inverse, nearest, farthest, newest, distance, rho, baseline):
    """Write the positions of tracks in the newest view [M, 2], and what :func:`off_line` returns for each and its first
    view [M]; ``pixel`` [N, W, 2] and ``poses`` [W, 4, 4]. As a leaf, it counts no references to slices, which take most
    of the time to compile."""
    last = len(poses) - 1
    for i in range(len(track)):
        one, other = pixel[track[i], last], pixel[track[i], first[i]]
        newest[i, 0], newest[i, 1] = one[0], one[1]
        views = one, other, poses[last], poses[first[i]]
        distance[i], rho[i], baseline[i] = off_line(*views, K, K_inverse, nearest, farthest)
