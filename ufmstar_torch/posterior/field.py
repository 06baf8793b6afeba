"""A Gaussian field on a grid's nodes, conditioned on observations at some: mean and variance at every node (numba).

    y = x . b + f + noise,      b ~ N(b_0, P),      f ~ N(0, Q^-1)

with the features x and the field f of precision Q: f^T Q f = kappa |f|^2 + sum over links (f_i - f_j)^2 / variance of
the link. An observation of variance 1/w at node i adds w to Q_ii. A Schur complement integrates b out. The only large
system is that of the nodes.

A Cholesky factorisation (float64) solves it in a window of 32 nodes. With C columns, the precision matrix has
the bandwidth C, and elimination fills only the band. The window of C + 1 nodes
is a full matrix, which nodes enter and leave in order. A backward pass over the factor gives the covariance within the
window (Takahashi's equations), and with it all marginal variances. Node i has the slot i mod 32, so that every loop has
one fixed length.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.kernels.compile_cpu import empty, leaf, part, reordered_leaf
from ufmstar_torch.posterior.running import Floats

WINDOW = 32
# Number of right-hand sides: features, y, and zeros up to a multiple of four.
RIGHT = 8
_WIDTH = WINDOW + RIGHT


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
    factor, window, row = empty((n, _WIDTH), np.float64), empty((WINDOW, _WIDTH), np.float64), empty(_WIDTH, np.float64)
    solved, variance = empty((n, RIGHT), np.float64), empty(n, np.float64)
    _eliminate(diagonal, right, down, columns, cols, window, factor)
    _covariances(factor, window, row, solved, variance)
    return solved, variance


@reordered_leaf
def _eliminate(diagonal, right, down, columns, cols, window, factor):
    """Write the factor [n, 40]: row j has the window's nodes at their slots, then the right-hand sides."""
    n = diagonal.size
    _clear(window)
    for j in range(-cols, n):
        if j + cols < n:
            _enter(window, j + cols, diagonal, right, down, columns, cols)
        if j < 0:
            continue
        slot, row = j % WINDOW, factor[j]
        scale = 1 / math.sqrt(window[slot, slot])
        for c in range(_WIDTH):
            row[c] = window[slot, c] * scale
        for k in range(WINDOW):
            other, multiple = window[k], row[k]
            for c in range(len(row)):  # the compiler would unroll a constant length instead of vectorising
                other[c] -= multiple * row[c]
        for k in range(WINDOW):
            window[k, slot] = 0.0
        for c in range(_WIDTH):
            window[slot, c] = 0.0


@leaf
def _clear(window):
    for k in range(WINDOW):
        for c in range(_WIDTH):
            window[k, c] = 0.0


@leaf
def _enter(window, i, diagonal, right, down, columns, cols):
    """Enter node i with its links to earlier nodes at a slot that is 0."""
    slot, n = i % WINDOW, diagonal.size
    total = diagonal[i]
    if (i + 1) % cols:
        total += right[i]
    if i + cols < n:
        total += down[i]
    if i % cols:
        total += right[i - 1]
        window[slot, (i - 1) % WINDOW] -= right[i - 1]
        window[(i - 1) % WINDOW, slot] -= right[i - 1]
    if i >= cols:
        total += down[i - cols]
        window[slot, (i - cols) % WINDOW] -= down[i - cols]
        window[(i - cols) % WINDOW, slot] -= down[i - cols]
    window[slot, slot] += total
    for c in range(RIGHT):
        window[slot, WINDOW + c] = columns[i, c]


@reordered_leaf
def _covariances(factor, window, out, solved, variance):
    """Backward pass over the factor, whose diagonal is overwritten: the solutions and marginal variances."""
    _clear(window)
    for j in range(len(factor) - 1, -1, -1):
        slot, row = j % WINDOW, factor[j]
        scale = 1 / row[slot]
        row[slot] = 0.0
        for c in range(_WIDTH):
            out[c] = 0.0
        for k in range(0, WINDOW, 4):
            one, two, three, four = row[k], row[k + 1], row[k + 2], row[k + 3]
            for c in range(_WIDTH):
                first = one * window[k, c] + two * window[k + 1, c]
                out[c] += first + three * window[k + 2, c] + four * window[k + 3, c]
        total = 1.0
        for c in range(WINDOW):
            total += out[c] * row[c]
            window[slot, c] = -scale * out[c]
            window[c, slot] = -scale * out[c]
        variance[j] = window[slot, slot] = scale * scale * total
        for c in range(RIGHT):
            solved[j, c] = window[slot, WINDOW + c] = scale * (row[WINDOW + c] - out[WINDOW + c])


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
