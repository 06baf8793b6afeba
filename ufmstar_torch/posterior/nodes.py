"""Gaussian windows around every node over a frame's anchors, and the links between nodes (numba)."""

from __future__ import annotations

import numpy as np

from ufmstar_torch.kernels.compile_cpu import kernel, part
from ufmstar_torch.posterior.field import fast


@fast
def spread(node, weight, used, value, row_window, col_window, mean, variance, out):
    """Write the variance [n] of ``value`` [N] around every node; see
    :func:`ufmstar_torch.posterior.scene.spread_around`."""
    cells = np.zeros((3, len(row_window), len(col_window)))
    for k in range(len(node)):
        if used[k]:
            row, column = node[k] // len(col_window), node[k] % len(col_window)
            product = weight[k] * value[k]
            cells[0, row, column] += weight[k]
            cells[1, row, column] += product
            cells[2, row, column] += product * value[k]
    _blur(cells, row_window, col_window)
    for i in range(len(out)):
        row, column = i // len(col_window), i % len(col_window)
        total = cells[0, row, column] + 1
        middle = (cells[1, row, column] + mean) / total
        moment = (cells[2, row, column] + mean * mean + variance) / total
        out[i] = max(moment - middle * middle, 0.0)


@fast
def scale(node, weight, used, residual, total, clip, row_window, col_window, out):
    """Write the mean z^2 [n] around every node of residuals [N] of variances ``total``; see
    :func:`ufmstar_torch.posterior.scene.local_scale`."""
    cells = np.zeros((2, len(row_window), len(col_window)))
    for k in range(len(node)):
        if used[k]:
            row, column = node[k] // len(col_window), node[k] % len(col_window)
            cells[0, row, column] += weight[k]
            cells[1, row, column] += weight[k] * min(residual[k] * residual[k] / total[k], clip)
    _blur(cells, row_window, col_window)
    for i in range(len(out)):
        row, column = i // len(col_window), i % len(col_window)
        out[i] = (cells[1, row, column] + 1) / (cells[0, row, column] + 1)


@part
def _blur(cells, row_window, col_window):
    """Replace sums over cells [k, R, C] by those in the windows [R, R] and [C, C] around every cell."""
    rows, cols = len(row_window), len(col_window)
    across, line = np.empty((rows, cols)), np.empty(cols)
    for layer in range(len(cells)):
        for i in range(rows):
            for c in range(cols):
                line[c] = 0.0
            for j in range(cols):
                value = cells[layer, i, j]
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
                cells[layer, i, c] = line[c]


@kernel
def link(log_depth, jump, least, by_square, right, down, far_right, far_down):
    """Write the links [R, C] of :class:`ufmstar_torch.posterior.scene.Grid` between nodes of mean log d [R, C]."""
    rows, cols = log_depth.shape
    for i in range(rows):
        for j in range(cols):
            edge = jump * abs(log_depth[i, j + 1] - log_depth[i, j]) if j + 1 < cols else np.inf
            right[i, j], far_right[i, j] = least + by_square * edge * edge, 1 / cols + edge
            edge = jump * abs(log_depth[i + 1, j] - log_depth[i, j]) if i + 1 < rows else np.inf
            down[i, j], far_down[i, j] = least + by_square * edge * edge, 1 / rows + edge
