"""The scanline segmentation of SPGF as compiled code (numba): the rows of an image, each on its own.

Every formula is written in the torch reference's order of operations, so that the decisions agree to the
last bit. No fastmath: it would let the compiler reorder them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, kernel, leaf, zeros

# Counters start here: numba gives a plain 0 another type, and would compile the functions called with it twice.
ZERO: Any = np.int64(0)

# Columns of a finished segment. Within a row y = z (v - cy)/fy, so x and z say everything.
MX, MZ, CXX, CXZ, CZZ, LX, LZ = range(7)
# Its whole numbers: N, smallest bin, interval.
N, NEAREST, UL, UR = range(4)
SEGMENT, SEGMENT_INT = 7, 4


class _Open(NamedTuple):
    """An open segment, which compiled code keeps in registers. d = p - pL."""

    n: int
    u_left: int
    u_right: int
    nearest: int  # smallest depth bin
    born: int  # which of the segments that the row started, from 1 on
    x_left: float
    z_left: float
    x_right: float
    z_right: float
    w2: float  # |pR - pL|^2
    dx: float  # sums of d_x, d_z, d_x^2, d_x d_z, d_z^2
    dz: float
    dxx: float
    dxz: float
    dzz: float


@kernel
def scan_rows(
    z, use, spread, fx, fy, cx, cy, slope, lengths2, edges, limits, first, last, spans, table, table_int, runs
):
    """Scanline segmentation of the rows from ``first`` to ``last``, each on its own.

    Finished segments go to ``table`` and ``table_int``, from row ``first * most`` on, with at most ``most`` of an image
    row. Pixels go to ``runs``, from row ``first * W`` on: where a run of pixels of one segment begins in the image row,
    and 1 + the place of the segment or 0. ``spans`` [H, 4] receives where a row's segments begin and end, and likewise
    its runs.
    """
    width = z.shape[1]
    row, rx = (
        (empty(width, np.float64), empty(width, np.float64), empty(width, np.float64), zeros(width, np.float64)),
        empty(width, np.float64),
    )
    for u in range(width):
        rx[u] = (u - cx) / fx
    place = empty(width + 1, np.int32)  # what the row started, from 1 on -> 1 + finished segment; 0 = too sparse
    older, older_int = empty((limits.max_open, 10), np.float64), empty((limits.max_open, 5), np.int64)
    end, pixels = first * segments_of_row(width, limits), first * width
    for v in range(first, last):
        spans[v, 0], spans[v, 2] = end, pixels
        _usable(z, use, spread, v, limits.max_depth, row[0], row[3])
        _thresholds(row[0], rx, slope, limits, row[1], row[2])
        end, pixels = _scanline(
            row, rx, (v - cy) / fy, slope, lengths2, edges, limits, spread.size > 0, older, older_int, table,
            table_int, end, place, runs, pixels,
        )  # fmt: skip
        spans[v, 1], spans[v, 3] = end, pixels


@leaf
def segments_of_row(width, limits):
    """The most segments that one row can have: each has more than ``sparse`` pixels."""
    return max(width // (limits.sparse + 1), 1)


@leaf
def _usable(z, use, spread, v, max_depth, depth, s2):
    """Depth and variance of the pixels of row v, depth 0 for those that take no part. NaN fails every comparison."""
    for u in range(z.shape[1]):
        d = np.float64(z[v, u])
        depth[u] = d if (d > 0) & (d <= max_depth) else 0.0
    for u in range(use.shape[1]):
        depth[u] = depth[u] if use[v, u] else 0.0
    for u in range(spread.shape[1]):
        s2[u] = spread[v, u]
        depth[u] = depth[u] if (s2[u] >= 0) & (s2[u] < np.inf) else 0.0


@leaf
def _thresholds(depth, rx, slope, limits, x, tau_z):
    """Write x and tau_z of a row (-1 for a pixel that takes no part)."""
    for u in range(depth.size):
        x[u] = rx[u] * depth[u]
    low, high = limits.noise_floor, limits.noise_thresh
    for u in range(depth.size):
        t = 6.0 * (slope * depth[u] * depth[u])
        t = t if t > low else low
        t = t if t < high else high
        tau_z[u] = t if depth[u] > 0 else -1.0


@leaf
def _near(x, z, last_x, last_z, tau_z, slope, limits):
    """True if a point is near the one before: within tau_z and tau_x."""
    tau_x = min(max(slope * z * z, limits.noise_floor), limits.line_thresh)
    return (abs(z - last_z) < tau_z) & (abs(x - last_x) < tau_x)


@leaf
def _scanline(
    row, rx, ry, slope, lengths2, edges, limits, spread, older, older_int, segments, segments_int, done,
    place, runs, run,
):  # fmt: skip
    """Scanline segmentation of a row.

    ``row`` are depth, x, tau_z and variances, which are 0 without ``spread``.
    Writes the finished segments from ``done`` on and the runs from ``run`` on; returns the end of both. The newest open
    segment lives in registers, the others in a ring of max_open - 1 places, ``front`` being the newest of them.
    ``place`` is scratch.
    """
    depth, x_of, tau_z, s2 = row
    y_factor = 1.0 + ry * ry
    room = limits.max_open - 1
    front = waiting = started = n = right = left = nearest = u = k = ZERO
    x0 = z0 = w2 = dx = dz = dxx = dxz = dzz = 0.0
    low, high, length2 = 0.0, edges[0], lengths2[0]  # of depth bin k
    first_run = run
    while u < depth.size:
        z, x = depth[u], x_of[u]
        if z == 0.0:
            run = _begun(runs, first_run, run, u, 0)
            u += 1
            continue
        if not (z > low and z <= high):
            while k < edges.size - 1 and edges[k] < z:
                k += 1
            while k > 0 and edges[k - 1] >= z:
                k -= 1
            low, length2 = edges[k - 1] if k > 0 else 0.0, lengths2[k]
            high = edges[k] if k < edges.size - 1 else np.inf
        fits = n > 0 and u - right <= limits.occlusion_gap and w2 < length2
        if fits and n > limits.n_check:
            fits = dx != 0 and abs(z0 + dz * (x - x0) / dx - z) < tau_z[u]
        elif fits:
            fits = _near(x, z, x_of[right], depth[right], tau_z[u], slope, limits)
        if not fits:
            q = _waiting_match(older, older_int, front, waiting, room, x, z, u, slope, tau_z[u], length2, limits)
            if q >= 0:
                match = _extended(_load(older, older_int, q), x, z, u, k, y_factor, rx[u], s2[u])
                _store(older, older_int, q, match)
                run = _begun(runs, first_run, run, u, match.born)
                u += 1
                continue
            if n > 0:
                newest = _Open(
                    n, left, right, nearest, started, x0, z0, x_of[right], depth[right], w2, dx, dz, dxx, dxz, dzz
                )
                front, waiting, done = _push(
                    newest, older, older_int, front, waiting, room, limits.sparse, segments, segments_int, done, place
                )
            started += 1
            n, left, nearest, x0, z0 = ZERO, u, k, x, z
            dx = dz = dxx = dxz = dzz = 0.0
        begin = u
        ex, ez = x - x0, z - z0
        w2 = ex * ex + y_factor * (ez * ez)
        dx, dz, dxx, dxz, dzz = dx + ex, dz + ez, dxx + ex * ex, dxz + ex * ez, dzz + ez * ez
        if s2[u] > 0:
            dxx, dxz, dzz = dxx + s2[u] * (rx[u] * rx[u]), dxz + s2[u] * rx[u], dzz + s2[u]
        nearest = min(nearest, k)
        u += 1
        # Pixels that follow without a gap in the same depth bin, by the same rules: until n_check, then by the line.
        short = u if spread else min(depth.size, max(u, begin + limits.n_check - n + 1))
        while 0 <= u < short:  # the index is not negative: no wrap-around to compile
            ex, ez = x_of[u] - x0, depth[u] - z0
            near = _near(x_of[u], depth[u], x_of[u - 1], depth[u - 1], tau_z[u], slope, limits)
            if not (near & (depth[u] > low) & (depth[u] <= high) & (w2 < length2)):
                break
            w2 = ex * ex + y_factor * (ez * ez)
            dx, dz, dxx, dxz, dzz = dx + ex, dz + ez, dxx + ex * ex, dxz + ex * ez, dzz + ez * ez
            u += 1
        stop = depth.size if u == short and not spread else u
        while 0 <= u < stop:
            ex, ez = x_of[u] - x0, depth[u] - z0
            off = abs(z0 + dz * ex / dx - depth[u])
            if not ((off < tau_z[u]) & (depth[u] > low) & (depth[u] <= high) & (w2 < length2)):
                break
            w2 = ex * ex + y_factor * (ez * ez)
            dx, dz, dxx, dxz, dzz = dx + ex, dz + ez, dxx + ex * ex, dxz + ex * ez, dzz + ez * ez
            u += 1
        run = _begun(runs, first_run, run, begin, started)
        n, right = n + u - begin, u - 1
    if n > 0:
        newest = _Open(n, left, right, nearest, started, x0, z0, x_of[right], depth[right], w2, dx, dz, dxx, dxz, dzz)
        done = _finish(newest, limits.sparse, segments, segments_int, done, place)
    for i in range(waiting):
        q = front - i if front >= i else front - i + room
        done = _finish(_load(older, older_int, q), limits.sparse, segments, segments_int, done, place)
    place[0] = 0
    for i in range(first_run, run):
        runs[i, 1] = place[runs[i, 1]]
    return done, run


@leaf
def _begun(runs, first, run, u, owner):
    """The end of the runs after pixel u of ``owner``, which begins one unless the run before is the owner's."""
    if run > first and runs[run - 1, 1] == owner:
        return run
    runs[run, 0], runs[run, 1] = u, owner
    return run + 1


