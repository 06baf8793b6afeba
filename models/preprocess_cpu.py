"""Resizing, cropping and resizing of 8-bit images, compiled, on one thread of the processor.

The reference is ``Preprocess.resampled``: the weights are its own, and every pixel adds up its products in the same
order, in single precision. They differ at most by the rounding of a fused multiplication.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from ufmstar_torch.kernels.compile_cpu import cached

Array = NDArray[Any]
Taps = tuple[Array, Array]
_PULSES = 256  # rows at a time: memory
compiled = cached(fastmath={"contract"})


def resample(
    image: Array, resized: tuple[int, int], top: int, left: int, cropped: tuple[int, int], final: tuple[int, int]
) -> Array:
    """The image in [0, 1], resized, cropped and resized again, linearly with antialiasing.

    Args:
        image: [H, W, 3] uint8.
        resized, top, left, cropped, final: see ``Geometry``.

    Returns:
        [3, h, w] float32.
    """
    height, width = image.shape[:2]
    first_rows, first_columns = taps(height, resized[0]), taps(width, resized[1])
    part = tuple(values[top : top + cropped[0]] for values in first_rows)
    columns = tuple(values[left : left + cropped[1]] for values in first_columns)
    once = _resized_bytes(image, *part, *columns)
    if final == cropped:
        return once
    result: Array = _resized(once, *taps(cropped[0], final[0]), *taps(cropped[1], final[1]))
    return result


@lru_cache(maxsize=16)
def taps(size: int, wanted: int) -> Taps:
    """The weights of ``interpolate`` along one axis: [wanted] the first source pixel, and [wanted, T] float32 weights
    from there on, 0 behind the last one."""
    pulses = torch.arange(size).split(_PULSES)
    weights = np.concatenate([_answers(F.one_hot(part, size), wanted) for part in pulses]).T
    counts = weights != 0
    first = counts.argmax(1)
    last = size - counts[:, ::-1].argmax(1)
    number = int((last - first).max())
    first = np.minimum(first, size - number)
    return first, np.ascontiguousarray(np.take_along_axis(weights, first[:, None] + np.arange(number), 1))


def _answers(pulses: torch.Tensor, wanted: int) -> Array:
    """[N, wanted] of rows [N, W]."""
    into = (len(pulses), wanted)
    rows = pulses[None, None].float()
    return F.interpolate(rows, into, mode="bilinear", align_corners=False, antialias=True)[0, 0].numpy()


@compiled
def _resized_bytes(image: Any, row: Any, row_weight: Any, column: Any, column_weight: Any) -> Any:
    """As :func:`_resized`, of [H, W, 3] bytes, 255 of which are 1."""
    low, high = row[0], row[-1] + row_weight.shape[1]
    across = np.empty((high - low, 3, len(column)), np.float32)
    line = np.empty((3 * image.shape[1]), np.float32)
    for y in range(low, high):
        bytes_ = image[y].reshape(-1)
        for x in range(len(line)):
            line[x] = np.float32(bytes_[x]) / np.float32(255)
        _across(line, 3, 1, column, column_weight, across[y - low])
    return _down(across, row - low, row_weight)


@compiled
def _resized(image: Any, row: Any, row_weight: Any, column: Any, column_weight: Any) -> Any:
    """[3, H, W] float32 resized by :func:`taps` for the rows [h] and the columns [w]."""
    across = np.empty((image.shape[1], 3, len(column)), np.float32)
    for y in range(image.shape[1]):
        _across(np.ascontiguousarray(image[:, y]).reshape(-1), 1, image.shape[2], column, column_weight, across[y])
    return _down(across, row, row_weight)


@compiled
def _across(line: Any, step: int, channel: int, first: Any, weight: Any, result: Any) -> None:
    """A row of three channels -> [3, w]; ``step`` lies between two pixels in ``line``, ``channel`` between two
    channels."""
    for x in range(len(first)):
        at, w = step * first[x], weight[x, 0]
        red, green, blue = line[at] * w, line[at + channel] * w, line[at + 2 * channel] * w
        for j in range(1, weight.shape[1]):
            at, w = at + step, weight[x, j]
            red += line[at] * w
            green += line[at + channel] * w
            blue += line[at + 2 * channel] * w
        result[0, x], result[1, x], result[2, x] = red, green, blue


@compiled
def _down(lines: Any, first: Any, weight: Any) -> Any:
    """[H, 3, w] -> [3, h, w]."""
    result = np.empty((3, len(first), lines.shape[2]), np.float32)
    for y in range(len(first)):
        for c in range(3):
            into, line, w = result[c, y], lines[first[y], c], weight[y, 0]
            for x in range(len(into)):
                into[x] = line[x] * w
            for j in range(1, weight.shape[1]):
                line, w = lines[first[y] + j, c], weight[y, j]
                for x in range(len(into)):
                    into[x] += line[x] * w
    return result
