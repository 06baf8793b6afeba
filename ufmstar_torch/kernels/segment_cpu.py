"""SPGF on the CPU (numba): the same partitions as :mod:`ufmstar_torch.segment`, in well under a millisecond.

Every formula is written in the torch reference's order of operations, so that the decisions agree to the
last bit. No fastmath: it would let the compiler reorder them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from ufmstar_torch.config import SPGFConfig, UfMStarConfig
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.segment_input import SegmentInput

# Columns of a finished segment. Within a row y = z (v - cy)/fy, so x and z say everything.
_N, _MX, _MZ, _CXX, _CXZ, _CZZ, _LX, _LZ, _NEAREST, _UL, _UR = range(11)
_SEGMENT = 11

# Columns of an open segment: sums of d = p - pL and of d d^T, first and last point, w2 = |pR - pL|^2 ...
_DX, _DZ, _DXX, _DXZ, _DZZ, _XL, _ZL, _XR, _ZR, _W2 = range(10)
_OPEN = 10
# ... and its whole numbers: N, uL, uR, smallest bin, how many were started in the row before it.
_ON, _OUL, _OUR, _OBIN, _BORN = range(5)
_OPEN_INT = 5

# Columns of a Gaussian: mean, scatter (upper triangle), line vector, first mean, plane vector, its pi2 ...
_M, _C, _L, _M0, _PI, _PI2 = 0, 3, 9, 12, 15, 18
_GAUSSIAN = 19
# ... and its whole numbers: N, n, smallest bin, stored interval, the row that extended it last.
_GN, _MERGED, _GBIN, _GUL, _GUR, _ROW = range(6)
_GAUSSIAN_INT = 6

_PRUNE = {"none": 0, "both": 1, "either": 2}


class _Limits(NamedTuple):
    """The thresholds that do not depend on the camera, as compiled code takes them."""

    noise_floor: float
    noise_thresh: float
    line_thresh: float
    angle2: float
    max_depth: float
    shortest_bin: float
    longest_bin: float
    depth_bins: int
    occlusion_gap: int
    n_check: int
    max_open: int
    sparse: int
    prune: int
    min_pixels: int
    min_rows: int


def spgf(
    depth: Tensor,
    intrinsics: Tensor,
    config: SPGFConfig | UfMStarConfig | None = None,
    *,
    variance: Tensor | None = None,
    valid: Tensor | None = None,
    features: Tensor | None = None,
    before_pruning: bool = False,
) -> tuple[GaussianMixture, Tensor]:
    """As :func:`ufmstar_torch.segment.spgf`, for CPU tensors, float64 inside.

    Raises:
        TypeError: as there.
        ValueError: as there, and for tensors of another device.
    """
    given = SegmentInput.checked(depth, intrinsics, config, variance, valid, features)
    if depth.device.type != "cpu":
        raise ValueError(f"depth must lie on the CPU for the numba kernel, got {depth.device}")
    z = given.depth.contiguous().numpy()
    absent = (z.shape[0], 1, 0)  # rows of no pixels stand for "not given"
    use = np.empty(absent, np.bool_) if valid is None else valid.contiguous().numpy()
    spread = np.empty(absent, z.dtype) if given.variance is None else _array(given.variance)
    cameras = np.array(
        [
            (K[0][0], K[1][1], K[0][2], K[1][2], given.config.slope(min(K[0][0], K[1][1])))
            for K in given.intrinsics.tolist()
        ]
    )
    dtype = np.float32 if given.dtype == torch.float32 else np.float64
    mean, covariance, weight, count, labels = _segment(
        z, use, spread, cameras, _limits(given, before_pruning), np.empty(0, dtype)
    )
    if given.features is None:
        extra = np.empty((*weight.shape, 0), dtype)
    else:
        extra = _feature_means(_array(given.features), labels, weight)
    fields = (mean, covariance, weight, np.zeros_like(weight), count, extra)
    return GaussianMixture(*map(torch.from_numpy, fields)), torch.from_numpy(labels)


def _array(value: Tensor) -> np.ndarray:
    """A contiguous float32 or float64 view of a CPU tensor; half and bfloat16 are converted."""
    if value.dtype not in (torch.float32, torch.float64):
        value = value.to(torch.float32)
    return value.contiguous().numpy()


def _limits(given: SegmentInput, before_pruning: bool) -> _Limits:
    c = given.config
    return _Limits(
        noise_floor=float(c.noise_floor),
        noise_thresh=float(c.noise_thresh),
        line_thresh=float(c.line_thresh),
        angle2=float(c.angle_cosine) ** 2,
        max_depth=float(c.max_depth),
        shortest_bin=float(c.min_gaussian_length),
        longest_bin=float(c.frame_max_scale * c.min_gaussian_length),
        depth_bins=given.depth_bins,
        occlusion_gap=c.occlusion_gap,
        n_check=c.n_check,
        max_open=c.max_open,
        sparse=c.sparse,
        prune=0 if before_pruning else _PRUNE[c.prune],
        min_pixels=c.min_pixels,
        min_rows=c.min_rows,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _segment(z, use, spread, cameras, limits, like):
    """All streams: moments, pixel counts, occupied slots and labels, padded to the largest stream."""
    streams, height, width = z.shape
    labels = np.empty((streams, height, width), np.int64)
    found = []
    most = 1
    for b in range(streams):
        kept, values, whole = _image(z[b], use[b], spread[b], cameras[b], limits, labels[b])
        found.append((kept, values, whole))
        most = max(most, kept.size)
    mean, covariance = np.zeros((streams, most, 3), like.dtype), np.zeros((streams, most, 3, 3), like.dtype)
    weight, count = np.zeros((streams, most), like.dtype), np.zeros((streams, most), np.int64)
    for b in range(streams):
        kept, values, whole = found[b]
        _write(kept, values, whole, mean[b], covariance[b], weight[b], count[b])
    return mean, covariance, weight, count, labels


@njit(cache=True, nogil=True, error_model="numpy")
def _image(z, use, spread, camera, limits, labels):
    """One image; writes its labels. Returns which Gaussians are kept, in emission order, and all their values."""
    height, width = z.shape
    fx, fy, cx, cy, slope = camera[0], camera[1], camera[2], camera[3], camera[4]
    lengths2, edges = _depth_bins(0.5 * min(width / fx, height / fy), limits)
    rx = np.empty(width)
    for u in range(width):
        rx[u] = (u - cx) / fx

    segments = np.empty((height, width // (limits.sparse + 1), _SEGMENT))
    finished = np.empty(height, np.int64)
    owner = np.empty((height, width), np.int32)  # which of the row's starts a pixel belongs to, -1 = none
    place = np.empty((height, width), np.int32)  # start -> finished segment, -1 = too sparse
    values, whole = np.empty((limits.max_open, _OPEN)), np.empty((limits.max_open, _OPEN_INT), np.int64)
    total = 0
    for v in range(height):
        finished[v] = _scanline(
            z[v], use[v % use.shape[0]], spread[v % spread.shape[0]], rx, (v - cy) / fy, slope, lengths2, edges,
            limits, values, whole, segments[v], owner[v], place[v],
        )  # fmt: skip
        total += finished[v]

    gaussians, whole = np.empty((total, _GAUSSIAN)), np.empty((total, _GAUSSIAN_INT), np.int64)
    member = np.empty((height, segments.shape[1]), np.int32)  # segment -> Gaussian, in order of creation
    emitted = _fuse(segments, finished, cy, fy, slope, lengths2, limits, gaussians, whole, member)
    slot = np.full(total, -1, np.int32)
    kept = np.empty(emitted.size, np.int32)
    n = 0
    for g in emitted:
        if _keeps(whole[g, _GN], whole[g, _MERGED], limits):
            kept[n] = g
            slot[g] = n
            n += 1
    for v in range(height):
        _label_row(owner[v], place[v], member[v], slot, labels[v])
    return kept[:n], gaussians, whole


@njit(cache=True, nogil=True, error_model="numpy")
def _depth_bins(s, limits):
    """Squared length and far edge of every depth bin [m^2, m]."""
    lengths2, edges = np.empty(limits.depth_bins), np.empty(limits.depth_bins)
    length = limits.shortest_bin
    edge = 0.0
    for k in range(limits.depth_bins):
        edge += length
        lengths2[k], edges[k] = length * length, edge
        length = min(max(s * edge, limits.shortest_bin), limits.longest_bin)
    return lengths2, edges


@njit(cache=True, nogil=True, error_model="numpy")
def _scanline(z, use, spread, rx, ry, slope, lengths2, edges, limits, values, whole, segments, owner, place):
    """Scanline segmentation of one row. Writes segments, owner and place; returns the number of segments.

    The queue of open segments is a ring in ``values`` and ``whole``: ``front`` is the newest.
    """
    y_factor = 1.0 + ry * ry
    front, opened, started, done = 0, 0, 0, 0
    k = 0
    for u in range(z.size):
        depth = np.float64(z[u])
        s2 = np.float64(spread[u]) if spread.size else 0.0
        # Comparisons are written so that NaN fails them.
        if not (depth > 0 and depth <= limits.max_depth and s2 >= 0 and s2 < np.inf and (use.size == 0 or use[u])):
            owner[u] = -1
            continue
        x = rx[u] * depth
        while k < edges.size - 1 and edges[k] < depth:
            k += 1
        while k > 0 and edges[k - 1] >= depth:
            k -= 1
        q = _match(x, depth, u, slope, lengths2[k], limits, values, whole, front, opened)
        if q < 0:
            q = (front + 1) % limits.max_open
            if opened == limits.max_open:  # the ring is full: the slot after the front holds the oldest
                done = _finish(values[q], whole[q], limits.sparse, segments, done, place)
            else:
                opened += 1
            front = q
            _start(values[q], whole[q], x, depth, u, k, started)
            started += 1
        _extend(values[q], whole[q], x, depth, u, k, y_factor)
        if s2 > 0:
            values[q, _DXX] += s2 * (rx[u] * rx[u])
            values[q, _DXZ] += s2 * rx[u]
            values[q, _DZZ] += s2
        owner[u] = whole[q, _BORN]
    for i in range(opened):
        q = (front - i) % limits.max_open
        done = _finish(values[q], whole[q], limits.sparse, segments, done, place)
    return done


@njit(cache=True, nogil=True, error_model="numpy")
def _match(x, z, u, slope, length2, limits, values, whole, front, opened):
    """The newest open segment that the point continues, or -1."""
    t = slope * z * z
    tau_z = min(max(6.0 * t, limits.noise_floor), limits.noise_thresh)
    for i in range(opened):
        q = front - i
        if q < 0:
            q += limits.max_open
        if u - whole[q, _OUR] > limits.occlusion_gap or not values[q, _W2] < length2:
            continue
        if whole[q, _ON] <= limits.n_check:
            tau_x = min(max(t, limits.noise_floor), limits.line_thresh)
            if abs(z - values[q, _ZR]) < tau_z and abs(x - values[q, _XR]) < tau_x:
                return q
        else:
            dx, dz = values[q, _DX], values[q, _DZ]
            if dx != 0 and abs(values[q, _ZL] + dz * (x - values[q, _XL]) / dx - z) < tau_z:
                return q
    return -1


@njit(cache=True, nogil=True, error_model="numpy")
def _start(values, whole, x, z, u, k, born):
    """An open segment without pixels that is anchored at its first one."""
    values[:] = 0.0
    values[_XL], values[_ZL] = x, z
    whole[_ON], whole[_OUL], whole[_OBIN], whole[_BORN] = 0, u, k, born


@njit(cache=True, nogil=True, error_model="numpy")
def _extend(values, whole, x, z, u, k, y_factor):
    """Add a pixel to an open segment."""
    dx, dz = x - values[_XL], z - values[_ZL]
    values[_DX] += dx
    values[_DZ] += dz
    values[_DXX] += dx * dx
    values[_DXZ] += dx * dz
    values[_DZZ] += dz * dz
    values[_XR], values[_ZR] = x, z
    values[_W2] = dx * dx + y_factor * (dz * dz)
    whole[_ON] += 1
    whole[_OUR] = u
    whole[_OBIN] = min(whole[_OBIN], k)


@njit(cache=True, nogil=True, error_model="numpy")
def _finish(values, whole, sparse, segments, done, place):
    """Output an open segment unless it is too sparse; returns the new number of finished ones."""
    n = whole[_ON]
    if n <= sparse:
        place[whole[_BORN]] = -1
        return done
    place[whole[_BORN]] = done
    out = segments[done]
    dx, dz = values[_DX], values[_DZ]
    out[_N] = n
    out[_MX], out[_MZ] = values[_XL] + dx / n, values[_ZL] + dz / n
    out[_CXX] = values[_DXX] - dx * dx / n
    out[_CXZ] = values[_DXZ] - dx * dz / n
    out[_CZZ] = values[_DZZ] - dz * dz / n
    out[_LX], out[_LZ] = dx, dz
    out[_NEAREST], out[_UL], out[_UR] = whole[_OBIN], whole[_OUL], whole[_OUR]
    return done + 1


@njit(cache=True, nogil=True, error_model="numpy")
def _fuse(segments, finished, cy, fy, slope, lengths2, limits, gaussians, whole, member):
    """Segment fusion over the rows. Fills the Gaussians and member; returns the order of emission."""
    height, most = member.shape
    active, fresh = np.empty(2 * most, np.int32), np.empty(2 * most, np.int32)
    emitted = np.empty(whole.shape[0], np.int32)
    before, created, done = 0, 0, 0
    h = np.empty(_GAUSSIAN)
    h_int = np.empty(_GAUSSIAN_INT, np.int64)
    for v in range(height):
        n = before
        ry = (v - cy) / fy
        for j in range(finished[v]):
            _lift(segments[v, j], ry, v, h, h_int)
            o = _best_overlap(h_int, active, before, whole)
            if o >= 0 and _same_plane(gaussians[o], whole[o], h, slope, lengths2, limits):
                _merge(gaussians[o], whole[o], h, h_int)
                member[v, j] = o
            else:
                gaussians[created] = h
                whole[created] = h_int
                active[n] = member[v, j] = created
                n += 1
                created += 1
        going = 0
        for i in range(n):
            # After the last row all are complete together, in the order of the active list.
            if whole[active[i], _ROW] == v and v < height - 1:
                fresh[going] = active[i]
                going += 1
            else:
                emitted[done] = active[i]
                done += 1
        active, fresh = fresh, active
        before = going
    return emitted[:done]


@njit(cache=True, nogil=True, error_model="numpy")
def _lift(segment, ry, v, h, h_int):
    """A segment of row v as a Gaussian of its own: y and the moments with y follow from y = ry z."""
    h[:] = 0.0
    h[_M], h[_M + 1], h[_M + 2] = segment[_MX], ry * segment[_MZ], segment[_MZ]
    xx, xz, zz = segment[_CXX], segment[_CXZ], segment[_CZZ]
    h[_C], h[_C + 1], h[_C + 2] = xx, ry * xz, xz
    h[_C + 3], h[_C + 4], h[_C + 5] = ry * ry * zz, ry * zz, zz
    h[_L], h[_L + 1], h[_L + 2] = segment[_LX], ry * segment[_LZ], segment[_LZ]
    h_int[_GN], h_int[_MERGED], h_int[_ROW] = int(segment[_N]), 1, v
    h_int[_GBIN], h_int[_GUL], h_int[_GUR] = int(segment[_NEAREST]), int(segment[_UL]), int(segment[_UR])


@njit(cache=True, nogil=True, error_model="numpy")
def _best_overlap(h_int, active, before, whole):
    """The Gaussian active before this row whose stored interval overlaps the segment's most, or -1."""
    best, found = 0.0, -1
    low, high = h_int[_GUL], h_int[_GUR]
    for i in range(before):
        o = active[i]
        shared = min(whole[o, _GUR], high) - max(whole[o, _GUL], low)
        if shared > 0:
            rho = shared / (max(whole[o, _GUR], high) - min(whole[o, _GUL], low))
            if rho > best:
                best, found = rho, o
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _same_plane(o, o_int, h, slope, lengths2, limits):
    """Does segment h continue the surface of Gaussian o?"""
    if not o[_PI2] < lengths2[o_int[_GBIN]]:
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