@leaf
def _push(newest, older, older_int, front, waiting, room, sparse, segments, segments_int, done, place):
    """Let the newest open segment wait, and finish the oldest if there is no room."""
    if room == 0:
        return front, waiting, _finish(newest, sparse, segments, segments_int, done, place)
    front = front + 1 if front + 1 < room else 0
    if waiting == room:  # the ring is full: the place after the front holds the oldest
        oldest = _load(older, older_int, front)
        done = _finish(oldest, sparse, segments, segments_int, done, place)
    else:
        waiting += 1
    _store(older, older_int, front, newest)
    return front, waiting, done


@leaf
def _fits(o, x, z, u, slope, tau_z, length2, limits):
    """Does the point continue the open segment?"""
    if u - o.u_right > limits.occlusion_gap or not o.w2 < length2:
        return False
    if o.n <= limits.n_check:
        return _near(x, z, o.x_right, o.z_right, tau_z, slope, limits)
    return o.dx != 0 and abs(o.z_left + o.dz * (x - o.x_left) / o.dx - z) < tau_z


@leaf
def _waiting_match(older, older_int, front, waiting, room, x, z, u, slope, tau_z, length2, limits):
    """The newest of the waiting segments that the point continues, or -1."""
    for i in range(waiting):
        q = front - i if front >= i else front - i + room
        if _fits(_load(older, older_int, q), x, z, u, slope, tau_z, length2, limits):
            return q
    return -1


