"""Resizing, cropping and resizing of 8-bit images, compiled, on one CPU thread.

The reference is ``Preprocess.by_torch``, with the same weights and the same order of summation in float32. The results
differ at most by the rounding of a fused multiplication.
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
_PULSES = 256  # rows at a time, to bound the memory
compiled = cached(fastmath={"contract"})


def resample(
    image: Array, resized: tuple[int, int], top: int, left: int, cropped: tuple[int, int], final: tuple[int, int]
) -> Array:
    """Convert an image to [0, 1], resize, crop and resize it, linearly with antialiasing.

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
    from there on, padded with 0."""
    pulses = torch.arange(size).split(_PULSES)
    weights = np.concatenate([_responses(F.one_hot(part, size), wanted) for part in pulses]).T
    counts = weights != 0
    first = counts.argmax(1)
    last = size - counts[:, ::-1].argmax(1)
    number = int((last - first).max())
    first = np.minimum(first, size - number)
    return first, np.ascontiguousarray(np.take_along_axis(weights, first[:, None] + np.arange(number), 1))


def _responses(pulses: torch.Tensor, wanted: int) -> Array:
    """Rows [N, W] resized to [N, wanted]."""
    size = (len(pulses), wanted)
    rows = pulses[None, None].float()
    return F.interpolate(rows, size, mode="bilinear", align_corners=False, antialias=True)[0, 0].numpy()


@compiled
def _resized_bytes(image: Any, row: Any, row_weight: Any, column: Any, column_weight: Any) -> Any:
    """As :func:`_resized`, for bytes [H, W, 3], divided by 255."""
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
    """Resize a row of three channels to [3, w]; strides in ``line``: ``step`` between pixels, ``channel`` between
    channels."""
    for x in range(len(first)):
        i, w = step * first[x], weight[x, 0]
        red, green, blue = line[i] * w, line[i + channel] * w, line[i + 2 * channel] * w
        for j in range(1, weight.shape[1]):
            i, w = i + step, weight[x, j]
            red += line[i] * w
            green += line[i + channel] * w
            blue += line[i + 2 * channel] * w
        result[0, x], result[1, x], result[2, x] = red, green, blue


@compiled
def _down(lines: Any, first: Any, weight: Any) -> Any:
    """Resize the rows of [H, 3, w] to [3, h, w]."""
    result = np.empty((3, len(first), lines.shape[2]), np.float32)
    for y in range(len(first)):
        for c in range(3):
            row, line, w = result[c, y], lines[first[y], c], weight[y, 0]
            for x in range(len(row)):
                row[x] = line[x] * w
            for j in range(1, weight.shape[1]):
                line, w = lines[first[y] + j, c], weight[y, j]
                for x in range(len(row)):
                    row[x] += line[x] * w
    return result
