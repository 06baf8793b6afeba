"""The check of a frame's anchors, and warnings about those in wrong pixels or units.

Each warning is logged once per stream, to the logger ``ufmstar_torch``.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.anchors import Anchors, inside, require_anchors
from ufmstar_torch.frames.arguments import require_float, require_mask
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.frames.warnings import log_once
from ufmstar_torch.kernels.cpu.calls import array

# Largest factor between an anchor and the prediction. A single anchor beyond it would dominate the mean of all others,
# and larger values overflow in the state. More than FEW such anchors, if they outnumber the valid ones, show that the
# prediction is wrong.
FARTHEST_OFF, FEW = 100.0, 3
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

# Judging a frame takes .2 ms. At first every frame is judged; the interval grows by one every ``_FIRST`` frames, up to
# ``_EVERY``.
_FIRST, _EVERY = 16, 16

# Pixel, depth and variance, the mask of usable anchors, and the frame -> the checked fields of ``Anchors``: pixel,
# index, predicted, depth, variance, valid, rejected and contradiction.
Checked = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
CheckAnchors = Callable[[Tensor, Tensor, Tensor, Tensor | None, FrameInput], Checked]


def check_anchor_values(
    pixel: Tensor, depth: Tensor, variance: Tensor, mask: Tensor | None, frame: FrameInput
) -> Checked:  # fmt: skip
    """Check the values of anchors: pixel [B, N, 2] [px], depth [B, N] [m], variance [B, N] [m^2], all float64, and mask
    [B, N] or None; the caller has checked shapes and dtypes."""
    # Standard deviations are compared, as the square of a large depth overflows.
    size = frame.size
    usable = (depth > 0) & (depth < torch.inf) & (variance >= 0) & (variance.sqrt() < depth) & inside(pixel, size)
    if mask is not None:
        usable = usable & mask
    one, zero = torch.ones_like(depth), torch.zeros_like(depth)
    pixel = torch.where(usable[..., None], pixel, zero[..., None])
    u, v = pixel.round().long().unbind(-1)
    index = v * size[1] + u
    predicted = torch.gather(frame.depth.flatten(1), 1, index).double()
    usable = usable & torch.gather(frame.valid.flatten(1), 1, index)
    near = (depth <= FARTHEST_OFF * predicted) & (predicted <= FARTHEST_OFF * depth)
    valid, far = usable & near, usable & ~near
    rejected = far.sum(1)
    square = torch.where(far, (depth / predicted - 1).clamp_max(FARTHEST_OFF).square(), zero).sum(1)
    many = (rejected > FEW) & (rejected > valid.sum(1))
    contradiction = torch.where(many, square / rejected.clamp_min(1), torch.zeros_like(square))
    predicted, depth = torch.where(valid, predicted, one), torch.where(valid, depth, one)
    return pixel, index, predicted, depth, torch.where(valid, variance, zero), valid, rejected, contradiction


def check_anchors(
    anchors: Anchors, frame: FrameInput, network_variances: Sequence[Tensor] = (),
    kernel: CheckAnchors = check_anchor_values,
) -> Anchors:  # fmt: skip
    """Check the anchors of one frame and convert them to float64 on the depth's device.

    An anchor is invalid if a value is impossible, if it lies outside the image or on a pixel without depth, if its
    standard deviation reaches its depth, or if its depth differs from the prediction by more than a factor of 100.

    Args:
        anchors: see :class:`Anchors`.
        frame: of the same B streams.
        network_variances: the network's variances in use, of A and E, each [B, H, W] [m^2].
        kernel: an implementation of :func:`check_anchor_values`.

    Raises:
        TypeError: ``anchors`` is no :class:`Anchors`, or a field is no tensor or has the wrong kind of dtype.
        ValueError: a field has the wrong shape or device.
    """
    b = frame.depth.shape[0]
    anchors = require_anchors(anchors)
    pixel = require_float("anchors.pixel", anchors.pixel, like=frame.depth).detach().double()
    if pixel.dim() != 3 or pixel.shape[0] != b or pixel.shape[2] != 2:
        raise ValueError(f"anchors.pixel must be [{b}, N, 2], got {tuple(pixel.shape)}")
    shape = [(b, pixel.shape[1])]
    depth = require_float("anchors.depth", anchors.depth, shape, frame.depth).detach().double()
    variance = require_float("anchors.variance", anchors.variance, shape, frame.depth).detach().double()
    mask = anchors.valid
    if mask is not None:
        mask = require_mask("anchors.valid", mask, shape, frame.depth)
    for name in ("pose_error", "shared", "scale"):
        if (value := getattr(anchors, name)) is not None:
            require_float(f"anchors.{name}", value, [(b,)], frame.depth)
    motion = anchors.motion
    if motion is not None:
        motion = require_float("anchors.motion", motion, like=frame.depth).detach().double()
        if motion.dim() != 3 or motion.shape[0] != b or motion.shape[2] != 3:
            raise ValueError(f"anchors.motion must be [{b}, M, 3], got {tuple(motion.shape)}")
    pixel, index, predicted, depth, variance, valid, rejected, contradiction = kernel(
        pixel, depth, variance, mask, frame
    )
    predicted_variance = torch.zeros_like(depth)
    if network_variances:
        predicted_variance = torch.where(valid, _variance_at(network_variances, index), predicted_variance)
    return replace(
        anchors, pixel=pixel, index=index, predicted=predicted, depth=depth, variance=variance, valid=valid,
        rejected=rejected, contradiction=contradiction, network_variance=predicted_variance, motion=motion,
    )  # fmt: skip


def _variance_at(network_variances: Sequence[Tensor], index: Tensor) -> Tensor:
    """[B, N] float64 sum of the maps ``network_variances`` [B, H, W] at pixels ``index``."""
    total, *others = (torch.gather(value.detach().flatten(1), 1, index) for value in network_variances)
    for other in others:
        total = total + other
    return total.double()


class AnchorDoubts:
    """Judges the anchors of a video's frames. Only on the CPU: elsewhere, this would synchronise with the device."""

    def __init__(self) -> None:
        self._calls = 0
        self._logged = set[tuple[int, str]]()
        # By stream: successive frames with depths of another scale, and by more than _UNIT; frames with depths in the
        # opposite order minus the others, since a network that misjudges one view repeats this in the next frames.
        self._off, self._far_off, self._inverse = Counter[int](), Counter[int](), Counter[int]()

    def judge(self, anchors: Anchors, checked: Anchors, size: tuple[int, int]) -> None:
        """Warn of implausible anchors [B, N] of a frame of ``size`` (H, W), given to the step and as checked."""
        self._calls += 1
        seldom = self._calls % max(1, min(self._calls // _FIRST, _EVERY))
        if seldom or not checked.depth.is_cpu or not checked.depth.shape[1]:
            return
        log_once(self._logged, (*self._pixels(anchors, checked, size), *self._depths(checked)))

    def _pixels(self, anchors: Anchors, checked: Anchors, size: tuple[int, int]) -> Iterator[tuple[int, str, str]]:
        height, width = size
        arrays = (array(x) for x in (anchors.pixel, anchors.depth, anchors.mask, checked.mask, checked.pixel))
        for b, (pixel, depth, mask, usable, at) in enumerate(zip(*arrays, strict=True)):
            if np.count_nonzero(usable) >= (1 - _EXCHANGED) * np.count_nonzero(mask) and at.max() > 1:
                continue  # the usual case, and fast to test
            pixel = pixel[np.isfinite(pixel).all(1) & (depth > 0) & mask]
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

    def _depths(self, checked: Anchors) -> Iterator[tuple[int, str, str]]:
        columns = (array(x) for x in (checked.mask, checked.depth, checked.predicted))
        for b, (valid, depth, predicted) in enumerate(zip(*columns, strict=True)):
            ratios = depth[valid] / predicted[valid]
            count, ratio = len(ratios), _median(ratios) if len(ratios) else math.nan
            if checked.contradiction[b] > 0:
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

    def _inverted(self, b: int, checked: Anchors) -> str:
        """Count whether predicted depths have the anchors' opposite order; returns a warning if most frames do."""
        used = np.flatnonzero(array(checked.mask[b]))
        used = used[:: -(-len(used) // _COMPARED) or 1]
        anchors, predicted = np.log(array(checked.depth[b])[used]), array(checked.predicted[b])[used]
        if len(used) < _RANKED or anchors.std() < _SPREAD:
            return ""
        rank = np.arange(len(used)) - (len(used) - 1) / 2
        order = float(rank @ predicted[anchors.argsort()].argsort().argsort() / (rank @ rank))
        self._inverse[b] += 1 if order < _INVERSE else -1
        if self._inverse[b] != _SUCCESSIVE:
            return ""
        return f"far is near in the depth (rank correlation {order:.2f} with the anchors): is it inverse depth?"


def _within(pixel: NDArray[np.float64], size: tuple[int, int]) -> int:
    """The number of whole positions [N, 2] in an image of ``size`` (H, W)."""
    return int(np.count_nonzero(((pixel >= 0) & (pixel < size[::-1])).all(1)))


def _median(values: NDArray[np.float64]) -> float:
    """The median of values [N], N at least 1; ``np.median`` takes five times as long for a few hundred."""
    ordered, n = np.sort(values), len(values)
    return float(ordered[(n - 1) // 2] + ordered[n // 2]) / 2
