"""How a training is run: what may change between two sessions of the same training without changing its result."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class FitSettings:
    """Attributes:
        out: folder for everything that is written.
        seed: of the training; member n has 1000 seed + n, so that trainings with different seeds share none.
        init: weights to start from, or None; see ``train.start.starting_network``.
        trainable: only parameters whose names begin so are trained; empty = all of them.
        accelerator, devices, nodes, strategy, precision: as Lightning's Trainer takes them; of the strategies,
            those that start processes as scripts ("ddp", not "ddp_spawn").
        member_processes: members that are trained at the same time, each in a process of its own.
        checkpoint_every: steps between checkpoints within an epoch, 0 = at the end of epochs only.
        log_every: steps between rows of steps.csv.
        examples: validation images in the picture that every epoch leaves, 0 = no pictures.
        max_minutes: after which this session stops in good order, over all members; 0 = never.
        sync_batchnorm: whether batch norm uses the statistics of the batches of all processes (GPUs only).
        tensorboard: whether to write logs for TensorBoard.
        progress: whether to show a progress bar.

    Raises:
        ValueError: a value is impossible; the message names the field.
    """

    out: Path
    seed: int = 0
    init: Path | None = None
    trainable: tuple[str, ...] = ()
    accelerator: str = "auto"
    devices: int | str = 1
    nodes: int = 1
    strategy: str = "auto"
    precision: str = "32-true"
    member_processes: int = 1
    checkpoint_every: int = 500
    log_every: int = 50
    examples: int = 4
    max_minutes: float = 0.0
    sync_batchnorm: bool = False
    tensorboard: bool = True
    progress: bool = True

    def __post_init__(self) -> None:
        lowest = {"seed": 0, "nodes": 1, "member_processes": 1, "checkpoint_every": 0, "log_every": 1, "examples": 0}
        for name, low in {**lowest, "max_minutes": 0}.items():
            if not getattr(self, name) >= low:
                raise ValueError(f"FitSettings.{name} must be at least {low}, got {getattr(self, name)}")
        if any(word in self.strategy for word in ("spawn", "fork", "notebook")):
            raise ValueError(f"FitSettings.strategy must start processes as scripts: 'ddp', not {self.strategy!r}")
        if self.member_processes > 1 and (self.devices != 1 or self.nodes != 1):
            raise ValueError("FitSettings.member_processes above 1 goes with devices = 1 and nodes = 1")
