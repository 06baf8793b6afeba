"""Samples of pixels and their statistics for CPU tensors, in NumPy: a chain of small tensors takes several times as
long."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.frames.output import SampleStatistics
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
    present = x == x
    count, floats = present.sum(-1), x.dtype.type
    some = count.astype(floats)
    with np.errstate(divide="ignore", invalid="ignore"):  # 0/0 = NaN without a pixel
        mean = _total(np.where(present, x, floats(0))) / some
        squares = _total(np.where(present, np.square(x - mean[..., None]), floats(0)))
        variance = np.where(count > 1, squares / np.maximum(some - 1, floats(1)), floats(np.nan))
    ordered = np.sort(x, -1)  # NaN last
    last = np.maximum(count - 1, 0)[..., None]
    median, largest = (np.take_along_axis(ordered, at, -1)[..., 0] for at in (last // 2, last))
    each = mean, variance, median, largest, count
    return SampleStatistics(*(torch.from_numpy(np.asarray(statistic)) for statistic in each))


def _total(x: NDArray[Any]) -> NDArray[Any]:
    """Sum along the last axis in the order of ``fixed_order.total``."""
    n = x.shape[-1]
    if n == 0:
        return np.asarray(x.sum(-1))
    while n > 1:
        half = 1 << (n - 1).bit_length() - 1
        folded = x[..., :half].copy()
        folded[..., : n - half] += x[..., half:n]
        x, n = folded, half
    return np.asarray(x[..., 0])