@njit(cache=True, nogil=True, error_model="numpy")
def _merge(o, o_int, h, h_int):
    """Add segment h to Gaussian o: moments about the means (Chan et al.), then interval and plane state."""
    n_o, n_h = o_int[_GN], h_int[_GN]
    n = n_o + n_h
    share, factor = n_h / n, n_o * n_h / n
    dx, dy, dz = h[_M] - o[_M], h[_M + 1] - o[_M + 1], h[_M + 2] - o[_M + 2]
    o[_C] += h[_C] + factor * (dx * dx)
    o[_C + 1] += h[_C + 1] + factor * (dx * dy)
    o[_C + 2] += h[_C + 2] + factor * (dx * dz)
    o[_C + 3] += h[_C + 3] + factor * (dy * dy)
    o[_C + 4] += h[_C + 4] + factor * (dy * dz)
    o[_C + 5] += h[_C + 5] + factor * (dz * dz)
    o[_M] += share * dx
    o[_M + 1] += share * dy
    o[_M + 2] += share * dz
    first = o_int[_MERGED] == 1
    pi2 = 0.0
    for i in range(3):
        o[_L + i] += h[_L + i]
        if first:
            o[_M0 + i] = o[_M + i]
        step = h[_M + i] - o[_M0 + i]
        o[_PI + i] += step
        pi2 += step * step
    o[_PI2] = pi2
    o_int[_GN] = n
    o_int[_GUL] = (o_int[_GUL] + h_int[_GUL]) // 2
    o_int[_GUR] = (o_int[_GUR] + h_int[_GUR]) // 2
    o_int[_GBIN] = min(o_int[_GBIN], h_int[_GBIN])
    o_int[_MERGED] += 1
    o_int[_ROW] = h_int[_ROW]


