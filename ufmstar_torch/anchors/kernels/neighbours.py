"""Tests each anchor of a frame against its neighbours, on the CPU (numba).

Neighbours are searched in a grid over the image: time and memory grow with the number of anchors.
"""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.anchors.evidence import (
    LEAST_SIGMA,
    LOWER_QUARTILE,
    NEIGHBOURS,
    SIMILAR_SIGMAS,
    SUPPORT,
    TIE,
)
from ufmstar_torch.kernels.compile_cpu import empty, leaf, part

_PER_CELL = 3  # mean number of anchors in a cell


@part
def grid(pixel, chosen, mean_count):
    """Sort the chosen ones of N pixels [N, 2] into cells of about ``mean_count`` each: the grid's first corner and cell
    side [px], columns and rows, the start of each cell in the order [cells + 1], and the order."""
    low, high, count = empty(2, np.float64), empty(2, np.float64), 0
    low[0] = low[1] = np.inf
    high[0] = high[1] = -np.inf
    for i in range(chosen.size):
        if chosen[i]:
            count += 1
            for j in range(2):
                low[j], high[j] = min(low[j], pixel[i, j]), max(high[j], pixel[i, j])
    if count == 0:
        low[0] = low[1] = high[0] = high[1] = 0.0
    wide, tall, share = high[0] - low[0], high[1] - low[1], mean_count / max(count, 1)
    # The second term limits the number of cells to about that of anchors where they lie on a line.
    side = max(math.sqrt(wide * tall * share), max(wide, tall) * share, 1e-6)
    columns, rows = int(wide / side) + 1, int(tall / side) + 1
    cell, start = empty(chosen.size, np.int64), empty(columns * rows + 1, np.int64)
    for c in range(start.size):
        start[c] = 0
    for i in range(chosen.size):
        if chosen[i]:
            column = min(int((pixel[i, 0] - low[0]) / side), columns - 1)
            cell[i] = min(int((pixel[i, 1] - low[1]) / side), rows - 1) * columns + column
            start[cell[i] + 1] += 1
    for c in range(columns * rows):
        start[c + 1] += start[c]
    next_free, order = empty(start.size, np.int64), empty(count, np.int64)
    for c in range(start.size):
        next_free[c] = start[c]
    for i in range(chosen.size):
        if chosen[i]:
            order[next_free[cell[i]]] = i
            next_free[cell[i]] += 1
    return low, side, columns, rows, start, order


@part
def supported(pixel, predicted, depth, variance, valid, out):
    """Write to ``out`` [N] whether an anchor is valid and supported by its neighbours (``evidence.inliers``)."""
    cells = grid(pixel, valid, _PER_CELL)
    order = cells[5]
    n = order.size
    for a in range(valid.size):
        out[a] = valid[a]
    if n <= SUPPORT:
        return
    count = min(NEIGHBOURS, n - 1)
    # In the order of the grid: pixel, tie-breaker, log g/d, and the variance of log g.
    u, v, tie = empty(n, np.float64), empty(n, np.float64), empty(n, np.float64)
    ratio, noise = empty(n, np.float64), empty(n, np.float64)
    for i in range(n):
        a = order[i]
        u[i], v[i], tie[i] = pixel[a, 0], pixel[a, 1], TIE * a
        ratio[i], noise[i] = math.log(depth[a] / predicted[a]), variance[a] / (depth[a] * depth[a])
    neighbour, distance = empty((n, count), np.int64), empty(count, np.float64)
    gap, reordered_gap = empty(n * count, np.float64), empty(n * count, np.float64)
    for i in range(n):
        _nearest(cells, u, v, tie, i, distance, neighbour[i])
        for j in range(count):
            gap[i * count + j] = reordered_gap[i * count + j] = abs(ratio[i] - ratio[neighbour[i, j]])
    sigma = _lower_quartile(reordered_gap, gap.size) / LOWER_QUARTILE
    for i in range(n):
        support = 0
        for j in range(count):
            allowed = sigma * sigma + 2 * LEAST_SIGMA**2 + noise[i] + noise[neighbour[i, j]]
            support += gap[i * count + j] <= SIMILAR_SIGMAS * math.sqrt(allowed)
        out[order[i]] = support >= SUPPORT


@part
def _lower_quartile(values, n):
    """``torch.quantile(values[:n], 0.25)``, 0 where n = 0; reorders the values."""
    if n == 0:
        return 0.0
    rank = 0.25 * (n - 1)
    below, first, last = int(rank), 0, n - 1
    while first < last:  # Hoare's selection: what is not above values[below] moves before it
        pivot, i, j = values[below], first, last
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        if j < below:
            first = i
        if below < i:
            last = j
    low, high, weight = values[below], values[min(below + 1, n - 1)], rank - below
    for i in range(below + 1, n):
        high = min(high, values[i])
    return low + weight * (high - low) if weight < 0.5 else high - (high - low) * (1 - weight)


@leaf
def _nearest(cells, u, v, tie, i, distance, neighbour):
    """Write the ``distance.size`` anchors nearest to anchor i, as indices in the order of the grid, to ``neighbour``;
    at least as many others exist. Rings of cells around its cell are searched until they contain a circle with so
    many."""
    low, side, columns, rows, start = cells[0], cells[1], cells[2], cells[3], cells[4]
    x, y = (u[i] - low[0]) / side, (v[i] - low[1]) / side
    column, row = min(int(x), columns - 1), min(int(y), rows - 1)
    # [cells] From the anchor to the border of its cell; a billionth less for rounding.
    margin = max(min(min(x - column, column + 1 - x), min(y - row, row + 1 - y)) - 1e-9, 0.0)
    ring, last, limit = 0, distance.size - 1, 0.0
    while ring == 0 or not distance[last] < limit:
        ring += 1
        limit = np.inf if ring >= max(columns, rows) else (ring + margin) * side * ((ring + margin) * side)
        for k in range(last + 1):
            distance[k] = limit
        left, right = max(column - ring, 0), min(column + ring, columns - 1)
        for y_cell in range(max(row - ring, 0), min(row + ring, rows - 1) + 1):
            for j in range(start[y_cell * columns + left], start[y_cell * columns + right + 1]):
                du, dv = u[j] - u[i], v[j] - v[i]
                squared = du * du + dv * dv + tie[j]
                if j == i or not squared < distance[last]:
                    continue
                k = last
                while k > 0 and distance[k - 1] > squared:
                    distance[k], neighbour[k] = distance[k - 1], neighbour[k - 1]
                    k -= 1
                distance[k], neighbour[k] = squared, j
