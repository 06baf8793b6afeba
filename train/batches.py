"""The order of training samples: a function of seed and epoch, divided among processes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from torch.utils.data import Sampler

from ufmstar_torch.train.samples import SampleKey


class EpochBatches(Sampler[list[SampleKey]]):
    """Batches of (epoch, frame) for a loader's ``batch_sampler``.

    Training (``shuffle``): each epoch has another order. The processes of a distributed run split each batch of
    ``world * batch_size``, so that their steps equal those of one process with that batch size; an incomplete last
    batch is dropped. Validation: every frame once, in order; process ``rank`` gets every ``world``-th frame, so the
    numbers of batches may differ. A process without any frame gets the last frame, as a sample that does not count,
    because the first validation batch after a training step synchronises the processes.

    Args:
        length: number of frames, or of clips.
        batch_size: frames, or clips, per process and step.
        seed: of the order.
        rank, world: index of this process, and the number of processes.
        shuffle: training or validation.
        clips: the frames of every clip, which are not separated; None = single frames.

    Raises:
        ValueError: a number out of range, or fewer frames than a training step needs.
    """

    def __init__(
        self,
        length: int,
        batch_size: int,
        *,
        seed: int = 0,
        rank: int = 0,
        world: int = 1,
        shuffle: bool = True,
        clips: Sequence[range] | None = None,
    ) -> None:
        if length < 1 or batch_size < 1:
            raise ValueError(f"length and batch_size must be at least 1, got {length} and {batch_size}")
        if seed < 0 or not 0 <= rank < world:
            raise ValueError(f"seed must be >= 0 and rank in [0, world), got {seed}, {rank} of {world}")
        if shuffle and length < batch_size * world:
            raise ValueError(f"a step needs batch_size {batch_size} x {world} processes, got only {length} frames")
        self.length, self.batch_size, self.seed = length, batch_size, seed
        self.rank, self.world, self.shuffle = rank, world, shuffle
        self.clips = clips
        self.epoch = 0

    @property
    def sampler(self) -> EpochBatches:
        """This object: Lightning calls ``loader.batch_sampler.sampler.set_epoch`` at the start of every epoch."""
        return self

    def set_epoch(self, epoch: int) -> None:
        """Iterate over the batches of ``epoch``, at least 0, from now on."""
        self.epoch = epoch

    def __len__(self) -> int:
        if self.shuffle:
            return self.length // (self.batch_size * self.world)
        return -(-len(self._order()) // self.batch_size)

    def __iter__(self) -> Iterator[list[SampleKey]]:
        epoch, order = self.epoch, self._order()
        counts = self.shuffle or self.rank < self.length  # False: the only frame is another process's
        for batch in range(len(self)):
            step = self.batch_size * (self.world if self.shuffle else 1)
            share = slice(self.rank, None, self.world) if self.shuffle else slice(None)
            chosen = order[batch * step : (batch + 1) * step][share].tolist()
            frames = chosen if self.clips is None else [frame for clip in chosen for frame in self.clips[clip]]
            yield [SampleKey(epoch, frame, counts) for frame in frames]

    def _order(self) -> np.ndarray:
        if not self.shuffle:
            return np.arange(min(self.rank, self.length - 1), self.length, self.world)
        return np.random.default_rng((self.seed, self.epoch)).permutation(self.length)
