"""Cholesky factors of small symmetric positive definite matrices in compiled code: solutions and inverses."""

from __future__ import annotations

import numpy as np

from ufmstar_torch.kernels.compile_cpu import reordered_leaf


@reordered_leaf
def factored(A):
    """Overwrite the lower triangle of A [n, n] with L of L L^T = A; False where A is not positive definite."""
    for j in range(len(A)):
        for i in range(j, len(A)):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            if i > j:
                A[i, j] = total / A[j, j]
            elif total > 0:
                A[i, j] = np.sqrt(total)
            else:
                return False
    return True


@reordered_leaf
def substituted(L, b):
    """Overwrite b [n] with the solution x of L L^T x = b."""
    n = len(b)
    for i in range(n):
        total = b[i]
        for k in range(i):
            total -= L[i, k] * b[k]
        b[i] = total / L[i, i]
    for i in range(n - 1, -1, -1):
        b[i] /= L[i, i]
        for k in range(i):
            b[k] -= L[i, k] * b[i]


@reordered_leaf
def inverted(L, inverse):
    """Write the inverse of L L^T to ``inverse`` [n, n]."""
    size = len(L)
    for j in range(size):  # the columns of L^-1, as rows of the upper triangle
        inverse[j, j] = 1 / L[j, j]
        for i in range(j + 1, size):
            total = 0.0
            for k in range(j, i):
                total += L[i, k] * inverse[j, k]
            inverse[j, i] = -total / L[i, i]
    for i in range(size):
        for j in range(i + 1):  # j = i comes last, because the other sums read inverse[i, i]
            total = 0.0
            for k in range(i, size):
                total += inverse[i, k] * inverse[j, k]
            inverse[i, j] = total
    for i in range(size):
        for j in range(i):
            inverse[j, i] = inverse[i, j]


@reordered_leaf
def reduced(A, left, right):
    """Subtract left^T right from the lower triangle of A [n, n], for ``left`` and ``right`` [m, n]."""
    size, count = len(A), len(left)
    whole = count - count % 4
    for n in range(0, whole, 4):  # four rows at a time: A is read and written once for them
        for i in range(size):
            one, two, three, four = left[n, i], left[n + 1, i], left[n + 2, i], left[n + 3, i]
            for j in range(i + 1):
                A[i, j] -= (one * right[n, j] + two * right[n + 1, j]) + (
                    three * right[n + 2, j] + four * right[n + 3, j]
                )
    for n in range(whole, count):
        for i in range(size):
            for j in range(i + 1):
                A[i, j] -= left[n, i] * right[n, j]
