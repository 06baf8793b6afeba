"""Sums in a fixed order in compiled code (numba)."""

from __future__ import annotations

from ufmstar_torch.kernels.compile_cpu import leaf


@leaf
def folded(values):
    """The sum of at least one value in the order of ``fixed_order.total``: of two halves, for a length rounded up to a
    power of two. Overwrites the values."""
    n = values.size
    while n > 1:
        half = 1
        while 2 * half < n:
            half *= 2
        for i in range(half, n):
            values[i - half] += values[i]
        n = half
    return values[0]
