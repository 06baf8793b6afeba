"""Adds up tests of motion by cell, for ``anchors.motion``; on the CPU (numba)."""

from __future__ import annotations

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, reordered

_LEAST, _MOST = 0.02, 0.98  # limits of F_k
_WINDOW = 1.5  # standard deviation of the window [cells]
_CERTAIN = 1.9  # log ratio from which a surface counts as moving: motion is then more probable, by the prior odds


@reordered
def tally(pixel, failed, used, cell, out):
    """Count the used ones of N tests, passed or failed [N], in ``out`` [2, R, C] by cells of the pixels [N, 2]."""
    rows, columns = out.shape[1:]
    for n in range(len(pixel)):
        if used[n]:
            row, column = int(pixel[n, 1] / cell), int(pixel[n, 0] / cell)
            out[1 if failed[n] else 0, min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)] += 1


@reordered
def combine(tests, count, failures, memory, caught, weight, ratios):
    """Write the log likelihood ratios of motion [R, C].

    Args:
        tests: [K, 2, R, C] by kind, see :func:`tally`.
        count, failures: [K] running numbers of tests and of failed ones, updated.
        memory: share of them that remains.
        caught, weight: [K] c_k, and the weights of the tests.
        ratios: overwritten.
    """
    rows, columns = ratios.shape
    cells, smooth = empty((rows, columns), np.float64), empty((rows, columns), np.float64)
    window = empty(max(rows, columns), np.float64)
    for i in range(len(window)):
        window[i] = np.exp(-((i / _WINDOW) ** 2) / 2)
    for k in range(len(tests)):
        count[k] *= memory
        failures[k] *= memory
        for row in range(rows):
            for column in range(columns):
                count[k] += tests[k, 0, row, column] + tests[k, 1, row, column]
                failures[k] += tests[k, 1, row, column]
        failing = min(max(failures[k] / max(count[k], 1e-9), _LEAST), _MOST)
        fails = weight[k] * np.log((failing + (1 - failing) * caught[k]) / failing)
        passes = weight[k] * np.log(1 - caught[k])
        for row in range(rows):
            for column in range(columns):
                before = cells[row, column] if k > 0 else 0.0
                cells[row, column] = before + passes * tests[k, 0, row, column] + fails * tests[k, 1, row, column]
    for row in range(rows):
        for column in range(columns):
            smooth[row, column] = 0.0
        for other in range(rows):
            for column in range(columns):
                smooth[row, column] += window[abs(row - other)] * cells[other, column]
    for row in range(rows):
        for column in range(columns):
            total = 0.0
            for other in range(columns):
                total += window[abs(column - other)] * smooth[row, other]
            ratios[row, column] = total


@reordered
def mark(ratios, pixel, cell, moving):
    """Write which pixels [N, 2] lie in a cell that moves, from the log ratios [R, C] of the cells."""
    rows, columns = ratios.shape
    for n in range(len(pixel)):
        row, column = int(pixel[n, 1] / cell), int(pixel[n, 0] / cell)
        moving[n] = ratios[min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)] > _CERTAIN
