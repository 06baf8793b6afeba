"""A Gaussian field on a grid's nodes, conditioned on observations at some: mean and variance at every node (numba).

    y = x . b + f + noise,      b ~ N(b_0, P),      f ~ N(0, Q^-1)

with the features x and the field f of precision Q: f^T Q f = kappa |f|^2 + sum over links (f_i - f_j)^2 / variance of
the link. An observation of variance 1/w at node i adds w to Q_ii. A Schur complement integrates b out. The only large
system is that of the nodes.

A Cholesky factorisation (float64) solves it in the band: with C columns, the precision matrix and its factor have the
bandwidth C. Each row of the factor is that of the matrix less multiples of the C rows before, and has the matrix's
diagonal first. A backward pass over the factor gives the covariance within a window of 32 nodes (Takahashi's
equations), and with it all marginal variances; node i has the slot i mod 32. Both passes are vector instructions, since
LLVM would keep the sums over earlier rows in memory.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.kernels.compile_cpu import empty, leaf, part
from ufmstar_torch.kernels.cpu.vectors import Lanes, vectors
from ufmstar_torch.posterior.running import Floats

WINDOW = 32
# Number of right-hand sides: features, y, and zeros up to a vector of 64 bytes.
RIGHT = 8
# Numbers in a row of the factor: the band, a vector of zeros, and the right-hand sides. Numbers in a row of the window.
_ROW, _WIDTH = WINDOW + 2 * RIGHT, WINDOW + RIGHT


class Field(NamedTuple):
    """b and f, conditioned on the observations.

    Attributes:
        coefficients: [F] mean of b.
        covariance: [F, F] of b.
        offset: [n] mean of f.
        response: [n, RIGHT] decrease of f's mean per unit of b, in the first F columns.
        variance: [n] variance of f for fixed b.
    """

    coefficients: Floats
    covariance: Floats
    offset: Floats
    response: Floats
    variance: Floats


class Prior(NamedTuple):
    """Prior of b and f.

    Attributes:
        diagonal: kappa.
        right, down: [n] precision of the link to the next node in the row, in the column; 0 where there is none.
        mean: [F] b_0; F + 1 is at most ``RIGHT``.
        precision: [F, F] P^-1.
        cols: nodes in a row, less than ``WINDOW``.
    """

    diagonal: float
    right: Floats
    down: Floats
    mean: Floats
    precision: Floats
    cols: int


class Observed(NamedTuple):
    """N observations. Some may have the weight 0.

    Attributes:
        node: [N].
        features: [N, F] x; the first is 1.
        value: [N] y.
    """

    node: NDArray[np.int64]
    features: Floats
    value: Floats


@part
def conditioned(prior, observed, weight):
    """The :class:`Field` of a :class:`Prior`, conditioned on observations of precision ``weight`` [N]."""
    n, F = prior.right.size, prior.mean.size
    diagonal, nodes = empty(n, np.float64), empty((n, RIGHT), np.float64)
    coefficients, precision = empty(F, np.float64), empty((F, F), np.float64)
    offset, right_side = empty(n, np.float64), empty(F, np.float64)
    _gather(prior, observed, weight, diagonal, nodes, precision, right_side)
    solved, variance = solve(diagonal, prior.right, prior.down, nodes, prior.cols)
    _subtract_schur(nodes, solved, precision, right_side)
    invert(precision)
    _add_observed(prior.mean, precision, right_side, solved, coefficients, offset)
    return Field(coefficients, precision, offset, solved, variance)


@leaf
def _gather(prior, observed, weight, diagonal, nodes, precision, right_side):
    """Write the equations. The observations add w to the diagonal of their nodes, w x and w (y - x b_0) to the nodes'
    right-hand sides, w x x^T and w x (y - x b_0) to the coefficients' precision and right-hand side."""
    F = prior.mean.size
    for i in range(diagonal.size):
        diagonal[i] = prior.diagonal
        for c in range(RIGHT):
            nodes[i, c] = 0.0
    for f in range(F):
        right_side[f] = 0.0
        for g in range(F):
            precision[f, g] = prior.precision[f, g]
    for k in range(weight.size):
        i, w, residual = observed.node[k], weight[k], observed.value[k]
        for f in range(F):
            residual -= observed.features[k, f] * prior.mean[f]
        diagonal[i] += w
        nodes[i, F] += w * residual
        for f in range(F):
            weighted = w * observed.features[k, f]
            nodes[i, f] += weighted
            right_side[f] += weighted * residual
            for g in range(F):
                precision[f, g] += weighted * observed.features[k, g]


