"""A Gaussian field on a grid's nodes, conditioned on observations at some: mean and variance at every node.

    y = x . b + f + noise,      b ~ N(b_0, P),      f ~ N(0, Q^-1)

with the features x and the field f of precision Q: f^T Q f = kappa |f|^2 + sum over links (f_i - f_j)^2 / variance of
the link. An observation of variance 1/w at node i adds w to Q_ii. A Schur complement integrates b out. The only large
system is that of the nodes.

A Cholesky factorisation (numba, float64) solves it in a window of 32 nodes. With C columns, the precision matrix has
the bandwidth C, and elimination fills only the band. The window of C + 1 nodes
is a full matrix, which nodes enter and leave in order. A backward pass over the factor gives the covariance within the
window (Takahashi's equations), and with it all marginal variances. Node i has the slot i mod 32, so that every loop has
one fixed length.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.kernels.compile_cpu import cached, kernel, part
from ufmstar_torch.posterior.running import Floats

WINDOW = 32
# Number of right-hand sides: features, y, and zeros up to a multiple of four.
RIGHT = 8
_WIDTH = WINDOW + RIGHT

# Kernels (``compile_cpu``) whose sums may be reordered, for values without infinity and NaN.
fast = cached(fastmath=True)


class Field(NamedTuple):
    """b and f, conditioned on the observations.

    Attributes:
        coefficients: [F] mean of b.
        covariance: [F, F] of b.
        offset: [n] mean of f.
        response: [n, F] decrease of f's mean per unit of b.
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
        diagonal: [n] kappa.
        right, down: [n] precision of the link to the next node in the row, in the column; 0 where there is none.
        mean: [F] b_0; F + 1 is at most ``RIGHT``.
        precision: [F, F] P^-1.
        cols: nodes in a row, less than ``WINDOW``.
    """

    diagonal: Floats
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


def conditioned(prior: Prior, observed: Observed, weight: Floats) -> Field:
    """Condition the prior on observations of precision ``weight`` [N]."""
    n, F = len(prior.diagonal), len(prior.mean)
    nodes, offset, coefficients = np.zeros((n, RIGHT)), np.empty(n), prior.mean.copy()
    diagonal, precision, right_side = prior.diagonal.copy(), prior.precision.copy(), np.zeros(F)
    _gather(*observed, weight, prior.mean, diagonal, nodes, precision, right_side)
    solved, variance = solve(diagonal, prior.right, prior.down, nodes, prior.cols)
    _subtract_schur(nodes, solved, precision, right_side)
    _invert(precision)
    _add_observed(precision, right_side, solved, coefficients, offset)
    return Field(coefficients, precision, offset, solved[:, :F], variance)


@fast
def _gather(node, features, value, weight, mean, diagonal, nodes, precision, right_side):
    """Add the observations to the prior's equations: w to the diagonal of their nodes, w x and w (y - x b_0) to the
    nodes' right-hand sides, w x x^T and w x (y - x b_0) to the coefficients' precision and right-hand side."""
    F = len(mean)
    for k in range(len(node)):
        x, row, w, residual = features[k], nodes[node[k]], weight[k], value[k]
        for f in range(F):
            residual -= x[f] * mean[f]
        diagonal[node[k]] += w
        row[F] += w * residual
        for f in range(F):
            row[f] += w * x[f]
            right_side[f] += w * x[f] * residual
            for g in range(F):
                precision[f, g] += w * x[f] * x[g]


@fast
def _subtract_schur(nodes, solved, precision, right_side):
    """Schur complement: subtract what the field explains of the observations from the coefficients' equations."""
    F = len(right_side)
    for i in range(len(nodes)):
        x, y = nodes[i], solved[i]
        if x[0] > 0:  # observed; the first feature is 1
            for f in range(F):
                right_side[f] -= x[f] * y[F]
                for g in range(F):
                    precision[f, g] -= x[f] * y[g]


