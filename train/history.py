"""The course of a training as two CSV files, which a continued training extends as if it had never stopped.

```
OUT/member_0/metrics.csv    one row per validation: epoch, step, seconds, train_loss, the validation's figures
OUT/member_0/steps.csv      one row every so many steps: step, epoch, seconds, train_loss, learning_rate
```
Lightning's ``CSVLogger`` deletes the file of an earlier session when it starts.
"""

from __future__ import annotations

import csv
import io
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning.pytorch as pl

from ufmstar_torch.eval.run.files import write_atomic
from ufmstar_torch.train.checkpoints import POSITION

SECONDS = "ufmstar_seconds"
METRICS, STEPS = "metrics.csv", "steps.csv"
FIGURES = ("val_nll", "val_nll_constant", "val_nll_constant_best", "val_delta1", "val_rmse", "val_rel")
_COLUMNS = {
    METRICS: ("epoch", "step", "seconds", "train_loss", *FIGURES),
    STEPS: ("step", "epoch", "seconds", "train_loss", "learning_rate"),
}


class History(pl.Callback):
    """Writes both files, on the first process.

    Args:
        folder: of the member; it must exist.
        every: steps between rows of steps.csv.
        checkpoint: from which the training goes on, written by :class:`~ufmstar_torch.train.checkpoints.Checkpoints`;
            None = from the beginning. Rows after it, which a killed session or a stopped epoch left, are removed.
    """

    def __init__(self, folder: Path, every: int, checkpoint: Mapping[str, Any] | None = None) -> None:
        self.folder, self.every = folder, every
        self._step = 0 if checkpoint is None else int(checkpoint["global_step"])
        self._epoch = 0 if checkpoint is None else int(checkpoint[POSITION]["epoch"])
        self._seconds_before = 0.0 if checkpoint is None else float(checkpoint[SECONDS])
        self._began = time.monotonic()

    @property
    def seconds(self) -> float:
        """Of training so far, earlier sessions included."""
        return self._seconds_before + time.monotonic() - self._began

    def on_fit_start(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        """Keep the rows of the steps before, and start the clock."""
        self._began = time.monotonic()
        if trainer.is_global_zero:
            self._keep(METRICS, lambda row: int(row["epoch"]) < self._epoch)
            self._keep(STEPS, lambda row: int(row["step"]) <= self._step)

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, *_: Any) -> None:
        """A row of steps.csv."""
        if trainer.is_global_zero and trainer.global_step % self.every == 0:
            self._append(STEPS, trainer, trainer.callback_metrics)

    def on_train_epoch_end(self, trainer: pl.Trainer, module: Any) -> None:
        """A row of metrics.csv."""
        if trainer.is_global_zero:
            self._append(METRICS, trainer, {**trainer.callback_metrics, "train_loss": module.losses.mean()})

    def on_save_checkpoint(self, trainer: pl.Trainer, module: pl.LightningModule, checkpoint: dict[str, Any]) -> None:
        """Store the clock."""
        checkpoint[SECONDS] = self.seconds

    def _keep(self, name: str, wanted: Any) -> None:
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, _COLUMNS[name])
        writer.writeheader()
        writer.writerows(row for row in read_rows(self.folder / name) if wanted(row))
        write_atomic(self.folder / name, lambda file: file.write(text.getvalue().encode()))

    def _append(self, name: str, trainer: pl.Trainer, values: Mapping[str, Any]) -> None:
        own = {"epoch": trainer.current_epoch, "step": trainer.global_step, "seconds": f"{self.seconds:.1f}"}
        with (self.folder / name).open("a", encoding="utf-8", newline="") as file:
            csv.writer(file).writerow([own[c] if c in own else _number(values.get(c)) for c in _COLUMNS[name]])


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file; none where it is missing. A last line that a kill cut short is left out."""
    if not path.is_file():
        return []
    whole = path.read_text(encoding="utf-8")
    rows = csv.DictReader(io.StringIO(whole[: whole.rfind("\n") + 1], newline=""))
    return [row for row in rows if row.get("step", "") and None not in row.values()]


def _number(value: Any) -> str:
    return "" if value is None or not math.isfinite(float(value)) else f"{float(value):.9g}"
