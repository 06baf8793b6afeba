"""Lightning's data module: a train and a validation loader from one configuration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader
from torch.utils.data.distributed import DistributedSampler

from ufmstar_torch.eval.check.check import check_sequence
from ufmstar_torch.eval.sequences.nyu import PARTS
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.frames.warnings import LOGGER
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.runtime.kinds import check_kinds
from ufmstar_torch.train.augment import Augmentation
from ufmstar_torch.train.data_config import DataConfig, Part
from ufmstar_torch.train.samples import Sample, SampleDataset, clips, joined
from ufmstar_torch.train.sequence_data import SequenceFrames, open_rgbd
from ufmstar_torch.train.tour_data import tour_frames

CHECKED = 3  # most sequences whose depth, poses and images are checked: a mistake in units affects all


class DepthDataModule(LightningDataModule):
    """Train and validation loaders of samples at a network's size; augments and normalises them on their device.

    Args:
        config: source of the frames.
        preprocess: of the network.
        batch_size: frames per step and process.
        seed: of the order.
        clip_frames: length of the clips of successive frames in training. From two on, only colours are augmented,
            because a zoom that divides depth, or a mirror, would not match the camera's path.

    Raises:
        ValueError: ``batch_size`` is no multiple of ``clip_frames``.
    """

    @check_kinds
    def __init__(
        self, config: DataConfig, preprocess: Preprocess, batch_size: int = 8, *, seed: int = 0, clip_frames: int = 1
    ) -> None:
        super().__init__()
        if clip_frames < 1 or batch_size % clip_frames:
            raise ValueError(f"batch_size {batch_size} of a process must be a multiple of {clip_frames} frames")
        self.config, self.preprocess = config, preprocess
        self.batch_size, self.seed, self.clip_frames = batch_size, seed, clip_frames
        self.train_set: SampleDataset | None = None
        self.validation_set: SampleDataset | None = None
        augment = config.augmentation
        if augment is not None and clip_frames > 1:
            augment = replace(augment, scale=(1.0, 1.0), rotation=0.0, flip=0.0)
        self.augmentation = None if augment is None else Augmentation(augment)

    def prepare_data(self) -> None:
        """Render tours that are not in the cache; Lightning calls this in one process per computer."""
        if self.config.kind == "tour":
            sources(self.config)

    def setup(self, stage: str | None = None) -> None:
        """Open both parts, in every process. Raises OSError: a path does not exist, or cannot be written for rendered
        tours; ValueError: a path does not contain the configured kind of data, or the two parts overlap."""
        if self.train_set is not None:
            return
        train, validation = sources(self.config)
        parts = clips(train, self.clip_frames) if self.clip_frames > 1 else None
        self.train_set = SampleDataset(train, self.preprocess, parts, self.config.on_bad_file)
        self.validation_set = SampleDataset(validation, self.preprocess, on_bad_file=self.config.on_bad_file)

    def train_dataloader(self) -> DataLoader[Sample]:
        """Training clips in random order, another in every epoch; this process's share of every batch."""
        rank, world, epoch = 0, 1, 0
        if self.trainer is not None:
            rank, world = self.trainer.global_rank, self.trainer.world_size
            # Workers prefetch before Lightning sets the epoch, which is not 0 in a continued training.
            progress: Any = self.trainer.fit_loop.epoch_progress.current
            epoch = progress.processed
        # The order of an epoch is drawn with the sum of seed and epoch: no two trainings share one.
        seed = (self.seed << 20) % 2**63
        order: Any = DistributedSampler(self._opened(self.train_set), world, rank, seed=seed, drop_last=True)
        order.set_epoch(epoch)
        return self._loader(self.train_set, self.batch_size // self.clip_frames, sampler=order, drop_last=True)

    def val_dataloader(self) -> DataLoader[Sample]:
        """Validation frames in order."""
        return self._loader(self.validation_set, self.batch_size)

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> dict[str, Tensor]:
        """A batch on its device, augmented in training, and its colours normalised for the network."""
        image, depth, K, pose = (batch[name] for name in Sample.__annotations__)
        if self.augmentation is not None and self.trainer is not None and self.trainer.training:
            image, depth, K = self.augmentation(image, depth, K)
            if self.clip_frames == 1:  # the camera was turned or mirrored
                pose = torch.full_like(pose, torch.nan)
        return {"image": self.preprocess.normalized(image), "depth": depth, "intrinsics": K, "T_world_cam": pose}

    def _opened(self, dataset: SampleDataset | None) -> SampleDataset:
        if dataset is None:
            raise RuntimeError("call setup() before asking for a loader")
        return dataset

    def _loader(self, dataset: SampleDataset | None, batch_size: int, **how: Any) -> DataLoader[Sample]:
        workers = self.config.workers
        return DataLoader(
            self._opened(dataset),
            batch_size,
            collate_fn=joined,
            num_workers=workers,
            pin_memory=torch.cuda.is_available(),
            # Forked processes inherit the state of OpenMP's threads and hang if the parent has used them.
            multiprocessing_context="spawn" if workers else None,
            persistent_workers=workers > 0,
            # Without a generator, every iteration would draw from the global one.
            generator=torch.Generator(),
            **how,
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
