"""The inner loops of the regression over tiles, as vector instructions (``vectors``); compiled code calls them."""

from __future__ import annotations

import functools
import math

from ufmstar_torch.kernels.cpu.vectors import Lanes, vectors

TILE = 8  # pixels, the side of a tile
PIXELS = TILE * TILE
TERMS = 11  # of a component: whitening (6), log2 of the peak, m, the last three features from the last on
# Sums of features of any magnitude start from TINY, which is subtracted at the end: without it, the product of a small
# feature and the density of a far component can be subnormal, which slows an addition down a hundred times. It rounds
# off 1e-7 of TINY.
TINY = 2.0**-100


def _rows(code, at, stride):
    """For each vector of a tile: its first pixel, and where its rows begin in an image whose tile begins at ``at``."""
    for pixel in range(0, PIXELS, code.lanes):
        rows = range(pixel // TILE, (pixel + code.lanes) // TILE)
        yield pixel, [code.plus(at, code.times(stride, row)) for row in rows]


@vectors
def read_tile(code, image, at, stride, values):
    """Copy the pixels of a tile, which begins at the index ``at`` of an image of width ``stride``, to values [64]."""
    for pixel, starts in _rows(code, at, stride):
        values.store(image.load_rows(starts, TILE), pixel)


@vectors
def write_tile(code, values, image, at, stride):
    """Inverse of :func:`read_tile`."""
    for pixel, starts in _rows(code, at, stride):
        image.store_rows(values.load(pixel), starts, TILE)


@vectors
def largest(code, values, n, most):
    """Raise the first number of ``most`` to the largest of the first n values, a multiple of ``LANES``."""
    best = code.variable(most.one(0))
    with code.loop(n, code.lanes) as i:
        best.value = values.load(i).at_least(best.value)
    most.put(best.value.everywhere(Lanes.at_least), 0)


@vectors
def place_points(code, z, grid, ray, points, hole, box):
    """Write the points of a tile from its origin, the middle of the tile at the least depth.

    Args:
        z: [64] depths; where one is not positive, the pixel is a hole and gets the least depth.
        grid: [2, 64] the pixels' rays less the ray through the middle.
        ray: [2] the ray through the middle, at z = 1.
        points: [3, 64] x, y and z.
        hole: [64] NaN where there is a hole, else 0.
        box: [7] the least x, y and z, the greatest, and the least depth: infinite where all are holes.
    """
    rows, ray_x, ray_y = range(0, PIXELS, code.lanes), ray.one(0), ray.one(1)
    depths = [z.load(row) for row in rows]
    filled = [(depth > 0.0).select(depth, math.inf) for depth in depths]
    least = functools.reduce(Lanes.at_most, filled).everywhere(Lanes.at_most)
    columns: list[list[Lanes]] = [[], [], []]
    for row, depth in zip(rows, depths, strict=True):
        seen = depth > 0.0
        hole.store(seen.select(depth - depth, math.nan), row)
        full = seen.select(depth, least)
        deeper = full - least
        point = grid.load(row) * full + ray_x * deeper, grid.load(row, PIXELS) * full + ray_y * deeper, deeper
        for axis, value in enumerate(point):
            points.store(value, row, axis * PIXELS)
            columns[axis].append(value)
    for axis, values in enumerate(columns):
        box.put(functools.reduce(Lanes.at_most, values).everywhere(Lanes.at_most), axis)
        box.put(functools.reduce(Lanes.at_least, values).everywhere(Lanes.at_least), 3 + axis)
    box.put(least, 6)


@vectors
def bounds(code, packed, stride, n, box, upper):
    """log2 of upper bounds of densities in a box of points, and of the greatest lower bounds of a density and of a
    density times m.

    Infinity and NaN, from a far outlier, retain a component and raise no lower bound.

    Args:
        packed: [11, stride] the components' fields: mean, whitening, log2 of the peak and of m.
        n: number of components, a multiple of a vector's length.
        box: [9] its centre, half its sides, the relative rounding error of a distance, which widens the box, and the
            least lower bounds, which the greatest lower bounds replace.
        upper: [n].
    """
    centre, half = [box.one(i) for i in range(3)], [box.one(3 + i) for i in range(3)]
    slack, greatest, greatest_product = box.one(6), code.variable(box.one(7)), code.variable(box.one(8))
    with code.loop(n, code.lanes) as j:
        fields = [packed.load(code.plus(j, code.times(stride, i))) for i in range(11)]
        mean, (a, b, c, d, e, f), peak = fields[:3], fields[3:9], fields[9]
        x, y, z = (centre[i] - mean[i] for i in range(3))
        u, v, w = (half[i] + slack * mean[i].size() for i in range(3))
        middle = (a * x).size(), (b * x + c * y).size(), (d * x + (e * y + f * z)).size()
        reach = a * u, b.size() * u + c * v, d.size() * u + (e.size() * v + f * w)
        low = high = peak
        for m, r in zip(middle, reach, strict=True):
            far, near = m + r, (m - r).at_least(0.0)
            low, high = low - far * far, high - near * near
        greatest.value = low.at_least(greatest.value)
        greatest_product.value = (low + fields[10]).at_least(greatest_product.value)
        upper.store(high, j)
    box.put(greatest.value.everywhere(Lanes.at_least), 7)
    box.put(greatest_product.value.everywhere(Lanes.at_least), 8)


@vectors
def mix(code, terms, chosen, offsets, count, points, points_used, start, hole, sums, densities, keep):
    """Averages of m and of the last feature (:func:`_mix`)."""
    _mix(code, terms, chosen, offsets, count, points, points_used, start, hole, sums, densities, keep, 1)


@vectors
def mix_three(code, terms, chosen, offsets, count, points, points_used, start, hole, sums, densities, keep):
    """Averages of m and of the last three features (:func:`_mix`)."""
    _mix(code, terms, chosen, offsets, count, points, points_used, start, hole, sums, densities, keep, 3)


def _mix(code, terms, chosen, offsets, count, points, points_used, start, hole, sums, densities, keep, features):
    """Averages over components at the points of a tile, weighted by their densities.

    Args:
        terms: [n, TERMS] of the components.
        chosen: indices of components; the first ``count`` are used.
        offsets: [count, 3] whitened offsets of the tile's origin from the components' means.
        points: [3, 64] x, y and z from the tile's origin.
        points_used: number of points, from the first on; a multiple of a vector's length.
        start: [6] initial values of the sums: of the densities, of m, of the last feature, of the features before it
            (subtracted at the end); then shifts of the averages of the feature before the last and of the one before.
        hole: [64] NaN where there is a hole, else 0.
        sums: [5, 64] the sum of the densities, the average of m, and the averages of the features from the last on; the
            averages are NaN in a hole.
        densities: [n, 64], written where ``keep`` is True.
        features: number of features.
    """
    with code.loop(points_used, code.lanes) as i:
        x, y, z = (points.load(i, axis * PIXELS) for axis in range(3))
        totals = [code.variable(start.one(min(row, 3))) for row in range(2 + features)]
        with code.loop(count) as j:
            at, offset = code.times(chosen.whole(j), TERMS), code.times(j, 3)
            a, b, c, d, e, f, peak, *averaged = (terms.one(at, term) for term in range(8 + features))
            x0, y0, z0 = (offsets.one(offset, axis) for axis in range(3))
            p, q, r = a * x + x0, b * x + (c * y + y0), d * x + (e * y + (f * z + z0))
            density = (((peak - p * p) - q * q) - r * r).exp2()
            for total, part in zip(totals, (density, *(density * value for value in averaged)), strict=True):
                total.value = total.value + part
            with code.when(keep):
                densities.store(density, code.plus(code.times(j, PIXELS), i))
        evidence, holes = totals[0].value, hole.load(i)
        sums.store(evidence, i)
        for row in range(1, 2 + features):
            total = totals[row].value
            mean = total.over(evidence) if row < 3 else (total - start.one(3)).over(evidence) + start.one(1 + row)
            sums.store(mean + holes, i, row * PIXELS)


@vectors
def mix_more(code, values, count, densities, sums, hole, averages):
    """The averages [64] of one more feature, whose values at the components are ``values`` [n].

    ``densities`` and ``sums`` are those of :func:`mix`, for ``count`` components.
    """
    rows = range(0, PIXELS, code.lanes)
    totals = [code.variable(sums.load(row) * 0.0) for row in rows]
    with code.loop(count) as j:
        value, at = values.one(j), code.times(j, PIXELS)
        for row, total in zip(rows, totals, strict=True):
            total.value = total.value + densities.load(at, row) * value
    for row, total in zip(rows, totals, strict=True):
        averages.store(total.value.over(sums.load(row)) + hole.load(row), row)


@vectors
def add_shares(code, fields, stride, n, point, row, density, added):
    """Add the row of a point to the rows of the components, in proportion to their densities at the point.

    Args:
        fields: [10, stride] of the components: mean, whitening, log2 of the peak.
        n: number of components, a multiple of a vector's length.
        point: [3].
        row: [4] three values and the prior's weight.
        density: [n] scratch.
        added: [3, stride] the components' rows.
    """
    at = [point.one(axis) for axis in range(3)]
    total = code.variable(at[0] * 0.0)
    with code.loop(n, code.lanes) as j:
        columns = [fields.load(code.plus(j, code.times(stride, i))) for i in range(10)]
        (x, y, z), (a, b, c, d, e, f) = (one - mean for one, mean in zip(at, columns[:3], strict=True)), columns[3:9]
        p, q, r = a * x, b * x + c * y, d * x + (e * y + f * z)
        value = (((columns[9] - p * p) - q * q) - r * r).exp2()
        density.store(value, j)
        total.value = total.value + value
    evidence = total.value.everywhere(Lanes.__add__) + row.one(3)
    shares = [row.one(axis).over(evidence) for axis in range(3)]
    with code.loop(n, code.lanes) as j:
        for axis, share in enumerate(shares):
            target = code.plus(j, code.times(stride, axis))
            added.store(added.load(target) + density.load(j) * share, target)
