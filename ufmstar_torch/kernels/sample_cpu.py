"""The image average from a sample of pixels on the CPU (numba), in the reference's order of summation."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch import regress
from ufmstar_torch.kernels.arrays_cpu import array
from ufmstar_torch.kernels.compile_cpu import kernel, leaf
from ufmstar_torch.regress import SampleMean, random_order


def sample_pixels(valid: Tensor, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """As :func:`ufmstar_torch.regress.sample_pixels`, for CPU tensors."""
    flat = array(valid).reshape(len(valid), -1)
    index, used = np.empty((len(flat), count), np.int64), np.empty((len(flat), count), np.bool_)
    _choose(flat, array(random_order(flat.shape[1], seed)), index, used)
    return torch.from_numpy(index), torch.from_numpy(used)


@kernel
def _choose(valid, order, index, used):
    """The first pixels in an order [N] that are valid [B, N]; where there are not enough, then the first others."""
    for b in range(index.shape[0]):
        n = 0
        for wanted in (True, False):
            i = 0
            while n < index.shape[1] and i < order.size:
                index[b, n], used[b, n] = order[i], wanted
                n += valid[b, order[i]] == wanted
                i += 1


def sample_mean(variance: Tensor, measured: Tensor, used: Tensor, valid_pixels: Tensor) -> SampleMean:
    """As :func:`ufmstar_torch.regress.sample_mean`, for CPU tensors; who wants gradients gets the reference."""
    if variance.requires_grad:
        return regress.sample_mean(variance, measured, used, valid_pixels)
    values, b = array(variance), len(variance)
    out = np.empty((2, b), values.dtype), np.empty(b, np.int64), np.empty(b, np.float32)
    work = np.empty(values.shape[1], values.dtype)
    _mean(values, array(measured), array(used), array(valid_pixels), work, *out)
    (mean, error), count, share = (torch.from_numpy(value) for value in out)
    return SampleMean(mean, error, count, share)


@kernel
def _mean(variance, measured, used, valid_pixels, work, out, count, share):
    """Mean and standard error ``out`` [2, B], how many pixels were averaged, and the share that was measured."""
    real, single = variance.dtype.type, np.float32
    for b in range(count.size):
        n = sampled = seen = 0
        for i in range(work.size):
            known = used[b, i] and variance[b, i] == variance[b, i]
            sampled += used[b, i]
            seen += used[b, i] and measured[b, i]
            n += known
            work[i] = variance[b, i] if known else real(0)
        mean = real(_folded(work) / real(n))
        for i in range(work.size):
            known = used[b, i] and variance[b, i] == variance[b, i]
            difference = real(variance[b, i] - mean)
            work[i] = difference * difference if known else real(0)
        left = single(1) - single(sampled) / single(max(valid_pixels[b], 1))
        error = real(real(real(_folded(work) / real(max(n - 1, 0))) / real(n)) * real(left))
        out[0, b], out[1, b] = mean, real(math.sqrt(error)) if n > 1 else real(np.nan)
        count[b], share[b] = n, single(seen) / single(sampled)


@leaf
def _folded(x):
    """The sum of x, which is overwritten, in the order of ``fixed_order.total``."""
    n = x.size
    while n > 1:
        half = 1
        while 2 * half < n:
            half *= 2
        for i in range(n - half):
            x[i] += x[half + i]
        n = half
    return x[0]
