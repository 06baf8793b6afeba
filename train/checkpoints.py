"""Checkpoints that are whole or absent, written so that a killed training goes on exactly; and orderly stops.

```
OUT/member_0/last.ckpt    Lightning's checkpoint: weights, optimizer, schedule, loops; and the next (epoch, batch)
```
The order of the samples, their augmentation and dropout are functions of seed, epoch and step (``train.batches``,
``train.module.step_seed``), so no state of a random number generator has to be kept: nothing else that draws
numbers, nor a progress bar, nor another number of workers, changes the result of a continued training.
"""

from __future__ import annotations

import signal
import threading
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO

from ufmstar_torch.eval.run.files import write_atomic

NAME = "last.ckpt"
# Under this key, the sampler's position: {"epoch", "batch"} that come next.
POSITION = "ufmstar_next"
TIME, SIGNAL = "time budget spent", "stopped"


class ResumeError(ValueError):
    """The checkpoint cannot be read or does not fit; the message names the option that helps."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes through a temporary file that then takes the old one's place, once the disk has it.

    Lightning's own writer fills the destination in place: a kill in the middle would leave neither checkpoint.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Replace ``path`` durably. Raises OSError: for example a full disk; the checkpoint before it is kept."""
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(target, lambda file: torch.save(checkpoint, file), durable=True)


class Checkpoints(pl.Callback):
    """Writes ``last.ckpt`` every so many steps (0 = never) and at the end of every epoch, after its validation."""

    def __init__(self, path: Path, every: int) -> None:
        self.path = path
        self.every = every

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, *_: Any) -> None:
        """In the middle of an epoch; what its last batch leaves is kept with its validation."""
        due = self.every > 0 and trainer.global_step % self.every == 0
        if (due or trainer.should_stop) and not trainer.fit_loop.epoch_loop._num_ready_batches_reached():
            trainer.save_checkpoint(self.path)

    def on_train_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        """At the end of an epoch that was not cut short."""
        if trainer.fit_loop.epoch_loop._num_ready_batches_reached():
            trainer.save_checkpoint(self.path)

    def on_save_checkpoint(self, trainer: pl.Trainer, module: pl.LightningModule, checkpoint: dict[str, Any]) -> None:
        """The sampler's position."""
        loop: Any = trainer.fit_loop.epoch_loop
        done = loop.batch_progress.current.processed
        ended = loop._num_ready_batches_reached()
        epoch = trainer.current_epoch
        checkpoint[POSITION] = {"epoch": epoch + 1, "batch": 0} if ended else {"epoch": epoch, "batch": done}


class Stops(pl.Callback):
    """Ends a training in good order, after a validation: with its last step of ``total``, at a deadline in
    ``time.monotonic()``'s seconds, or when ``asked`` returns True. ``reason``: why it was stopped, or None."""

    def __init__(self, total: int, deadline: float | None = None, asked: Callable[[], bool] | None = None) -> None:
        self.total = total
        self.deadline = deadline
        self.asked = asked
        self.reason: str | None = None
        self._sigterm = signal.getsignal(signal.SIGTERM)

    def on_train_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        """Restore the caller's SIGTERM handler: Lightning has just replaced it by its own, which ends the program with
        success and without a result."""
        if self.asked is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, self._sigterm)

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, *_: Any) -> None:
        """All processes stop after the same step."""
        code = int(self.deadline is not None and time.monotonic() >= self.deadline)
        code = 2 if self.asked is not None and self.asked() else code
        if trainer.world_size > 1:
            highest = torch.tensor(code, device=module.device)
            torch.distributed.all_reduce(highest, torch.distributed.ReduceOp.MAX)
            code = int(highest)
        reason = (None, TIME, SIGNAL)[code]
        self.reason = self.reason if reason is None else reason
        if reason is not None or trainer.global_step >= self.total:
            trainer.should_stop = True


def read_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint that :class:`Checkpoints` wrote. Raises ResumeError: the file cannot be read, or is another
    program's."""
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, EOFError, RuntimeError, KeyError, UnpicklingError, zipfile.BadZipFile, ValueError) as error:
        raise ResumeError(f"--resume: {path} cannot be read ({error}); --overwrite starts again") from error
    if not isinstance(stored, dict) or POSITION not in stored:
        raise ResumeError(f"--resume: {path} is no checkpoint of this program; --overwrite starts again")
    return stored
