"""Lightning's data module: a train and a validation loader from one configuration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader

from ufmstar_torch.eval.check.check import check_sequence
from ufmstar_torch.eval.sequences.nyu import PARTS
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.frames.warnings import LOGGER
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.train.augment import Augmentation
from ufmstar_torch.train.batches import EpochBatches
from ufmstar_torch.train.data_config import DataConfig, Part
from ufmstar_torch.train.samples import Sample, SampleDataset, clips
from ufmstar_torch.train.sequence_data import SequenceFrames, open_rgbd
from ufmstar_torch.train.tour_data import tour_frames

CHECKED = 3  # most sequences whose depth, poses and images are checked: a mistake in units affects all


class DepthDataModule(LightningDataModule):
    """Train and validation loaders of samples at a network's size.

    The trainer must not replace the sampler: ``Trainer(use_distributed_sampler=False)``.

    Args:
        config: source of the frames.
        preprocess: of the network.
        batch_size: frames per step and process.
        seed: of the order and the augmentation.
        clip_frames: length of the clips of successive frames in training. From two on, only colours are augmented,
            because a zoom that divides depth, or a mirror, would not match the camera's path.

    Raises:
        ValueError: ``batch_size`` is no multiple of ``clip_frames``.

    Attributes:
        clips: of the training part, after ``setup``; None with ``clip_frames = 1``.
    """

    def __init__(
        self, config: DataConfig, preprocess: Preprocess, batch_size: int = 8, *, seed: int = 0, clip_frames: int = 1
    ) -> None:
        super().__init__()
        if batch_size % clip_frames:
            raise ValueError(f"batch_size {batch_size} of a process must be a multiple of {clip_frames} frames")
        self.config, self.preprocess = config, preprocess
        self.batch_size, self.seed, self.clip_frames = batch_size, seed, clip_frames
        self.clips: list[range] | None = None
        self.train_set: SampleDataset | None = None
        self.validation_set: SampleDataset | None = None

    def prepare_data(self) -> None:
        """Render tours that are not in the cache; Lightning calls this in one process per computer."""
        if self.config.kind == "tour":
            sources(self.config)

    def setup(self, stage: str | None = None) -> None:
        """Open both parts, in every process. Raises OSError: a path does not exist, or cannot be written for rendered
        tours; ValueError: a path does not contain the configured kind of data, or the two parts overlap."""
        if self.train_set is not None:
            return
        c = self.config
        train, validation = sources(c)
        config = c.augmentation
        if self.clip_frames > 1:
            self.clips = clips(train, self.clip_frames)
            config = None if config is None else replace(config, scale=(1.0, 1.0), rotation=0.0, flip=0.0)
        augmentation = None if config is None else Augmentation(config)
        self.train_set = SampleDataset(train, self.preprocess, augmentation, seed=self.seed, on_bad_file=c.on_bad_file)
        self.validation_set = SampleDataset(validation, self.preprocess, on_bad_file=c.on_bad_file, evaluate=True)

    def train_dataloader(self) -> DataLoader[Sample]:
        """Training frames in random order; this process's share of every batch."""
        return self._loader(self.train_set, shuffle=True)

    def val_dataloader(self) -> DataLoader[Sample]:
        """Validation frames in order; this process's share."""
        return self._loader(self.validation_set, shuffle=False)

    def bad_files(self) -> tuple[str, ...]:
        """The broken files skipped so far in both parts."""
        return tuple(name for part in (self.train_set, self.validation_set) if part for name in part.bad_files())

    def _loader(self, dataset: SampleDataset | None, shuffle: bool) -> DataLoader[Sample]:
        if dataset is None:
            raise RuntimeError("call setup() before asking for a loader")
        rank, world = (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)
        c = self.config
        order: dict[str, Any] = {"seed": self.seed, "rank": rank, "world": world, "shuffle": shuffle}
        if shuffle and self.clips is not None:
            batches = EpochBatches(len(self.clips), self.batch_size // self.clip_frames, clips=self.clips, **order)
        else:
            batches = EpochBatches(len(dataset), self.batch_size, **order)
        if shuffle and self.trainer is not None:
            # Workers prefetch before Lightning sets the epoch, which is not 0 in a resumed training.
            progress: Any = self.trainer.fit_loop.epoch_progress.current
            batches.set_epoch(progress.processed)
        return sample_loader(dataset, batches, c.workers)


def sample_loader(dataset: SampleDataset, batches: EpochBatches, workers: int = 0) -> DataLoader[Sample]:
    """A loader of samples in the order of ``batches``, with ``workers`` processes (0: this one). They are started with
    "spawn", because forked processes inherit the state of OpenMP's threads and hang if the parent has used them."""
    return DataLoader(
        dataset,
        batch_sampler=batches,
        num_workers=workers,
        pin_memory=torch.cuda.is_available(),
        multiprocessing_context="spawn" if workers else None,
        persistent_workers=workers > 0,
        # Without a generator, every iteration would draw from the global one.
        generator=torch.Generator(),
    )


def sources(config: DataConfig) -> tuple[SequenceFrames, SequenceFrames]:
    """The frames for training and for validation. Raises OSError, ValueError: as ``DepthDataModule.setup``."""
    c = config
    if c.kind == "nyu":
        train, validation = (SequenceFrames([open_sequence(Path(c.paths[0]) / part)]) for part in PARTS)
        return train, validation
    if c.kind == "tour":
        seeds = range(c.first_tour, c.first_tour + c.tours + c.validation_tours)
        return tour_frames(seeds[: c.tours], c), tour_frames(seeds[c.tours :], c)
    return _sequences(c)


def _sequences(c: DataConfig) -> tuple[SequenceFrames, SequenceFrames]:
    opened = [open_rgbd(path) for path in c.paths]
    part, held_back = Part.parse(c.part), Part.parse(c.validation_part)
    validated = {Path(path).resolve() for path in c.validation_paths or c.paths}
    for sequence, path in zip(opened, c.paths, strict=True):
        both = set(part.frames(len(sequence))) & set(held_back.frames(len(sequence)))
        if both and Path(path).resolve() in validated:
            raise ValueError(
                f"DataConfig.part {part} and validation_part {held_back} share {len(both)} frames of {sequence.name}"
            )
    others = [open_rgbd(path) for path in c.validation_paths] or opened
    for sequence in opened[:CHECKED]:
        for problem in check_sequence(sequence).problems:
            LOGGER.warning("%s: %s (ufmstar data check)", sequence.name, problem)
    return SequenceFrames(opened, part), SequenceFrames(others, held_back)
