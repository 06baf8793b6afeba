"""The exact sum of the regression at every pixel on the CPU (numba), with culling in three levels.

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

Points are taken relative to the nearest point of their tile, so that float32 loses nothing to the distance from the
camera, nor to a far outlier in the tile. Densities are powers of two: log2(e)/2 is part of the whitening.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import types
from numba.extending import overload, register_jitable

from ufmstar_torch.kernels.compile_cpu import kernel, part
from ufmstar_torch.kernels.regress_points_cpu import prepare

# Multiply and add joined where the processor can: one rounding less, not one more.
contracted: Any = register_jitable(error_model="numpy", fastmath={"contract"})

_TILE = 8  # pixels
_PIXELS = _TILE * _TILE
_SIDE = 4  # tiles of a block
_PRIOR = 1e-3  # share of the prior in a threshold
_FIELDS = 10  # of a component: mean (3), whitening (6), log2 of the peak
_LOG2_E = math.log2(math.e)
# Rows of a tile's buffer, each of 64 numbers.
_X, _Y, _Z, _EVIDENCE, _TOTAL, _FIRST, _SECOND = (i * _PIXELS for i in range(7))


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
        # Below 2^-100 it is 0: products with numbers too small for normal floats take a hundred times as long.
        some = t > np.float32(-100.0)
        t = t if some else np.float32(-100.0)
        n = np.float32(t + np.float32(12582912.0))
        r = t - (n - np.float32(12582912.0))
        p = np.float32(0.00132764718)
        p = p * r + np.float32(0.00967554133)
        p = p * r + np.float32(0.0555071327)
        p = p * r + np.float32(0.240221197)
        p = p * r + np.float32(0.693146967)
        p = np.float32(p * r + np.float32(1.00000007))
        power = np.int32((n.view(np.int32) << np.int32(23)) + p.view(np.int32))
        return power.view(np.float32) if some else np.float32(0.0)

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
    side = _TILE * _SIDE
    rows, columns = (height + side - 1) // side, (width + side - 1) // side
    points, boxes = np.empty((_SIDE * _SIDE, 3, _PIXELS)), np.empty((_SIDE * _SIDE, 2, 3))
    seen = np.empty(_SIDE * _SIDE, np.bool_)
    buffer, sums = np.empty(7 * _PIXELS, out.dtype), np.empty((features.shape[1], _PIXELS), out.dtype)
    coefficient, least = np.empty(22, out.dtype), math.log2(_PRIOR * prior_weight)
    index, whitening, log_peak = prepare(mean, covariance, weight)
    limit = _limit(epsilon, index.size) + least
    index, fields = _visible(mean, covariance, index, whitening, log_peak, K, height, width, limit)
    rays = _rays(K, height, width)
    everyone, near = np.empty((_FIELDS, index.size), out.dtype), np.empty((_FIELDS, index.size), out.dtype)
    bounds = np.empty((2, index.size), out.dtype)
    in_block, in_tile = np.empty(index.size, np.int64), np.empty(index.size, np.int64)
    for i in range(_FIELDS):
        for k in range(index.size):
            everyone[i, k] = fields[k, i]
    for block in range(first, rows * columns, shares):
        v0, u0 = block // columns * side, block % columns * side
        if not _points(depth, valid, rays, v0, u0, points, boxes, seen):
            _blank(v0, u0, side, out, out_f)
            continue
        low, high = _union(boxes, seen)
        n = _cull(everyone, index.size, low, high, epsilon, least, bounds, in_block)
        for i in range(_FIELDS):
            for j in range(n):
                near[i, j] = everyone[i, in_block[j]]
        for tile in range(_SIDE * _SIDE):
            v, u = v0 + tile // _SIDE * _TILE, u0 + tile % _SIDE * _TILE
            if not seen[tile]:
                _blank(v, u, _TILE, out, out_f)
                continue
            count = _cull(near, n, boxes[tile, 0], boxes[tile, 1], epsilon, least, bounds, in_tile)
            for j in range(count):
                in_tile[j] = in_block[in_tile[j]]
            _sum(
                points[tile], boxes[tile, 0, 2], in_tile, count, index, fields, m, features,
                prior_weight, prior_mean, buffer, sums, coefficient,
            )  # fmt: skip
            _finish(valid, v, u, buffer, sums, out, out_f)


@part
def _limit(epsilon, count):
    """log2 of the share of a lower bound that one component may add at one level, a little less for rounding."""
    return math.log2(epsilon / (3 * max(count, 1))) - 0.01


@part
def _visible(mean, covariance, index, whitening, log_peak, K, height, width, limit):
    """Index and fields [K, 10] of the components whose density can exceed 2^limit at a pixel of the image.

    The fields are mean, whitening and log2 of the peak: 2^(peak - |whitening (x - mean)|^2) is the density.
    """
    fields, chosen = np.empty((index.size, _FIELDS)), np.empty(index.size, np.int64)
    scale, n = math.sqrt(0.5 * _LOG2_E), 0
    for k in range(index.size):
        square = 2 * (log_peak[k] - limit / _LOG2_E) * (1 + 1e-6)
        if not _meets(mean[index[k]], covariance[index[k]], square, K, height, width):
            continue
        for i in range(3):
            fields[n, i] = mean[index[k], i]
        for i in range(6):
            fields[n, 3 + i] = whitening[k, i] * scale
        fields[n, 9] = log_peak[k] * _LOG2_E
        chosen[n] = index[k]
        n += 1
    return chosen[:n], fields[:n]


@part
def _meets(mu, S, square, K, height, width):
    """Whether the ellipsoid (x - mu)^T S^-1 (x - mu) = square can have a point in the view.

    Its silhouette lies between the planes x = s z (and y = s z) that touch it, (mu_x - s mu_z)^2 =
    square (S_xx - 2 s S_xz + s^2 S_zz): a quadratic equation in s. One that reaches z = 0 may be anywhere.
    """
    least = 1e-14 * max(S[0, 0], S[1, 1], S[2, 2])  # as in prepare
    szz = square * (S[2, 2] + least)
    a = mu[2] * mu[2] - szz
    if square <= 0 or (mu[2] < 0 and a > 1e-6 * szz):
        return False  # its peak is too low, or it lies behind the camera
    if a <= 1e-6 * szz:
        return True
    for axis in range(2):
        half_b = mu[axis] * mu[2] - square * S[axis, 2]
        root = math.sqrt(max(half_b * half_b - a * (mu[axis] * mu[axis] - square * (S[axis, axis] + least)), 0.0))
        root += 1e-9 * (abs(half_b) + root)
        p = (half_b - root) / a * K[axis, axis] + K[axis, 2]
        q = (half_b + root) / a * K[axis, axis] + K[axis, 2]
        if max(p, q) < -1 or min(p, q) > (width if axis == 0 else height):
            return False
    return True


@part
def _rays(K, height, width):
    """x/z of every column and y/z of every row."""
    across, down = np.empty(width), np.empty(height)
    for u in range(width):
        across[u] = (u - K[0, 2]) / K[0, 0]
    for v in range(height):
        down[v] = (v - K[1, 2]) / K[1, 1]
    return across, down


@part
def _points(depth, valid, rays, v_low, u_low, points, boxes, seen):
    """Points [16, 3, 64] of the tiles of a block and their bounding boxes [16, 2, 3]; False where no pixel is valid.

    A pixel that is not valid, or outside of the image, takes the place of a valid one; ``seen`` [16] is False for a
    tile without any.
    """
    some = False
    for tile in range(_SIDE * _SIDE):
        v0, u0 = v_low + tile // _SIDE * _TILE, u_low + tile % _SIDE * _TILE
        v1, u1 = min(v0 + _TILE, depth.shape[0]), min(u0 + _TILE, depth.shape[1])
        seen[tile] = False
        for v in range(v0, v1):
            for u in range(u0, u1):
                if valid[v, u] and not seen[tile]:
                    seen[tile] = True
                    z = np.float64(depth[v, u])
                    first = (rays[0][u] * z, rays[1][v] * z, z)
            if seen[tile]:
                break
        if seen[tile]:
            some = True
            _place(depth, valid, rays, v0, v1, u0, u1, first, points[tile], boxes[tile])
    return some


@part
def _place(depth, valid, rays, v0, v1, u0, u1, first, points, box):
    """The points [3, 64] of one tile and their bounding box [2, 3]; ``first`` is the point of its first valid pixel."""
    x, y, z = points[0], points[1], points[2]
    across, down = rays
    x0, y0, z0 = first
    x_low, y_low, z_low = first
    x_high, y_high, z_high = first
    if v1 - v0 < _TILE or u1 - u0 < _TILE:
        for i in range(_PIXELS):
            x[i], y[i], z[i] = x0, y0, z0
    for v in range(v0, v1):
        i = (v - v0) * _TILE
        for u in range(u0, u1):
            d = np.float64(depth[v, u])
            ok = valid[v, u]
            px, py, pz = across[u] * d if ok else x0, down[v] * d if ok else y0, d if ok else z0
            x[i], y[i], z[i] = px, py, pz
            x_low, x_high = px if px < x_low else x_low, px if px > x_high else x_high
            y_low, y_high = py if py < y_low else y_low, py if py > y_high else y_high
            z_low, z_high = pz if pz < z_low else z_low, pz if pz > z_high else z_high
            i += 1
    box[0, 0], box[0, 1], box[0, 2] = x_low, y_low, z_low
    box[1, 0], box[1, 1], box[1, 2] = x_high, y_high, z_high


@part
def _union(boxes, seen):
    """The least and the greatest corner of the boxes of the tiles that are seen."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for tile in range(seen.size):
        if seen[tile]:
            for i in range(3):
                low[i], high[i] = min(low[i], boxes[tile, 0, i]), max(high[i], boxes[tile, 1, i])
    return low, high


