"""The exact sum of the regression at every pixel, or at some, on the CPU (numba), with culling in three levels.

A component k adds w_k(x) = pi_k N(x; mu_k, Sigma_k) to the denominator D(x) = pi_0 + sum_k w_k(x) of a point x.

1. Image: w_k(x) exceeds a threshold in an ellipsoid only. Its silhouette has a bounding box of pixels.
2. Block of 32 x 32 pixels: for the components whose silhouette meets the block, interval arithmetic over the bounding
   box of the block's points gives l_k <= w_k(x) <= h_k.
3. Tile of 8 x 8 pixels: the same, for the components that the block keeps.

Each level leaves out the components with h_k <= (eps / 3n) max(max_j l_j, pi_0 / 1000), with n components at that level
(level 1: max_j l_j = 0). max_j l_j and pi_0 are parts of the denominator, so that the components left out add up to
d(x) <= eps max(max_j w_j(x), pi_0 / 1000) <= eps D(x). The error is d/D times the difference of two averages of m_k
and mu_0:

    |m_hat - m_hat_culled| <= eps max(m_k, mu_0),

and eps / 1000 max(m_k, mu_0) at a point that no component explains (every w_j <= pi_0 / 1000). The factor 1000 keeps
the *relative* error small there, where m_hat itself is small. What the arithmetic rounds off comes on top; the bounds
contain their own rounding. tests/test_regress.py checks the bound.

Points are taken relative to an origin in the middle of their tile at the depth of its nearest pixel, and whitened
offsets of the components from there in double precision, so that float32 loses nothing to the distance from the camera,
nor to a far outlier in the tile. Densities are powers of two: log2(e)/2 is part of the whitening.

A subset of the pixels takes the same way: a block's share of them, up to 64 at a time, is a tile.
"""

from __future__ import annotations

import numpy as np
from numba import types
from numba.extending import overload

from ufmstar_torch.kernels.compile_cpu import contracted, kernel, leaf, part
from ufmstar_torch.kernels.regress_cull_cpu import FIELDS, cull, pad

_TILE = 8  # pixels
_PIXELS = _TILE * _TILE
_SIDE = 4  # tiles of a block
_TILES = _SIDE * _SIDE
# Rows of a tile's buffer, each of 64 numbers.
_X, _Y, _Z, _EVIDENCE, _TOTAL, _LAST, _FIRST, _SECOND = (i * _PIXELS for i in range(8))


def exp2_(t):
    """2^t for t < 128 in t's own precision; compiled code only (see the overload)."""
    return 2.0**t


@overload(exp2_, jit_options={"fastmath": {"contract"}})
def _exp2_overload(t):
    if t is not types.float32:
        return lambda t: np.exp2(t)

    def exp2_32(t):
        # 2^n 2^r with |r| <= 1/2 and the minimax polynomial of degree 5 (2.3e-7 relative with its rounding), as code
        # without branches, which the compiler turns into vector instructions.
        # Adding 1.5 2^23 rounds to an integer, in the last bits, from where a shift brings it to the exponent.
        # Below 2^-100, and for NaN, it is 0: products with numbers too small for normal floats take a hundred times
        # as long.
        n = np.float32(t + np.float32(12582912.0))
        r = t - (n - np.float32(12582912.0))
        p = np.float32(0.00132764718)
        p = p * r + np.float32(0.00967554133)
        p = p * r + np.float32(0.0555071327)
        p = p * r + np.float32(0.240221197)
        p = p * r + np.float32(0.693146967)
        p = np.float32(p * r + np.float32(1.00000007))
        power = np.int32((n.view(np.int32) << np.int32(23)) + p.view(np.int32))
        return power.view(np.float32) if t > np.float32(-100.0) else np.float32(0.0)

    return exp2_32


