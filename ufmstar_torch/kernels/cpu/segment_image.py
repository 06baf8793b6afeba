"""The fusion of SPGF's segments as compiled code (numba), from row to row of one image (``segment_rows``).

Every formula is written in the torch reference's order of operations, so that the decisions agree to the
last bit. No fastmath: it would let the compiler reorder them.
"""

from __future__ import annotations

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, kernel, leaf, part
from ufmstar_torch.kernels.cpu.fuse import WORK, floor_covariance
from ufmstar_torch.kernels.cpu.segment_rows import (
    CXX,
    CXZ,
    CZZ,
    LX,
    LZ,
    MX,
    MZ,
    NEAREST,
    SEGMENT_INT,
    UL,
    UR,
    ZERO,
    N,
    scan_rows,
    segments_of_row,
)

# Columns of a Gaussian: mean, scatter (upper triangle), line vector, first mean, plane vector, its pi2 ...
_M, _C, _L, _M0, _PI, _PI2 = 0, 3, 9, 12, 15, 18
# ... and its integers: those of a segment, its number of segments, the row that extended it last, its emission order.
_MERGED, _ROW, _ORDER = range(4, 7)
_GAUSSIAN, _GAUSSIAN_INT = 19, 7


@kernel
def fit(z, K, slope, bins, limits, first, last, joined, spans, table, table_int, runs, floor):
    """Scan the rows of an image z [H, W] from ``first`` to ``last`` (:func:`scan_rows`); then, if ``joined``, fuse the
    segments of all rows, from the first row to the last.

    Args:
        K: [3, 3].
        bins: squared lengths and far edges of the depth bins.
        spans, table, table_int, runs: of :func:`scan_rows`.
        floor: near plane, variance of a pixel, and share of the trace, of :func:`_write_gaussians`.

    Returns:
        Mean [n, 3], covariance [n, 3, 3] and weight [n] of the retained Gaussians in emission order, and for each
        segment index in ``runs`` the slot of its Gaussian, -1 for none; without a Gaussian unless ``joined``.
    """
    fx, fy, cx, cy, lengths2, width = K[0, 0], K[1, 1], K[0, 2], K[1, 2], bins[0], z.shape[1]
    scan_rows(z, fx, fy, cx, cy, slope, lengths2, bins[1], limits, first, last, spans, table, table_int, runs)
    if not joined:
        return empty((0, 3), np.float64), empty((0, 3, 3), np.float64), empty(0, np.float64), empty(0, np.int64)
    height, most = spans.shape[0], segments_of_row(width, limits)
    member = empty(table.shape[0], np.int64)  # segment -> Gaussian
    active, interval = empty(2 * most, np.int64), empty((2, 2 * most), np.int64)
    gaussians, whole = empty((4 * most + 64, _GAUSSIAN), np.float64), empty((4 * most + 64, _GAUSSIAN_INT), np.int64)
    h, before, created, emitted = empty(_GAUSSIAN, np.float64), ZERO, ZERO, ZERO
    for v in range(height):
        if created + spans[v, 1] - spans[v, 0] > gaussians.shape[0]:
            gaussians, whole = _doubled(gaussians), _doubled(whole)
        n, created = _join_row(
            table, table_int, spans[v, 0], spans[v, 1], v, (v - cy) / fy, slope, lengths2, limits, gaussians, whole,
            active, interval, before, created, member, h,
        )  # fmt: skip
        before, emitted = _retire(active, interval, n, v, v == height - 1, whole, emitted)
    retained, position, slot = empty(created, np.int64), empty(created, np.int64), empty(table.shape[0] + 1, np.int64)
    n = _prune(whole, created, limits, empty(created, np.int64), retained, position)
    slot[0] = -1
    for v in range(height):
        for i in range(spans[v, 0], spans[v, 1]):
            slot[i + 1] = position[member[i]]
    mean, covariance, weight = empty((n, 3), np.float64), empty((n, 3, 3), np.float64), empty(n, np.float64)
    _write_gaussians(retained, gaussians, whole, min(fx, fy), floor, z.dtype.type, mean, covariance, weight)
    return mean, covariance, weight, slot


@kernel
def write_labels(spans, runs, slot, labels):
    """Write the slot of every pixel's segment, or -1."""
    for v in range(labels.shape[0]):
        for i in range(spans[v, 2], spans[v, 3]):
            for u in range(runs[i, 0], runs[i + 1, 0] if i + 1 < spans[v, 3] else labels.shape[1]):
                labels[v, u] = slot[runs[i, 1]]


