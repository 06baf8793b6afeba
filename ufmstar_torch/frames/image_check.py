"""Finds images that show nothing, and images that contradict a pose that never changes.

A network predicts a depth for a black image, too, and predicts it again for the next one, so views agree on a guess. An
image shows nothing if it is black, saturated, blurred beyond recognition or covered (``shows_something``), or if it is
the same as the last one although the camera moved. The depth of such an image is neither fused nor counted as measured.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, TypeGuard

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ufmstar_torch.frames.warnings import LOGGER, log_once

# Width of the reduced image [px], and the cells over which it is averaged [px].
_WIDTH, _CELL = 192, 3
# Least detail [grey levels of 255]: RMS difference of a cell from the mean of its 3 x 3 cells. Images of recordings and
# tours have 5 to 18, at a tenth of their brightness .5 to 1.8, blurred with a radius of 1/30 of the width .2 to 1.4;
# sensor noise of 3 grey levels has .5.
_DETAIL = 1.0
# Cells within this range of grey levels are not clipped; least share of such cells.
_DARK, _BRIGHT, _SHARE = 4.0, 251.0, 0.1
# Successive images after which a warning is logged.
_IMAGES = 8
# Largest correlation of an image with that at the first of ``_IMAGES`` equal poses: below, the camera must have moved.
_SAME_SCENE = 0.5
_BLACK = {torch.uint8: 1, torch.float32: 1 / 255, torch.float64: 1 / 255}  # largest value of a black image
_BRIGHTEST = 8.0  # largest value of a normalised image, by a wide margin
Values = Any  # an array or a tensor


def warn_of_range(image: Tensor) -> None:
    """Log a warning if the values of a video's first image [B, 3, H, W] are those of a usual mistake; on the CPU."""
    if not image.is_cpu or image.dtype not in _BLACK:
        return
    low, high = (float(value) for value in image.aminmax())
    if high <= _BLACK[image.dtype]:
        LOGGER.warning("the first image is black: was it divided by 255 twice, or cast to whole numbers?")
    if image.is_floating_point() and high > _BRIGHTEST and low >= 0:
        brightest = f"the first image has floats up to {high:g}"
        LOGGER.warning("%s: pass bytes, or floats in [0, 1], unless the network expects this", brightest)


