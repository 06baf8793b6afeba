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
from ufmstar_torch.kernels.compile_cpu import leaf, part
from ufmstar_torch.kernels.regress_vectors_cpu import count_less, square_distances
from ufmstar_torch.kernels.vectors_cpu import LANES

_FEW = 3  # anchors of a cell, on average
_TRIALS = 100  # of a radius: distances differ by so little only where rounding makes them equal


@part
def grid(pixel, chosen, mean_count):
    """Cells over the chosen ones of N pixels [N, 2], about so many in each: their first corner and side [px], columns
    and rows, where each cell starts in the order [cells + 1], and the order."""
    low, high, count = np.full(2, np.inf), np.full(2, -np.inf), 0
    for i in range(chosen.size):
        if chosen[i]:
            count += 1
            for j in range(2):
                low[j], high[j] = min(low[j], pixel[i, j]), max(high[j], pixel[i, j])
    if count == 0:
        low[:], high[:] = 0.0, 0.0
    wide, tall, share = high[0] - low[0], high[1] - low[1], mean_count / max(count, 1)
    # Not smaller than on a line, so that there are no more cells than about anchors, wherever they lie.
    side = max(math.sqrt(wide * tall * share), max(wide, tall) * share, 1e-6)
    columns, rows = int(wide / side) + 1, int(tall / side) + 1
    cell, start = np.empty(chosen.size, np.int64), np.zeros(columns * rows + 1, np.int64)
    for i in range(chosen.size):
        if chosen[i]:
            column = min(int((pixel[i, 0] - low[0]) / side), columns - 1)
            cell[i] = min(int((pixel[i, 1] - low[1]) / side), rows - 1) * columns + column
            start[cell[i] + 1] += 1
    for c in range(columns * rows):
        start[c + 1] += start[c]
    place, order = start.copy(), np.empty(count, np.int64)
    for i in range(chosen.size):
        if chosen[i]:
            order[place[cell[i]]] = i
            place[cell[i]] += 1
    return low, side, columns, rows, start, order


@part
def supported(pixel, predicted, depth, variance, valid, out):
    """Write to ``out`` [N] whether an anchor is valid and supported by its neighbours (``evidence.inliers``)."""
    cells = grid(pixel, valid, _FEW)
    order = cells[5]
    n = order.size
    for a in range(valid.size):
        out[a] = valid[a]
    if n <= SUPPORT:
        return
    most, room = min(NEIGHBOURS, n - 1), n + LANES
    # In the order of the grid: pixel, what breaks a tie, log g/d, and the variance of log g.
    u, v, tie, ratio, noise = np.empty(room), np.empty(room), np.empty(room), np.empty(n), np.empty(n)
    for i in range(n):
        a = order[i]
        u[i], v[i], tie[i] = pixel[a, 0], pixel[a, 1], TIE * a
        ratio[i], noise[i] = math.log(depth[a] / predicted[a]), variance[a] / (depth[a] * depth[a])
    neighbour, differ = np.empty((n, most + 1), np.int64), np.empty(n * most)
    distance, place, work = np.empty(room), np.empty(n, np.int64), np.empty(4)
    for i in range(n):
        _nearest(cells, u, v, tie, i, distance, place, work, neighbour[i])
        for j in range(most):
            differ[i * most + j] = abs(ratio[i] - ratio[neighbour[i, j]])
    sigma = _lower_quartile(differ.copy(), differ.size) / LOWER_QUARTILE
    for i in range(n):
        support = 0
        for j in range(most):
            allowed = sigma * sigma + 2 * LEAST_SIGMA**2 + noise[i] + noise[neighbour[i, j]]
            support += differ[i * most + j] <= SIMILAR_SIGMAS * math.sqrt(allowed)
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
def _nearest(cells, u, v, tie, i, distance, place, work, neighbour):
    """Write the anchors nearest to anchor i to ``neighbour`` [most + 1], whose last entry is scratch, of more than
    ``most`` in the order of the grid.

    They are among those in rings of cells around its own if so many lie within the circle that the rings contain.
    """
    low, side, columns, rows = cells[:4]
    work[0], work[1], most = u[i], v[i], neighbour.size - 1
    x, y = (u[i] - low[0]) / side, (v[i] - low[1]) / side
    column, row = min(int(x), columns - 1), min(int(y), rows - 1)
    # [cells] From the anchor to the border of its cell; a billionth less for rounding.
    margin = max(min(min(x - column, column + 1 - x), min(y - row, row + 1 - y)) - 1e-9, 0.0)
    ring, within, n, limit = 0, 0, 0, 0.0
    while within < most:
        ring += 1
        n = _around(cells, u, v, tie, i, column, row, ring, distance, place, work)
        limit = (ring + margin) * side * ((ring + margin) * side)
        if ring >= max(columns, rows):  # all of them
            for j in range(n):
                limit = max(limit, 2 * distance[j] + 1) if distance[j] < np.inf else limit
        within = _within(distance, n, limit, work)
    least, below = 0.0, 0
    for _ in range(_TRIALS):
        if within == most:
            break
        # Their number grows about as the square of the distance.
        middle = least + (limit - least) * (most + 0.5 - below) / (within + 1 - below)
        count = _within(distance, n, middle, work)
        if count < most:
            least, below = middle, count
        else:
            limit, within = middle, count
    count = 0
    for j in range(n):  # without a branch, which would be mispredicted
        neighbour[count] = place[j]
        count = min(count + (distance[j] < limit), most)


@leaf
def _around(cells, u, v, tie, i, column, row, ring, distance, place, work):
    """Write the squared distances of anchor i from those in rings of cells around its own, infinite from itself, and
    which they are; return how many. Behind the last one there are as many infinite ones as fit in a vector."""
    columns, rows, start = cells[2], cells[3], cells[4]
    n, left, right = 0, max(column - ring, 0), min(column + ring, columns - 1)
    for y in range(max(row - ring, 0), min(row + ring, rows - 1) + 1):
        first, last = start[y * columns + left], start[y * columns + right + 1]
        square_distances(u, v, tie, first, last - first, work, distance, n)
        for j in range(first, last):
            place[n + j - first] = j
        if first <= i < last:
            distance[n + i - first] = np.inf
        n += last - first
    for j in range(LANES):
        distance[n + j] = np.inf
    return n


@leaf
def _within(distance, n, limit, work):
    """Number of the n distances that are less than ``limit``."""
    work[2] = limit
    count_less(distance, n, work[2:])
    return int(work[3])
