"""Samples of pixels (NumPy) and their statistics (numba) for CPU tensors: a chain of small tensors takes several times
as long."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.frames.output import SampleStatistics
from ufmstar_torch.kernels.compile_cpu import kernel, leaf
from ufmstar_torch.kernels.cpu.calls import array
from ufmstar_torch.steps.sample import random_order


def sample_pixels(valid: Tensor, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """As :func:`ufmstar_torch.steps.sample.sample_pixels`; the same pixels."""
    flat = array(valid).reshape(len(valid), -1)
    order = random_order(flat.shape[1], seed).numpy()
    index, used = np.empty((len(flat), count), np.int64), np.zeros((len(flat), count), np.bool_)
    for b, usable in enumerate(flat):
        requested, found = 2 * count, np.empty(0, np.int64)
        while True:
            first = order[:requested]
            found = first[usable[first]]
            if len(found) >= count or requested >= len(order):
                break
            requested *= 2
        n = min(len(found), count)
        index[b, :n], used[b, :n] = found[:n], True
        if n < count:
            index[b, n:] = order[~usable[order]][: count - n]
    return torch.from_numpy(index), torch.from_numpy(used)


def sample_statistics(values: Tensor) -> SampleStatistics:
    """As :func:`ufmstar_torch.steps.sample.sample_statistics`; the same bits, without gradients."""
    x = array(values)
    statistics, counts = np.empty((4, *x.shape[:-1]), x.dtype), np.empty(x.shape[:-1], np.int64)
    _statistics(x.reshape(-1, x.shape[-1]), statistics.reshape(4, -1), counts.reshape(-1))
    mean, variance, median, maximum = map(torch.from_numpy, statistics)
    return SampleStatistics(mean, variance, median, maximum, torch.from_numpy(counts))


@kernel
def _statistics(values, out, counts):
    """Write mean, variance, median and maximum [4, m] of the rows [m, n] without NaN, and the numbers of values."""
    n = values.shape[1]
    terms, present = np.empty(n, values.dtype), np.empty(n, values.dtype)
    for row in range(len(values)):
        count = 0
        for i in range(n):
            value = values[row, i]
            terms[i] = 0
            if value == value:
                terms[i] = present[count] = value
                count += 1
        number = values.dtype.type(count)
        counts[row] = count
        mean = out[0, row] = folded(terms) / number
        for i in range(n):
            difference = values[row, i] - mean
            terms[i] = difference * difference if difference == difference else 0
        out[1, row] = out[2, row] = out[3, row] = np.nan
        if count > 1:
            out[1, row] = folded(terms) / (number - values.dtype.type(1))
        if count > 0:
            out[2, row] = smallest(present, count, (count - 1) // 2)
            largest = present[0]
            for i in range(1, count):
                largest = max(largest, present[i])
            out[3, row] = largest


@leaf
def folded(values):
    """The sum in the order of ``fixed_order.total``, 0 of no values; overwrites the values."""
    n = values.size
    if n == 0:
        return values.dtype.type(0)
    while n > 1:
        half = 1
        while 2 * half < n:
            half *= 2
        for i in range(half, n):
            values[i - half] += values[i]
        n = half
    return values[0]


@leaf
def smallest(values, count, rank):
    """The value of a ``rank``, from 0, among the first ``count``, which are reordered."""
    low, high = 0, count - 1
    while low < high:
        pivot, i, j = values[(low + high) // 2], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return values[rank]
