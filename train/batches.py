"""The order of training samples: a function of seed and epoch, divided among processes, entered at any batch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Sampler

from ufmstar_torch.train.samples import Sample, SampleDataset, SampleKey


class EpochBatches(Sampler[list[SampleKey]]):
    """Batches of (epoch, frame) for a loader's ``batch_sampler``.

    Training (``shuffle``): each epoch has its own order. The processes of a distributed run divide each batch of
    ``world * batch_size`` among them, so that together they take the steps of one process with that batch
    size; what is left at the end of the order and fills no batch is left out in that epoch. Validation:
    everything once, in order, process ``rank`` takes every ``world``-th frame; processes may then have
    unequal numbers of batches. One without any frame gets the last one, as a sample that does not count: the
    first validation batch after a training step synchronises the processes, so each must have one.

    ``len`` is the number of batches in the whole epoch, also where iteration starts inside it.

    Args:
        length: number of frames, or of clips.
        batch_size: frames, or clips, per process and step.
        seed: of the order.
        rank, world: number of this process, and of all.
        shuffle: training or validation.
        clips: the frames of every clip, which stay together; None = single frames.

    Raises:
        ValueError: a number out of range, or fewer frames than one training step takes.
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
            raise ValueError(f"a step takes batch_size {batch_size} x {world} processes of only {length} frames")
        self.length, self.batch_size, self.seed = length, batch_size, seed
        self.rank, self.world, self.shuffle = rank, world, shuffle
        self.clips = clips
        self.epoch = self.start_batch = 0

    def set_epoch(self, epoch: int, start_batch: int = 0) -> None:
        """What the iterations from now on go over: the batches of ``epoch`` from ``start_batch`` on. Raises ValueError:
        a number out of range."""
        if epoch < 0 or not 0 <= start_batch <= len(self):
            raise ValueError(f"epoch must be >= 0 and start_batch in [0, {len(self)}], got {epoch} and {start_batch}")
        self.epoch, self.start_batch = epoch, start_batch

    def __len__(self) -> int:
        if self.shuffle:
            return self.length // (self.batch_size * self.world)
        return -(-len(self._order()) // self.batch_size)

    def __iter__(self) -> Iterator[list[SampleKey]]:
        epoch, order = self.epoch, self._order()
        counts = self.shuffle or self.rank < self.length  # whether this process has frames of its own
        for batch in range(self.start_batch, len(self)):
            chosen = self._batch(order, batch).tolist()
            frames = chosen if self.clips is None else [frame for clip in chosen for frame in self.clips[clip]]
            yield [SampleKey(epoch, frame, counts) for frame in frames]

    def _order(self) -> np.ndarray:
        if not self.shuffle:
            return np.arange(min(self.rank, self.length - 1), self.length, self.world)
        return np.random.default_rng((self.seed, self.epoch)).permutation(self.length)

    def _batch(self, order: np.ndarray, batch: int) -> np.ndarray:
        if self.shuffle:
            step = self.batch_size * self.world
            return order[batch * step : (batch + 1) * step][self.rank :: self.world]
        return order[batch * self.batch_size : (batch + 1) * self.batch_size]


class EpochLoader:
    """A ``DataLoader`` whose position can be stored: what a trainer iterates over.

    Lightning calls ``sampler.set_epoch`` at the start of every epoch and stores ``state_dict`` in its
    checkpoints, so a run that was killed inside an epoch goes on with the batch after the last one of its
    checkpoint. Workers are started with "spawn": forked ones inherit OpenMP's threads as they are, and hang
    where the parent has used them.

    Args:
        dataset: the samples.
        batches: their order.
        workers: processes that load; 0 = in this one.
        pin_memory: for copies to a GPU.
    """

    batch_sampler: None = None  # Lightning reads it from every loader with a ``sampler``

    def __init__(self, dataset: SampleDataset, batches: EpochBatches, *, workers: int = 0, pin_memory: bool = False):
        self.dataset, self.batches = dataset, batches
        self._loader: DataLoader[Sample] = DataLoader(
            dataset,
            batch_sampler=batches,
            num_workers=workers,
            pin_memory=pin_memory,
            multiprocessing_context="spawn" if workers else None,
            persistent_workers=workers > 0,
            # Its own generator: without one, every iteration would draw from the global one.
            generator=torch.Generator(),
        )
        self._delivered = 0

    @property
    def sampler(self) -> EpochLoader:
        """Itself, where Lightning looks for ``set_epoch``."""
        return self

    def set_epoch(self, epoch: int) -> None:
        """Iterate over that epoch: from its beginning, or from a loaded state's batch."""
        if epoch != self.batches.epoch:
            self.batches.set_epoch(epoch)

    def state_dict(self) -> dict[str, int]:
        """The epoch and the number of its batches that were handed out."""
        if self._delivered == len(self.batches):
            return {"epoch": self.batches.epoch + 1, "batch": 0}
        return {"epoch": self.batches.epoch, "batch": self._delivered}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where :meth:`state_dict` was asked."""
        self.batches.set_epoch(state["epoch"], state["batch"])
        self._delivered = state["batch"]

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[Any]:
        # A generator: nothing is started, and no epoch fixed, before the first batch is asked for.
        self._delivered = self.batches.start_batch
        for batch in self._loader:
            self._delivered += 1
            yield batch