@leaf
def _extended(o, x, z, u, k, y_factor, rx, s2):
    """The open segment with a pixel added."""
    dx, dz = x - o.x_left, z - o.z_left
    dxx, dxz, dzz = o.dxx + dx * dx, o.dxz + dx * dz, o.dzz + dz * dz
    if s2 > 0:
        dxx, dxz, dzz = dxx + s2 * (rx * rx), dxz + s2 * rx, dzz + s2
    return _Open(
        o.n + 1, o.u_left, u, min(o.nearest, k), o.born, o.x_left, o.z_left, x, z,
        dx * dx + y_factor * (dz * dz), o.dx + dx, o.dz + dz, dxx, dxz, dzz,
    )  # fmt: skip


@leaf
def _store(values, whole, q, o):
    whole[q, 0], whole[q, 1], whole[q, 2], whole[q, 3], whole[q, 4] = o.n, o.u_left, o.u_right, o.nearest, o.born
    values[q, 0], values[q, 1], values[q, 2], values[q, 3], values[q, 4] = (
        o.x_left,
        o.z_left,
        o.x_right,
        o.z_right,
        o.w2,
    )
    values[q, 5], values[q, 6], values[q, 7], values[q, 8], values[q, 9] = o.dx, o.dz, o.dxx, o.dxz, o.dzz


@leaf
def _load(values, whole, q):
    f, i = values[q], whole[q]
    return _Open(i[0], i[1], i[2], i[3], i[4], f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8], f[9])


@leaf
def _finish(o, sparse, segments, segments_int, done, place):
    """Output an open segment unless it is too sparse; returns the new number of finished ones."""
    if o.n <= sparse:
        place[o.born] = 0
        return done
    place[o.born] = done + 1
    out, whole = segments[done], segments_int[done]
    out[MX], out[MZ] = o.x_left + o.dx / o.n, o.z_left + o.dz / o.n
    out[CXX] = o.dxx - o.dx * o.dx / o.n
    out[CXZ] = o.dxz - o.dx * o.dz / o.n
    out[CZZ] = o.dzz - o.dz * o.dz / o.n
    out[LX], out[LZ] = o.dx, o.dz
    whole[N], whole[NEAREST], whole[UL], whole[UR] = o.n, o.nearest, o.u_left, o.u_right
    return done + 1
