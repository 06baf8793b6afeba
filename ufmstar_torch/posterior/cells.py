"""Means of pixels in cells, and interpolation from nodes to pixels, without smoothing across depth edges (numba)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.check import FARTHEST_OFF
from ufmstar_torch.kernels.compile_cpu import cached
from ufmstar_torch.posterior.config import PosteriorConfig
from ufmstar_torch.posterior.field import fast
from ufmstar_torch.posterior.running import Floats

# Upper limit of |y|: anchors that are off by more are not valid.
LARGEST = math.log(FARTHEST_OFF)
# Kernels whose sums may be reordered, for values with NaN.
with_nan = cached(fastmath={"contract", "reassoc", "nsz", "arcp"})


def cell_means(logs: NDArray[Any], valid: NDArray[np.bool_], rows: int, cols: int) -> Floats:
    """Mean of log d over the valid pixels of every cell [rows cols]; a cell covers every pixel that it touches."""
    total, count = np.zeros((2, rows, cols))
    _add_up(logs, valid, total, count)
    mean = total / np.maximum(count, 1)
    return np.where(count > 0, mean, mean.sum() / max(np.count_nonzero(count), 1)).ravel()


@fast
def _add_up(logs, valid, total, count):
    """Sums over the cells."""
    height, width = logs.shape
    rows, cols = total.shape
    for row in range(rows):
        for i in range(row * height // rows, ((row + 1) * height + rows - 1) // rows):
            for c in range(cols):
                cell_sum, used = 0.0, 0
                for j in range(c * width // cols, ((c + 1) * width + cols - 1) // cols):
                    if valid[i, j]:
                        cell_sum += logs[i, j]
                        used += 1
                total[row, c] += cell_sum
                count[row, c] += used


def features(logs: Floats, u: Floats, v: Floats) -> Floats:
    """[N, 4] features for log d - m_0 [N] at u and v [N] from 0 to 1: 1, log d - m_0, u and v from -1 to 1."""
    return np.stack([np.ones_like(logs), logs, 2 * u - 1, 2 * v - 1], 1)


def ranges(depth: NDArray[Any], valid: NDArray[np.bool_], index: NDArray[np.int64]) -> Floats:
    """[N] largest less smallest log d of the valid pixels among a valid pixel and its eight neighbours."""
    out = np.empty(len(index))
    _highest_over_lowest(depth, valid, index, out)
    return np.log(out)


@fast
def _highest_over_lowest(depth, valid, index, out):
    height, width = depth.shape
    for k in range(len(index)):
        row, column = index[k] // width, index[k] % width
        low = high = np.float64(depth[row, column])
        for i in range(max(row - 1, 0), min(row + 2, height)):
            for j in range(max(column - 1, 0), min(column + 2, width)):
                if valid[i, j]:
                    low, high = min(low, np.float64(depth[i, j])), max(high, np.float64(depth[i, j]))
        out[k] = high / low


def local_variance(f: Floats) -> Floats:
    """[R, C] variance of f [R, C] over each value and its eight neighbours; border values are repeated outside."""
    out = np.empty_like(f)
    _vary(f, out)
    return out


@fast
def _vary(f, out):
    rows, cols = f.shape
    for i in range(rows):
        for j in range(cols):
            total = squares = 0.0  # of differences from the centre, to lose less in rounding
            for r in range(i - 1, i + 2):
                for c in range(j - 1, j + 2):
                    difference = f[min(max(r, 0), rows - 1), min(max(c, 0), cols - 1)] - f[i, j]
                    total += difference
                    squares += difference * difference
            out[i, j] = squares / 9 - (total / 9) ** 2


def read(
    depth: NDArray[Any], valid: NDArray[np.bool_], logs: NDArray[Any], claimed: NDArray[Any], nodes: Floats,
    coefficients: Floats, mean: float, size: tuple[int, int], config: PosteriorConfig,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:  # fmt: skip
    """Depth, variances and the probability of another surface at every pixel.

    The four nodes around a pixel have their bilinear weights times 1/(1 + (D/edge_contrast)^2); D is the difference
    between the pixel's log d and the node's.

    Args:
        depth: [H, W] d [m].
        valid: [H, W].
        logs: [H, W] log d.
        claimed: [H, W] UfM*'s variance [m^2]; its product with the share without evidence is a lower limit.
        nodes: [n, 6] log d, y - b . x, variance over the squared depth, the same on the evidence's surface, probability
            of another surface, and share without evidence.
        coefficients: [4] of 1, log d - m_0, u, v.
        mean: m_0.
        size: R and C of the nodes.
        config: of the posterior.

    Returns:
        Depth d e^y [m], its variance [m^2], that on the surface of the evidence, and the probability, [H, W] in
        depth's dtype, NaN where not valid.
    """
    rows, cols = size
    width = depth.shape[1]
    u = (np.arange(width) + 0.5) / width
    between = (u * cols - 0.5).clip(0, cols - 1)
    before = np.minimum(between.astype(np.int64), max(cols - 2, 0))
    lines = np.ascontiguousarray(nodes.reshape(rows, cols, 6).transpose(0, 2, 1))
    left, right = lines.take(before, 2), lines.take(np.minimum(before + 1, cols - 1), 2)
    y, spread, inlier, p = (np.empty_like(logs) for _ in range(4))
    base = coefficients[0] - coefficients[1] * mean + coefficients[2] * (2 * u - 1)
    slopes = coefficients[1], coefficients[3]
    limits = config.edge_contrast**2, LARGEST
    _pixels(depth, valid, logs, claimed, left, right, between - before, base, slopes, limits, y, spread, inlier, p)
    factor = np.exp(y, out=y)
    square = factor * factor
    return depth * factor, spread * square, inlier * square, p


@with_nan
def widen(depth, variance, inlier, shared, scale, contradiction, limit, floor):
    """Raise two variances [H, W] to ``floor`` and add what the anchors of a frame share (``correct.widened``)."""
    for i in range(depth.shape[0]):
        d, V, V1 = depth[i], variance[i], inlier[i]
        for j in range(len(d)):
            square = np.float64(d[j]) * np.float64(d[j])
            common = square * shared + scale
            added = square * (contradiction + (common if common < limit else limit))
            V[j] = (floor if V[j] < floor else V[j]) + added
            V1[j] = (floor if V1[j] < floor else V1[j]) + added


@with_nan
def _pixels(depth, valid, logs, claimed, left, right, across, base, slopes, limits, y, spread, inlier, outlier):
    """Write y [H, W], the variances of d e^y over e^2y, and p at every pixel; y and p are NaN where not valid.

    ``left`` and ``right`` [R, 6, W] are the nodes before and after each column, ``across`` the weight of the one after.
    The ratios of the four weights s/(1 + D^2) are those of s times the other three denominators.
    """
    height, rows = len(logs), len(left)
    contrast2, largest = limits
    by_depth, by_row = slopes
    for i in range(height):
        v = (i + 0.5) / height
        position = min(max(v * rows - 0.5, 0.0), rows - 1.0)
        top = min(int(position), max(rows - 2, 0))
        fv, bottom = position - top, min(top + 1, rows - 1)
        n0, n1, n2, n3 = left[top], right[top], left[bottom], right[bottom]
        depths, used, gs, Vs = depth[i], valid[i], logs[i], claimed[i]
        ys, variances, inliers, outliers = y[i], spread[i], inlier[i], outlier[i]
        for j in range(len(across)):
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
