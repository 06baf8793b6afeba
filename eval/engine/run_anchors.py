"""Anchors of a run: corners of the sequence's images, tracked at the camera's own resolution."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.anchors.given import Anchors
from ufmstar_torch.anchors.tracker import LandmarkTracker
from ufmstar_torch.eval.sequences.frame import Frame, FrameSequence
from ufmstar_torch.step import FrameStatistics

# Of the tensors that a source keeps, those of its tracker.
_PREFIX = "tracker."


class RunAnchors:
    """Tracks the images of a run.

    Attributes:
        identity: plain values on which the anchors depend.
    """

    def __init__(self) -> None:
        self._tracker = LandmarkTracker()
        self._before = self._tracker.state()
        self._tracked = self._found = 0
        self.identity = {"anchors": "tracked", "tracker": self._tracker.config.to_dict()}

    def of(self, frame: Frame) -> Anchors | None:
        """Those of the next frame, [1, N] in its image's pixels; None where it has no image.

        Raises:
            ModuleNotFoundError: OpenCV is not installed.
            ValueError: the image is not of the size of those before.
        """
        self._before, self._tracked, self._found = self._tracker.state(), 0, 0
        if frame.image is None:
            return None
        landmarks = self._tracker.update(frame.image, frame.T_world_cam, frame.intrinsics)
        self._tracked, self._found = landmarks.tracked, len(landmarks.depth)
        return landmarks.anchors(frame.intrinsics, torch.from_numpy(frame.intrinsics))

    def counts(self, statistics: FrameStatistics) -> dict[str, Any]:
        """What became of the last frame's corners, as plain values.

        ``tracked`` were followed from the frame before, of which ``found`` were triangulated; ``usable`` lie on a pixel
        with a depth, and ``used`` agree with others. Without any used, ``without`` says why.
        """
        used, usable = int(statistics.anchors_used[0]), int(statistics.anchors[0])
        counts = {"tracked": self._tracked, "found": self._found, "usable": usable, "used": used}
        return {**counts, "without": None if used else why_none(self._tracked, self._found, usable)}

    def undo(self) -> None:
        """As if the last frame had not been: UfM* skipped it, and its pose is not to be trusted."""
        self._tracker.load_state(self._before)

    def reset(self) -> None:
        """Forget everything."""
        self._tracker.reset()

    def state(self) -> dict[str, Tensor]:
        """What the next frame's anchors depend on."""
        return {_PREFIX + name: value for name, value in self._tracker.state().items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on where ``state`` was taken.

        Raises:
            ValueError: it was taken of a tracker of another size.
        """
        self._tracker.load_state({name.removeprefix(_PREFIX): value for name, value in state.items()})


def of_tracker(state: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """The tensors that are a tracker's (:meth:`RunAnchors.state`), and the others."""
    own = {name: value for name, value in state.items() if name.startswith(_PREFIX)}
    return own, {name: value for name, value in state.items() if name not in own}


def why_none(tracked: int, found: int, usable: int) -> str:
    """Why a frame has no anchors, from how many were left at each stage."""
    if not tracked:
        return "no corner followed from the frame before"
    if not found:
        return "no parallax, or no track that fits the poses"
    return "none lies on a pixel with a depth" if not usable else "they contradict each other"


def require_images(sequence: FrameSequence) -> None:
    """What tracking needs.

    Raises:
        ValueError: the sequence has no images.
        ModuleNotFoundError: OpenCV is not installed.
    """
    if all(entry.load_image is None for entry in sequence.entries):
        raise ValueError(f"--anchors tracks corners of images, of which the sequence {sequence.name!r} has none")
    if find_spec("cv2") is None:
        raise ModuleNotFoundError("--anchors needs OpenCV: pip install 'ufmstar-torch[eval]'")
