"""The posterior's field, distances and maps on the CPU (numba), float64, one stream after the other.

The precision of a field on C columns has a band of C + 1: its Cholesky factor fills it, and the inverse within the band
follows from the factor alone (Takahashi's equations), so that all marginal variances cost what the factor does.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from ufmstar_torch.posterior.field import Solved
from ufmstar_torch.posterior.read import ALIKE, LARGEST_LOG

compiled: Any = njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
# Distances are compared with infinity, which fast arithmetic leaves undefined.
exactly: Any = njit(cache=True, nogil=True, error_model="numpy")


def solve(diagonal: Tensor, right: Tensor, down: Tensor, columns: Tensor, cols: int) -> Solved:
    """As :func:`ufmstar_torch.posterior.field.solve`, for CPU tensors."""
    solved, variance = columns.clone(memory_format=torch.contiguous_format), torch.empty_like(diagonal)
    maps = (x.contiguous().numpy() for x in (diagonal, right, down))
    for d, r, b, x, v in zip(*maps, solved.numpy(), variance.numpy(), strict=True):
        factor = np.zeros((len(d), cols + 1))
        _factorise(d, r, b, cols, factor)
        _substitute(factor, x)
        _invert(factor, v)
    return Solved(solved, variance)


@compiled
def _factorise(diagonal, right, down, cols, L):
    """L[j, k] is the factor's entry in column j and row j + k."""
    n = len(diagonal)
    for i in range(n):
        L[i, 0] += diagonal[i]
        if (i + 1) % cols:
            L[i, 0] += right[i]
            L[i + 1, 0] += right[i]
            L[i, 1] -= right[i]
        if i + cols < n:
            L[i, 0] += down[i]
            L[i + cols, 0] += down[i]
            L[i, cols] -= down[i]
    for j in range(n):
        pivot, last = 1 / np.sqrt(L[j, 0]), min(cols, n - 1 - j)
        for k in range(last + 1):
            L[j, k] *= pivot
        for k in range(1, last + 1):
            factor, row = L[j, k], L[j + k]
            for m in range(k, last + 1):
                row[m - k] -= L[j, m] * factor


@compiled
def _substitute(L, X):
    """X [n, q] becomes A^-1 X."""
    n, q = X.shape
    cols = L.shape[1] - 1
    for j in range(n):
        x, pivot = X[j], 1 / L[j, 0]
        for c in range(q):
            x[c] *= pivot
        for k in range(1, min(cols, n - 1 - j) + 1):
            factor, y = L[j, k], X[j + k]
            for c in range(q):
                y[c] -= factor * x[c]
    for j in range(n - 1, -1, -1):
        x, pivot = X[j], 1 / L[j, 0]
        for k in range(1, min(cols, n - 1 - j) + 1):
            factor, y = L[j, k], X[j + k]
            for c in range(q):
                x[c] -= factor * y[c]
        for c in range(q):
            x[c] *= pivot


@compiled
def _invert(L, variance):
    """Diagonal of A^-1. S[j, k] is the inverse's entry (j, j + k)."""
    n, band = L.shape
    S, scaled, out = np.zeros((n, band)), np.empty(band), np.empty(band)
    for j in range(n - 1, -1, -1):
        pivot, last = 1 / L[j, 0], min(band - 1, n - 1 - j)
        for k in range(1, last + 1):
            scaled[k] = L[j, k] * pivot
            out[k] = 0.0
        for m in range(1, last + 1):
            row, factor = S[j + m], scaled[m]
            along = row[0] * factor
            for k in range(m + 1, last + 1):
                out[k] += row[k - m] * factor
                along += row[k - m] * scaled[k]
            out[m] += along
        own = pivot * pivot
        for k in range(1, last + 1):
            S[j, k] = -out[k]
            own += out[k] * scaled[k]
        S[j, 0] = own
        variance[j] = own


def distance(source: Tensor, right: Tensor, down: Tensor, cols: int, limit: float) -> Tensor:
    """As :func:`ufmstar_torch.posterior.distance.distance`, for CPU tensors."""
    way = torch.where(source, 0.0, right.new_tensor(limit))
    for w, r, d in zip(way.numpy(), right.contiguous().numpy(), down.contiguous().numpy(), strict=True):
        _sweep(w, r, d, cols)
    return way


@exactly
def _sweep(way, right, down, cols):
    """Sweeps forth and back until nothing gets shorter."""
    n, shorter = len(way), True
    while shorter:
        shorter = False
        for i in range(n):
            best = way[i]
            if i % cols and way[i - 1] + right[i - 1] < best:
                best = way[i - 1] + right[i - 1]
            if i >= cols and way[i - cols] + down[i - cols] < best:
                best = way[i - cols] + down[i - cols]
            shorter = shorter or best < way[i]
            way[i] = best
        for i in range(n - 1, -1, -1):
            best = way[i]
            if (i + 1) % cols and way[i + 1] + right[i] < best:
                best = way[i + 1] + right[i]
            if i + cols < n and way[i + cols] + down[i] < best:
                best = way[i + cols] + down[i]
            shorter = shorter or best < way[i]
            way[i] = best


def read(
    depth: Tensor, valid: Tensor, claimed: Tensor, nodes: Tensor, coefficients: Tensor, mean: Tensor,
    size: tuple[int, int],
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """As :func:`ufmstar_torch.posterior.read.read`, for CPU tensors."""
    logs = torch.where(valid, depth, torch.ones_like(depth)).log()
    y, spread = torch.empty_like(logs), torch.empty_like(logs)
    maps = (x.detach().contiguous().numpy() for x in (depth, logs, claimed, nodes, coefficients))
    for d, g, c, at, b, m, out, var in zip(*maps, mean.tolist(), y.numpy(), spread.numpy(), strict=True):
        _pixels(d, g, c, at, b, m, *size, ALIKE, LARGEST_LOG, out, var)
    corrected = depth * y.exp()
    corrected, variance = (torch.where(valid, x, torch.nan) for x in (corrected, corrected.square() * spread))
    return corrected, variance


@compiled
def _pixels(depth, logs, claimed, nodes, b, mean, rows, cols, alike, largest, y, spread):
    """y [H, W] and its variance, at every pixel."""
    height, width = depth.shape
    over = 1 / (alike * alike)
    for i in range(height):
        v = (i + 0.5) / height
        at = min(max(v * rows - 0.5, 0.0), rows - 1.0)
        top = min(int(at), max(rows - 2, 0))
        below, low = at - top, min(top + 1, rows - 1)
        for j in range(width):
            u = (j + 0.5) / width
            at = min(max(u * cols - 0.5, 0.0), cols - 1.0)
            left = min(int(at), max(cols - 2, 0))
            beside, far = at - left, min(left + 1, cols - 1)
            g, total, offset, variance, unseen = logs[i, j], 0.0, 0.0, 0.0, 0.0
            for corner in range(4):
                row = low if corner > 1 else top
                column = far if corner % 2 else left
                share = (below if corner > 1 else 1 - below) * (beside if corner % 2 else 1 - beside)
                node = nodes[row * cols + column]
                apart = g - node[0]
                weight = share / (1 + apart * apart * over)
                total += weight
                offset += weight * node[1]
                variance += weight * node[2]
                unseen += weight * node[3]
            value = b[0] + b[1] * (g - mean) + b[2] * (2 * u - 1) + b[3] * (2 * v - 1) + offset / total
            y[i, j] = min(max(value, -largest), largest)
            spread[i, j] = (variance + unseen * claimed[i, j] / (depth[i, j] * depth[i, j])) / total
