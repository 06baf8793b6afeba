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

import math
from typing import Any

import numpy as np
from numba import types
from numba.extending import overload, register_jitable

from ufmstar_torch.kernels.compile_cpu import contracted, kernel, leaf, part
from ufmstar_torch.kernels.regress_points_cpu import prepare

# Of finite numbers, so that least and greatest can be found several at a time.
finite: Any = register_jitable(error_model="numpy", _nrt=False, fastmath={"nnan", "nsz"})

_TILE = 8  # pixels
_PIXELS = _TILE * _TILE
_SIDE = 4  # tiles of a block
_TILES = _SIDE * _SIDE
_PRIOR = 1e-3  # share of the prior in a threshold
_FIELDS = 10  # of a component: mean (3), whitening (6), log2 of the peak
_TERMS = 9  # of a component, whatever the tile: whitening (6), log2 of the peak, m, last feature
_LOG2_E = math.log2(math.e)
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
def in_view(mean, covariance, weight, m, features, K, height, width, prior_weight, prior_mean, epsilon, zero):
    """The components of a mixture [K, ...] that can matter in an image, as :func:`exact` takes them.

    Returns:
        Indices [n], fields [n, 10], the same in the dtype of ``zero`` and by field [10, n], the terms of the sum
        [n, 9], and the settings (prior weight and mean, epsilon, log2 of the least threshold).
    """
    index, whitening, log_peak = prepare(mean, covariance, weight)
    least = math.log2(_PRIOR * prior_weight)
    limit = _limit(epsilon, index.size) + least
    fields, constants = np.empty((index.size, _FIELDS)), np.empty((index.size, _TERMS), np.array(zero).dtype)
    n = _visible(mean, covariance, index, whitening, log_peak, K, height, width, limit, fields, constants, m, features)
    packed = np.empty((_FIELDS, n), constants.dtype)
    for i in range(_FIELDS):
        for k in range(n):
            packed[i, k] = fields[k, i]
    return index[:n], fields, packed, constants, (prior_weight, prior_mean, epsilon, least)


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
    boxes and origins [16, 9], depths, work on them, whether a tile has a pixel; buffer and sums of features;
    fields, bounds and two lists of components."""
    n, dtype = packed.shape[1], packed.dtype
    return (
        np.empty((_TILES, 3 * _PIXELS), dtype), np.empty((_TILES, 9)), np.empty(_PIXELS), np.empty((6, _PIXELS)),
        np.empty(_TILES, np.bool_),
        np.empty(8 * _PIXELS, dtype), np.empty((out_f.shape[0], _PIXELS), dtype),
        np.empty((_FIELDS, n), dtype), np.empty((2, n), dtype), np.empty(n, np.int64), np.empty(n, np.int64),
    )  # fmt: skip


@leaf
def _blocks(depth, across, down, view, features, scratch, out, out_f, first, shares):
    """The blocks of an image, of which every ``shares``-th is done, from ``first`` on."""
    points, boxes, z, work, seen, buffer, sums, near, bounds, in_block, in_tile = scratch
    _, _, everyone, _, settings = view
    side = _TILE * _SIDE
    rows, columns = (depth.shape[0] + side - 1) // side, (depth.shape[1] + side - 1) // side
    for block in range(first, rows * columns, shares):
        v0, u0 = block // columns * side, block % columns * side
        some = False
        for tile in range(_TILES):
            v, u = v0 + tile // _SIDE * _TILE, u0 + tile % _SIDE * _TILE
            seen[tile] = v < depth.shape[0] and u < depth.shape[1] and _depths(depth, v, u, z)
            if seen[tile]:
                some = True
                _place(z, across, u // _TILE, down, v // _TILE, points, boxes, tile, work)
            else:
                _blank(v, u, out, out_f)
        if not some:
            continue
        count = _cull(everyone, everyone.shape[1], _union(boxes, seen), settings, bounds, in_block)
        for i in range(_FIELDS):
            for j in range(count):
                near[i, j] = everyone[i, in_block[j]]
        for tile in range(_TILES):
            if seen[tile]:
                chosen = _cull(near, count, _box(boxes, tile), settings, bounds, in_tile)
                for j in range(chosen):
                    in_tile[j] = in_block[in_tile[j]]
                _sum(points, boxes, tile, in_tile, chosen, view, features, buffer, sums)
                _finish(depth, v0 + tile // _SIDE * _TILE, u0 + tile % _SIDE * _TILE, buffer, sums, out, out_f)


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
    points, boxes, z, work, _, buffer, sums, _, bounds, kept, _ = scratch
    _, _, everyone, _, settings = view
    nan = out.dtype.type(np.nan)
    for block in range(begin.size - 1):
        for low in range(begin[block], begin[block + 1], _PIXELS):
            high = min(low + _PIXELS, begin[block + 1])
            for i in range(_PIXELS):
                p = pixels[order[min(low + i, high - 1)]]
                v, u = p // depth.shape[1], p % depth.shape[1]
                rays[0, i], rays[1, i] = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
                z[i] = depth[v, u] if depth[v, u] > 0 else np.inf
            if _nearest_instead(z):
                _place(z, rays[:1], 0, rays[1:], 0, points, boxes, 0, work)
                count = _cull(everyone, everyone.shape[1], _box(boxes, 0), settings, bounds, kept)
                _sum(points, boxes, 0, kept, count, view, features, buffer, sums)
                _averages(buffer, sums)
            for i in range(high - low):
                to = order[low + i]
                use = depth[pixels[to] // depth.shape[1], pixels[to] % depth.shape[1]] > 0
                out[to] = buffer[_TOTAL + i] if use else nan
                for g in range(sums.shape[0]):
                    out_f[g, to] = sums[g, i] if use else nan


@leaf
def _limit(epsilon, count):
    """log2 of the share of a lower bound that one component may add at one level, a little less for rounding."""
    return math.log2(epsilon / (3 * max(count, 1))) - 0.01


@leaf
def _visible(mean, covariance, index, whitening, log_peak, K, height, width, limit, fields, constants, m, features):
    """Write the fields of the components whose density can exceed 2^limit at a pixel of the image.

    The fields are mean, whitening and log2 of the peak: 2^(peak - |whitening (x - mean)|^2) is the density.
    ``constants`` are the terms of the sum. The indices of these components move to the head of
    ``index``; returns how many there are.
    """
    scale, n = math.sqrt(0.5 * _LOG2_E), 0
    for k in range(index.size):
        square = 2 * (log_peak[k] - limit / _LOG2_E) * (1 + 1e-6)
        if not _meets(mean, covariance, index[k], square, K, height, width):
            continue
        for i in range(3):
            fields[n, i] = mean[index[k], i]
        for i in range(6):
            fields[n, 3 + i] = whitening[k, i] * scale
        fields[n, 9] = log_peak[k] * _LOG2_E
        for i in range(6):
            constants[n, i] = fields[n, 3 + i]
        constants[n, 6], constants[n, 7] = fields[n, 9], m[index[k]]
        constants[n, 8] = features[index[k], features.shape[1] - 1] if features.shape[1] > 0 else 0.0
        index[n] = index[k]
        n += 1
    return n


@leaf
def _meets(mean, covariance, k, square, K, height, width):
    """Whether the ellipsoid (x - mu)^T S^-1 (x - mu) = square can have a point in the view.

    Its silhouette lies between the planes x = s z (and y = s z) that touch it, (mu_x - s mu_z)^2 =
    square (S_xx - 2 s S_xz + s^2 S_zz): a quadratic equation in s. One that reaches z = 0 may be anywhere.
    """
    sxx, syy, szz = covariance[k, 0, 0], covariance[k, 1, 1], covariance[k, 2, 2]
    z = mean[k, 2]
    least = 1e-14 * max(sxx, syy, szz)  # as in prepare
    szz = square * (szz + least)
    a = z * z - szz
    if square <= 0 or (z < 0 and a > 1e-6 * szz):
        return False  # its peak is too low, or it lies behind the camera
    if a <= 1e-6 * szz:
        return True
    for axis in range(2):
        x, sx = mean[k, axis], covariance[k, axis, axis] + least
        half_b = x * z - square * covariance[k, axis, 2]
        root = math.sqrt(max(half_b * half_b - a * (x * x - square * sx), 0.0))
        root += 1e-9 * (abs(half_b) + root)
        p = (half_b - root) / a * K[axis, axis] + K[axis, 2]
        q = (half_b + root) / a * K[axis, axis] + K[axis, 2]
        if max(p, q) < -1 or min(p, q) > (width if axis == 0 else height):
            return False
    return True


@leaf
def _depths(depth, v0, u0, z):
    """Depths [64] of a tile; that of its nearest pixel for one without, or outside of the image.

    Returns False where no pixel has one.
    """
    if v0 + _TILE <= depth.shape[0] and u0 + _TILE <= depth.shape[1]:
        for v in range(_TILE):  # a row as a slice: indices from 0 on need no test for negative ones
            d, row = depth[v0 + v, u0 : u0 + _TILE], z[v * _TILE : (v + 1) * _TILE]
            for u in range(_TILE):
                row[u] = d[u] if d[u] > 0 else np.inf
    else:
        for i in range(_PIXELS):
            v, u = v0 + i // _TILE, u0 + i % _TILE
            use = v < depth.shape[0] and u < depth.shape[1] and depth[v, u] > 0
            z[i] = np.float64(depth[v, u]) if use else np.inf
    return _nearest_instead(z)


@finite
def _nearest_instead(z):
    """Put the least depth in place of infinity; False where all are infinite."""
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

    ``work`` [6, 64] is scratch.
    """
    x, y = across[column], down[row]
    for i in range(_PIXELS):
        work[0, i] = x[i] * z[i]
    for i in range(_PIXELS):
        work[1, i] = y[i] * z[i]
    for i in range(_PIXELS):
        work[2, i] = z[i]
    boxes[tile, 8] = z0 = _extremes(work, boxes, tile)
    boxes[tile, 6] = x0 = 0.5 * (x[0] + x[_PIXELS - 1]) * z0
    boxes[tile, 7] = y0 = 0.5 * (y[0] + y[_PIXELS - 1]) * z0
    for i in range(_PIXELS):
        points[tile, i] = x[i] * z[i] - x0
    for i in range(_PIXELS):
        points[tile, _PIXELS + i] = y[i] * z[i] - y0
    for i in range(_PIXELS):
        points[tile, 2 * _PIXELS + i] = z[i] - z0


