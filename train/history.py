"""The course of a training as two CSV files that a continued training goes on with as if it had never stopped.

```
OUT/member_0/metrics.csv    one row per validation: epoch, step, seconds, train_loss, the validation's figures
OUT/member_0/steps.csv      one row every so many steps: step, epoch, seconds, train_loss, learning_rate
```
"""

from __future__ import annotations

import csv
import io
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning.pytorch as pl

from ufmstar_torch.eval.results.files import write_atomic
from ufmstar_torch.train.checkpoints import POSITION

SECONDS = "ufmstar_seconds"
METRICS, STEPS = "metrics.csv", "steps.csv"
METRIC_COLUMNS = (
    "epoch",
    "step",
    "seconds",
    "train_loss",
    "val_nll",
    "val_nll_constant",
    "val_nll_constant_best",
    "val_delta1",
    "val_rmse",
    "val_rel",
)
STEP_COLUMNS = ("step", "epoch", "seconds", "train_loss", "learning_rate")


@dataclass(frozen=True)
class Start:
    """Where a training goes on: steps done, the epoch that comes or goes on next, seconds spent."""

    step: int = 0
    epoch: int = 0
    seconds: float = 0.0

    @classmethod
    def after(cls, checkpoint: Mapping[str, Any]) -> Start:
        """A checkpoint that :class:`~ufmstar_torch.train.checkpoints.Checkpoints` wrote."""
        return cls(int(checkpoint["global_step"]), int(checkpoint[POSITION]["epoch"]), float(checkpoint[SECONDS]))


class History(pl.Callback):
    """Writes both files, on the first process.

    Args:
        folder: of the member; it must exist.
        every: steps between rows of steps.csv.
        start: where the training goes on; what lies behind it was written by a killed run, or for an epoch that was
            stopped in the middle, and is dropped.
    """

    def __init__(self, folder: Path, every: int, start: Start | None = None) -> None:
        self.folder = folder
        self.every = every
        self.start = Start() if start is None else start
        self._began = time.monotonic()

    @property
    def seconds(self) -> float:
        """Of training so far, earlier sessions included."""
        return self.start.seconds + time.monotonic() - self._began

    def on_fit_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        """Keep what belongs to the steps before, and start the clock."""
        self._began = time.monotonic()
        if trainer.is_global_zero:
            metrics = [row for row in read_rows(self.folder / METRICS) if int(row["epoch"]) < self.start.epoch]
            write_rows(self.folder / METRICS, METRIC_COLUMNS, metrics)
            steps = [row for row in read_rows(self.folder / STEPS) if int(row["step"]) <= self.start.step]
            write_rows(self.folder / STEPS, STEP_COLUMNS, steps)

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, *_: Any) -> None:
        """A row of steps.csv."""
        if trainer.is_global_zero and trainer.global_step % self.every == 0:
            told = trainer.callback_metrics
            row = {"train_loss": told.get("train_loss"), "learning_rate": told.get("learning_rate")}
            self._append(STEPS, STEP_COLUMNS, trainer, row)

    def on_train_epoch_end(self, trainer: pl.Trainer, module: Any) -> None:
        """A row of metrics.csv."""
        if trainer.is_global_zero:
            self._append(
                METRICS, METRIC_COLUMNS, trainer, {**trainer.callback_metrics, "train_loss": module.losses.mean()}
            )

    def on_save_checkpoint(self, trainer: pl.Trainer, module: pl.LightningModule, checkpoint: dict[str, Any]) -> None:
        """The clock."""
        checkpoint[SECONDS] = self.seconds

    def _append(self, name: str, columns: Sequence[str], trainer: pl.Trainer, values: Mapping[str, Any]) -> None:
        own = {"epoch": trainer.current_epoch, "step": trainer.global_step, "seconds": f"{self.seconds:.1f}"}
        row = {c: own[c] if c in own else _number(values.get(c)) for c in columns}
        with (self.folder / name).open("a", encoding="utf-8", newline="") as file:
            csv.DictWriter(file, columns).writerow(row)


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file; none where it is missing. A last line that a kill cut short is left out."""
    if not path.is_file():
        return []
    whole = path.read_text(encoding="utf-8")
    rows = csv.DictReader(io.StringIO(whole[: whole.rfind("\n") + 1], newline=""))
    return [row for row in rows if row.get("step", "") and None not in row.values()]


def write_rows(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Replace a CSV file."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns)
    writer.writeheader()
    writer.writerows(rows)
    write_atomic(path, lambda file: file.write(text.getvalue().encode()))


def _number(value: Any) -> str:
    return "" if value is None or not math.isfinite(float(value)) else f"{float(value):.9g}"
