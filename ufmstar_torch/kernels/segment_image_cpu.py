"""SPGF of one image as compiled code (numba): the rows, each on its own, then their fusion from row to row.

Every formula is written in the torch reference's order of operations, so that the decisions agree to the
last bit. No fastmath: it would let the compiler reorder them. The code stays in one file, because numba's
cache does not notice when a function that was inlined from another file has changed.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ufmstar_torch.kernels.compile_cpu import kernel, leaf, part

# Where counters start. numba gives a plain 0 a type of its own, and compiles all that is called with it twice.
_ZERO: Any = np.int64(0)

# Columns of a finished segment. Within a row y = z (v - cy)/fy, so x and z say everything.
_MX, _MZ, _CXX, _CXZ, _CZZ, _LX, _LZ = range(7)
# Its whole numbers: N, smallest bin, interval.
_N, _NEAREST, _UL, _UR = range(4)
SEGMENT, SEGMENT_INT = 7, 4

# Columns of a Gaussian: mean, scatter (upper triangle), line vector, first mean, plane vector, its pi2 ...
_M, _C, _L, _M0, _PI, _PI2 = 0, 3, 9, 12, 15, 18
# ... and its whole numbers: those of a segment, n, the row that extended it last, its place in the output.
_MERGED, _ROW, _ORDER = range(4, 7)
_GAUSSIAN, _GAUSSIAN_INT = 19, 7


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
    z, use, spread, fx, fy, cx, cy, slope, lengths2, edges, limits, first, last, spans, table, table_int, owner
):
    """Scanline segmentation of the rows from ``first`` to ``last``, each on its own.

    Finished segments go to ``table`` and ``table_int``, from row ``first * most`` on, with at most ``most`` of an image
    row. ``spans`` [H, 2] receives where a row's segments begin and end, ``owner`` [H, W] 1 + the place of the segment
    that a pixel belongs to, or 0.
    """
    width = z.shape[1]
    row = np.empty(width), np.empty(width), np.empty(width), np.zeros(width, np.bool_), np.zeros(width)
    rx, spare = np.empty(width), np.empty(width)
    for u in range(width):
        rx[u] = (u - cx) / fx
    place = np.empty(width + 1, np.int32)  # what the row started, from 1 on -> 1 + finished segment; 0 = too sparse
    older, older_int = np.empty((limits.max_open, 10)), np.empty((limits.max_open, 5), np.int64)
    end = first * segments_of_row(width, limits)
    for v in range(first, last):
        spans[v, 0] = end
        _usable(z, use, spread, v, limits.max_depth, row[0], row[4])
        _thresholds(row[0], rx, slope, limits, row[1], row[2], spare, row[3])
        end = _scanline(
            row, rx, (v - cy) / fy, slope, lengths2, edges, limits, spread.size > 0, older, older_int, table,
            table_int, end, place, owner, v,
        )  # fmt: skip
        spans[v, 1] = end


@leaf
def segments_of_row(width, limits):
    """The most segments that one row can have: each has more than ``sparse`` pixels."""
    return max(width // (limits.sparse + 1), 1)


@kernel
def join_rows(width, fy, cy, slope, lengths2, limits, spans, table, table_int):
    """Fuse the segments of all rows of an image, from the first row to the last.

    Returns which Gaussians are kept, in emission order, all their values, and the slot among those kept of the segment
    that ``owner`` names (see :func:`scan_rows`), -1 for none.
    """
    height, most = spans.shape[0], segments_of_row(width, limits)
    member = np.empty(table.shape[0], np.int64)  # segment -> Gaussian
    active, interval = np.empty(2 * most, np.int64), np.empty((2, 2 * most), np.int64)
    gaussians, whole = np.empty((4 * most + 64, _GAUSSIAN)), np.empty((4 * most + 64, _GAUSSIAN_INT), np.int64)
    h, before, created, emitted = np.empty(_GAUSSIAN), _ZERO, _ZERO, _ZERO
    for v in range(height):
        if created + spans[v, 1] - spans[v, 0] > gaussians.shape[0]:
            gaussians, whole = _doubled(gaussians), _doubled(whole)
        n, created = _join_row(
            table, table_int, spans[v, 0], spans[v, 1], v, (v - cy) / fy, slope, lengths2, limits, gaussians, whole,
            active, interval, before, created, member, h,
        )  # fmt: skip
        before, emitted = _retire(active, interval, n, v, v == height - 1, whole, emitted)
    kept, place, slot = np.empty(created, np.int64), np.empty(created, np.int64), np.empty(table.shape[0] + 1, np.int64)
    n = _prune(whole, created, limits, np.empty(created, np.int64), kept, place)
    slot[0] = -1
    for v in range(height):
        for i in range(spans[v, 0], spans[v, 1]):
            slot[i + 1] = place[member[i]]
    return kept[:n], gaussians, whole, slot


@kernel
def write_labels(owner, slot, labels):
    """The slot of every pixel's segment, or -1."""
    for v in range(labels.shape[0]):
        for u in range(labels.shape[1]):
            labels[v, u] = slot[owner[v, u]]