@njit(cache=True, nogil=True, error_model="numpy")
def _keeps(pixels, merged, limits):
    """The pruning rule."""
    if limits.prune == 0:
        return True
    large, tall = pixels >= limits.min_pixels, merged >= limits.min_rows
    return large or tall if limits.prune == 1 else large and tall


@njit(cache=True, nogil=True, error_model="numpy")
def _label_row(owner, place, member, slot, labels):
    """From a pixel's start to its finished segment, its Gaussian, and that one's slot."""
    for u in range(owner.size):
        labels[u] = -1
        if owner[u] >= 0 and place[owner[u]] >= 0:
            labels[u] = slot[member[place[owner[u]]]]


@njit(cache=True, nogil=True, error_model="numpy")
def _write(kept, gaussians, whole, mean, covariance, weight, count):
    """The kept Gaussians as the mixture's slots; a single pixel has no sample covariance (zeros)."""
    for i in range(kept.size):
        g = gaussians[kept[i]]
        n = whole[kept[i], _GN]
        weight[i], count[i] = n, 1
        scatter = 0
        for r in range(3):
            mean[i, r] = g[_M + r]
            for c in range(r, 3):
                value = g[_C + scatter] / (n - 1) if n > 1 else 0.0
                covariance[i, r, c] = value
                covariance[i, c, r] = value
                scatter += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _feature_means(features, labels, weight):
    """Mean of the features [B, F, H, W] over the pixels of each Gaussian, in raster order."""
    streams, channels, height, width = features.shape
    sums = np.zeros((streams, weight.shape[1], channels))
    for b in range(streams):
        for f in range(channels):
            for v in range(height):
                for u in range(width):
                    if labels[b, v, u] >= 0:
                        sums[b, labels[b, v, u], f] += features[b, f, v, u]
    out = np.zeros(sums.shape, weight.dtype)
    for b in range(streams):
        for k in range(weight.shape[1]):
            for f in range(channels):
                if weight[b, k] > 0:
                    out[b, k, f] = sums[b, k, f] / weight[b, k]
    return out