@leaf
def _subtract_schur(nodes, solved, precision, right_side):
    """Schur complement: subtract what the field explains of the observations from the coefficients' equations."""
    F = right_side.size
    for i in range(nodes.shape[0]):
        if nodes[i, 0] > 0:  # observed; the first feature is 1
            for f in range(F):
                right_side[f] -= nodes[i, f] * solved[i, F]
                for g in range(F):
                    precision[f, g] -= nodes[i, f] * solved[i, g]


@leaf
def invert(A):
    """Invert a positive definite matrix [F, F] in place (Gauss-Jordan)."""
    n = A.shape[0]
    for k in range(n):
        pivot = 1 / A[k, k]
        A[k, k] = 1.0
        for c in range(n):
            A[k, c] *= pivot
        for r in range(n):
            if r != k:
                factor = A[r, k]
                A[r, k] = 0.0
                for c in range(n):
                    A[r, c] -= factor * A[k, c]


@leaf
def _add_observed(before, covariance, right_side, solved, coefficients, offset):
    """Add the observations' effect to the coefficients ``before``, and write the mean of the field."""
    F = before.size
    for f in range(F):
        coefficients[f] = 0.0
        for g in range(F):
            coefficients[f] += covariance[f, g] * right_side[g]
    for i in range(offset.size):
        offset[i] = solved[i, F]
        for f in range(F):
            offset[i] -= solved[i, f] * coefficients[f]
    for f in range(F):
        coefficients[f] += before[f]


@leaf
def at(field, node, features, k):
    """Mean and variance of x . b + f at a node, for x = ``features[k]``."""
    F, mean, variance = field.coefficients.size, field.offset[node], field.variance[node]
    for f in range(F):
        mean += features[k, f] * field.coefficients[f]
        product = 0.0
        for g in range(F):
            product += field.covariance[f, g] * (features[k, g] - field.response[node, g])
        variance += product * (features[k, f] - field.response[node, f])
    return mean, variance


@part
def solve(diagonal, right, down, columns, cols):
    """Solve A X = Y and compute the diagonal of A^-1, for A from a diagonal and the links of a grid.

    Args:
        diagonal: [n] diagonal of A without the links, positive.
        right, down: [n] precision of the link to the next node in the row, in the column; 0 where there is none.
        columns: [n, RIGHT] Y.
        cols: nodes in a row, less than ``WINDOW``.

    Returns:
        X [n, RIGHT], and the diagonal of A^-1 [n].
    """
    n = diagonal.size
    factor, window, work = (
        empty((cols + n, _ROW), np.float64), empty((WINDOW, _WIDTH), np.float64), empty(8 + 2 * WINDOW, np.float64),
    )  # fmt: skip
    solved, variance = empty((n, RIGHT), np.float64), empty(n, np.float64)
    _eliminate(diagonal, right, down, columns, cols, factor)
    _covariances(factor, cols, window, work, solved, variance)
    return solved, variance


@leaf
def _eliminate(diagonal, right, down, columns, cols, factor):
    """Write the factor [C + n, 48]: zeros, then for each node the diagonal, the following nodes of the band, zeros from
    the 33rd number on, and the right-hand sides."""
    for i in range(factor.shape[0]):
        for c in range(_ROW):
            factor[i, c] = 0.0
    one, two, three, four = min(cols, 8), min(max(cols - 8, 0), 8), min(max(cols - 16, 0), 8), max(cols - 24, 0)
    for i in range(diagonal.size):
        row, total = factor[cols + i], diagonal[i]
        total += right[i - 1] if i % cols else 0.0
        total += down[i - cols] if i >= cols else 0.0
        if (i + 1) % cols:
            total += right[i]
            row[1] -= right[i]
        if i + cols < diagonal.size:
            total += down[i]
            row[cols] -= down[i]
        row[0] = total
        for c in range(RIGHT):
            row[_ROW - RIGHT + c] = columns[i, c]
        _subtract(factor, (cols + i) * _ROW, cols, one, two, three, four)
        scale = 1 / math.sqrt(row[0])
        for c in range(_ROW):
            row[c] *= scale


