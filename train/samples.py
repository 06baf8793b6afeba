"""Training samples: a network's inputs with their ground truth, and the treatment of broken files."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, NamedTuple, TypedDict

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from ufmstar_torch.eval.sequences.frame import Frame, FrameError
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.train.augment import Augmentation

if TYPE_CHECKING:
    from ufmstar_torch.train.sequence_data import SequenceFrames

_LOG = logging.getLogger(__name__)


class Sample(TypedDict):
    """One training sample at the network's size; a loader stacks them along a first dimension.

    image [3, H, W] float32, output of the network's ``Preprocess``; depth [H, W] float32 [m], 0 = none; valid [H, W]
    bool, True = has ground truth; intrinsics [3, 3] float64 [px]; T_world_cam [4, 4] float64 camera-to-world [m], NaN =
    unknown.
    """

    image: Tensor
    depth: Tensor
    valid: Tensor
    intrinsics: Tensor
    T_world_cam: Tensor


class SampleKey(NamedTuple):
    """A frame and its epoch, from a sampler: augmentation depends on the epoch, but not on the number of workers.
    ``counts`` False: no pixel of the sample is valid."""

    epoch: int
    frame: int
    counts: bool = True


class SampleDataset(Dataset[Sample]):
    """The frames of a source as samples for a network.

    Args:
        source: of the frames.
        preprocess: of the network.
        augmentation: None = no augmentation, as for validation.
        seed: of the augmentation.
        on_bad_file: "raise": the first broken file stops the run. "skip": the next readable frame (cyclically) replaces
            it, in every process and order. In training, that frame then occurs twice in an epoch; in validation
            (``evaluate``), its copy has no valid pixel.
        evaluate: see ``on_bad_file``.

    Raises:
        ValueError: an empty source, another value of ``on_bad_file``.
    """

    def __init__(
        self,
        source: SequenceFrames,
        preprocess: Preprocess,
        augmentation: Augmentation | None = None,
        *,
        seed: int = 0,
        on_bad_file: str = "raise",
        evaluate: bool = False,
    ) -> None:
        if on_bad_file not in ("raise", "skip"):
            raise ValueError(f"on_bad_file must be 'raise' or 'skip', got {on_bad_file!r}")
        if len(source) < 1:
            raise ValueError("source must hold at least one frame, got none")
        self.source, self.preprocess, self.augmentation = source, preprocess, augmentation
        self.seed, self.on_bad_file, self.evaluate = seed, on_bad_file, evaluate
        # In shared memory, so that the calling process can read the workers' entries.
        self._bad = torch.zeros(len(source), dtype=torch.bool).share_memory_()

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, key: int | SampleKey) -> Sample:
        """The sample of a frame. ``key``: from ``EpochBatches``, or a frame's number, for epoch 0. Raises IndexError:
        no such frame; FrameError: a broken file with ``on_bad_file="raise"``, or no readable file."""
        epoch, index, counts = SampleKey(*key) if isinstance(key, tuple) else SampleKey(0, key)
        if not 0 <= index < len(self):
            raise IndexError(f"index must lie in [0, {len(self)}), got {index}")
        frame, number = self._readable(index)
        sample = make_sample(frame, self.preprocess, self.augmentation, (self.seed, epoch, index))
        if not counts or (self.evaluate and number != index):
            sample["valid"] = torch.zeros_like(sample["valid"])
        if number != index:  # the replacement may belong to another sequence
            sample["T_world_cam"] = torch.full_like(sample["T_world_cam"], torch.nan)
        return sample

    def bad_files(self) -> tuple[str, ...]:
        """The broken files so far, of this process and of the workers of its loaders."""
        return tuple(self.source.name(index) for index in self._bad.nonzero()[:, 0].tolist())

    def _readable(self, index: int) -> tuple[Frame, int]:
        """The first readable frame from ``index`` on, and its number."""
        for step in range(len(self)):
            candidate = (index + step) % len(self)
            if self._bad[candidate]:
                continue
            try:
                return self.source.load(candidate), candidate
            except FrameError as error:
                if self.on_bad_file == "raise":
                    raise
                self._bad[candidate] = True
                _LOG.warning("skipped a broken file: %s", error)
        raise FrameError(self.source.name(index), f"and all others of {len(self)} files are broken")


def make_sample(
    frame: Frame, preprocess: Preprocess, augmentation: Augmentation | None, seed: tuple[int, ...]
) -> Sample:
    """Convert a stored frame to a sample: augment, then preprocess it; ``seed``: of the augmentation."""
    parts = (frame.image, frame.depth, frame.intrinsics, frame.T_world_cam)
    image, depth, K, pose = (torch.from_numpy(np.array(part)) for part in parts)
    image = image.permute(2, 0, 1).contiguous().to(torch.float32) / 255
    depth = torch.where(depth.isfinite() & (depth > 0), depth, 0.0).to(torch.float32)
    if augmentation is not None:
        image, depth, K = augmentation(image, depth, K, seed)
    x, K_network = preprocess(image[None], K)
    depth = preprocess.apply_depth(depth)
    return Sample(image=x[0], depth=depth.contiguous(), valid=depth > 0, intrinsics=K_network, T_world_cam=pose)


def clips(source: SequenceFrames, length: int) -> list[range]:
    """Divide the frames of a source into clips without overlap, dropping incomplete clips. Raises ValueError: there is
    no complete clip."""
    whole = [run[i : i + length] for run in source.runs() for i in range(0, len(run) - length + 1, length)]
    if not whole:
        raise ValueError(f"clip_frames: the training part has no {length} frames with known poses one after the other")
    return whole
