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
_TERMS = 12  # of a component beside a tile: whitening (6), whitened offset (3), log2 of the peak, m, last feature
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
def exact(
    depth, valid, K, mean, covariance, weight, m, features, prior_weight, prior_mean, epsilon, out, out_f, first, shares
):
    """One stream; of its blocks every ``shares``-th, from ``first`` on.

    depth [H, W], valid [H, W], K [3, 3] and the mixture [K, ...] into out [H, W] and out_f [F, H, W]; NaN where not
    valid.
    """
    height, width = depth.shape
    index, whitening, log_peak = prepare(mean, covariance, weight)
    least = math.log2(_PRIOR * prior_weight)
    fields, packed = np.empty((index.size, _FIELDS)), np.empty((_FIELDS, index.size), out.dtype)
    n = _visible(
        mean, covariance, index, whitening, log_peak, K, height, width, _limit(epsilon, index.size) + least, fields,
        packed,
    )  # fmt: skip
    columns, rows = (width + _TILE - 1) // _TILE, (height + _TILE - 1) // _TILE
    across, down = np.empty((columns, _PIXELS)), np.empty((rows, _PIXELS))
    for i in range(columns * _PIXELS):
        across[i // _PIXELS, i % _PIXELS] = (i // _PIXELS * _TILE + i % _TILE - K[0, 2]) / K[0, 0]
    for i in range(rows * _PIXELS):
        down[i // _PIXELS, i % _PIXELS] = (i // _PIXELS * _TILE + i % _PIXELS // _TILE - K[1, 2]) / K[1, 1]
    _blocks(
        depth, valid, across, down, index, n, fields, packed, np.empty((_FIELDS, n), out.dtype), m, features,
        (prior_weight, prior_mean, epsilon, least), *_scratch(n, out.dtype.type(0), out_f), out, out_f, first, shares,
    )  # fmt: skip


@kernel
def exact_at(
    depth, valid, K, pixels, mean, covariance, weight, m, features, prior_weight, prior_mean, epsilon, out, out_f
):
    """One stream at some pixels [n], indices into the flattened image, into out [n] and out_f [F, n]."""
    height, width = depth.shape
    index, whitening, log_peak = prepare(mean, covariance, weight)
    least = math.log2(_PRIOR * prior_weight)
    fields, packed = np.empty((index.size, _FIELDS)), np.empty((_FIELDS, index.size), out.dtype)
    n = _visible(
        mean, covariance, index, whitening, log_peak, K, height, width, _limit(epsilon, index.size) + least, fields,
        packed,
    )  # fmt: skip
    side = _TILE * _SIDE
    columns, rows = (width + side - 1) // side, (height + side - 1) // side
    begin, order = np.zeros(rows * columns + 1, np.int64), np.empty(pixels.size, np.int64)
    _by_block(pixels, width, columns, begin, order)
    _at_pixels(
        depth, valid, K, pixels, begin, order, np.empty((2, _PIXELS)), index, n, fields, packed, m, features,
        (prior_weight, prior_mean, epsilon, least), *_scratch(n, out.dtype.type(0), out_f), out, out_f,
    )  # fmt: skip


@part
def _scratch(n, zero, out_f):
    """Memory for what is in work on a block, with n components: the points [16, 192] of its tiles, the tiles' boxes and
    origins [16, 9], depths, whether a tile has a pixel, buffer, sums of features, terms, bounds and two lists."""
    real = np.array([zero])
    return (
        np.empty((_TILES, 3 * _PIXELS), real.dtype), np.empty((_TILES, 9)), np.empty(_PIXELS),
        np.empty(_TILES, np.bool_),
        np.empty(8 * _PIXELS, real.dtype), np.empty((out_f.shape[0], _PIXELS), real.dtype),
        np.empty((n + 1, _TERMS), real.dtype), np.empty((2, n), real.dtype), np.empty(n, np.int64),
        np.empty(n, np.int64),
    )  # fmt: skip


@leaf
def _blocks(
    depth, valid, across, down, index, n, fields, everyone, near, m, features, settings, points, boxes, z, seen, buffer,
    sums, terms, bounds, in_block, in_tile, out, out_f, first, shares,
):  # fmt: skip
    """The blocks of an image, of which every ``shares``-th is done, from ``first`` on."""
    side = _TILE * _SIDE
    rows, columns = (depth.shape[0] + side - 1) // side, (depth.shape[1] + side - 1) // side
    for block in range(first, rows * columns, shares):
        v0, u0 = block // columns * side, block % columns * side
        some = False
        for tile in range(_TILES):
            v, u = v0 + tile // _SIDE * _TILE, u0 + tile % _SIDE * _TILE
            seen[tile] = v < depth.shape[0] and u < depth.shape[1] and _depths(depth, valid, v, u, z)
            if seen[tile]:
                some = True
                _place(z, across, u // _TILE, down, v // _TILE, points, boxes, tile)
            else:
                _blank(v, u, out, out_f)
        if not some:
            continue
        count = _cull(everyone, n, _union(boxes, seen), settings, bounds, in_block)
        for i in range(_FIELDS):
            for j in range(count):
                near[i, j] = everyone[i, in_block[j]]
        for tile in range(_TILES):
            if seen[tile]:
                chosen = _cull(near, count, _box(boxes, tile), settings, bounds, in_tile)
                for j in range(chosen):
                    in_tile[j] = in_block[in_tile[j]]
                _sum(points, boxes, tile, in_tile, chosen, index, fields, m, features, settings, buffer, sums, terms)
                v, u = v0 + tile // _SIDE * _TILE, u0 + tile % _SIDE * _TILE
                _finish(valid, v, u, buffer, sums, out, out_f)


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
def _at_pixels(
    depth, valid, K, pixels, begin, order, rays, index, n, fields, everyone, m, features, settings, points, boxes, z,
    seen, buffer, sums, terms, bounds, kept, unused, out, out_f,
):  # fmt: skip
    """The blocks of an image at some pixels."""
    nan = out.dtype.type(np.nan)
    for block in range(begin.size - 1):
        for low in range(begin[block], begin[block + 1], _PIXELS):
            some = False
            high = min(low + _PIXELS, begin[block + 1])
            for i in range(_PIXELS):
                p = pixels[order[min(low + i, high - 1)]]
                v, u = p // depth.shape[1], p % depth.shape[1]
                rays[0, i], rays[1, i] = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
                z[i] = depth[v, u] if valid[v, u] else np.inf
                some = some or valid[v, u]
            if some:
                _nearest_instead(z)
                _place(z, rays[:1], 0, rays[1:], 0, points, boxes, 0)
                count = _cull(everyone, n, _box(boxes, 0), settings, bounds, kept)
                _sum(points, boxes, 0, kept, count, index, fields, m, features, settings, buffer, sums, terms)
                for i in range(_PIXELS):
                    buffer[_TOTAL + i] = buffer[_TOTAL + i] / buffer[_EVIDENCE + i]
            for i in range(high - low):
                p, to = pixels[order[low + i]], order[low + i]
                use = valid[p // depth.shape[1], p % depth.shape[1]]
                out[to] = buffer[_TOTAL + i] if use else nan
                for g in range(sums.shape[0]):
                    out_f[g, to] = sums[g, i] / buffer[_EVIDENCE + i] if use else nan


@leaf
def _limit(epsilon, count):
    """log2 of the share of a lower bound that one component may add at one level, a little less for rounding."""
    return math.log2(epsilon / (3 * max(count, 1))) - 0.01


@leaf
def _visible(mean, covariance, index, whitening, log_peak, K, height, width, limit, fields, packed):
    """Fields [K, 10] and, packed, [10, K] of the components whose density can exceed 2^limit at a pixel of the image.

    The fields are mean, whitening and log2 of the peak: 2^(peak - |whitening (x - mean)|^2) is the density. The indices
    of these components move to the head of ``index``; returns how many there are.
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
        for i in range(_FIELDS):
            packed[i, n] = fields[n, i]
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
def _depths(depth, valid, v0, u0, z):
    """Depths [64] of a tile; that of its nearest valid pixel for one that is not, or outside of the image.

    Returns False where no pixel is valid.
    """
    some = False
    if v0 + _TILE <= depth.shape[0] and u0 + _TILE <= depth.shape[1]:
        for v in range(_TILE):
            for u in range(_TILE):
                use = valid[v0 + v, u0 + u]
                z[v * _TILE + u] = np.float64(depth[v0 + v, u0 + u]) if use else np.inf
                some |= use
    else:
        for i in range(_PIXELS):
            v, u = v0 + i // _TILE, u0 + i % _TILE
            use = v < depth.shape[0] and u < depth.shape[1] and valid[v, u]
            z[i] = np.float64(depth[v, u]) if use else np.inf
            some |= use
    if some:
        _nearest_instead(z)
    return some


@finite
def _nearest_instead(z):
    """The least depth in place of infinity."""
    least = np.inf
    for i in range(_PIXELS):
        least = z[i] if z[i] < least else least
    for i in range(_PIXELS):
        z[i] = z[i] if z[i] < np.inf else least


@finite
def _place(z, across, column, down, row, points, boxes, tile):
    """The points [3, 64] of a tile, relative to its origin, its bounding box (low, high) and its origin."""
    x_low = y_low = z_low = np.inf
    x_high = y_high = z_high = -np.inf
    for i in range(_PIXELS):
        x, y = across[column, i] * z[i], down[row, i] * z[i]
        x_low, x_high = x if x < x_low else x_low, x if x > x_high else x_high
        y_low, y_high = y if y < y_low else y_low, y if y > y_high else y_high
        z_low, z_high = z[i] if z[i] < z_low else z_low, z[i] if z[i] > z_high else z_high
    x0 = 0.5 * (across[column, 0] + across[column, _PIXELS - 1]) * z_low
    y0 = 0.5 * (down[row, 0] + down[row, _PIXELS - 1]) * z_low
    for i in range(_PIXELS):
        points[tile, i], points[tile, _PIXELS + i] = across[column, i] * z[i] - x0, down[row, i] * z[i] - y0
        points[tile, 2 * _PIXELS + i] = z[i] - z_low
    boxes[tile, 0], boxes[tile, 1], boxes[tile, 2] = x_low, y_low, z_low
    boxes[tile, 3], boxes[tile, 4], boxes[tile, 5] = x_high, y_high, z_high
    boxes[tile, 6], boxes[tile, 7], boxes[tile, 8] = x0, y0, z_low


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
def _add_two(terms, j, buffer):
    """Add two components to 64 points: their densities to the row of evidence, times m to that of the total, and times
    the last feature to that of the last."""
    a0, a1, a2, a3, a4, a5 = terms[j, 0], terms[j, 1], terms[j, 2], terms[j, 3], terms[j, 4], terms[j, 5]
    ax, ay, az, a_peak, a_m, a_f = terms[j, 6], terms[j, 7], terms[j, 8], terms[j, 9], terms[j, 10], terms[j, 11]
    k = j + 1
    b0, b1, b2, b3, b4, b5 = terms[k, 0], terms[k, 1], terms[k, 2], terms[k, 3], terms[k, 4], terms[k, 5]
    bx, by, bz, b_peak, b_m, b_f = terms[k, 6], terms[k, 7], terms[k, 8], terms[k, 9], terms[k, 10], terms[k, 11]
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
def _sum(points, boxes, tile, chosen, count, index, fields, m, features, settings, buffer, sums, terms):
    """Evidence, total and sums of the features [F, 64] at the points of a tile, over ``chosen`` components."""
    real = buffer.dtype.type
    prior_weight, prior_mean, _, _ = settings
    prior, total, last = real(prior_weight), real(prior_weight * prior_mean), sums.shape[0] - 1
    for i in range(3 * _PIXELS):
        buffer[_X + i] = points[tile, i]
    for i in range(_PIXELS):
        buffer[_EVIDENCE + i], buffer[_TOTAL + i], buffer[_LAST + i] = prior, total, real(0)
    for g in range(last):
        for i in range(_PIXELS):
            sums[g, i] = 0
    x, y, z = boxes[tile, 6], boxes[tile, 7], boxes[tile, 8]
    for j in range(count):
        _terms(fields, chosen[j], x, y, z, m, features, index, last, terms, j)
    if count % 2 == 1:
        for i in range(_TERMS):
            terms[count, i] = 0
        terms[count, 9] = -1e4  # an odd one has no companion
    for j in range(0, count, 2):
        _add_two(terms, j, buffer)
        for g in range(last):
            a, b = index[chosen[j]], index[chosen[min(j + 1, count - 1)]]
            _add_feature(real(features[a, g]), real(features[b, g]), buffer, sums, g)
    if last >= 0:
        for i in range(_PIXELS):
            sums[last, i] = buffer[_LAST + i]


@leaf
def _terms(fields, k, x, y, z, m, features, index, last, terms, j):
    """Write what :func:`_add_two` needs of component k, with points relative to (x, y, z), to row j."""
    dx, dy, dz = x - fields[k, 0], y - fields[k, 1], z - fields[k, 2]
    for i in range(6):
        terms[j, i] = fields[k, 3 + i]
    terms[j, 6] = fields[k, 3] * dx
    terms[j, 7] = fields[k, 4] * dx + fields[k, 5] * dy
    terms[j, 8] = fields[k, 6] * dx + fields[k, 7] * dy + fields[k, 8] * dz
    terms[j, 9], terms[j, 10] = fields[k, 9], m[index[k]]
    terms[j, 11] = features[index[k], last] if last >= 0 else 0.0


@leaf
def _finish(valid, v0, u0, buffer, sums, out, out_f):
    """Write the averages of a tile; NaN where not valid."""
    nan = out.dtype.type(np.nan)
    for i in range(_PIXELS):
        buffer[_TOTAL + i] = buffer[_TOTAL + i] / buffer[_EVIDENCE + i]
    for v in range(v0, min(v0 + _TILE, out.shape[0])):
        for u in range(u0, min(u0 + _TILE, out.shape[1])):
            i = (v - v0) * _TILE + u - u0
            out[v, u] = buffer[_TOTAL + i] if valid[v, u] else nan
    for g in range(sums.shape[0]):
        for i in range(_PIXELS):
            sums[g, i] = sums[g, i] / buffer[_EVIDENCE + i]
        for v in range(v0, min(v0 + _TILE, out.shape[0])):
            for u in range(u0, min(u0 + _TILE, out.shape[1])):
                out_f[g, v, u] = sums[g, (v - v0) * _TILE + u - u0] if valid[v, u] else nan
