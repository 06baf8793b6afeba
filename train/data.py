"""Lightning's view of the training data: a train and a validation loader from one configuration."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from lightning.pytorch import LightningDataModule

from ufmstar_torch.eval import synthetic
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.train.augment import Augmentation, AugmentationConfig
from ufmstar_torch.train.batches import EpochBatches, EpochLoader
from ufmstar_torch.train.samples import FrameSource, RawSample, SampleDataset


@dataclass(frozen=True)
class DataConfig:
    """Where samples come from and how they are served."""

    kind: str = "tour"
    paths: tuple[str, ...] = ()
    batch_size: int = 8
    workers: int = 0
    seed: int = 0
    augmentation: AugmentationConfig | None = field(default_factory=AugmentationConfig)
    on_bad_file: str = "raise"


class DepthDataModule(LightningDataModule):
    """Train and validation loaders of samples at a network's size."""

    def __init__(self, config: DataConfig, preprocess: Preprocess) -> None:
        super().__init__()
        self.config, self.preprocess = config, preprocess
        self.train_set: SampleDataset | None = None
        self.validation_set: SampleDataset | None = None

    def setup(self, stage: str | None = None) -> None:
        """Opens both parts; every process does."""
        c = self.config
        augmentation = None if c.augmentation is None else Augmentation(c.augmentation)
        self.train_set = SampleDataset(
            _Room(32, 0), self.preprocess, augmentation, seed=c.seed, on_bad_file=c.on_bad_file
        )
        self.validation_set = SampleDataset(_Room(8, 1), self.preprocess, on_bad_file=c.on_bad_file, evaluate=True)

    def train_dataloader(self) -> EpochLoader:
        """Shuffled, this process's share of every batch."""
        return self._loader(self.train_set, shuffle=True)

    def val_dataloader(self) -> EpochLoader:
        """Everything once over all processes."""
        return self._loader(self.validation_set, shuffle=False)

    def _loader(self, dataset: SampleDataset | None, shuffle: bool) -> EpochLoader:
        if dataset is None:
            raise RuntimeError("call setup() before asking for a loader")
        rank, world = (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)
        c = self.config
        batches = EpochBatches(len(dataset), c.batch_size, seed=c.seed, rank=rank, world=world, shuffle=shuffle)
        return EpochLoader(dataset, batches, workers=c.workers)


class _Room(FrameSource):
    """Skeleton source."""

    def __init__(self, frames: int, seed: int) -> None:
        self.room = synthetic.Room.furnished(20, seed)
        self.poses = list(synthetic.walk(frames))

    def __len__(self) -> int:
        return len(self.poses)

    def name(self, index: int) -> str:
        return f"room:{index}"

    def load(self, index: int) -> RawSample:
        K = synthetic.intrinsics(60, 80)
        depth = synthetic.render(self.room, self.poses[index], K, 60, 80)
        grey = (255 * np.exp(-depth / 3)).astype(np.uint8)
        image = torch.from_numpy(grey).expand(3, -1, -1)
        return RawSample(image, torch.from_numpy(depth).float(), torch.from_numpy(K))
