"""Samples of pixels and their statistics for CPU tensors (numba): a chain of small tensors takes several times as
long."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.frames.output import SampleStatistics
from ufmstar_torch.kernels.compile_cpu import empty, kernel, leaf
from ufmstar_torch.kernels.cpu.calls import array, arrays
from ufmstar_torch.steps.regress import HALF
from ufmstar_torch.steps.sample import random_order


def sample_pixels(valid: Tensor, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """As :func:`ufmstar_torch.steps.sample.sample_pixels`; the same pixels."""
    flat = array(valid).reshape(len(valid), -1)
    index, used = _choose(flat, random_order(flat.shape[1], seed).numpy(), count)
    return torch.from_numpy(index), torch.from_numpy(used)


@kernel
def _choose(valid, order, count):
    """Indices [B, count] of the first valid pixels in their order, then invalid ones, for which ``used`` is False."""
    index, used = empty((len(valid), count), np.int64), empty((len(valid), count), np.bool_)
    for b in range(len(valid)):
        n = 0
        for wanted in (True, False):
            for i in range(order.size):
                if n == count:
                    break
                if valid[b, order[i]] == wanted:
                    index[b, n], used[b, n] = order[i], wanted
                    n += 1
    return index, used


def sample_summary(
    maps: Sequence[Tensor], used: Tensor, measured: Tensor, valid_pixels: Tensor
) -> tuple[list[SampleStatistics], Tensor, Tensor]:
    """As :func:`ufmstar_torch.steps.sample.sample_summary`, without gradients: the same bits but for the
    standard error."""
    distinct = {id(value): array(value) for value in maps}  # V may be M
    table = np.empty((len(distinct), *used.shape), np.result_type(*distinct.values()))
    for m, value in enumerate(distinct.values()):
        table[m] = value
    *found, error, share = _summary(table, *arrays(used, measured, valid_pixels))
    each = [SampleStatistics(*map(torch.from_numpy, (*row, n))) for row, n in zip(*found, strict=True)]
    by_map = dict(zip(distinct, each, strict=True))
    return [by_map[id(value)] for value in maps], torch.from_numpy(error), torch.from_numpy(share)


@kernel
def _summary(values, used, measured, valid_pixels):
    """Mean, variance, median and maximum [M, 4, B] of the ``used`` values [M, B, n] without NaN, their numbers [M, B],
    the standard error [B] of the mean of the first, and the share [B] of measured pixels."""
    maps, streams, n = values.shape
    single, real = np.float32, values.dtype.type
    table, counts = empty((maps, 4, streams), values.dtype), empty((maps, streams), np.int64)
    error, share, scratch = empty(streams, values.dtype), empty(streams, single), empty((2, n), values.dtype)
    for m in range(maps):
        for b in range(streams):
            counts[m, b] = _statistics(values[m, b], used[b], scratch, table[m], b)
    for b in range(streams):
        every, many = 0, 0
        for i in range(n):
            every += used[b, i]
            many += used[b, i] and measured[b, i] >= HALF
        share[b] = single(many) / single(every)
        unsampled = single(1) - single(every) / single(max(valid_pixels[b], 1))
        error[b] = math.sqrt(table[0, 1, b] / real(counts[0, b]) * unsampled)
    return table, counts, error, share


@leaf
def _statistics(values, used, scratch, out, b):
    """Write the four statistics of the values [n] of stream ``b`` to ``out`` [4, B]; return the number of values."""
    real, terms, present, count = values.dtype.type, scratch[0], scratch[1], 0
    for i in range(values.size):
        terms[i] = 0
        if used[i] and values[i] == values[i]:
            terms[i] = present[count] = values[i]
            count += 1
    mean = out[0, b] = folded(terms) / real(count)
    for i in range(values.size):
        difference = values[i] - mean
        terms[i] = difference * difference if used[i] and difference == difference else 0
    out[1, b] = out[2, b] = out[3, b] = np.nan
    if count > 1:
        out[1, b] = folded(terms) / (real(count) - real(1))
    if count > 0:
        out[2, b] = smallest(present, count, (count - 1) // 2)
        largest = present[0]
        for i in range(1, count):
            largest = max(largest, present[i])
        out[3, b] = largest
    return count


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
