"""The exact sum of the regression at every pixel, or at some, on the CPU (numba).

Each tile of 8 x 8 pixels sums the components that ``regress_cull`` selects, which states the error. Points are
relative to an origin in the middle of their tile at the depth z_0 of its nearest pixel. A pixel (i, j) from the middle,
of depth z, lies at z (i / f_x, j / f_y, 0) + (z - z_0) r, with the ray r from the camera through the middle (r_z = 1).
Whitened offsets from the components to the origin are in double precision, so that float32 loses nothing to the
distance from the camera, nor to a far outlier in the tile. Densities are powers of two: log2(e)/2 is part of the
whitening.

For a subset of the pixels, up to 64 pixels of a block form a tile.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.kernels.compile_cpu import contracted, empty, kernel, leaf, part
from ufmstar_torch.kernels.cpu.regress_cull import ROWS, cull, limit, pad
from ufmstar_torch.kernels.cpu.regress_vectors import (
    PIXELS,
    TILE,
    TINY,
    mix,
    mix_more,
    mix_three,
    place_points,
    read_tile,
    write_tile,
)
from ufmstar_torch.kernels.cpu.vectors import LANES

_SIDE = 4  # tiles of a block
_TILES = _SIDE * _SIDE
_BLOCK = TILE * _SIDE  # pixels
_EVIDENCE, _TOTAL, _LAST = range(3)  # rows of a tile's sums and averages, as `mix` writes them, then further features


class Tiles(NamedTuple):
    """Scratch of the tiles of a block.

    Attributes:
        grid: [2, 64] rays of the pixels less the ray through the middle.
        z: [64] depths of one tile.
        points: [16, 192] points of each tile, from its origin.
        boxes: [16, 9] box (low, high) and origin of each tile.
        seen: [16] whether a tile has a pixel.
        holes: [16, 64] NaN at the holes of each tile, else 0 (:func:`place_points`).
        work: [10] the box of one tile, and the ray through its middle.
    """

    grid: NDArray[np.floating]
    z: NDArray[np.floating]
    points: NDArray[np.floating]
    boxes: NDArray[np.float64]
    seen: NDArray[np.bool_]
    holes: NDArray[np.floating]
    work: NDArray[np.floating]


class Lists(NamedTuple):
    """Scratch of the components that a block and a tile keep.

    Attributes:
        near: [11, n] fields of the block's.
        work: [n + 9] of :func:`cull`.
        in_block, in_tile: [n] indices.
    """

    near: NDArray[np.floating]
    work: NDArray[np.floating]
    in_block: NDArray[np.int64]
    in_tile: NDArray[np.int64]


class Sums(NamedTuple):
    """Scratch of the sums at a tile.

    Attributes:
        start: [6] initial values of the sums, and the shifts.
        offsets: [n, 3] whitened offsets of the origin from the components.
        densities: [n, 64] of the components, for further features.
        averages: [5, 64] evidence, M, and up to three features.
        others: [F, 64] averages of further features.
        values: [n] of one of them.
    """

    start: NDArray[np.floating]
    offsets: NDArray[np.floating]
    densities: NDArray[np.floating]
    averages: NDArray[np.floating]
    others: NDArray[np.floating]
    values: NDArray[np.floating]


@kernel
def exact(depth, K, view, features, shift, out, out_f, first, shares):
    """Regress every ``shares``-th block of one stream, from block ``first`` on.

    Reads depth [H, W], K [3, 3], the ``view`` of :func:`in_view` and features [K, F]. Writes out [H, W] and out_f
    [F, H, W], NaN where the depth is not positive. ``shift`` [2] is added to the two features before the last, of three
    or more.
    """
    tiles, lists, sums = _scratch(view, out_f.shape[0], shift)
    grid = tiles.grid
    for i in range(PIXELS):
        grid[0, i] = (i % TILE - 0.5 * (TILE - 1)) / K[0, 0]
        grid[1, i] = (i // TILE - 0.5 * (TILE - 1)) / K[1, 1]
    _blocks(depth, K, view, features, tiles, lists, sums, out, out_f, first, shares)


@kernel
def exact_at(depth, K, pixels, view, features, shift, out, out_f):
    """Regress one stream at pixels [n], indices into the flattened image, into out [n] and out_f [F, n]."""
    height, width = depth.shape
    columns, rows = (width + _BLOCK - 1) // _BLOCK, (height + _BLOCK - 1) // _BLOCK
    begin, order = empty(rows * columns + 2, np.int64), empty(pixels.size, np.int64)
    _by_block(pixels, width, columns, begin, order)
    tiles, lists, sums = _scratch(view, out_f.shape[0], shift)
    _at_pixels(depth, K, pixels, begin, order, view, features, tiles, lists, sums, out, out_f)


@part
def _scratch(view, features, shift):
    """Memory for the work on one block, of the n components in view, in the dtype of the maps."""
    n, dtype, others = view.packed.shape[1], view.packed.dtype, features - _mixed(features)  # n is padded
    tiles = Tiles(
        empty((2, PIXELS), dtype), empty(PIXELS, dtype), empty((_TILES, 3 * PIXELS), dtype),
        empty((_TILES, 9), np.float64), empty(_TILES, np.bool_), empty((_TILES, PIXELS), dtype), empty(10, dtype),
    )  # fmt: skip
    lists = Lists(empty((ROWS, n), dtype), empty(n + 9, dtype), empty(n, np.int64), empty(n, np.int64))
    start, prior = empty(6, dtype), view.settings.prior_weight
    start[_EVIDENCE], start[_TOTAL], start[_LAST], start[3] = prior, prior * view.settings.prior_mean, 0, TINY
    start[4], start[5] = shift[1], shift[0]
    sums = Sums(
        start, empty((n, 3), dtype), empty((n if others > 0 else 0, PIXELS), dtype), empty((5, PIXELS), dtype),
        empty((others, PIXELS), dtype), empty(n, dtype),
    )  # fmt: skip
    return tiles, lists, sums


@leaf
def _mixed(features):
    """Number of the last features that are averaged together with m."""
    return features if features < 1 else 1 if features < 3 else 3


@leaf
def _blocks(depth, K, view, features, tiles, lists, sums, out, out_f, first, shares):
    """Regress every ``shares``-th block of an image, from block ``first`` on."""
    seen, (near, work, in_block, in_tile), packed, settings = tiles.seen, lists, view.packed, view.settings
    rows, columns = (depth.shape[0] + _BLOCK - 1) // _BLOCK, (depth.shape[1] + _BLOCK - 1) // _BLOCK
    half = 0.5 * (TILE - 1)
    for block in range(first, rows * columns, shares):
        v0, u0 = block // columns * _BLOCK, block % columns * _BLOCK
        any_seen = False
        for tile in range(_TILES):
            v, u = v0 + tile // _SIDE * TILE, u0 + tile % _SIDE * TILE
            seen[tile] = v < depth.shape[0] and u < depth.shape[1]
            if seen[tile]:
                _depths(depth, v, u, tiles.z)
                seen[tile] = _placed((u + half - K[0, 2]) / K[0, 0], (v + half - K[1, 2]) / K[1, 1], tiles, tile)
            any_seen |= seen[tile]
        if not any_seen:
            _clear(v0, u0, _BLOCK, out, out_f)
            continue
        share, box = limit(settings.error, view.among), _union(tiles.boxes, seen)
        count = cull(packed, view.slot.size, share, box, settings, work, in_block)
        share = limit(settings.error, count)
        for i in range(ROWS):
            for j in range(count):
                near[i, j] = packed[i, in_block[j]]
        pad(near, count)
        for tile in range(_TILES):
            v, u = v0 + tile // _SIDE * TILE, u0 + tile % _SIDE * TILE
            if not seen[tile]:
                _clear(v, u, TILE, out, out_f)
                continue
            chosen = cull(near, count, share, _box(tiles.boxes, tile), settings, work, in_tile)
            for j in range(chosen):
                in_tile[j] = in_block[in_tile[j]]
            _average(PIXELS, tiles, tile, in_tile, chosen, view, features, sums)
            _write(sums, v, u, out, out_f)


@leaf
def _by_block(pixels, width, columns, begin, order):
    """Sort pixels stably by block: block b has the pixels ``order[begin[b]:begin[b + 1]]``."""
    for block in range(begin.size):
        begin[block] = 0
    for i in range(pixels.size):
        begin[_block(pixels[i], width, columns) + 2] += 1
    for block in range(2, begin.size):
        begin[block] += begin[block - 1]
    for i in range(pixels.size):
        block = _block(pixels[i], width, columns)
        order[begin[block + 1]] = i
        begin[block + 1] += 1


@leaf
def _block(pixel, width, columns):
    """The block of a pixel."""
    v = pixel // width
    return v // _BLOCK * columns + (pixel - v * width) // _BLOCK


@leaf
def _at_pixels(depth, K, pixels, begin, order, view, features, tiles, lists, sums, out, out_f):
    """Regress the blocks of an image at some pixels, up to 64 at a time; ``begin`` and ``order`` are those of
    :func:`_by_block`."""
    grid, z, retained, others, last = tiles.grid, tiles.z, lists.in_block, sums.others, out_f.shape[0] - 1
    columns = (depth.shape[1] + _BLOCK - 1) // _BLOCK
    for block in range(begin.size - 2):
        v0, u0 = block // columns * _BLOCK + 0.5 * (_BLOCK - 1), block % columns * _BLOCK + 0.5 * (_BLOCK - 1)
        for low in range(begin[block], begin[block + 1], PIXELS):
            count = min(PIXELS, begin[block + 1] - low)
            for i in range(count):
                v = pixels[order[low + i]] // depth.shape[1]
                u = pixels[order[low + i]] - v * depth.shape[1]
                grid[0, i], grid[1, i] = (u - u0) / K[0, 0], (v - v0) / K[1, 1]
                z[i] = depth[v, u]
            for i in range(count, PIXELS):  # the last one again
                grid[0, i], grid[1, i], z[i] = grid[0, count - 1], grid[1, count - 1], z[count - 1]
            if not _placed((u0 - K[0, 2]) / K[0, 0], (v0 - K[1, 2]) / K[1, 1], tiles, 0):
                for i in range(count):
                    out[order[low + i]] = np.nan
                    for g in range(last + 1):
                        out_f[g, order[low + i]] = np.nan
                continue
            box, settings = _box(tiles.boxes, 0), view.settings
            share = limit(settings.error, view.among)
            chosen = cull(view.packed, view.slot.size, share, box, settings, lists.work, retained)
            filled = (count + LANES - 1) // LANES * LANES
            _average(filled, tiles, 0, retained, chosen, view, features, sums)
            for i in range(count):
                out[order[low + i]] = sums.averages[_TOTAL, i]
                for g in range(others.shape[0]):
                    out_f[g, order[low + i]] = others[g, i]
                for g in range(others.shape[0], last + 1):
                    out_f[g, order[low + i]] = sums.averages[_LAST + last - g, i]


@leaf
def _depths(depth, v0, u0, z):
    """Depths [64] of a tile, 0 beyond the image."""
    if v0 + TILE <= depth.shape[0] and u0 + TILE <= depth.shape[1]:
        read_tile(depth, v0 * depth.shape[1] + u0, depth.shape[1], z)
    else:
        for i in range(PIXELS):
            v, u = v0 + i // TILE, u0 + i % TILE
            z[i] = depth[v, u] if v < depth.shape[0] and u < depth.shape[1] else 0


@leaf
def _placed(x, y, tiles, tile):
    """Write the points of a tile, its box (low, high) and its origin; False where all of its pixels are holes.

    ``x`` and ``y`` are the ray through the tile's middle, at z = 1.
    """
    work = tiles.work
    work[7], work[8] = x, y
    place_points(tiles.z, tiles.grid, work[7:], tiles.points[tile], tiles.holes[tile], work)
    least = np.float64(work[6])
    if not least < np.inf:
        return False
    box = tiles.boxes[tile]
    box[6], box[7], box[8] = x * least, y * least, least
    for i in range(6):
        box[i] = box[6 + i % 3] + work[i]
    return True


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
def _average(points_used, tiles, tile, chosen, count, view, features, sums):
    """As :func:`mix` at the first ``points_used`` points of a tile, with averages of the other features."""
    offsets, densities, averages, others, values = sums.offsets, sums.densities, sums.averages, sums.others, sums.values
    points, hole = tiles.points[tile], tiles.holes[tile]
    _offsets(view.fields, chosen, count, tiles.boxes[tile], offsets)
    outputs = averages, densities, others.shape[0] > 0
    if features.shape[1] < 3:
        mix(view.terms, chosen, offsets, count, points, points_used, sums.start, hole, *outputs)
    else:
        mix_three(view.terms, chosen, offsets, count, points, points_used, sums.start, hole, *outputs)
    for g in range(others.shape[0]):
        for j in range(count):
            values[j] = features[view.slot[chosen[j]], g]
        mix_more(values, count, densities, averages, hole, others[g])


@contracted
def _offsets(fields, chosen, count, box, offsets):
    """Write the whitened offsets of a tile's origin from the means of the chosen components."""
    x, y, z = box[6], box[7], box[8]
    for j in range(count):
        k = fields[chosen[j]]
        dx, dy, dz = x - k[0], y - k[1], z - k[2]
        offsets[j, 0] = k[3] * dx
        offsets[j, 1] = k[4] * dx + k[5] * dy
        offsets[j, 2] = k[6] * dx + k[7] * dy + k[8] * dz


@leaf
def _write(sums, v0, u0, out, out_f):
    """Copy the averages at a tile to the maps."""
    averages, others, last = sums.averages, sums.others, out_f.shape[0] - 1
    _copy(averages[_TOTAL], v0, u0, out)
    for g in range(out_f.shape[0]):
        _copy(others[g] if g < others.shape[0] else averages[_LAST + last - g], v0, u0, out_f[g])


@leaf
def _clear(v0, u0, side, out, out_f):
    """Set the maps to NaN in a square."""
    for v in range(v0, min(v0 + side, out.shape[0])):
        for u in range(u0, min(u0 + side, out.shape[1])):
            out[v, u] = np.nan
            for g in range(out_f.shape[0]):
                out_f[g, v, u] = np.nan


@leaf
def _copy(values, v0, u0, out):
    """Copy the values [64] of a tile to a map."""
    if v0 + TILE <= out.shape[0] and u0 + TILE <= out.shape[1]:
        write_tile(values, out, v0 * out.shape[1] + u0, out.shape[1])
    else:
        for v in range(v0, min(v0 + TILE, out.shape[0])):
            for u in range(u0, min(u0 + TILE, out.shape[1])):
                out[v, u] = values[(v - v0) * TILE + u - u0]
