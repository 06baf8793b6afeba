"""Settings of a session of training, and the job: recipe, data and settings together."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from torch import nn

from ufmstar_torch.models.spec import MOST_MEMBERS
from ufmstar_torch.runtime.checked import Checked, number
from ufmstar_torch.runtime.kinds import check_fields
from ufmstar_torch.train.data_config import DataConfig
from ufmstar_torch.train.presets import Recipe


@dataclass(frozen=True, kw_only=True)
class FitSettings(Checked):
    """Settings of one session. Apart from seed, init, trainable and precision, the settings may change between
    two sessions of one training without changing its result.

    Attributes:
        out: output folder.
        seed: of the training; member n has the seed 1000 seed + n, so that trainings with different seeds share none.
        init: weights to start from: a trained .safetensors, FastDepth's .onnx, a ResNet's .pth, Monodepth2's folder or
            the word imagenet; see ``train.start.starting_network``.
        trainable: train only parameters whose names begin with one of these; empty = all of them.
        accelerator: cpu, gpu or auto.
        devices: number of processes or GPUs, as Lightning takes it.
        nodes: number of computers.
        strategy: Lightning's name of how processes work together: auto, ddp, ...; those that start processes as
            scripts ("ddp", not "ddp_spawn").
        precision: 32-true, bf16-mixed or 16-mixed; the loss is in float32 always.
        log_every: steps between rows of metrics.csv.
        max_minutes: after which this session stops, all members together, with a validation. 0 = never.
        sync_batchnorm: whether batch norm uses the batches of all processes (GPUs only).
        tensorboard: whether to write logs for TensorBoard.
        progress: whether to show a progress bar.

    Raises:
        ValueError: a value is impossible; the message names the field.
    """

    out: Path
    seed: int = number(0, "seed", "1", 0)
    init: Path | None = None
    trainable: tuple[str, ...] = ()
    accelerator: str = "auto"
    devices: int | str = 1
    nodes: int = number(1, "N", "computers", 1)
    strategy: str = "auto"
    precision: str = "32-true"
    log_every: int = number(50, "N", "steps", 1)
    max_minutes: float = number(0.0, "t", "min", 0)
    sync_batchnorm: bool = False
    tensorboard: bool = True
    progress: bool = True

    def __post_init__(self) -> None:
        check_fields(self)
        super().__post_init__()
        if any(word in self.strategy for word in ("spawn", "fork", "notebook")):
            raise ValueError(f"FitSettings.strategy must start processes as scripts: 'ddp', not {self.strategy!r}")


@dataclass(frozen=True)
class Job:
    """Recipe, data and settings of a training; can be pickled."""

    recipe: Recipe  # determines the weights
    data: DataConfig  # source of the samples
    settings: FitSettings  # of this session
    # custom network of the recipe, with its initial weights; None = weights of a file, or random
    backbone: nn.Module | None = field(default=None, compare=False)

    def folder(self, member: int) -> Path:
        """The folder of one member's files."""
        return self.settings.out / f"member_{member}"

    def seed(self, member: int) -> int:
        """The seed of a member's initial weights, order of samples, augmentation and dropout.

        Trainings with different seeds share no member's seed; with seed + member, seeds 0 and 1 would share nine of
        ten.
        """
        return self.settings.seed * MOST_MEMBERS + member
