"""Small matrix products and sums whose result does not depend on the batch, the padding or the number of threads.

BLAS and torch's reductions choose their order of summation by shape, processor and threads, so a stream would differ in
its last bits between running alone and running in a batch. These functions multiply and add elementwise in a fixed
order; the matrices are 2x2 to 4x4.
"""

from __future__ import annotations

import torch
from torch import Tensor


def product(A: Tensor, B: Tensor) -> Tensor:
    """A B for A [..., n, m] and B [..., m, p], summed over m from first to last; m is small."""
    first, *rest = zip(A.unbind(-1), B.unbind(-2), strict=True)
    out = first[0].unsqueeze(-1) * first[1].unsqueeze(-2)
    for column, row in rest:
        out = out + column.unsqueeze(-1) * row.unsqueeze(-2)
    return out


def apply(A: Tensor, x: Tensor) -> Tensor:
    """A x for A [..., n, m] and vectors x [..., m], summed over m from first to last."""
    first, *rest = zip(A.unbind(-1), x.unbind(-1), strict=True)
    out = first[0] * first[1].unsqueeze(-1)
    for column, value in rest:
        out = out + column * value.unsqueeze(-1)
    return out


def congruence(A: Tensor, S: Tensor) -> Tensor:
    """A S A^T for A [..., n, m] and S [..., m, m]."""
    return product(product(A, S), A.mT)


def total(x: Tensor, dim: int) -> Tensor:
    """Sum along ``dim`` by folding halves: entry i is added to entry i + 2^j.

    The order is that of a length rounded up to a power of two, so trailing zeros change no bit.
    """
    n = x.shape[dim]
    if n == 0:
        return x.sum(dim)
    while n > 1:
        half = 1 << (n - 1).bit_length() - 1
        head, tail = x.narrow(dim, 0, half), x.narrow(dim, half, n - half)
        if n < 2 * half:
            tail = torch.cat([tail, torch.zeros_like(head.narrow(dim, 0, 2 * half - n))], dim)
        x, n = head + tail, half
    return x.squeeze(dim)