@vectors
def _subtract(code, factor, at, cols, one, two, three, four):
    """Subtract multiples of the ``cols`` rows before the row at the index ``at`` from it, the farthest first. The row k
    before has the multiple in its column k, and zeros beyond column ``cols``: of the farthest ``one`` rows, a vector
    remains, of the next ``two``, two vectors remain, and so on."""
    band, answers = [factor.load(at, 8 * v) for v in range(4)], factor.load(at, _ROW - RIGHT)
    farthest = code.plus(at, code.times(cols, 1 - _ROW)), code.plus(at, code.times(cols, -_ROW))
    for before, rows in enumerate((one, two, three, four)):
        sums = [code.variable(answers * 0.0) for _ in range(before + 2)]
        with code.loop(rows) as t:
            column, row = (
                code.plus(start, code.times(t, step)) for start, step in zip(farthest, (_ROW - 1, _ROW), strict=True)
            )
            multiple = factor.one(column, 8 * before * (_ROW - 1))
            for v in range(before + 1):
                part_of_row = factor.load(column, 8 * before * (_ROW - 1) + 8 * v)
                sums[v].value = sums[v].value + multiple * part_of_row
            sums[-1].value = sums[-1].value + multiple * factor.load(row, 8 * before * _ROW + _ROW - RIGHT)
        band = [value - sums[v].value if v <= before else value for v, value in enumerate(band)]
        answers = answers - sums[-1].value
    for v, value in enumerate(band):
        factor.store(value, at, 8 * v)
    factor.store(answers, at, _ROW - RIGHT)


@leaf
def _covariances(factor, cols, window, work, solved, variance):
    """Backward pass over the factor, whose diagonal is overwritten: the solutions and marginal variances."""
    for k in range(WINDOW):
        for c in range(_WIDTH):
            window[k, c] = 0.0
    for j in range(variance.size - 1, -1, -1):
        row, slot = factor[cols + j], j % WINDOW
        scale = work[0] = 1 / row[0]
        row[0] = 0.0
        later = min(cols, WINDOW - 1 - slot)
        _combine(factor, (cols + j) * _ROW, window, slot, later, cols - later, solved, j, work)
        for c in range(WINDOW):
            window[c, slot] = window[slot, c]
        variance[j] = window[slot, slot] = scale * scale - scale * work[1]


@vectors
def _combine(code, factor, at, window, slot, later, wrapped, solved, j, work):
    """Write the covariances of node j with the window, its solution, and the sum of its covariances weighted by its row
    of the factor, from this row at the index ``at``. The ``later`` next nodes have the slots after the node's, the
    ``wrapped`` ones after them those from 0 on.

    ``work`` has 1 over the factor's diagonal; the sum becomes its second number, and the covariances its last 64.
    """
    zero, scale = work.one(0) * 0.0, work.one(0)
    sums, line = [code.variable(zero) for _ in range(5)], code.times(slot, _WIDTH)
    for count, first, offset, column in (
        (later, line, _WIDTH, at),
        (wrapped, code.times(slot, 0), 0, code.plus(at, later)),
    ):
        with code.loop(count) as t:
            multiple, other = factor.one(code.plus(column, t), 1), code.plus(first, code.times(t, _WIDTH))
            for v, total in enumerate(sums):
                total.value = total.value + multiple * window.load(other, offset + 8 * v)
    for v, total in enumerate(sums[:4]):
        covariance = zero - scale * total.value
        window.store(covariance, line, 8 * v)
        work.store(covariance, 8 + 8 * v)
        work.store(covariance, 40 + 8 * v)
    solution = scale * (factor.load(at, _ROW - RIGHT) - sums[4].value)
    window.store(solution, line, WINDOW)
    solved.store(solution, code.times(j, RIGHT))
    product = zero
    for v in range(4):
        product = product + factor.load(at, 8 * v) * work.load(slot, 8 + 8 * v)
    work.put(product.everywhere(Lanes.__add__), 1)


@part
def distance(source, right, down, cols, limit):
    """Geodesic distance of every node from the nearest evidence, along the links of the grid.

    Args:
        source: [n] True at nodes with evidence.
        right, down: [n] positive lengths of the links to the next node in the row, in the column; infinite where there
            is none.
        cols: nodes in a row.
        limit: upper limit of the distances.

    Returns:
        [n] distances.
    """
    length = empty(source.size, np.float64)
    for i in range(length.size):
        length[i] = 0.0 if source[i] else limit
    _sweep(length, right, down, cols)
    return length


@leaf
def _sweep(length, right, down, cols):
    """Relax the lengths forwards and backwards until none changes."""
    n, shorter = length.size, True
    while shorter:
        shorter = False
        for i in range(n):
            best = length[i]
            if i % cols and length[i - 1] + right[i - 1] < best:
                best = length[i - 1] + right[i - 1]
            if i >= cols and length[i - cols] + down[i - cols] < best:
                best = length[i - cols] + down[i - cols]
            shorter = shorter or best < length[i]
            length[i] = best
        for i in range(n - 1, -1, -1):
            best = length[i]
            if (i + 1) % cols and length[i + 1] + right[i] < best:
                best = length[i + 1] + right[i]
            if i + cols < n and length[i + cols] + down[i] < best:
                best = length[i + cols] + down[i]
            shorter = shorter or best < length[i]
            length[i] = best