@part
def _blank(v_low, u_low, side, out, out_f):
    """NaN at the pixels of a patch."""
    for v in range(v_low, min(v_low + side, out.shape[0])):
        for u in range(u_low, min(u_low + side, out.shape[1])):
            out[v, u] = np.nan
            for g in range(out_f.shape[0]):
                out_f[g, v, u] = np.nan


@contracted
def _bounds(packed, n, centre, half, slack, lower, upper):
    """log2 of the bounds of n densities in the box centre +- half.

    ``slack`` times the coordinates bounds the rounding of the distances, and widens the box by it. Infinity and NaN,
    from a far outlier, keep a component and bound nothing.
    """
    mx, my, mz, a, b, c = packed[0], packed[1], packed[2], packed[3], packed[4], packed[5]
    d, e, f, peak = packed[6], packed[7], packed[8], packed[9]
    cx, cy, cz = centre
    hx, hy, hz = half
    zero, least = slack - slack, peak.dtype.type(-1e30)
    for j in range(n):
        dx, dy, dz = cx - mx[j], cy - my[j], cz - mz[j]
        wx, wy, wz = hx + slack * abs(mx[j]), hy + slack * abs(my[j]), hz + slack * abs(mz[j])
        y0, r0 = abs(a[j] * dx), a[j] * wx
        y1, r1 = abs(b[j] * dx + c[j] * dy), abs(b[j]) * wx + c[j] * wy
        y2, r2 = abs(d[j] * dx + e[j] * dy + f[j] * dz), abs(d[j]) * wx + abs(e[j]) * wy + f[j] * wz
        p0, p1, p2 = y0 + r0, y1 + r1, y2 + r2
        low = peak[j] - (p0 * p0 + p1 * p1 + p2 * p2)
        lower[j] = low if low > least else least
        q0, q1, q2 = y0 - r0, y1 - r1, y2 - r2
        q0, q1, q2 = q0 if q0 > zero else zero, q1 if q1 > zero else zero, q2 if q2 > zero else zero
        upper[j] = peak[j] - (q0 * q0 + q1 * q1 + q2 * q2)


