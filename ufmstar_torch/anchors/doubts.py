"""Warnings about anchors in wrong pixels or units: each once per stream, to the logger ``ufmstar_torch``."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.anchors import FARTHEST_OFF, Anchors
from ufmstar_torch.anchors.epipolar import median
from ufmstar_torch.frames.frame import AnchorInput
from ufmstar_torch.kernels.cpu.calls import array

_LOG = logging.getLogger("ufmstar_torch")
_FEW = 8  # least anchors of a frame that are judged
# Largest share of anchors outside the image: a crop to a square leaves out a quarter of a 4:3 image. Least share
# outside before rows and columns may be exchanged.
_OUTSIDE, _EXCHANGED = 0.6, 0.05
# Largest median ratio of the anchors' and the predicted depth, in successive judged frames: networks err by .6 to 1.5.
_RATIO, _SUCCESSIVE = 4.0, 8
# A ratio that is named after the second such frame. Largest rank correlation of the two depths that suggests inverse
# depth, with at least so many anchors, whose logarithms of depth have at least this standard deviation.
_UNIT, _AT_ONCE = 8.0, 2
_INVERSE, _RANKED, _SPREAD = -0.3, 20, 0.1
_COMPARED = 200  # largest number of anchors of which the order is compared

# Frames that are all judged, and the interval of those after them: a frame takes .1 ms.
_FIRST, _EVERY = 64, 16


class AnchorDoubts:
    """Judges the anchors of a video's frames. Only on the CPU: elsewhere, this would synchronise with the device."""

    def __init__(self) -> None:
        self._calls = 0
        self._logged = set[tuple[int, str]]()
        # By stream, successive frames: with depths of another scale, by more than _UNIT, and in the opposite order.
        self._off, self._far_off, self._inverse = Counter[int](), Counter[int](), Counter[int]()

    def judge(self, anchors: Anchors, checked: AnchorInput, size: tuple[int, int]) -> None:
        """Warn of implausible anchors [B, N] of a frame of ``size`` (H, W), given to the step and as checked."""
        self._calls += 1
        seldom = self._calls > _FIRST and self._calls % _EVERY
        if seldom or not checked.valid.is_cpu or not checked.valid.shape[1]:
            return
        for b, kind, text in (*self._pixels(anchors, size), *self._depths(checked)):
            if (b, kind) not in self._logged:
                self._logged.add((b, kind))
                _LOG.warning("stream %d: %s (logged once)", b, text)

    def _pixels(self, anchors: Anchors, size: tuple[int, int]) -> Iterator[tuple[int, str, str]]:
        height, width = size
        for b, (pixel, depth) in enumerate(zip(array(anchors.pixel), array(anchors.depth), strict=True)):
            use = np.isfinite(pixel).all(1) & (depth > 0)
            pixel = pixel[use if anchors.valid is None else use & array(anchors.valid[b])]
            if (count := len(pixel)) < _FEW:
                continue
            nearest = np.rint(pixel)
            seen, exchanged = (_within(one, size) for one in (nearest, nearest[:, ::-1]))
            if pixel.max() <= 1 and min(size) > 2:
                text = f"all {count} anchors lie within 1 px of the image's corner: are their pixels normalised? They "
                yield b, "pixels", text + f"are columns and rows (u, v) of the {width} x {height} image"
            elif seen < (1 - _EXCHANGED) * count and exchanged == count:
                text = f"{count - seen} of {count} anchors lie outside the {width} x {height} image, and none with "
                yield b, "pixels", text + "rows and columns exchanged: anchors.pixel is (u, v), the column first"
            elif seen < (1 - _OUTSIDE) * count:
                text = f"{count - seen} of {count} anchors lie outside the {width} x {height} image: are their pixels "
                yield b, "pixels", text + "those of an image of another size?"

    def _depths(self, checked: AnchorInput) -> Iterator[tuple[int, str, str]]:
        columns = (array(x) for x in (checked.valid, checked.depth, checked.predicted))
        for b, (valid, depth, predicted) in enumerate(zip(*columns, strict=True)):
            ratios = depth[valid] / predicted[valid]
            count, ratio = len(ratios), median(ratios) if len(ratios) else math.nan
            if checked.contradiction is not None and checked.rejected is not None and checked.contradiction[b] > 0:
                off = int(checked.rejected[b])
                text = f"{off} of {off + count} anchors are off from the predicted depth by more than a factor of "
                text += f"{FARTHEST_OFF:g}; the variance is increased"
                yield b, "far", text + ". Check that depth, poses and anchors are in metres"
            if count < _FEW or math.isnan(ratio):
                continue
            if text := self._inverted(b, checked):
                yield b, "inverse", text
            self._far_off[b] = self._far_off[b] + 1 if max(ratio, 1 / ratio) > _UNIT else 0
            if self._far_off[b] == _AT_ONCE:
                text = f"the predicted depth is {1 / ratio:.2g} times what the anchors show: another unit, or a scene "
                yield b, "scale", text + "far from the training data; the variance is increased"
            self._off[b] = self._off[b] + 1 if max(ratio, 1 / ratio) > _RATIO else 0
            if self._off[b] == _SUCCESSIVE:
                text = f"in {_SUCCESSIVE} frames the anchors' median depth was {ratio:.2g} times the predicted one; "
                yield b, "scale", text + "the variance is increased. Are depth, poses and anchors in metres?"

    def _inverted(self, b: int, checked: AnchorInput) -> str:
        """Count a frame where predicted depths have the anchors' opposite order; returns a warning after some."""
        used = np.flatnonzero(array(checked.valid[b]))
        used = used[:: -(-len(used) // _COMPARED) or 1]
        anchors, predicted = np.log(array(checked.depth[b])[used]), array(checked.predicted[b])[used]
        if len(used) < _RANKED or anchors.std() < _SPREAD:
            return ""
        ranks = [values.argsort().argsort() - (len(used) - 1) / 2 for values in (anchors, predicted)]
        order = float(ranks[0] @ ranks[1] / (ranks[0] @ ranks[0]))
        self._inverse[b] = self._inverse[b] + 1 if order < _INVERSE else 0
        if self._inverse[b] != _SUCCESSIVE:
            return ""
        return f"far is near in the depth (rank correlation {order:.2f} with the anchors): is it inverse depth?"


def _within(pixel: NDArray[np.float64], size: tuple[int, int]) -> int:
    """The number of whole positions [N, 2] in an image of ``size`` (H, W)."""
    return int(np.count_nonzero(((pixel >= 0) & (pixel < size[::-1])).all(1)))