@part
def _doubled(table):
    """The same rows with as many free ones behind them."""
    out = np.empty((2 * table.shape[0], table.shape[1]), table.dtype)
    for i in range(table.shape[0]):
        for j in range(table.shape[1]):  # a slice assignment takes seconds to compile
            out[i, j] = table[i, j]
    return out


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
def _thresholds(depth, rx, slope, limits, x, tau_z, tau_x, near):
    """Of a row: x, tau_z (-1 for a pixel that takes no part), tau_x, and which pixels are near the one before."""
    for u in range(depth.size):
        x[u] = rx[u] * depth[u]
    low, high, highest = limits.noise_floor, limits.noise_thresh, limits.line_thresh
    for u in range(depth.size):
        t = 6.0 * (slope * depth[u] * depth[u])
        t = t if t > low else low
        t = t if t < high else high
        tau_z[u] = t if depth[u] > 0 else -1.0
    for u in range(depth.size):
        t = slope * depth[u] * depth[u]
        t = t if t > low else low
        tau_x[u] = t if t < highest else highest
    for u in range(1, depth.size):
        near[u] = (abs(depth[u] - depth[u - 1]) < tau_z[u]) & (abs(x[u] - x[u - 1]) < tau_x[u])


@leaf
def _scanline(
    row, rx, ry, slope, lengths2, edges, limits, spread, older, older_int, segments, segments_int, done,
    place, owner, v,
):  # fmt: skip
    """Scanline segmentation of row v.

    ``row`` are depth, x, tau_z, which pixels are near the one before, and variances, which are 0 without ``spread``.
    Writes the finished segments from ``done`` on and, to row v of ``owner``, 1 + the place of a pixel's segment or 0;
    returns the end of the finished segments. The newest open segment lives in registers, the others in a ring of
    max_open - 1 places, ``front`` being the newest of them. ``place`` is scratch.
    """
    depth, x_of, tau_z, near, s2 = row
    y_factor = 1.0 + ry * ry
    room = limits.max_open - 1
    front = waiting = started = n = right = left = nearest = u = k = _ZERO
    x0 = z0 = w2 = dx = dz = dxx = dxz = dzz = 0.0
    low, high, length2 = 0.0, edges[0], lengths2[0]  # of depth bin k
    while u < depth.size:
        z, x = depth[u], x_of[u]
        if z == 0.0:
            owner[v, u] = 0
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
            fits = abs(z - depth[right]) < tau_z[u] and abs(x - x_of[right]) < min(
                max(slope * z * z, limits.noise_floor), limits.line_thresh
            )
        if not fits:
            q = _waiting_match(older, older_int, front, waiting, room, x, z, u, slope, tau_z[u], length2, limits)
            if q >= 0:
                match = _extended(_load(older, older_int, q), x, z, u, k, y_factor, rx[u], s2[u])
                _store(older, older_int, q, match)
                owner[v, u] = match.born
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
            n, left, nearest, x0, z0 = _ZERO, u, k, x, z
            dx = dz = dxx = dxz = dzz = 0.0
        begin = u
        ex, ez = x - x0, z - z0
        w2 = ex * ex + y_factor * (ez * ez)
        dx, dz, dxx, dxz, dzz = dx + ex, dz + ez, dxx + ex * ex, dxz + ex * ez, dzz + ez * ez
        if s2[u] > 0:
            dxx, dxz, dzz = dxx + s2[u] * (rx[u] * rx[u]), dxz + s2[u] * rx[u], dzz + s2[u]
        nearest = min(nearest, k)
        u += 1
        # What follows without a gap in the same depth bin, by the same rules: until n_check, then by the line.
        short = u if spread else min(depth.size, max(u, begin + limits.n_check - n + 1))
        while u < short:
            ex, ez = x_of[u] - x0, depth[u] - z0
            if not (near[u] & (depth[u] > low) & (depth[u] <= high) & (w2 < length2)):
                break
            w2 = ex * ex + y_factor * (ez * ez)
            dx, dz, dxx, dxz, dzz = dx + ex, dz + ez, dxx + ex * ex, dxz + ex * ez, dzz + ez * ez
            u += 1
        stop = depth.size if u == short and not spread else u
        while u < stop:
            ex, ez = x_of[u] - x0, depth[u] - z0
            off = abs(z0 + dz * ex / dx - depth[u])
            if not ((off < tau_z[u]) & (depth[u] > low) & (depth[u] <= high) & (w2 < length2)):
                break
            w2 = ex * ex + y_factor * (ez * ez)
            dx, dz, dxx, dxz, dzz = dx + ex, dz + ez, dxx + ex * ex, dxz + ex * ez, dzz + ez * ez
            u += 1
        for i in range(begin, u):
            owner[v, i] = started
        n, right = n + u - begin, u - 1
    if n > 0:
        newest = _Open(n, left, right, nearest, started, x0, z0, x_of[right], depth[right], w2, dx, dz, dxx, dxz, dzz)
        done = _finish(newest, limits.sparse, segments, segments_int, done, place)
    for i in range(waiting):
        q = front - i if front >= i else front - i + room
        done = _finish(_load(older, older_int, q), limits.sparse, segments, segments_int, done, place)
    place[0] = 0
    for u in range(depth.size):
        owner[v, u] = place[owner[v, u]]
    return done


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
        tau_x = min(max(slope * z * z, limits.noise_floor), limits.line_thresh)
        return abs(z - o.z_right) < tau_z and abs(x - o.x_right) < tau_x
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
    out[_MX], out[_MZ] = o.x_left + o.dx / o.n, o.z_left + o.dz / o.n
    out[_CXX] = o.dxx - o.dx * o.dx / o.n
    out[_CXZ] = o.dxz - o.dx * o.dz / o.n
    out[_CZZ] = o.dzz - o.dz * o.dz / o.n
    out[_LX], out[_LZ] = o.dx, o.dz
    whole[_N], whole[_NEAREST], whole[_UL], whole[_UR] = o.n, o.nearest, o.u_left, o.u_right
    return done + 1


