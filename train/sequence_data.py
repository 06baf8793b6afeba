"""RGB-D sequences as training frames: all layouts of ``open_sequence``, and folders without poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.frame import Frame, FrameError, FrameSequence
from ufmstar_torch.eval.sequences.generic import has_images_and_depth, open_unposed
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.eval.sequences.layout import layout_of
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.runtime.kinds import check_kinds
from ufmstar_torch.train.data_config import Part


class SequenceFrames:
    """The frames with depth of the same part of several sequences, concatenated. The part refers to all usable frames
    of a sequence, including those without a depth map.

    Depth maps of a separate depth camera are projected to the image's pixels (``eval.sequences.ground_truth``). Raises
    ValueError: no sequence, or a sequence whose part has no frame with depth.
    """

    @check_kinds
    def __init__(self, sequences: Sequence[FrameSequence], part: str | Part = "0:100%") -> None:
        part = Part.parse(part) if isinstance(part, str) else part
        if not sequences:
            raise ValueError("sequences must hold at least one sequence, got none")
        self.sequences = tuple(sequences)
        self._frames: list[tuple[int, int]] = []
        for number, sequence in enumerate(self.sequences):
            entries = sequence.entries
            with_depth = [i for i in part.frames(len(sequence)) if entries[i].load_depth and entries[i].load_image]
            if not with_depth:
                raise ValueError(f"{sequence.name}: no frame of the part {part} has an image and a depth map")
            self._frames += [(number, i) for i in with_depth]

    def __len__(self) -> int:
        return len(self._frames)

    def name(self, index: int) -> str:
        """Names of sequence and frame."""
        number, frame = self._frames[index]
        sequence = self.sequences[number]
        return f"{sequence.name}/{sequence.entries[frame].name}"

    def runs(self) -> list[range]:
        """The indices of the frames of every sequence with poses."""
        owner = [number for number, _ in self._frames]
        posed = [number for number in range(len(self.sequences)) if self.sequences[number].posed and number in owner]
        return [range(owner.index(number), owner.index(number) + owner.count(number)) for number in posed]

    def load(self, index: int) -> Frame:
        """A frame with an image and depth at the image's pixels; its pose is NaN if unknown. Raises FrameError: a file
        is missing, cannot be decoded, or does not have the sequence's size."""
        number, i = self._frames[index]
        try:
            frame = self.sequences[number][i]
            if frame.image is None:
                raise FrameError(frame.name, "has no image")
            depth = truth_at(frame, frame.intrinsics, (frame.image.shape[0], frame.image.shape[1]))
        except FrameError as error:
            raise FrameError(self.name(index), str(error)) from error
        if depth is None:
            raise FrameError(self.name(index), "has no depth map")
        pose = frame.T_world_cam if self.sequences[number].posed else np.full((4, 4), np.nan)
        return replace(frame, depth=depth.astype(np.float32), depth_intrinsics=None, T_world_cam=pose)


def open_rgbd(source: str | Path) -> FrameSequence:
    """Open a sequence with ``open_sequence``, or a folder of images and depth maps without poses. Raises
    FileNotFoundError: no such path; ValueError: neither of them; the message lists the supported layouts."""
    path = Path(source)
    if has_images_and_depth(path):
        try:
            layout_of("auto", path)
        except ValueError:  # no layout with poses
            return open_unposed(path, Options())
    return open_sequence(source)