@finite
def _extremes(work, boxes, tile):
    """Least and greatest of three rows of 64 numbers, halved until few are left; returns the least of the last."""
    for axis in range(3):
        for i in range(_PIXELS):
            work[3 + axis, i] = work[axis, i]
        half = _PIXELS // 2
        while half >= 4:
            for i in range(half):
                a, b = work[axis, i], work[axis, half + i]
                work[axis, i] = a if a < b else b
            for i in range(half):
                a, b = work[3 + axis, i], work[3 + axis, half + i]
                work[3 + axis, i] = a if a > b else b
            half //= 2
        low, high = work[axis, 0], work[3 + axis, 0]
        for i in range(1, 4):
            low, high = min(low, work[axis, i]), max(high, work[3 + axis, i])
        boxes[tile, axis], boxes[tile, 3 + axis] = low, high
    return boxes[tile, 2]


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
def _bounds(packed, n, centre, half, slack, bounds):
    """log2 of the lower and upper bounds [2, n] of n densities in the box centre +- half.

    ``slack`` times the coordinates bounds the rounding of the distances, and widens the box by it. Infinity and NaN,
    from a far outlier, keep a component and bound nothing.
    """
    cx, cy, cz = centre
    hx, hy, hz = half
    zero, least = slack - slack, packed.dtype.type(-1e30)
    for j in range(n):
        dx, dy, dz = cx - packed[0, j], cy - packed[1, j], cz - packed[2, j]
        wx, wy, wz = hx + slack * abs(packed[0, j]), hy + slack * abs(packed[1, j]), hz + slack * abs(packed[2, j])
        a, b, c, d, e, f = packed[3, j], packed[4, j], packed[5, j], packed[6, j], packed[7, j], packed[8, j]
        y0, r0 = abs(a * dx), a * wx
        y1, r1 = abs(b * dx + c * dy), abs(b) * wx + c * wy
        y2, r2 = abs(d * dx + e * dy + f * dz), abs(d) * wx + abs(e) * wy + f * wz
        p0, p1, p2 = y0 + r0, y1 + r1, y2 + r2
        low = packed[9, j] - (p0 * p0 + p1 * p1 + p2 * p2)
        bounds[0, j] = low if low > least else least
        q0, q1, q2 = y0 - r0, y1 - r1, y2 - r2
        q0, q1, q2 = q0 if q0 > zero else zero, q1 if q1 > zero else zero, q2 if q2 > zero else zero
        bounds[1, j] = packed[9, j] - (q0 * q0 + q1 * q1 + q2 * q2)


