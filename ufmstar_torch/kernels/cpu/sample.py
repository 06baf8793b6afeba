"""Samples of pixels and their statistics for CPU tensors (numba): a chain of small tensors takes several times as
long."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.frames.output import SampleStatistics
from ufmstar_torch.kernels.compile_cpu import kernel, leaf
from ufmstar_torch.kernels.cpu.calls import array
from ufmstar_torch.steps.regress import HALF
from ufmstar_torch.steps.sample import random_order


def sample_pixels(valid: Tensor, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """As :func:`ufmstar_torch.steps.sample.sample_pixels`; the same pixels."""
    flat = array(valid).reshape(len(valid), -1)
    index, used = np.empty((len(flat), count), np.int64), np.empty((len(flat), count), np.bool_)
    _choose(flat, random_order(flat.shape[1], seed).numpy(), index, used)
    return torch.from_numpy(index), torch.from_numpy(used)


@kernel
def _choose(valid, order, index, used):
    """Write the first valid pixels in their order, then invalid ones; ``used`` is False for these."""
    for b in range(len(valid)):
        n = 0
        for wanted in (True, False):
            for i in range(order.size):
                if n == index.shape[1]:
                    break
                if valid[b, order[i]] == wanted:
                    index[b, n], used[b, n] = order[i], wanted
                    n += 1


def sample_summary(
    maps: Sequence[Tensor], used: Tensor, measured: Tensor, valid_pixels: Tensor
) -> tuple[list[SampleStatistics], Tensor, Tensor]:
    """As :func:`ufmstar_torch.steps.sample.sample_summary`, without gradients: the same bits but for the
    standard error."""
    values = [array(value) for value in maps]
    kind = np.result_type(*values)
    table, counts = np.empty((4, len(values), len(used)), kind), np.empty((len(values), len(used)), np.int64)
    error, share, mask = np.empty(len(used), kind), np.empty(len(used), np.float32), array(used)
    for m, value in enumerate(values):
        same = next(i for i, other in enumerate(maps) if other is maps[m])  # V may be M
        if same < m:
            table[:, m], counts[m] = table[:, same], counts[same]
        else:
            _statistics(np.asarray(value, kind), mask, table[:, m], counts[m])
    _error(table[1, 0], counts[0], mask, array(measured), array(valid_pixels), error, share)
    each = []
    for row, count in zip(torch.from_numpy(table).unbind(1), torch.from_numpy(counts).unbind(), strict=True):
        mean, variance, median, maximum = row.unbind()
        each.append(SampleStatistics(mean, variance, median, maximum, count))
    return each, torch.from_numpy(error), torch.from_numpy(share)


@kernel
def _error(variance, counts, used, measured, valid_pixels, error, share):
    """Write the standard error of the mean, and the share of measured pixels."""
    single = np.float32
    for b in range(error.size):
        n, many = 0, 0
        for i in range(used.shape[1]):
            n += used[b, i]
            many += used[b, i] and measured[b, i] >= HALF
        share[b] = single(many) / single(n)
        unsampled = single(1) - single(n) / single(max(valid_pixels[b], 1))
        error[b] = math.sqrt(variance[b] / error.dtype.type(counts[b]) * unsampled)


@kernel
def _statistics(values, used, out, counts):
    """Write mean, variance, median and maximum [4, B] of the ``used`` values [B, n] without NaN, and the numbers of
    values."""
    n, real = values.shape[1], values.dtype.type
    terms, present = np.empty(n, values.dtype), np.empty(n, values.dtype)
    for row in range(len(values)):
        count = 0
        for i in range(n):
            value = values[row, i]
            terms[i] = 0
            if used[row, i] and value == value:
                terms[i] = present[count] = value
                count += 1
        counts[row] = count
        mean = out[0, row] = folded(terms) / real(count)
        for i in range(n):
            difference = values[row, i] - mean
            terms[i] = difference * difference if used[row, i] and difference == difference else 0
        out[1, row] = out[2, row] = out[3, row] = np.nan
        if count > 1:
            out[1, row] = folded(terms) / (real(count) - real(1))
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
