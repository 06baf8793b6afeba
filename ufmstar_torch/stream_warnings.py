"""Warnings about a stream in which hardly anything can be compared: each once, to the logger ``ufmstar_torch``."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.output import FrameStatistics

# Frames and components before anything is said of views, and the share of components seen in one view alone from which
# on it is. On rendered tours, at 1/10 of their frames too, right input stays below .7; poses in millimetres reach .99.
_FRAMES, _COMPONENTS, _ALONE = 8, 20, 0.9
# Frames, each moved by a share of the depth, in which less than one anchor a frame was used.
_MOVED_FRAMES, _MOVED = 10, 0.01
# On an accelerator reading the counts waits: every so many frames.
_EVERY = 64
LOGGER = logging.getLogger("ufmstar_torch")
_CAUSES = (
    "Likely causes: poses or depth in another unit (millimetres, a scale of their own), world-to-camera poses, axes of "
    "another convention, a trajectory of other times, depth that is inverse or relative, or intrinsics of an image of "
    "another size"
)


class StreamWarnings:
    """Looks at the counts of every frame, and warns of a stream in which nothing is compared."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget what was said."""
        self._calls = 0
        self._said = set[tuple[int, str]]()
        self._moved = dict[int, tuple[Tensor, int, int]]()  # last camera, moving frames and anchors used, by stream

    def after_frame(
        self, frame: FrameInput, statistics: FrameStatistics, frames: Tensor, config: UfMStarConfig
    ) -> None:
        """Warn of a frame without a segment, of components that no second view sees, and of moving frames without
        anchors; ``frames`` [B] counts those used."""
        device = frame.depth.device.type
        self._calls += 1
        if device == "meta" or (device != "cpu" and self._calls % _EVERY):
            return
        for b, kind, text in (
            *_without_segments(frame, statistics, config),
            *_alone(statistics, frames),
            *self._without_anchors(frame, statistics),
        ):
            if (b, kind) not in self._said:
                self._said.add((b, kind))
                LOGGER.warning("stream %d: %s (said once)", b, text)

    def _without_anchors(self, frame: FrameInput, statistics: FrameStatistics) -> Iterator[tuple[int, str, str]]:
        if statistics.anchors_used is None:
            return
        pixels, sums = statistics.valid_pixels.tolist(), frame.depth.sum((1, 2)).tolist()
        counts = torch.stack([statistics.anchors_used, statistics.fault]).T.tolist()
        for b, (used, fault) in enumerate(counts):
            place = frame.T_world_cam[b, :3, 3].cpu()
            before, moving, total = self._moved.get(b, (place, 0, 0))
            if fault or not pixels[b]:
                continue
            if float((place - before).norm()) < _MOVED * sums[b] / pixels[b]:
                self._moved[b] = before, moving, total
                continue
            moving, total = moving + 1, total + used
            if moving >= _MOVED_FRAMES and total < moving:
                text = f"{total} anchors were used in {moving} frames of a moving camera, so the error on which all "
                yield b, "anchors", text + f"views agree is not measured. {_CAUSES}"
            self._moved[b] = place, moving, total


def _without_segments(
    frame: FrameInput, statistics: FrameStatistics, config: UfMStarConfig
) -> Iterator[tuple[int, str, str]]:
    segments = statistics.segments.tolist()
    if all(segments):
        return
    given = (statistics.valid_pixels + frame.beyond + frame.out_of_range).tolist()
    for b in (b for b, count in enumerate(segments) if not count and given[b]):
        text = f"a frame has no segment, so nothing is compared between views: of {given[b]} pixels "
        text += f"{int(frame.beyond[b])} lie beyond segment.max_depth = {config.segment.depth_limit} m and "
        text += f"{int(frame.out_of_range[b])} outside the accepted ranges. Is the depth in metres, smooth, and the "
        yield b, "segments", text + "intrinsics the depth map's?"


def hardly_compared(alone: int, components: int, frames: int) -> str:
    """A warning where one frame alone has seen nearly all of so many components after so many frames; else ""."""
    if frames < _FRAMES or components < _COMPONENTS or alone <= _ALONE * components:
        return ""
    text = (
        f"after {frames} frames {alone} of {components} Gaussians were seen in one view alone, so hardly anything is "
    )
    return text + f"compared between views. {_CAUSES}, or views that do not overlap"


def _alone(statistics: FrameStatistics, frames: Tensor) -> Iterator[tuple[int, str, str]]:
    counts = (value.tolist() for value in (statistics.single_view, statistics.components, frames))
    for b, each in enumerate(zip(*counts, strict=True)):
        if text := hardly_compared(*each):
            yield b, "views", text
