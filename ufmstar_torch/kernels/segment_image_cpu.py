"""SPGF of one image as compiled code (numba), row after row in a single pass.

Every formula is written in the torch reference's order of operations, so that the decisions agree to the
last bit. No fastmath: it would let the compiler reorder them. The code stays in one file, because numba's
cache does not notice when a function that was inlined from another file has changed.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ufmstar_torch.kernels.compile_cpu import kernel, part

# Where counters start. numba gives a plain 0 a type of its own, and compiles all that is called with it twice.
_ZERO: Any = np.int64(0)

# Columns of a finished segment. Within a row y = z (v - cy)/fy, so x and z say everything.
_MX, _MZ, _CXX, _CXZ, _CZZ, _LX, _LZ = range(7)
# Its whole numbers: N, smallest bin, interval.
_N, _NEAREST, _UL, _UR = range(4)
_SEGMENT, _SEGMENT_INT = 7, 4

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
    born: int  # how many segments the row had started before
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
def segment_image(z, use, spread, fx, fy, cx, cy, slope, lengths2, edges, limits, labels):
    """One image; writes its labels. Returns which Gaussians are kept, in emission order, and all their values."""
    height, width = z.shape
    depth, s2, rx = np.empty(width), np.zeros(width), np.empty(width)
    for u in range(width):
        rx[u] = (u - cx) / fx

    most = width // (limits.sparse + 1)  # segments of one row
    segments, segments_int = np.empty((most, _SEGMENT)), np.empty((most, _SEGMENT_INT), np.int64)
    place = np.empty(width, np.int64)  # what the row started -> finished segment, then Gaussian; -1 = too sparse
    member = np.empty(most, np.int64)  # finished segment -> Gaussian
    active = np.empty(2 * most, np.int64)
    gaussians, whole = np.empty((4 * most + 64, _GAUSSIAN)), np.empty((4 * most + 64, _GAUSSIAN_INT), np.int64)
    older, older_int = np.empty((limits.max_open, 10)), np.empty((limits.max_open, 5), np.int64)
    before = created = emitted = _ZERO
    for v in range(height):
        ry = (v - cy) / fy
        _usable(z[v], use[v % use.shape[0]], spread[v % spread.shape[0]], limits.max_depth, depth, s2)
        done, started = _scanline(
            depth, s2, rx, ry, slope, lengths2, edges, limits, older, older_int, segments, segments_int, place,
            labels[v],
        )  # fmt: skip
        if created + done > gaussians.shape[0]:
            gaussians, whole = _doubled(gaussians), _doubled(whole)
        n, created = _join_row(
            segments, segments_int, done, v, ry, slope, lengths2, limits, gaussians, whole, active, before, created,
            member,
        )  # fmt: skip
        for i in range(started):
            place[i] = member[place[i]] if place[i] >= 0 else -1
        for u in range(width):
            labels[v, u] = place[labels[v, u]] if labels[v, u] >= 0 else -1
        before, emitted = _retire(active, n, v, v == height - 1, whole, emitted)
    return _prune(whole, created, limits, labels), gaussians, whole


@part
def _doubled(table):
    """The same rows with as many free ones behind them."""
    out = np.empty((2 * table.shape[0], table.shape[1]), table.dtype)
    for i in range(table.shape[0]):
        for j in range(table.shape[1]):  # a slice assignment takes seconds to compile
            out[i, j] = table[i, j]
    return out


@part
def _usable(z, use, spread, max_depth, depth, s2):
    """Depth and variance of a row's pixels, depth 0 for those that take no part. NaN fails every comparison."""
    for u in range(z.size):
        d = np.float64(z[u])
        depth[u] = d if (d > 0) & (d <= max_depth) else 0.0
    for u in range(use.size):
        depth[u] = depth[u] if use[u] else 0.0
    for u in range(spread.size):
        s2[u] = spread[u]
        depth[u] = depth[u] if (s2[u] >= 0) & (s2[u] < np.inf) else 0.0


