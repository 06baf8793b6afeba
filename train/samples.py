"""Training samples: clips of frames as a network's inputs with their ground truth."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from ufmstar_torch.eval.sequences.frame import Frame, FrameError
from ufmstar_torch.models.preprocess import Preprocess

if TYPE_CHECKING:
    from ufmstar_torch.train.sequence_data import SequenceFrames

_LOG = logging.getLogger(__name__)


class Sample(TypedDict):
    """One frame at the network's size; a clip stacks them along a first dimension.

    image [3, H, W] float32 in [0, 1]: the input of ``Preprocess.normalized``; depth [H, W] float32 [m], 0 = none;
    intrinsics [3, 3] float64 [px]; T_world_cam [4, 4] float64 camera-to-world [m], NaN = unknown.
    """

    image: Tensor
    depth: Tensor
    intrinsics: Tensor
    T_world_cam: Tensor


class SampleDataset(Dataset[Sample]):
    """The clips of a source as samples for a network.

    Args:
        source: of the frames.
        preprocess: of the network.
        clips: the frames of every clip; None = every frame is a clip of its own.
        on_bad_file: "raise": the first broken file stops the run. "skip": the next readable frame (cyclically), whose
            pose then counts as unknown, replaces it, and a warning names the file.
    """

    def __init__(
        self,
        source: SequenceFrames,
        preprocess: Preprocess,
        clips: Sequence[range] | None = None,
        on_bad_file: str = "raise",
    ) -> None:
        self.source, self.preprocess, self.on_bad_file = source, preprocess, on_bad_file
        self.clips = [range(i, i + 1) for i in range(len(source))] if clips is None else clips

    def __len__(self) -> int:
        return len(self.clips)

    def __getitem__(self, index: int) -> Sample:
        """A clip: the values of :class:`Sample` with the frames as first dimension. Raises FrameError: a broken file
        with ``on_bad_file="raise"``, or no readable file."""
        return joined([self._frame(frame) for frame in self.clips[index]], torch.stack)

    def _frame(self, index: int) -> Sample:
        frames = len(self.source)
        for candidate in (*range(index, frames), *range(index)):
            try:
                sample = make_sample(self.source.load(candidate), self.preprocess)
            except FrameError as error:
                if self.on_bad_file == "raise":
                    raise
                _LOG.warning("skipped a broken file: %s", error)
                continue
            if candidate != index:  # it may belong to another sequence
                sample["T_world_cam"] = torch.full_like(sample["T_world_cam"], torch.nan)
            return sample
        raise FrameError(self.source.name(index), f"and all others of {frames} files are broken")


def joined(samples: Sequence[Sample], how: Callable[[list[Tensor]], Tensor] = torch.cat) -> Sample:
    """The values of several samples joined along their first dimension; a loader's ``collate_fn``."""
    values: list[Any] = list(samples)
    joint: Any = {name: how([one[name] for one in values]) for name in Sample.__annotations__}
    return joint


def make_sample(frame: Frame, preprocess: Preprocess) -> Sample:
    """Convert a stored frame to a sample, without normalising its colours."""
    parts = (frame.image, frame.depth, frame.intrinsics, frame.T_world_cam)
    image, depth, K, pose = (torch.from_numpy(np.array(part)) for part in parts)
    depth = torch.where(depth.isfinite() & (depth > 0), depth, 0.0).to(torch.float32)
    x = preprocess.resampled(image.permute(2, 0, 1)[None])[0].contiguous()
    K_network = preprocess.apply_intrinsics(K, *depth.shape)
    return Sample(image=x, depth=preprocess.apply_depth(depth).contiguous(), intrinsics=K_network, T_world_cam=pose)


def clips(source: SequenceFrames, length: int) -> list[range]:
    """Divide the frames of a source into clips without overlap, dropping incomplete clips. Raises ValueError: there is
    no complete clip."""
    whole = [run[i : i + length] for run in source.runs() for i in range(0, len(run) - length + 1, length)]
    if not whole:
        raise ValueError(f"clip_frames: the training part has no {length} frames with known poses one after the other")
    return whole
