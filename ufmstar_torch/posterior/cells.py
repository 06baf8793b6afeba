"""Means of pixels in cells, sums in windows around nodes, and interpolation from nodes to pixels, without smoothing
across depth edges (numba)."""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.anchors.check import FARTHEST_OFF
from ufmstar_torch.kernels.compile_cpu import empty, leaf, part, reordered_leaf

# Upper limit of |y|: anchors that are off by more are not valid.
LARGEST = math.log(FARTHEST_OFF)


@part
def cell_means(logs, valid, rows, cols):
    """Mean of log d over the valid pixels of every cell [rows cols]; a cell covers every pixel that it touches."""
    mean = empty(rows * cols, np.float64)
    _cell_means(logs, valid, rows, cols, mean)
    total, count = 0.0, 0
    for i in range(mean.size):
        if mean[i] == mean[i]:
            total += mean[i]
            count += 1
    for i in range(mean.size):
        if mean[i] != mean[i]:
            mean[i] = total / max(count, 1)
    return mean


@reordered_leaf
def _cell_means(logs, valid, rows, cols, mean):
    """As :func:`cell_means`, NaN in cells without a valid pixel."""
    height, width = logs.shape
    for row in range(rows):
        for c in range(cols):
            total, count = 0.0, 0
            for i in range(row * height // rows, ((row + 1) * height + rows - 1) // rows):
                for j in range(c * width // cols, ((c + 1) * width + cols - 1) // cols):
                    if valid[i, j]:
                        total += logs[i, j]
                        count += 1
            mean[row * cols + c] = total / count if count else np.nan


@reordered_leaf
def highest_over_lowest(depth, valid, index):
    """The ratio of the largest and the least depth of the valid pixels among a valid pixel and its eight neighbours."""
    height, width = depth.shape
    row = index // width
    column = index - row * width
    low = high = np.float64(depth[row, column])
    for i in range(max(row - 1, 0), min(row + 2, height)):
        for j in range(max(column - 1, 0), min(column + 2, width)):
            if valid[i, j]:
                low, high = min(low, np.float64(depth[i, j])), max(high, np.float64(depth[i, j]))
    return high / low


@part
def steepness(f, rows, cols):
    """[n] variance of the field's mean ``f`` [n] over a node and its eight neighbours, values at the border repeated
    outside: the grid locates a depth edge, where y changes, to one node only."""
    out = empty(f.size, np.float64)
    _vary(f, rows, cols, out)
    return out


@reordered_leaf
def _vary(f, rows, cols, out):
    for i in range(rows):
        for j in range(cols):
            total = squares = 0.0  # of differences from the centre, to lose less in rounding
            for r in range(i - 1, i + 2):
                for c in range(j - 1, j + 2):
                    difference = f[min(max(r, 0), rows - 1) * cols + min(max(c, 0), cols - 1)] - f[i * cols + j]
                    total += difference
                    squares += difference * difference
            out[i * cols + j] = squares / 9 - (total / 9) ** 2


@part
def windows_around(scene, rows, width):
    """[k, n] sums of ``rows`` [k, N] over the anchors of a scene in a Gaussian window around every node of standard
    deviation ``width`` [image widths]."""
    grid, node, layers = scene.grid, scene.observed.node, rows.shape[0]
    out = empty((layers, grid.log_depth.size), np.float64)
    windows = empty((grid.rows, grid.rows), np.float64), empty((grid.cols, grid.cols), np.float64)
    work = empty((grid.rows, grid.cols), np.float64), empty(grid.cols, np.float64)
    for layer in range(layers):
        for i in range(out.shape[1]):
            out[layer, i] = 0.0
        for k in range(node.size):
            out[layer, node[k]] += rows[layer, k]
    _blur(out, windows[0], windows[1], work[0], work[1], width)
    return out


@reordered_leaf
def _blur(cells, row_window, col_window, across, line, width):
    """Replace sums over cells [k, R C] by those in Gaussian windows around every cell."""
    rows, cols = across.shape
    for window in (row_window, col_window):
        n = window.shape[0]
        for distance in range(n):
            weight = math.exp(-((distance / n / width) ** 2) / 2)
            for i in range(n - distance):
                window[i, i + distance] = window[i + distance, i] = weight
    for layer in range(cells.shape[0]):
        for i in range(rows):
            for c in range(cols):
                line[c] = 0.0
            for j in range(cols):
                value = cells[layer, i * cols + j]
                if value != 0:  # most cells have no anchor
                    for c in range(cols):
                        line[c] += value * col_window[j, c]
            for c in range(cols):
                across[i, c] = line[c]
        for i in range(rows):
            for c in range(cols):
                line[c] = 0.0
            for j in range(rows):
                weight = row_window[i, j]
                for c in range(cols):
                    line[c] += weight * across[j, c]
            for c in range(cols):
                cells[layer, i * cols + c] = line[c]


@part
def interpolate(maps, nodes, coefficients, grid, config, outputs):
    """Write y, the two variances and the probability of another surface at every pixel [H, W].

    The four nodes around a pixel have their bilinear weights times 1/(1 + (D/edge_contrast)^2); D is the difference
    between the pixel's log d and the node's.

    Args:
        maps: depth d [m]; valid; log d; and UfM*'s variance [m^2], whose product with the share without evidence is a
            lower limit [H, W].
        nodes: [6, n] log d, y - b . x, variance over the squared depth, the same on the evidence's surface, probability
            of another surface, and share without evidence.
        coefficients: [4] of 1, log d - m_0, u, v.
        grid: of the nodes.
        config: of the posterior.
        outputs: [H, W], written: y, NaN where not valid; variance of the depth d e^y over e^2y [m^2]; the probability,
            NaN where not valid; and the variance on the surface of the evidence.
    """
    depth, valid, logs, claimed = maps
    y, variance, outlier, inlier = outputs
    b, cols, width = coefficients, grid.cols, depth.shape[1]
    lines, before = empty((2, 2, 6, width), np.float64), empty(width, np.int64)
    across, base = empty(width, np.float64), empty(width, np.float64)
    for j in range(width):
        u = (j + 0.5) / width
        position = min(max(u * cols - 0.5, 0.0), cols - 1.0)
        before[j] = min(int(position), max(cols - 2, 0))
        across[j], base[j] = position - before[j], b[0] - b[1] * grid.mean + b[2] * (2 * u - 1)
    columns, limits = (across, base, before), (config.edge_contrast * config.edge_contrast, LARGEST)
    _pixels(
        depth, valid, logs, claimed, nodes, grid.rows, cols, lines, columns, b, limits, y, variance, inlier, outlier
    )


@leaf
def _fill(nodes, row, cols, before, line):
    """Write the nodes of a row before and after each column of pixels [2, 6, W]."""
    for k in range(6):
        for j in range(before.size):
            i = row * cols + before[j]
            line[0, k, j], line[1, k, j] = nodes[k, i], nodes[k, min(i + 1, row * cols + cols - 1)]


@reordered_leaf
def _pixels(
    depth, valid, logs, claimed, nodes, rows, cols, lines, columns, b, limits, y, spread, inlier, outlier
):  # fmt: skip
    """As :func:`interpolate`.

    ``columns`` are the weight of the node after each column, b . x without the parts that vary along the column, and
    the node before it. ``lines`` [2, 2, 6, W] hold the two rows of nodes around a row of pixels (:func:`_fill`).
    The ratios of the four weights s/(1 + D^2) are those of s times the other three denominators.
    """
    height, width, filled = logs.shape[0], logs.shape[1], -1
    across, base, before = columns
    contrast2, largest = limits
    by_depth, by_row = b[1], b[3]
    for i in range(height):
        v = (i + 0.5) / height
        position = min(max(v * rows - 0.5, 0.0), rows - 1.0)
        top = min(int(position), max(rows - 2, 0))
        fv, bottom = position - top, min(top + 1, rows - 1)
        while filled < bottom:
            filled += 1
            _fill(nodes, filled, cols, before, lines[filled % 2])
        n0, n1, n2, n3 = lines[top % 2, 0], lines[top % 2, 1], lines[bottom % 2, 0], lines[bottom % 2, 1]
        depths, used, gs, Vs = depth[i], valid[i], logs[i], claimed[i]
        ys, variances, inliers, outliers = y[i], spread[i], inlier[i], outlier[i]
        for j in range(width):
            g, d, V, fu = np.float64(gs[j]), np.float64(depths[j]), np.float64(Vs[j]), across[j]
            a0, a1, a2, a3 = g - n0[0, j], g - n1[0, j], g - n2[0, j], g - n3[0, j]
            q0, q1, q2, q3 = contrast2 + a0 * a0, contrast2 + a1 * a1, contrast2 + a2 * a2, contrast2 + a3 * a3
            w0, w1 = (1 - fv) * (1 - fu) * q1 * (q2 * q3), (1 - fv) * fu * q0 * (q2 * q3)
            w2, w3 = fv * (1 - fu) * q3 * (q0 * q1), fv * fu * q2 * (q0 * q1)
            share = 1 / (w0 + w1 + w2 + w3)
            offset = w0 * n0[1, j] + w1 * n1[1, j] + w2 * n2[1, j] + w3 * n3[1, j]
            variance = w0 * n0[2, j] + w1 * n1[2, j] + w2 * n2[2, j] + w3 * n3[2, j]
            inlier_variance = w0 * n0[3, j] + w1 * n1[3, j] + w2 * n2[3, j] + w3 * n3[3, j]
            p = w0 * n0[4, j] + w1 * n1[4, j] + w2 * n2[4, j] + w3 * n3[4, j]
            unseen = w0 * n0[5, j] + w1 * n1[5, j] + w2 * n2[5, j] + w3 * n3[5, j]
            value = base[j] + by_depth * g + by_row * (2 * v - 1) + offset * share
            ys[j] = min(max(value, -largest), largest) if used[j] else np.nan
            outliers[j] = p * share if used[j] else np.nan
            variances[j] = max(variance * d * d, unseen * (V if V == V else 0.0)) * share
            inliers[j] = inlier_variance * d * d * share