@part
def _scanline(
    depth, s2, rx, ry, slope, lengths2, edges, limits, older, older_int, segments, segments_int, place, owner
):
    """Scanline segmentation of one row.

    Writes the finished segments, ``place`` and ``owner`` (which of the row's starts a pixel belongs to, -1 =
    none); returns how many segments were finished and how many started. The newest open segment lives in
    registers, the others in a ring of max_open - 1 places, ``front`` being the newest of them.
    """
    y_factor = 1.0 + ry * ry
    room = limits.max_open - 1
    front = waiting = started = done = k = _ZERO
    newest = _Open(0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for u in range(depth.size):
        z = depth[u]
        if z == 0.0:
            owner[u] = -1
            continue
        x = rx[u] * z
        while k < edges.size - 1 and edges[k] < z:
            k += 1
        while k > 0 and edges[k - 1] >= z:
            k -= 1
        if newest.n > 0 and _fits(newest, x, z, u, slope, lengths2[k], limits):
            newest = _extended(newest, x, z, u, k, y_factor, rx[u], s2[u])
            owner[u] = newest.born
            continue
        q = _waiting_match(older, older_int, front, waiting, room, x, z, u, slope, lengths2[k], limits)
        if q >= 0:
            match = _extended(_load(older[q], older_int[q]), x, z, u, k, y_factor, rx[u], s2[u])
            _store(older[q], older_int[q], match)
            owner[u] = match.born
            continue
        if newest.n > 0:
            front, waiting, done = _push(
                newest, older, older_int, front, waiting, room, limits.sparse, segments, segments_int, done, place
            )
        empty = _Open(0, u, u, k, started, x, z, x, z, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        newest = _extended(empty, x, z, u, k, y_factor, rx[u], s2[u])
        owner[u] = started
        started += 1
    if newest.n > 0:
        done = _finish(newest, limits.sparse, segments, segments_int, done, place)
    for i in range(waiting):
        q = front - i if front >= i else front - i + room
        done = _finish(_load(older[q], older_int[q]), limits.sparse, segments, segments_int, done, place)
    return done, started


@part
def _push(newest, older, older_int, front, waiting, room, sparse, segments, segments_int, done, place):
    """Let the newest open segment wait, and finish the oldest if there is no room."""
    if room == 0:
        return front, waiting, _finish(newest, sparse, segments, segments_int, done, place)
    front = front + 1 if front + 1 < room else 0
    if waiting == room:  # the ring is full: the place after the front holds the oldest
        oldest = _load(older[front], older_int[front])
        done = _finish(oldest, sparse, segments, segments_int, done, place)
    else:
        waiting += 1
    _store(older[front], older_int[front], newest)
    return front, waiting, done


@part
def _fits(o, x, z, u, slope, length2, limits):
    """Does the point continue the open segment?"""
    if u - o.u_right > limits.occlusion_gap or not o.w2 < length2:
        return False
    t = slope * z * z
    tau_z = min(max(6.0 * t, limits.noise_floor), limits.noise_thresh)
    if o.n <= limits.n_check:
        tau_x = min(max(t, limits.noise_floor), limits.line_thresh)
        return abs(z - o.z_right) < tau_z and abs(x - o.x_right) < tau_x
    return o.dx != 0 and abs(o.z_left + o.dz * (x - o.x_left) / o.dx - z) < tau_z


@part
def _waiting_match(older, older_int, front, waiting, room, x, z, u, slope, length2, limits):
    """The newest of the waiting segments that the point continues, or -1."""
    for i in range(waiting):
        q = front - i if front >= i else front - i + room
        if _fits(_load(older[q], older_int[q]), x, z, u, slope, length2, limits):
            return q
    return -1


@part
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


@part
def _store(values, whole, o):
    whole[0], whole[1], whole[2], whole[3], whole[4] = o.n, o.u_left, o.u_right, o.nearest, o.born
    values[0], values[1], values[2], values[3], values[4] = o.x_left, o.z_left, o.x_right, o.z_right, o.w2
    values[5], values[6], values[7], values[8], values[9] = o.dx, o.dz, o.dxx, o.dxz, o.dzz


@part
def _load(f, i):
    return _Open(i[0], i[1], i[2], i[3], i[4], f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8], f[9])


@part
def _finish(o, sparse, segments, segments_int, done, place):
    """Output an open segment unless it is too sparse; returns the new number of finished ones."""
    if o.n <= sparse:
        place[o.born] = -1
        return done
    place[o.born] = done
    out, whole = segments[done], segments_int[done]
    out[_MX], out[_MZ] = o.x_left + o.dx / o.n, o.z_left + o.dz / o.n
    out[_CXX] = o.dxx - o.dx * o.dx / o.n
    out[_CXZ] = o.dxz - o.dx * o.dz / o.n
    out[_CZZ] = o.dzz - o.dz * o.dz / o.n
    out[_LX], out[_LZ] = o.dx, o.dz
    whole[_N], whole[_NEAREST], whole[_UL], whole[_UR] = o.n, o.nearest, o.u_left, o.u_right
    return done + 1


@part
def _join_row(
    segments, segments_int, done, v, ry, slope, lengths2, limits, gaussians, whole, active, before, created, member
):
    """Fusion of one row's segments with the Gaussians active before it.

    Fills ``member``, appends new Gaussians; returns the length of the active list and the number created.
    """
    n, h = before, np.empty(_GAUSSIAN)
    for j in range(done):
        _lift(segments[j], ry, h)
        o = _best_overlap(segments_int[j], active, before, whole)
        if o >= 0 and _same_plane(gaussians[o], whole[o], h, slope, lengths2, limits):
            _merge(gaussians[o], whole[o], h, segments_int[j])
            whole[o, _ROW] = v
            member[j] = o
        else:
            for i in range(_GAUSSIAN):
                gaussians[created, i] = h[i]
            for i in range(_SEGMENT_INT):
                whole[created, i] = segments_int[j, i]
            whole[created, _MERGED], whole[created, _ROW] = 1, v
            active[n] = member[j] = created
            n += 1
            created += 1
    return n, created


@part
def _retire(active, n, v, last, whole, emitted):
    """Emit the Gaussians that row v did not extend, after the last row all of them in the order of the list.

    Returns how many stay active, at the head of the list, and how many were ever emitted.
    """
    going = 0
    for i in range(n):
        g = active[i]
        if whole[g, _ROW] == v and not last:
            active[going] = g
            going += 1
        else:
            whole[g, _ORDER] = emitted
            emitted += 1
    return going, emitted


@part
def _lift(segment, ry, h):
    """A segment as a Gaussian of its own: y and the moments with y follow from y = ry z."""
    for i in range(h.size):
        h[i] = 0.0
    h[_M], h[_M + 1], h[_M + 2] = segment[_MX], ry * segment[_MZ], segment[_MZ]
    xx, xz, zz = segment[_CXX], segment[_CXZ], segment[_CZZ]
    h[_C], h[_C + 1], h[_C + 2] = xx, ry * xz, xz
    h[_C + 3], h[_C + 4], h[_C + 5] = ry * ry * zz, ry * zz, zz
    h[_L], h[_L + 1], h[_L + 2] = segment[_LX], ry * segment[_LZ], segment[_LZ]


@part
def _best_overlap(h_int, active, before, whole):
    """The Gaussian active before this row whose stored interval overlaps the segment's most, or -1."""
    best, result = 0.0, -1
    low, high = h_int[_UL], h_int[_UR]
    for i in range(before):
        o = active[i]
        shared = min(whole[o, _UR], high) - max(whole[o, _UL], low)
        if shared > 0:
            rho = shared / (max(whole[o, _UR], high) - min(whole[o, _UL], low))
            if rho > best:
                best, result = rho, o
    return result


@part
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


@part
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


@part
def _prune(whole, created, limits, labels):
    """Kept Gaussians in order of emission; turns the labels from orders of creation into slots."""
    emitted = np.empty(created, np.int64)
    for g in range(created):
        emitted[whole[g, _ORDER]] = g
    slot, kept = np.empty(created, np.int64), np.empty(created, np.int64)
    n = 0
    for g in emitted:
        slot[g] = -1
        large, tall = whole[g, _N] >= limits.min_pixels, whole[g, _MERGED] >= limits.min_rows
        if limits.prune == 0 or (large and tall) or (limits.prune == 1 and (large or tall)):
            kept[n] = g
            slot[g] = n
            n += 1
    for v in range(labels.shape[0]):
        for u in range(labels.shape[1]):
            if labels[v, u] >= 0:
                labels[v, u] = slot[labels[v, u]]
    return kept[:n]


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
