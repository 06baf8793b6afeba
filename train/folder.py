"""The output folder of a training.

```
OUT/training.json         settings at the start
OUT/lock                  locked during a training
OUT/member_0/...          of each member: last.ckpt, and version_N/metrics.csv of every session
OUT/tensorboard/          logs
OUT/trained.safetensors   all members
OUT/summary.json          figures, command, versions, hardware, seconds
```
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

from ufmstar_torch.eval.run.folder import FolderKind, output_folder
from ufmstar_torch.train.member import CHECKPOINT
from ufmstar_torch.train.settings import Job

SUMMARY, WEIGHTS = "summary.json", "trained.safetensors"
_SETTINGS = "version_*/hparams.yaml"  # of Lightning's loggers
# Fields of the data's configuration that change only the speed.
_SPEED = ("workers", "render_workers", "cache")


def identity(job: Job) -> dict[str, Any]:
    """The settings that determine the weights."""
    data = {name: value for name, value in asdict(job.data).items() if name not in _SPEED}
    s = job.settings
    session = {"seed": s.seed, "init": s.init, "trainable": s.trainable, "precision": s.precision}
    return {"recipe": job.recipe.to_dict(), "data": data, **session}


@contextmanager
def open_folder(job: Job, *, overwrite: bool = False) -> Iterator[None]:
    """Prepare and lock the folder ``job.settings.out``; see ``output_folder``."""
    content = {"identity": identity(job)}
    with output_folder(job.settings.out, TRAINING, content, overwrite=overwrite):
        yield


def _fixed(manifest: Mapping[str, Any], _: Mapping[str, Any]) -> Mapping[str, Any]:
    """The identity without the number of members, which may increase when a training continues."""
    stored = manifest["identity"]
    return {**stored, "recipe": {name: value for name, value in stored["recipe"].items() if name != "members"}}


TRAINING = FolderKind(
    program="ufmstar train",
    noun="training",
    manifest="training.json",
    format=2,
    lock="lock",
    files=(
        *(f"member_[0-9]*/{name}" for name in (CHECKPOINT, "version_*/metrics.csv", _SETTINGS)),
        *(f"tensorboard/member_*/{name}" for name in ("events.out.tfevents.*", "hparams.yaml")),
        WEIGHTS,
        SUMMARY,
    ),
    temporary=(".*.tmp", "member_*/.*.tmp"),
    identity=_fixed,
)