@kernel
def exact(depth, K, view, features, out, out_f, first, shares):
    """One stream; of its blocks every ``shares``-th, from ``first`` on.

    depth [H, W], K [3, 3], what is in view (:func:`in_view`) and features [K, F] into out [H, W] and out_f [F, H, W];
    NaN where the depth is not positive.
    """
    height, width = depth.shape
    columns, rows = (width + _TILE - 1) // _TILE, (height + _TILE - 1) // _TILE
    across, down = np.empty((columns, _PIXELS)), np.empty((rows, _PIXELS))
    for i in range(columns * _PIXELS):
        across[i // _PIXELS, i % _PIXELS] = (i // _PIXELS * _TILE + i % _TILE - K[0, 2]) / K[0, 0]
    for i in range(rows * _PIXELS):
        down[i // _PIXELS, i % _PIXELS] = (i // _PIXELS * _TILE + i % _PIXELS // _TILE - K[1, 2]) / K[1, 1]
    _blocks(depth, across, down, view, features, _scratch(view[2], out_f), out, out_f, first, shares)


@kernel
def exact_at(depth, K, pixels, view, features, out, out_f):
    """One stream at some pixels [n], indices into the flattened image, into out [n] and out_f [F, n]."""
    height, width = depth.shape
    side = _TILE * _SIDE
    columns, rows = (width + side - 1) // side, (height + side - 1) // side
    begin, order = np.zeros(rows * columns + 1, np.int64), np.empty(pixels.size, np.int64)
    _by_block(pixels, width, columns, begin, order)
    rays = np.empty((2, _PIXELS))
    _at_pixels(depth, K, pixels, begin, order, rays, view, features, _scratch(view[2], out_f), out, out_f)


@part
def _scratch(packed, out_f):
    """Memory for the work on one block, of components ``packed`` [10, n]: the points [16, 192] of its tiles, their
    boxes and origins [16, 9], depths, work on them, holes, whether a tile has a pixel; buffer and sums of features;
    fields, bounds and two lists of components."""
    n, dtype = packed.shape[1], packed.dtype  # padded
    return (
        np.empty((_TILES, 3 * _PIXELS), dtype), np.empty((_TILES, 9)), np.empty(_PIXELS), np.empty((5, _PIXELS)),
        np.empty((_TILES, _PIXELS), dtype), np.empty(_TILES, np.bool_),
        np.empty(8 * _PIXELS, dtype), np.empty((out_f.shape[0], _PIXELS), dtype),
        np.empty((FIELDS, n), dtype), np.empty((2, n), dtype), np.empty(n, np.int64), np.empty(n, np.int64),
    )  # fmt: skip


@leaf
def _blocks(depth, across, down, view, features, scratch, out, out_f, first, shares):
    """The blocks of an image, of which every ``shares``-th is done, from ``first`` on."""
    points, boxes, z, work, hole, seen, buffer, sums, near, bounds, in_block, in_tile = scratch
    index, _, everyone, _, settings = view
    side = _TILE * _SIDE
    rows, columns = (depth.shape[0] + side - 1) // side, (depth.shape[1] + side - 1) // side
    for block in range(first, rows * columns, shares):
        v0, u0 = block // columns * side, block % columns * side
        some = False
        for tile in range(_TILES):
            v, u = v0 + tile // _SIDE * _TILE, u0 + tile % _SIDE * _TILE
            seen[tile] = v < depth.shape[0] and u < depth.shape[1] and _depths(depth, v, u, z, hole, tile)
            if seen[tile]:
                some = True
                _place(z, across, u // _TILE, down, v // _TILE, points, boxes, tile, work)
            else:
                _blank(v, u, out, out_f)
        if not some:
            continue
        count = cull(everyone, index.size, _union(boxes, seen), settings, bounds, in_block)
        for i in range(FIELDS):
            for j in range(count):
                near[i, j] = everyone[i, in_block[j]]
        pad(near, count)
        for tile in range(_TILES):
            if seen[tile]:
                chosen = cull(near, count, _box(boxes, tile), settings, bounds, in_tile)
                for j in range(chosen):
                    in_tile[j] = in_block[in_tile[j]]
                _sum(points, boxes, tile, in_tile, chosen, view, features, buffer, sums)
                _averages(buffer, sums, hole, tile)
                v, u = v0 + tile // _SIDE * _TILE, u0 + tile % _SIDE * _TILE
                _write(buffer[_TOTAL : _TOTAL + _PIXELS], v, u, out)
                for g in range(sums.shape[0]):
                    _write(sums[g], v, u, out_f[g])


@leaf
def _by_block(pixels, width, columns, begin, order):
    """Sort pixels by block, keeping their order within one: ``begin`` [blocks + 1] and ``order`` [n]."""
    side = _TILE * _SIDE
    for i in range(pixels.size):
        begin[pixels[i] // width // side * columns + pixels[i] % width // side + 1] += 1
    for block in range(1, begin.size):
        begin[block] += begin[block - 1]
    for i in range(pixels.size):
        block = pixels[i] // width // side * columns + pixels[i] % width // side
        order[begin[block]] = i
        begin[block] += 1
    for block in range(begin.size - 1, 0, -1):
        begin[block] = begin[block - 1]
    begin[0] = 0


@leaf
def _at_pixels(depth, K, pixels, begin, order, rays, view, features, scratch, out, out_f):
    """The blocks of an image at some pixels."""
    points, boxes, z, work, hole, _, buffer, sums, _, bounds, kept, _ = scratch
    index, _, everyone, _, settings = view
    nan = out.dtype.type(np.nan)
    for block in range(begin.size - 1):
        for low in range(begin[block], begin[block + 1], _PIXELS):
            high = min(low + _PIXELS, begin[block + 1])
            for i in range(_PIXELS):
                p = pixels[order[min(low + i, high - 1)]]
                v, u = p // depth.shape[1], p % depth.shape[1]
                rays[0, i], rays[1, i] = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
                z[i] = depth[v, u]
            some = _without_holes(z, hole, 0)
            if some:
                _place(z, rays[:1], 0, rays[1:], 0, points, boxes, 0, work)
                count = cull(everyone, index.size, _box(boxes, 0), settings, bounds, kept)
                _sum(points, boxes, 0, kept, count, view, features, buffer, sums)
                _averages(buffer, sums, hole, 0)
            for i in range(high - low):
                out[order[low + i]] = buffer[_TOTAL + i] if some else nan
                for g in range(sums.shape[0]):
                    out_f[g, order[low + i]] = sums[g, i] if some else nan


# Loops run over all 64 pixels where they can: the compiler turns those into vector instructions, and unrolls one over a
# row of eight.


@leaf
def _depths(depth, v0, u0, z, hole, tile):
    """Depths [64] of a tile as :func:`_without_holes` leaves them; False where no pixel has one."""
    if v0 + _TILE <= depth.shape[0] and u0 + _TILE <= depth.shape[1]:
        for v in range(_TILE):  # rows as slices: indices from 0 on need no test for negative ones
            given, row = depth[v0 + v, u0 : u0 + _TILE], z[v * _TILE : (v + 1) * _TILE]
            for u in range(_TILE):
                row[u] = given[u]
    else:
        for i in range(_PIXELS):
            v, u = v0 + i // _TILE, u0 + i % _TILE
            z[i] = depth[v, u] if v < depth.shape[0] and u < depth.shape[1] else 0
    return _without_holes(z, hole, tile)


@leaf
def _without_holes(z, hole, tile):
    """Put the least positive depth in place of what is not positive, where ``hole`` [..., 64] becomes NaN and else 0;
    False where nothing is positive."""
    zero, nan = hole.dtype.type(0), hole.dtype.type(np.nan)
    for i in range(_PIXELS):
        z[i] = z[i] if z[i] > 0 else np.inf
    for i in range(_PIXELS):
        hole[tile, i] = zero if z[i] < np.inf else nan
    a, b, c, d = z[0], z[1], z[2], z[3]
    for i in range(4, _PIXELS, 4):  # four chains of comparisons, which do not wait for each other
        a, b = z[i] if z[i] < a else a, z[i + 1] if z[i + 1] < b else b
        c, d = z[i + 2] if z[i + 2] < c else c, z[i + 3] if z[i + 3] < d else d
    least = min(min(a, b), min(c, d))
    for i in range(_PIXELS):
        z[i] = z[i] if z[i] < np.inf else least
    return least < np.inf


@leaf
def _place(z, across, column, down, row, points, boxes, tile, work):
    """The points [3, 64] of a tile, relative to its origin, its bounding box (low, high) and its origin.

    ``work`` [5, 64] is scratch.
    """
    x, y = across[column], down[row]
    for i in range(_PIXELS):
        work[0, i] = x[i] * z[i]
    for i in range(_PIXELS):
        work[1, i] = y[i] * z[i]
    for i in range(_PIXELS):
        work[2, i] = z[i]
    for axis in range(3):
        boxes[tile, axis], boxes[tile, 3 + axis] = _extremes(work[axis], work[3], work[4])
    x0, y0, z0 = 0.5 * (x[0] + x[_PIXELS - 1]), 0.5 * (y[0] + y[_PIXELS - 1]), boxes[tile, 2]
    x0, y0 = x0 * z0, y0 * z0
    boxes[tile, 6], boxes[tile, 7], boxes[tile, 8] = x0, y0, z0
    for i in range(_PIXELS):
        points[tile, i] = work[0, i] - x0
    for i in range(_PIXELS):
        points[tile, _PIXELS + i] = work[1, i] - y0
    for i in range(_PIXELS):
        points[tile, 2 * _PIXELS + i] = work[2, i] - z0


@leaf
def _extremes(values, low, high):
    """The least and the greatest of 64 numbers, sixteen comparisons at a time."""
    for i in range(16):
        low[i] = high[i] = values[i]
    for first in range(16, _PIXELS, 16):
        row = values[first : first + 16]
        for i in range(16):
            low[i] = row[i] if row[i] < low[i] else low[i]
        for i in range(16):
            high[i] = row[i] if row[i] > high[i] else high[i]
    least, most = low[0], high[0]
    for i in range(1, 16):
        least, most = low[i] if low[i] < least else least, high[i] if high[i] > most else most
    return least, most


@leaf
def _box(boxes, tile):
    """The least and the greatest corner of a tile's box."""
    return boxes[tile, 0], boxes[tile, 1], boxes[tile, 2], boxes[tile, 3], boxes[tile, 4], boxes[tile, 5]


@leaf
def _union(boxes, seen):
    """The least and the greatest corner of the boxes of the tiles that are seen."""
    a = b = c = np.inf
    d = e = f = -np.inf
    for tile in range(seen.size):
        if seen[tile]:
            a, b, c = min(a, boxes[tile, 0]), min(b, boxes[tile, 1]), min(c, boxes[tile, 2])
            d, e, f = max(d, boxes[tile, 3]), max(e, boxes[tile, 4]), max(f, boxes[tile, 5])
    return a, b, c, d, e, f


@leaf
def _blank(v_low, u_low, out, out_f):
    """NaN at the pixels of a tile."""
    nan = out.dtype.type(np.nan)
    for v in range(v_low, min(v_low + _TILE, out.shape[0])):
        for u in range(u_low, min(u_low + _TILE, out.shape[1])):
            out[v, u] = nan
            for g in range(out_f.shape[0]):
                out_f[g, v, u] = nan


@contracted
def _add_two(constants, k, a_offset, j, b_offset, b_peak, buffer):
    """Add components k and j to 64 points: their densities to the row of evidence, times m to that of the total, and
    times the last feature to that of the last."""
    a0, a1, a2, a3, a4 = constants[k, 0], constants[k, 1], constants[k, 2], constants[k, 3], constants[k, 4]
    a5, a_peak, a_m, a_f = constants[k, 5], constants[k, 6], constants[k, 7], constants[k, 8]
    b0, b1, b2, b3, b4 = constants[j, 0], constants[j, 1], constants[j, 2], constants[j, 3], constants[j, 4]
    b5, b_m, b_f = constants[j, 5], constants[j, 7], constants[j, 8]
    ax, ay, az = a_offset
    bx, by, bz = b_offset
    for i in range(_PIXELS):
        x, y, z = buffer[_X + i], buffer[_Y + i], buffer[_Z + i]
        y0, y1, y2 = a0 * x + ax, a1 * x + (a2 * y + ay), a3 * x + (a4 * y + (a5 * z + az))
        p = exp2_(((a_peak - y0 * y0) - y1 * y1) - y2 * y2)
        y0, y1, y2 = b0 * x + bx, b1 * x + (b2 * y + by), b3 * x + (b4 * y + (b5 * z + bz))
        q = exp2_(((b_peak - y0 * y0) - y1 * y1) - y2 * y2)
        buffer[_EVIDENCE + i] = buffer[_EVIDENCE + i] + (p + q)
        buffer[_TOTAL + i] = (buffer[_TOTAL + i] + p * a_m) + q * b_m
        buffer[_LAST + i] = (buffer[_LAST + i] + p * a_f) + q * b_f
        buffer[_FIRST + i] = p
        buffer[_SECOND + i] = q


@contracted
def _add_feature(first, second, buffer, sums, g):
    """Add what two components' densities, as :func:`_add_two` left them, add to the sum of one feature."""
    for i in range(_PIXELS):
        sums[g, i] += buffer[_FIRST + i] * first + buffer[_SECOND + i] * second


@leaf
def _sum(points, boxes, tile, chosen, count, view, features, buffer, sums):
    """Evidence, total and sums of the features [F, 64] at the points of a tile, over ``chosen`` components."""
    real = buffer.dtype.type
    index, fields, _, constants, (prior_weight, prior_mean, _, _) = view
    prior, total, last = real(prior_weight), real(prior_weight * prior_mean), sums.shape[0] - 1
    for i in range(3 * _PIXELS):
        buffer[_X + i] = points[tile, i]
    for i in range(_PIXELS):
        buffer[_EVIDENCE + i], buffer[_TOTAL + i], buffer[_LAST + i] = prior, total, real(0)
    for g in range(last):
        for i in range(_PIXELS):
            sums[g, i] = 0
    x, y, z = boxes[tile, 6], boxes[tile, 7], boxes[tile, 8]
    for j in range(0, count, 2):
        a, b = chosen[j], chosen[min(j + 1, count - 1)]
        peak = constants[b, 6] if j + 1 < count else real(-1e4)  # an odd one is not counted twice
        _add_two(constants, a, _offset(fields, a, x, y, z, real), b, _offset(fields, b, x, y, z, real), peak, buffer)
        for g in range(last):
            _add_feature(real(features[index[a], g]), real(features[index[b], g]), buffer, sums, g)
    if last >= 0:
        for i in range(_PIXELS):
            sums[last, i] = buffer[_LAST + i]


@leaf
def _offset(fields, k, x, y, z, real):
    """The whitened offset of (x, y, z) from the mean of component k."""
    dx, dy, dz = x - fields[k, 0], y - fields[k, 1], z - fields[k, 2]
    w0, w1 = fields[k, 3] * dx, fields[k, 4] * dx + fields[k, 5] * dy
    return real(w0), real(w1), real(fields[k, 6] * dx + fields[k, 7] * dy + fields[k, 8] * dz)


@leaf
def _averages(buffer, sums, hole, tile):
    """Divide total and features by the evidence; NaN where there is a hole."""
    for i in range(_PIXELS):
        buffer[_TOTAL + i] = buffer[_TOTAL + i] / buffer[_EVIDENCE + i] + hole[tile, i]
    for g in range(sums.shape[0]):
        for i in range(_PIXELS):
            sums[g, i] = sums[g, i] / buffer[_EVIDENCE + i] + hole[tile, i]


@leaf
def _write(values, v0, u0, out):
    """The values [64] of a tile into a map."""
    if v0 + _TILE <= out.shape[0] and u0 + _TILE <= out.shape[1]:
        for v in range(_TILE):
            to, row = out[v0 + v, u0 : u0 + _TILE], values[v * _TILE : (v + 1) * _TILE]
            for u in range(_TILE):
                to[u] = row[u]
    else:
        for v in range(v0, min(v0 + _TILE, out.shape[0])):
            for u in range(u0, min(u0 + _TILE, out.shape[1])):
                out[v, u] = values[(v - v0) * _TILE + u - u0]