@part
def _doubled(table):
    """The same rows, followed by as many free ones."""
    out = empty((2 * table.shape[0], table.shape[1]), table.dtype)
    for i in range(table.shape[0]):
        for j in range(table.shape[1]):  # a slice assignment takes seconds to compile
            out[i, j] = table[i, j]
    return out


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
        i = _best_overlap(segments_int[j, UL], segments_int[j, UR], interval, before)
        o = active[i] if i >= 0 else i
        if o >= 0 and _same_plane(gaussians[o], whole[o], h, slope, lengths2, limits):
            _merge(gaussians[o], whole[o], h, segments_int[j])
            whole[o, _ROW] = v
            member[j] = o
            interval[0, i], interval[1, i] = whole[o, UL], whole[o, UR]
        else:
            for i in range(_GAUSSIAN):
                gaussians[created, i] = h[i]
            for i in range(SEGMENT_INT):
                whole[created, i] = segments_int[j, i]
            whole[created, _MERGED], whole[created, _ROW] = 1, v
            active[n] = member[j] = created
            interval[0, n], interval[1, n] = whole[created, UL], whole[created, UR]
            n += 1
            created += 1
    return n, created


@leaf
def _retire(active, interval, n, v, last, whole, emitted):
    """Emit the Gaussians that row v did not extend, or all of them after the last row, in the order of the list.

    Returns the number of active Gaussians, at the head of the list, and the number of all emitted ones.
    """
    remaining = 0
    for i in range(n):
        g = active[i]
        if whole[g, _ROW] == v and not last:
            active[remaining] = g
            interval[0, remaining], interval[1, remaining] = interval[0, i], interval[1, i]
            remaining += 1
        else:
            whole[g, _ORDER] = emitted
            emitted += 1
    return remaining, emitted


@leaf
def _lift(segment, ry, h):
    """Write a segment as a Gaussian: y and the moments with y follow from y = ry z."""
    for i in range(h.size):
        h[i] = 0.0
    h[_M], h[_M + 1], h[_M + 2] = segment[MX], ry * segment[MZ], segment[MZ]
    xx, xz, zz = segment[CXX], segment[CXZ], segment[CZZ]
    h[_C], h[_C + 1], h[_C + 2] = xx, ry * xz, xz
    h[_C + 3], h[_C + 4], h[_C + 5] = ry * ry * zz, ry * zz, zz
    h[_L], h[_L + 1], h[_L + 2] = segment[LX], ry * segment[LZ], segment[LZ]


@leaf
def _best_overlap(low, high, interval, before):
    """Index of the interval active before this row that overlaps [``low``, ``high``] most, or -1.

    The overlap is shared / union; products of whole numbers compare two of them as their quotients would.
    """
    num, den, best = ZERO, ZERO + 1, ZERO - 1
    left, right = interval[0], interval[1]
    for i in range(before):
        shared = min(right[i], high) - max(left[i], low)
        union = max(right[i], high) - min(left[i], low)
        better = shared * den > num * union
        num, den, best = shared if better else num, union if better else den, i if better else best
    return best


@leaf
def _same_plane(o, o_int, h, slope, lengths2, limits):
    """Does segment h continue the surface of Gaussian o?"""
    if not o[_PI2] < lengths2[o_int[NEAREST]]:
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
    n_o, n_h = o_int[N], h_int[N]
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
    o_int[N] = n
    o_int[UL] = (o_int[UL] + h_int[UL]) // 2
    o_int[UR] = (o_int[UR] + h_int[UR]) // 2
    o_int[NEAREST] = min(o_int[NEAREST], h_int[NEAREST])
    o_int[_MERGED] += 1


@leaf
def _prune(whole, created, limits, emitted, retained, position):
    """Write the retained Gaussians in emission order, and for every Gaussian its position among them or -1.

    Returns the number of retained Gaussians; ``emitted`` is scratch.
    """
    for g in range(created):
        emitted[whole[g, _ORDER]] = g
    n = 0
    for i in range(created):
        g = emitted[i]
        position[g] = -1
        large, tall = whole[g, N] >= limits.min_pixels, whole[g, _MERGED] >= limits.min_rows
        if limits.prune == 0 or (large and tall) or (limits.prune == 1 and (large or tall)):
            retained[n] = g
            position[g] = n
            n += 1
    return n


@part
def _write_gaussians(retained, gaussians, whole, focal, floor, real, mean, covariance, weight):
    """Write the retained Gaussians, rounded to the depth's dtype; a single pixel has no sample covariance (zeros).

    The eigenvalues of the covariances are lifted to the floor of a segment (``step``): the variance across one pixel,
    and a share of the trace for storage.
    """
    near, widening, share = floor
    work = empty(WORK, np.float64)
    for i in range(weight.size):
        g, S = gaussians[retained[i]], covariance[i]
        n = whole[retained[i], N]
        weight[i] = real(n)
        scatter = 0
        for r in range(3):
            mean[i, r] = real(g[_M + r])
            for c in range(r, 3):
                S[r, c] = S[c, r] = real(g[_C + scatter] / (n - 1)) if n > 1 else 0.0
                scatter += 1
        across = max(mean[i, 2], near) / focal
        floor_covariance(S, max(across * across * widening, share * (S[0, 0] + S[1, 1] + S[2, 2])), work)
