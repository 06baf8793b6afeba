"""The scanline segmentation of SPGF as compiled code (numba): the rows of an image, each on its own.

Every formula is written in the torch reference's order of operations, so that the decisions agree to the
last bit. No fastmath: it would let the compiler reorder them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, leaf, part

# First value of counters: a plain 0 has another type in numba, which would compile the functions called with it twice.
ZERO: Any = np.int64(0)

# Columns of a finished segment. Within a row y = z (v - cy)/fy, so that x and z suffice.
MX, MZ, CXX, CXZ, CZZ, LX, LZ = range(7)
# Its integers: N, smallest bin, interval.
N, NEAREST, UL, UR = range(4)
SEGMENT, SEGMENT_INT = 7, 4


class _Open(NamedTuple):
    """An open segment, which compiled code holds in registers. d = p - pL."""

    n: int
    u_left: int
    u_right: int
    nearest: int  # smallest depth bin
    born: int  # number of the segment in its row, from 1 on
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


@part
def scan_rows(z, fx, fy, cx, cy, slope, lengths2, edges, limits, first, last, spans, table, table_int, runs):
    """Scanline segmentation of the rows from ``first`` to ``last``, each on its own.

    Writes finished segments to ``table`` and ``table_int``, from row ``first * segments_of_row`` on. Writes runs of
    pixels of one segment to ``runs``, from row ``first * W`` on: the column where the run begins, and 1 + the index of
    the segment or 0. Writes to ``spans`` [H, 4] the begin and end of each row's segments and of its runs.
    """
    width = z.shape[1]
    depth, x, tau_z = empty(width, np.float64), empty(width, np.float64), empty(width, np.float64)
    rx = empty(width, np.float64)
    for u in range(width):
        rx[u] = (u - cx) / fx
    finished_index = empty(width + 1, np.int32)  # by ``born``: 1 + index of the finished segment; 0 = too sparse
    older = empty((limits.max_open, 15), np.float64)
    end, pixels = first * segments_of_row(width, limits), first * width
    for v in range(first, last):
        spans[v, 0], spans[v, 2] = end, pixels
        for u in range(width):
            d = np.float64(z[v, u])
            depth[u] = d if (d > 0) & (d <= limits.max_depth) else 0.0  # NaN fails every comparison
        _thresholds(depth, rx, slope, limits, x, tau_z)
        end, pixels = _scanline(
            (depth, x, tau_z), (v - cy) / fy, slope, lengths2, edges, limits, older, table, table_int, end,
            finished_index, runs, pixels,
        )  # fmt: skip
        spans[v, 1], spans[v, 3] = end, pixels


@leaf
def segments_of_row(width, limits):
    """The most segments that one row can have: each has more than ``sparse`` pixels."""
    return max(width // (limits.sparse + 1), 1)


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
    row, ry, slope, lengths2, edges, limits, older, segments, segments_int, done, finished_index, runs, run,
):  # fmt: skip
    """Scanline segmentation of a row, of which ``row`` are depth, x and tau_z.

    Writes the finished segments from ``done`` on and the runs from ``run`` on; returns the end of both. The newest open
    segment is in registers, the others are in a ring of max_open - 1 slots, the newest of them at ``front``.
    ``finished_index`` is scratch.
    """
    depth, x, tau_z = row
    y_factor, ring_size, first_run = 1.0 + ry * ry, limits.max_open - 1, run
    front = waiting = started = u = k = ZERO
    low, high, length2 = 0.0, edges[0], lengths2[0]  # of depth bin k
    newest = _fresh(u, k, started, 0.0, 0.0)
    while u < depth.size:
        z = depth[u]
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
        if not (newest.n > 0 and _fits(newest, x[u], z, u, slope, tau_z[u], length2, limits)):
            q = _waiting_match(older, front, waiting, ring_size, x[u], z, u, slope, tau_z[u], length2, limits)
            if q >= 0:
                match = _extended(_load(older, q), x[u], z, u, k, y_factor)
                _store(older, q, match)
                run = _begun(runs, first_run, run, u, match.born)
                u += 1
                continue
            if newest.n > 0:
                front, waiting, done = _push(
                    newest, older, front, waiting, ring_size, limits.sparse, segments, segments_int, done,
                    finished_index,
                )  # fmt: skip
            started += 1
            newest = _fresh(u, k, started, x[u], z)
        run = _begun(runs, first_run, run, u, started)
        newest = _extended(newest, x[u], z, u, k, y_factor)
        u += 1
        # Following pixels in the same depth bin; holes are in none.
        while 0 <= u < depth.size:  # the compiler sees no negative index, and omits the wrap-around
            continues = _continues(newest, x[u], depth[u], slope, tau_z[u], limits)
            if not (continues & (depth[u] > low) & (depth[u] <= high) & (newest.w2 < length2)):
                break
            newest = _extended(newest, x[u], depth[u], u, k, y_factor)
            u += 1
    if newest.n > 0:
        done = _finish(newest, limits.sparse, segments, segments_int, done, finished_index)
    for i in range(waiting):
        q = front - i if front >= i else front - i + ring_size
        done = _finish(_load(older, q), limits.sparse, segments, segments_int, done, finished_index)
    finished_index[0] = 0
    for i in range(first_run, run):
        runs[i, 1] = finished_index[runs[i, 1]]
    return done, run


@leaf
def _fresh(u, k, born, x, z):
    """An open segment without pixels, anchored at the current pixel."""
    return _Open(ZERO, u, u, k, born, x, z, x, z, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@leaf
def _begun(runs, first, run, u, owner):
    """Begin a run at pixel u unless the last run has the same ``owner``; return the end of the runs."""
    if run > first and runs[run - 1, 1] == owner:
        return run
    runs[run, 0], runs[run, 1] = u, owner
    return run + 1


@leaf
def _push(newest, older, front, waiting, ring_size, sparse, segments, segments_int, done, finished_index):
    """Move the newest open segment to the ring, and finish the oldest if the ring is full."""
    if ring_size == 0:
        return front, waiting, _finish(newest, sparse, segments, segments_int, done, finished_index)
    front = front + 1 if front + 1 < ring_size else 0
    if waiting == ring_size:  # the ring is full: the slot after the front holds the oldest
        oldest = _load(older, front)
        done = _finish(oldest, sparse, segments, segments_int, done, finished_index)
    else:
        waiting += 1
    _store(older, front, newest)
    return front, waiting, done


@leaf
def _fits(o, x, z, u, slope, tau_z, length2, limits):
    """Does the point continue the open segment?"""
    near = (u - o.u_right <= limits.occlusion_gap) & (o.w2 < length2)
    return near and _continues(o, x, z, slope, tau_z, limits)


@leaf
def _continues(o, x, z, slope, tau_z, limits):
    """Does the point lie near the last one of an open segment, or of one that is long enough on its line?"""
    if o.n <= limits.n_check:
        return _near(x, z, o.x_right, o.z_right, tau_z, slope, limits)
    return abs(o.z_left + o.dz * (x - o.x_left) / o.dx - z) < tau_z  # NaN or infinity where dx = 0


@leaf
def _waiting_match(older, front, waiting, ring_size, x, z, u, slope, tau_z, length2, limits):
    """The newest of the waiting segments that the point continues, or -1."""
    for i in range(waiting):
        q = front - i if front >= i else front - i + ring_size
        if _fits(_load(older, q), x, z, u, slope, tau_z, length2, limits):
            return q
    return -1


@leaf
def _extended(o, x, z, u, k, y_factor):
    """The open segment with a pixel added."""
    dx, dz = x - o.x_left, z - o.z_left
    return _Open(
        o.n + 1, o.u_left, u, min(o.nearest, k), o.born, o.x_left, o.z_left, x, z,
        dx * dx + y_factor * (dz * dz), o.dx + dx, o.dz + dz, o.dxx + dx * dx, o.dxz + dx * dz, o.dzz + dz * dz,
    )  # fmt: skip


@leaf
def _store(older, q, o):
    out = older[q]
    out[0], out[1], out[2], out[3], out[4] = o.n, o.u_left, o.u_right, o.nearest, o.born
    out[5], out[6], out[7], out[8], out[9] = o.x_left, o.z_left, o.x_right, o.z_right, o.w2
    out[10], out[11], out[12], out[13], out[14] = o.dx, o.dz, o.dxx, o.dxz, o.dzz


@leaf
def _load(older, q):
    f = older[q]
    whole = int(f[0]), int(f[1]), int(f[2]), int(f[3]), int(f[4])
    return _Open(*whole, f[5], f[6], f[7], f[8], f[9], f[10], f[11], f[12], f[13], f[14])


@leaf
def _finish(o, sparse, segments, segments_int, done, finished_index):
    """Output an open segment unless it is too sparse; return the number of finished segments."""
    if o.n <= sparse:
        finished_index[o.born] = 0
        return done
    finished_index[o.born] = done + 1
    out, whole = segments[done], segments_int[done]
    out[MX], out[MZ] = o.x_left + o.dx / o.n, o.z_left + o.dz / o.n
    out[CXX] = o.dxx - o.dx * o.dx / o.n
    out[CXZ] = o.dxz - o.dx * o.dz / o.n
    out[CZZ] = o.dzz - o.dz * o.dz / o.n
    out[LX], out[LZ] = o.dx, o.dz
    whole[N], whole[NEAREST], whole[UL], whole[UR] = o.n, o.nearest, o.u_left, o.u_right
    return done + 1