@part
def _greatest(values, n, start):
    """The greatest of ``start`` and n values without NaN."""
    a = b = c = start  # four chains of comparisons, which do not wait for each other
    for j in range(0, n - 3, 4):
        start = values[j] if values[j] > start else start
        a = values[j + 1] if values[j + 1] > a else a
        b = values[j + 2] if values[j + 2] > b else b
        c = values[j + 3] if values[j + 3] > c else c
    for j in range(n - n % 4, n):
        start = values[j] if values[j] > start else start
    return max(max(start, a), max(b, c))


@part
def _cull(packed, n, low, high, epsilon, least, bounds, kept):
    """Write the packed components that matter in the box from low to high to ``kept``; return how many."""
    real = packed.dtype.type
    slack = real(16 * np.finfo(packed.dtype).eps)
    cx, cy, cz = 0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), 0.5 * (low[2] + high[2])
    hx, hy, hz = 0.5 * (high[0] - low[0]), 0.5 * (high[1] - low[1]), 0.5 * (high[2] - low[2])
    hx, hy, hz = hx + slack * (hx + abs(cx)), hy + slack * (hy + abs(cy)), hz + slack * (hz + abs(cz))
    _bounds(packed, n, (real(cx), real(cy), real(cz)), (real(hx), real(hy), real(hz)), slack, bounds[0], bounds[1])
    threshold = _greatest(bounds[0], n, real(least)) + _limit(epsilon, n)
    count = 0
    for j in range(n):
        kept[count] = j
        count += bounds[1, j] > threshold
    return count