def reduced(image: Tensor) -> Tensor:
    """Grey levels [B, 1, h, w] from 0 to 255 of an image [B, 3, H, W] of bytes or of floats in [0, 1]."""
    stride = max(1, image.shape[-1] // _WIDTH)
    image = image[:, :, ::stride, ::stride]
    large = min(image.shape[-2:]) >= 3 * _CELL
    if image.dtype == torch.uint8 and image.is_cpu and large:
        return torch.from_numpy(_means_of_bytes(image.numpy()))
    grey = image.float().mean(1, keepdim=True)
    grey = grey if image.dtype == torch.uint8 else 255 * grey
    return avg_pool2d(grey, _CELL) if large else grey


def _means_of_bytes(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """[B, 1, h, w] means of an image's cells, from sums of whole numbers: a fourth of the time of torch's floats."""
    grey = image[:, :1].astype(np.uint16)
    for channel in range(1, image.shape[1]):
        grey += image[:, channel : channel + 1]
    for axis in (2, 3):
        end = grey.shape[axis] // _CELL * _CELL
        lines = [grey[(slice(None),) * axis + (slice(first, end, _CELL),)] for first in range(_CELL)]
        grey = lines[0] + lines[1] + lines[2]
    return np.divide(grey, image.shape[1] * _CELL**2, dtype=np.float32)


def shows_something(grey: Values) -> Values:
    """[B] False where a reduced image [B, 1, h, w] lacks detail, or is almost everywhere black or saturated."""
    one = _library(grey).ones_like(grey)
    off = grey - _around(grey) / _around(one)
    exposed = ((grey > _DARK) & (grey < _BRIGHT)).sum((1, 2, 3)) / (grey.shape[2] * grey.shape[3])
    return ((off * off).mean((1, 2, 3)) >= _DETAIL**2) & (exposed >= _SHARE)


def _around(values: Values) -> Values:
    """The sums of maps [B, 1, h, w] over 3 x 3 cells, fewer at the border."""
    rows = values + 0
    rows[..., 1:, :] += values[..., :-1, :]
    rows[..., :-1, :] += values[..., 1:, :]
    total = rows + 0
    total[..., 1:] += rows[..., :-1]
    total[..., :-1] += rows[..., 1:]
    return total


def _library(values: Values) -> Any:
    """The module whose functions take these values: small maps take a few times longer as tensors."""
    return np if isinstance(values, np.ndarray) else torch


class _Seen(NamedTuple):
    """The last image of B streams, and what they have shown: arrays, or tensors where images are on an accelerator.

    Attributes:
        grey: [B, 1, h, w] of the last image (``reduced``); NaN before it.
        pose: [B, 4, 4] of the last image.
        first: [B, 1, h, w] of the first image of the present pose.
        still: [B] number of images since then.
        empty: [B] number of images in a row that show nothing.
        frozen: [B] number of images in a row that are the same as the one before under another pose.
    """

    grey: Values
    pose: Values
    first: Values
    still: Values
    empty: Values
    frozen: Values

    @classmethod
    def before(cls, grey: Values, pose: Values) -> _Seen:
        """The streams before their first image."""
        library = _library(grey)
        zero, nothing = library.zeros_like(grey[:, 0, 0, 0], dtype=library.int64), grey * library.nan
        return cls(nothing, pose * library.nan, nothing, zero, zero, zero)

    def without(self, streams: Sequence[int], before: _Seen) -> _Seen:
        """These streams as they were ``before``, the others as they are; an index that the images lack is ignored."""
        forgotten = _Seen(*(value + 0 for value in self))
        for b in streams:
            for value, old in zip(forgotten, before, strict=True) if b < len(self.still) else ():
                value[b] = old[b]
        return forgotten


def _same_kind(seen: _Seen | None, grey: Values, pose: Values) -> TypeGuard[_Seen]:
    """True if an image and its pose are of the kind, device and shape of the ones before."""
    if seen is None:
        return False
    last, present = (
        [(type(x), x.shape, getattr(x, "device", None)) for x in pair] for pair in (seen[:2], (grey, pose))
    )
    return last == present


class ImageCheck:
    """Compares every image with the one before, and logs each finding once per stream."""

    def __init__(self) -> None:
        self.reset()

    def reset(self, streams: Sequence[int] | None = None) -> None:
        """Forget the images of all streams, because other videos begin, or of some."""
        if streams is None:
            self._seen: _Seen | None = None
            self._undone: _Seen | None = None
            self._examined = False  # whether an image waits for UfM*'s verdict
            self._logged = set[tuple[int, str]]()
        elif self._seen is not None:
            self._seen = self._seen.without(streams, _Seen.before(self._seen.grey, self._seen.pose))

    def undo(self, streams: Sequence[int] | None = None) -> None:
        """Forget the last image of all streams, or of some, because UfM* refused or skipped it; once an image."""
        if self._examined and (streams is None or streams):
            now, before = self._seen, self._undone
            if streams is None or now is None or not _same_kind(before, now.grey, now.pose):
                self._seen = before
            else:
                self._seen = now.without(streams, before)
        self._examined = False

    def informative(self, image: Tensor, pose: Tensor) -> Tensor | None:
        """[B] False where the image shows nothing; None for an image of normalised floats, or on a device without
        values, of which nothing is known.

        Args:
            image: [B, 3, H, W].
            pose: [B, 4, 4] or [4, 4] camera-to-world [m].
        """
        fits = pose.dim() == 2 or len(pose) in (1, len(image))  # if not, UfM* names it
        if image.is_meta or not fits or not (image.dtype == torch.uint8 or _in_unit_range(image)):
            return None
        values: tuple[Values, Values] = reduced(image.detach()), pose.detach().to(image.device).double()
        grey, T = (value.numpy() for value in values) if image.is_cpu else values
        T = _library(T).broadcast_to(T, (len(grey), *T.shape[-2:])) + 0.0
        self._undone = last = self._seen
        if not _same_kind(last, grey, T):
            last = _Seen.before(grey, T)
        where, b = _library(grey).where, len(grey)
        changed = (last.pose != T).reshape(b, -1).any(1)
        same = (grey == last.grey).reshape(b, -1).all(1)
        shows, frozen = shows_something(grey), same & changed
        still = where(changed, 0, last.still + 1)
        first = where(changed[:, None, None, None], grey, last.first)
        empty = where(shows, 0, last.empty + 1)
        repeated = where(changed, where(same, last.frozen + 1, 0), last.frozen)
        self._seen = _Seen(grey, T, first, still, empty, repeated)
        self._examined = True
        informative = shows & ~frozen
        if not image.is_cpu:  # reading the counts would synchronise
            return informative
        log_once(self._logged, _findings(self._seen))
        return torch.from_numpy(informative)


def _findings(seen: _Seen) -> Iterator[tuple[int, str, str]]:
    for b, (empty, frozen, still) in enumerate(zip(seen.empty, seen.frozen, seen.still, strict=True)):
        if empty == _IMAGES:
            text = f"{_IMAGES} images in a row show nothing (black, saturated, blurred, or a covered lens): their "
            yield b, "empty", text + "depth is a guess, so it counts as unmeasured"
        if frozen == _IMAGES:
            text = f"the image was the same in {_IMAGES + 1} frames of a moving camera: is it updated? Its depth "
            yield b, "frozen", text + "counts as unmeasured"
        if still == 0 or still % _IMAGES:
            continue
        if np.corrcoef(seen.grey[b].ravel(), seen.first[b].ravel())[0, 1] < _SAME_SCENE:
            text = f"the pose was the same in {still + 1} images, which show different scenes: is the "
            yield b, "pose", text + "pose updated, and has SLAM started?"


def _in_unit_range(image: Tensor) -> bool:
    """True for floats in [0, 1]; on an accelerator, where looking would synchronise, False."""
    if not image.is_floating_point() or not image.is_cpu or not image.numel():
        return False
    low, high = image.aminmax()
    return float(low) >= 0 and float(high) <= 1
