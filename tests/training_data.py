"""Frames, folders and sources for the tests of training data; small and known."""

from __future__ import annotations

import numpy as np
from layouts_more import write_h5

from ufmstar_torch.eval.sequences.frame import Frame, FrameError
from ufmstar_torch.models import Preprocess
from ufmstar_torch.train import DataConfig

SMALL = (48, 64)  # NYU's aspect ratio
PLAIN = Preprocess()
TINY = DataConfig(tour_frames=3, tour_stride=4, tour_size=(24, 32))


def nyu_frame(number: int, size=SMALL) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(number)
    return rng.integers(0, 256, (3, *size), np.uint8), rng.uniform(0.5, 9, size).astype(np.float32)


def write_nyu(root, frames=6):
    """Two scenes of training frames, numbered without leading zeros, and one of validation frames."""
    for i in range(frames):
        write_h5(root / "train" / f"kitchen_{i % 2}" / f"{i + 8}.h5", *nyu_frame(i))
    for i in range(3):
        write_h5(root / "val" / "official" / f"{i}.h5", *nyu_frame(100 + i))
    return root


class Numbered:
    """A source whose frame i has grey level i and depth i + 1. Frames in ``broken`` cannot be read."""

    def __init__(self, length: int, broken: tuple[int, ...] = ()) -> None:
        self.length, self.broken = length, broken

    def __len__(self) -> int:
        return self.length

    def name(self, index: int) -> str:
        return f"frame-{index}"

    def load(self, index: int) -> Frame:
        if index in self.broken:
            raise FrameError(self.name(index), "torn")
        image, depth = np.full((6, 8, 3), index, np.uint8), np.full((6, 8), index + 1, np.float32)
        return Frame(index, self.name(index), image, depth, np.eye(4), np.eye(3) + 2)