@fast
def _invert(A):
    """Invert a positive definite matrix [F, F] in place (Gauss-Jordan)."""
    for k in range(len(A)):
        pivot = 1 / A[k, k]
        A[k, k] = 1.0
        for c in range(len(A)):
            A[k, c] *= pivot
        for r in range(len(A)):
            if r != k:
                factor = A[r, k]
                A[r, k] = 0.0
                for c in range(len(A)):
                    A[r, c] -= factor * A[k, c]


@fast
def _add_observed(covariance, right_side, solved, coefficients, offset):
    """Add the observations' effect to the coefficients, and write the mean of the field."""
    F = len(right_side)
    b = np.zeros(F)
    for f in range(F):
        for g in range(F):
            b[f] += covariance[f, g] * right_side[g]
        coefficients[f] += b[f]
    for i in range(len(offset)):
        offset[i] = solved[i, F]
        for f in range(F):
            offset[i] -= solved[i, f] * b[f]


def at(field: Field, node: NDArray[np.int64], features: Floats) -> tuple[Floats, Floats]:
    """Mean and variance [N] of x . b + f at nodes [N] with features [N, F]."""
    mean, variance = field.offset[node], field.variance[node]
    _add_coefficients(features, features - field.response[node], field.coefficients, field.covariance, mean, variance)
    return mean, variance


@fast
def _add_coefficients(features, reduced, b, covariance, mean, variance):
    """Add x . b to the mean, and r . covariance r to the variance, with r = ``reduced``: x less the field's
    response."""
    F = len(b)
    for k in range(len(features)):
        x = reduced[k]
        for f in range(F):
            mean[k] += features[k, f] * b[f]
            product = 0.0
            for g in range(F):
                product += covariance[f, g] * x[g]
            variance[k] += product * x[f]


def solve(diagonal: Floats, right: Floats, down: Floats, columns: Floats, cols: int) -> tuple[Floats, Floats]:
    """Solve A X = Y and compute the diagonal of A^-1, for A from a diagonal and the links of a grid.

    Args:
        diagonal: [n] diagonal of A without the links, positive.
        right, down: [n] precision of the link to the next node in the row, in the column; 0 where there is none.
        columns: [n, RIGHT] Y.
        cols: nodes in a row, less than ``WINDOW``.

    Returns:
        X [n, RIGHT], and the diagonal of A^-1 [n].
    """
    n = len(diagonal)
    factor, solved, variance = np.empty((n, _WIDTH)), np.empty((n, RIGHT)), np.empty(n)
    _eliminate(diagonal, right, down, columns, cols, np.zeros((WINDOW, _WIDTH)), factor)
    _covariances(factor, np.zeros((WINDOW, _WIDTH)), np.empty(_WIDTH), solved, variance)
    return solved, variance


@fast
def _eliminate(diagonal, right, down, columns, cols, window, factor):
    """Write the factor [n, 40]: row j has the window's nodes at their slots, then the right-hand sides."""
    n = len(diagonal)
    for j in range(-cols, n):
        if j + cols < n:
            _enter(window, j + cols, diagonal, right, down, columns, cols)
        if j < 0:
            continue
        slot, row = j % WINDOW, factor[j]
        scale = 1 / np.sqrt(window[slot, slot])
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


@part
def _enter(window, i, diagonal, right, down, columns, cols):
    """Enter node i with its links to earlier nodes at a slot that is 0."""
    slot, n = i % WINDOW, len(diagonal)
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


@fast
def _covariances(factor, window, out, solved, variance):
    """Backward pass over the factor, whose diagonal is overwritten: the solutions and marginal variances."""
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


def distance(source: NDArray[np.bool_], right: Floats, down: Floats, cols: int, limit: float) -> Floats:
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
    length = np.where(source, 0.0, limit)
    _sweep(length, right, down, cols)
    return length


@kernel
def _sweep(length, right, down, cols):
    """Relax the lengths forwards and backwards until none changes."""
    n, shorter = len(length), True
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
