"""The output folder of a training.

```
OUT/training.json         what the training was started with
OUT/lock                  held while it is going on
OUT/member_0/...          checkpoint, weights, version_N/metrics.csv of every session, of every member
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
from ufmstar_torch.train.member import WEIGHTS
from ufmstar_torch.train.settings import Job

SUMMARY = "summary.json"
# Fields of the data's configuration that change how fast samples come, not which.
_SPEED = ("workers", "render_workers", "cache")


def identity(job: Job) -> dict[str, Any]:
    """The settings that decide the weights."""
    data = {name: value for name, value in asdict(job.data).items() if name not in _SPEED}
    s = job.settings
    session = {"seed": s.seed, "init": s.init, "trainable": s.trainable, "precision": s.precision}
    return {"recipe": job.recipe.to_dict(), "data": data, **session}


@contextmanager
def open_folder(job: Job, *, resume: bool = False, overwrite: bool = False) -> Iterator[None]:
    """Prepare the folder ``job.settings.out`` and hold it; see ``output_folder``."""
    content = {"identity": identity(job)}
    with output_folder(job.settings.out, TRAINING, content, resume=resume, overwrite=overwrite):
        yield


def _fixed(manifest: Mapping[str, Any], _: Mapping[str, Any]) -> Mapping[str, Any]:
    """The identity but for the number of members: a training may go on with more of them."""
    then = manifest["identity"]
    return {**then, "recipe": {name: value for name, value in then["recipe"].items() if name != "members"}}


TRAINING = FolderKind(
    program="ufmstar train",
    noun="training",
    manifest="training.json",
    format=1,
    lock="lock",
    files=("member_[0-9]", "member_[0-9][0-9]", "member_[0-9][0-9][0-9]", "tensorboard", WEIGHTS, SUMMARY),
    temporary=(".*.tmp", "member_*/.*.tmp"),
    identity=_fixed,
)