@leaf
def _join_row(
    segments, segments_int, first, end, v, ry, slope, lengths2, limits, gaussians, whole, active, interval, before,
    created, member, h,
):  # fmt: skip
    """Fusion of one row's segments, from ``first`` to ``end``, with the Gaussians active before it.

    Fills ``member``, appends new Gaussians; returns the length of the active list and the number created. ``interval``
    [2, ...] are the intervals of the active ones; ``h`` is scratch.
    """
    n = before
    for j in range(first, end):
        _lift(segments[j], ry, h)
        i = _best_overlap(segments_int[j, _UL], segments_int[j, _UR], interval, before)
        o = active[i] if i >= 0 else i
        if o >= 0 and _same_plane(gaussians[o], whole[o], h, slope, lengths2, limits):
            _merge(gaussians[o], whole[o], h, segments_int[j])
            whole[o, _ROW] = v
            member[j] = o
            interval[0, i], interval[1, i] = whole[o, _UL], whole[o, _UR]
        else:
            for i in range(_GAUSSIAN):
                gaussians[created, i] = h[i]
            for i in range(SEGMENT_INT):
                whole[created, i] = segments_int[j, i]
            whole[created, _MERGED], whole[created, _ROW] = 1, v
            active[n] = member[j] = created
            interval[0, n], interval[1, n] = whole[created, _UL], whole[created, _UR]
            n += 1
            created += 1
    return n, created


@leaf
def _retire(active, interval, n, v, last, whole, emitted):
    """Emit the Gaussians that row v did not extend, after the last row all of them in the order of the list.

    Returns how many stay active, at the head of the list, and how many were ever emitted.
    """
    going = 0
    for i in range(n):
        g = active[i]
        if whole[g, _ROW] == v and not last:
            active[going] = g
            interval[0, going], interval[1, going] = interval[0, i], interval[1, i]
            going += 1
        else:
            whole[g, _ORDER] = emitted
            emitted += 1
    return going, emitted


@leaf
def _lift(segment, ry, h):
    """A segment as a Gaussian of its own: y and the moments with y follow from y = ry z."""
    for i in range(h.size):
        h[i] = 0.0
    h[_M], h[_M + 1], h[_M + 2] = segment[_MX], ry * segment[_MZ], segment[_MZ]
    xx, xz, zz = segment[_CXX], segment[_CXZ], segment[_CZZ]
    h[_C], h[_C + 1], h[_C + 2] = xx, ry * xz, xz
    h[_C + 3], h[_C + 4], h[_C + 5] = ry * ry * zz, ry * zz, zz
    h[_L], h[_L + 1], h[_L + 2] = segment[_LX], ry * segment[_LZ], segment[_LZ]


