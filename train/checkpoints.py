"""Atomic checkpoints at the end of epochs, and orderly stops.

```
OUT/member_0/last.ckpt    Lightning's checkpoint: weights, optimizer, schedule, loops
```
The order of the samples, their augmentation and dropout are functions of seed, epoch and step (``train.batches``,
``train.module.step_seed``), so a checkpoint needs no state of a random number generator: other code that draws random
numbers, a progress bar or another number of workers do not change the result of a resumed training.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO

from ufmstar_torch.files.read import read_tensors
from ufmstar_torch.files.write import write_atomic
from ufmstar_torch.train.module import FIGURES_KEY

NAME = "last.ckpt"
TIME, SIGNAL = "time budget spent", "stopped"


class ResumeError(ValueError):
    """The checkpoint cannot be read or does not fit; the message names the option to use."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes atomically and durably.

    Lightning's writer overwrites the destination in place: a kill in the middle would leave no checkpoint.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Replace ``path`` durably. Raises OSError: for example a full disk; the previous checkpoint remains."""
        write_atomic(Path(path), lambda file: torch.save(checkpoint, file), durable=True)


class Checkpoints(pl.Callback):
    """Writes a checkpoint at the end of every complete epoch, after its validation."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def on_train_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        """Write a checkpoint after a complete epoch."""
        if trainer.fit_loop.epoch_loop.batch_progress.is_last_batch:
            trainer.save_checkpoint(self.path)


class Stops(pl.Callback):
    """Ends a training in an orderly way, after a validation: after ``total`` steps, at a deadline in
    ``time.monotonic()``'s seconds, or when ``asked`` returns True. ``reason``: of the stop, or None."""

    def __init__(self, total: int, deadline: float | None = None, asked: Callable[[], bool] | None = None) -> None:
        self.total = total
        self.deadline = deadline
        self.asked = asked
        self.reason: str | None = None
        self._sigterm = signal.getsignal(signal.SIGTERM)

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        """Restore the caller's SIGTERM handler: Lightning's handler, which has replaced it, ends the program with exit
        code 0 and without a result."""
        if self.asked is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, self._sigterm)

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, *_: Any) -> None:
        """Stop all processes after the same step."""
        in_any_process = trainer.strategy.reduce_boolean_decision
        if in_any_process(self.asked is not None and self.asked(), all=False):
            self.reason = SIGNAL
        elif in_any_process(self.deadline is not None and time.monotonic() >= self.deadline, all=False):
            self.reason = TIME
        if self.reason is not None or trainer.global_step >= self.total:
            trainer.should_stop = True


def require_checkpoint(path: Path) -> None:
    """Raise a ResumeError unless a file is a readable checkpoint of this program."""
    try:
        with path.open("rb") as file:
            stored = read_tensors(file, "it")
    except (OSError, ValueError) as error:
        raise ResumeError(f"--resume: {path} cannot be read ({error}); --overwrite starts again") from error
    if not isinstance(stored, dict) or FIGURES_KEY not in stored:
        raise ResumeError(f"--resume: {path} is no checkpoint of this program; --overwrite starts again")
