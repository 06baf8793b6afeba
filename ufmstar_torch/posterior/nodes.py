"""Sums over a frame's anchors in Gaussian windows around every node (numba)."""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, part, reordered_leaf


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