@contracted
def _add_two(coefficient, buffer):
    """Add two components to 64 points: their densities to the row of evidence, times m to that of the total.

    coefficient: for each one the fields relative to the points' origin (10), and m.
    """
    ax, ay, az, a0, a1, a2 = (
        coefficient[0], coefficient[1], coefficient[2], coefficient[3], coefficient[4], coefficient[5]
    )  # fmt: skip
    a3, a4, a5, a_peak, a_m = coefficient[6], coefficient[7], coefficient[8], coefficient[9], coefficient[10]
    bx, by, bz, b0, b1, b2 = (
        coefficient[11], coefficient[12], coefficient[13], coefficient[14], coefficient[15], coefficient[16]
    )  # fmt: skip
    b3, b4, b5, b_peak, b_m = coefficient[17], coefficient[18], coefficient[19], coefficient[20], coefficient[21]
    for i in range(_PIXELS):
        x, y, z = buffer[_X + i], buffer[_Y + i], buffer[_Z + i]
        dx, dy, dz = x - ax, y - ay, z - az
        y0, y1, y2 = a0 * dx, a1 * dx + a2 * dy, a3 * dx + a4 * dy + a5 * dz
        p = exp2_(a_peak - (y0 * y0 + y1 * y1 + y2 * y2))
        dx, dy, dz = x - bx, y - by, z - bz
        y0, y1, y2 = b0 * dx, b1 * dx + b2 * dy, b3 * dx + b4 * dy + b5 * dz
        q = exp2_(b_peak - (y0 * y0 + y1 * y1 + y2 * y2))
        buffer[_EVIDENCE + i] = buffer[_EVIDENCE + i] + (p + q)
        buffer[_TOTAL + i] = buffer[_TOTAL + i] + (p * a_m + q * b_m)
        buffer[_FIRST + i] = p
        buffer[_SECOND + i] = q


@contracted
def _add_feature(first, second, buffer, row):
    """Add what two components' densities, as :func:`_add_two` left them, add to the sum of one feature."""
    for i in range(_PIXELS):
        row[i] += buffer[_FIRST + i] * first + buffer[_SECOND + i] * second


@part
def _sum(points, least, chosen, count, index, fields, m, features, prior_weight, prior_mean, buffer, sums, coefficient):
    """Evidence, total and sums of the features [F, 64] at the points of a tile, over ``chosen`` components.

    ``least`` is the depth of the nearest point.
    """
    real = buffer.dtype.type
    nearest = _start(points, least, prior_weight, prior_mean, buffer, sums)
    x, y, z = points[0, nearest], points[1, nearest], points[2, nearest]
    for j in range(0, count, 2):
        a, b = chosen[j], chosen[min(j + 1, count - 1)]
        coefficient[0], coefficient[1], coefficient[2] = fields[a, 0] - x, fields[a, 1] - y, fields[a, 2] - z
        coefficient[11], coefficient[12], coefficient[13] = fields[b, 0] - x, fields[b, 1] - y, fields[b, 2] - z
        for i in range(3, _FIELDS):
            coefficient[i], coefficient[11 + i] = fields[a, i], fields[b, i]
        coefficient[10], coefficient[21] = m[index[a]], m[index[b]]
        if j + 1 == count:
            coefficient[20] = -1e4  # an odd one is not counted twice
        _add_two(coefficient, buffer)
        for g in range(sums.shape[0]):
            _add_feature(real(features[index[a], g]), real(features[index[b], g]), buffer, sums[g])


@part
def _start(points, least, prior_weight, prior_mean, buffer, sums):
    """Fill the buffer with the points relative to the nearest one, whose number is returned, and with the prior."""
    nearest = 0
    while nearest < _PIXELS - 1 and points[2, nearest] != least:
        nearest += 1
    x, y, z = points[0, nearest], points[1, nearest], points[2, nearest]
    total = prior_weight * prior_mean
    for i in range(_PIXELS):
        buffer[_X + i], buffer[_Y + i], buffer[_Z + i] = points[0, i] - x, points[1, i] - y, points[2, i] - z
        buffer[_EVIDENCE + i], buffer[_TOTAL + i] = prior_weight, total
    for g in range(sums.shape[0]):
        for i in range(_PIXELS):
            sums[g, i] = 0
    return nearest


@part
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
                out_f[g, v, u] = sums[g, i] / buffer[_EVIDENCE + i] if valid[v, u] else nan