@leaf
def _best_overlap(low, high, interval, before):
    """Which of the intervals active before this row overlaps the one from ``low`` to ``high`` most, or -1.

    The overlap is shared / union; products of whole numbers compare two of them as their quotients would.
    """
    best, of, result = _ZERO, _ZERO + 1, _ZERO - 1
    left, right = interval[0], interval[1]
    for i in range(before):
        shared = min(right[i], high) - max(left[i], low)
        union = max(right[i], high) - min(left[i], low)
        better = shared * of > best * union
        best, of, result = shared if better else best, union if better else of, i if better else result
    return result


@leaf
def _same_plane(o, o_int, h, slope, lengths2, limits):
    """Does segment h continue the surface of Gaussian o?"""
    if not o[_PI2] < lengths2[o_int[_NEAREST]]:
        return False
    hx, hz, ox, oz = h[_L], h[_L + 2], o[_L], o[_L + 2]
    dot = hx * ox + hz * oz
    if not dot * dot > limits.angle2 * (hx * hx + hz * hz) * (ox * ox + oz * oz):
        return False
    dz = o[_M + 2] - h[_M + 2]
    if o_int[_MERGED] == 1:
        return abs(dz) < 6.0 * (slope * o[_M + 2] * o[_M + 2])
    oy, px, py, pz = o[_L + 1], o[_PI], o[_PI + 1], o[_PI + 2]
    nx, ny, nz = oy * pz - oz * py, oz * px - ox * pz, ox * py - oy * px
    distance = nx * (o[_M] - h[_M]) + ny * (o[_M + 1] - h[_M + 1]) + nz * dz
    return distance * distance < (nx * nx + ny * ny + nz * nz) * (limits.noise_floor * limits.noise_floor)


@leaf
def _merge(o, o_int, h, h_int):
    """Add segment h to Gaussian o: moments about the means (Chan et al.), then interval and plane state."""
    n_o, n_h = o_int[_N], h_int[_N]
    n = n_o + n_h
    share, factor = n_h / n, n_o * n_h / n
    dx, dy, dz = h[_M] - o[_M], h[_M + 1] - o[_M + 1], h[_M + 2] - o[_M + 2]
    o[_C] += h[_C] + factor * (dx * dx)
    o[_C + 1] += h[_C + 1] + factor * (dx * dy)
    o[_C + 2] += h[_C + 2] + factor * (dx * dz)
    o[_C + 3] += h[_C + 3] + factor * (dy * dy)
    o[_C + 4] += h[_C + 4] + factor * (dy * dz)
    o[_C + 5] += h[_C + 5] + factor * (dz * dz)
    o[_M], o[_M + 1], o[_M + 2] = o[_M] + share * dx, o[_M + 1] + share * dy, o[_M + 2] + share * dz
    first, pi2 = o_int[_MERGED] == 1, 0.0
    for i in range(3):
        o[_L + i] += h[_L + i]
        if first:
            o[_M0 + i] = o[_M + i]
        step = h[_M + i] - o[_M0 + i]
        o[_PI + i] += step
        pi2 += step * step
    o[_PI2] = pi2
    o_int[_N] = n
    o_int[_UL] = (o_int[_UL] + h_int[_UL]) // 2
    o_int[_UR] = (o_int[_UR] + h_int[_UR]) // 2
    o_int[_NEAREST] = min(o_int[_NEAREST], h_int[_NEAREST])
    o_int[_MERGED] += 1


@leaf
def _prune(whole, created, limits, emitted, kept, place):
    """Write the kept Gaussians in order of emission, and for each in order of creation its place among them or -1.

    Returns how many are kept; ``emitted`` is scratch.
    """
    for g in range(created):
        emitted[whole[g, _ORDER]] = g
    n = 0
    for i in range(created):
        g = emitted[i]
        place[g] = -1
        large, tall = whole[g, _N] >= limits.min_pixels, whole[g, _MERGED] >= limits.min_rows
        if limits.prune == 0 or (large and tall) or (limits.prune == 1 and (large or tall)):
            kept[n] = g
            place[g] = n
            n += 1
    return n


@kernel
def write_gaussians(kept, gaussians, whole, mean, covariance, weight, count):
    """The kept Gaussians as the mixture's slots; a single pixel has no sample covariance (zeros)."""
    for i in range(kept.size):
        g = gaussians[kept[i]]
        n = whole[kept[i], _N]
        weight[i], count[i] = n, 1
        scatter = 0
        for r in range(3):
            mean[i, r] = g[_M + r]
            for c in range(r, 3):
                value = g[_C + scatter] / (n - 1) if n > 1 else 0.0
                covariance[i, r, c] = value
                covariance[i, c, r] = value
                scatter += 1
