"""Cholesky factors of small symmetric positive definite matrices in compiled code: solutions and inverses."""

from __future__ import annotations

import numpy as np

from ufmstar_torch.kernels.compile_cpu import reordered


@reordered
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


@reordered
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


@reordered
def inverted(L, inverse):
    """Write the inverse of L L^T to ``inverse`` [n, n]."""
    size = len(L)
    lower = np.zeros((size, size))  # the columns of L^-1, as rows
    for j in range(size):
        lower[j, j] = 1 / L[j, j]
        for i in range(j + 1, size):
            total = 0.0
            for k in range(j, i):
                total += L[i, k] * lower[j, k]
            lower[j, i] = -total / L[i, i]
    for i in range(size):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, size):
                total += lower[i, k] * lower[j, k]
            inverse[i, j] = inverse[j, i] = total