@leaf
def _greatest(bounds, n, start):
    """The greatest of ``start`` and n lower bounds."""
    a = b = c = start  # four chains of comparisons, which do not wait for each other
    for j in range(0, n - 3, 4):
        start = bounds[0, j] if bounds[0, j] > start else start
        a = bounds[0, j + 1] if bounds[0, j + 1] > a else a
        b = bounds[0, j + 2] if bounds[0, j + 2] > b else b
        c = bounds[0, j + 3] if bounds[0, j + 3] > c else c
    for j in range(n - n % 4, n):
        start = bounds[0, j] if bounds[0, j] > start else start
    return max(max(start, a), max(b, c))


@leaf
def _cull(packed, n, box, settings, bounds, kept):
    """Write the packed components that matter in the box to ``kept``; return how many."""
    real = packed.dtype.type
    x_low, y_low, z_low, x_high, y_high, z_high = box
    _, _, epsilon, least = settings
    slack = real(16 * np.finfo(packed.dtype).eps)
    cx, cy, cz = 0.5 * (x_low + x_high), 0.5 * (y_low + y_high), 0.5 * (z_low + z_high)
    hx, hy, hz = 0.5 * (x_high - x_low), 0.5 * (y_high - y_low), 0.5 * (z_high - z_low)
    hx, hy, hz = hx + slack * (hx + abs(cx)), hy + slack * (hy + abs(cy)), hz + slack * (hz + abs(cz))
    _bounds(packed, n, (real(cx), real(cy), real(cz)), (real(hx), real(hy), real(hz)), slack, bounds)
    threshold = _greatest(bounds, n, real(least)) + _limit(epsilon, n)
    count = 0
    for j in range(n):
        kept[count] = j
        count += bounds[1, j] > threshold
    return count


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
def _averages(buffer, sums):
    """Divide total and features by the evidence."""
    for i in range(_PIXELS):
        buffer[_TOTAL + i] = buffer[_TOTAL + i] / buffer[_EVIDENCE + i]
    for g in range(sums.shape[0]):
        for i in range(_PIXELS):
            sums[g, i] = sums[g, i] / buffer[_EVIDENCE + i]


@leaf
def _finish(depth, v0, u0, buffer, sums, out, out_f):
    """Write the averages of a tile; NaN without a depth."""
    _averages(buffer, sums)
    _write(depth, v0, u0, buffer[_TOTAL : _TOTAL + _PIXELS], out)
    for g in range(sums.shape[0]):
        _write(depth, v0, u0, sums[g], out_f[g])


@leaf
def _write(depth, v0, u0, values, out):
    """The values [64] of a tile into a map."""
    nan = out.dtype.type(np.nan)
    if v0 + _TILE <= out.shape[0] and u0 + _TILE <= out.shape[1]:
        for v in range(_TILE):
            to, d = out[v0 + v, u0 : u0 + _TILE], depth[v0 + v, u0 : u0 + _TILE]
            row = values[v * _TILE : (v + 1) * _TILE]
            for u in range(_TILE):
                value = row[u]
                to[u] = value if d[u] > 0 else nan
    else:
        for v in range(v0, min(v0 + _TILE, out.shape[0])):
            for u in range(u0, min(u0 + _TILE, out.shape[1])):
                out[v, u] = values[(v - v0) * _TILE + u - u0] if depth[v, u] > 0 else nan
