"""The output folder of a training: whose it is, and whether what is asked for now is the same training.

```
OUT/training.json         what the training was started with
OUT/lock                  held while it is going on
OUT/member_0/...          checkpoint, weights, metrics.csv, steps.csv, examples/ of every member
OUT/tensorboard/          logs
OUT/trained.safetensors   all members
OUT/summary.json          figures, command, versions, hardware, seconds
```
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.results.files import to_json, write_json_atomic
from ufmstar_torch.eval.results.run_folder import FolderError, flatten
from ufmstar_torch.train.member import WEIGHTS, Job

MANIFEST, SUMMARY, LOCK = "training.json", "summary.json", "lock"
PROGRAM, FORMAT = "ufmstar train", 1
# Fields of the data's configuration that change how fast samples come, not which.
_SPEED = ("workers", "render_workers", "cache")
_SHOWN = 5


def identity(job: Job) -> dict[str, Any]:
    """Everything that decides the weights, as plain values."""
    data = {name: value for name, value in asdict(job.data).items() if name not in (*_SPEED, "seed", "batch_size")}
    s = job.settings
    own = {"seed": s.seed, "init": s.init, "trainable": s.trainable, "precision": s.precision}
    plain: dict[str, Any] = to_json({"recipe": job.recipe.to_dict(), "data": data, **own})
    return plain


@contextmanager
def open_folder(job: Job, *, resume: bool = False, overwrite: bool = False) -> Iterator[None]:
    """Prepare the folder and hold it; files that are not this program's are never touched.

    Args:
        job: of the training; ``settings.out`` is created if missing.
        resume: go on with the training in it; without one, start.
        overwrite: remove what an earlier training left, and start.

    Raises:
        FolderError: the folder holds an earlier training and neither was asked for; other files; a training that
            was started with other values (they are named), or that is still going on.
        OSError: the folder cannot be made.
    """
    out, now = job.settings.out, identity(job)
    if out.exists() and not out.is_dir():
        raise FolderError(f"--out {out} is a file, expected a folder")
    manifest = out / MANIFEST
    if not manifest.is_file():
        if out.is_dir() and any(path.name != LOCK for path in out.iterdir()):
            raise FolderError(f"--out {out} holds files of someone else: choose an empty or a new folder")
    elif not (resume or overwrite):
        raise FolderError(f"--out {out} holds an earlier training: --resume goes on with it, --overwrite replaces it")
    out.mkdir(parents=True, exist_ok=True)
    with _locked(out):
        if manifest.is_file() and resume:
            _require_same(out, now, _read_manifest(manifest))
        else:
            _clear(out)
            write_json_atomic(manifest, {"program": PROGRAM, "format": FORMAT, "identity": now})
        yield


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Hold the folder; the lock goes with the process, however it ends."""
    with (out / LOCK).open("wb") as file:
        try:
            import fcntl
        except ImportError:  # not a POSIX system: no lock
            yield
            return
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FolderError(f"--out {out}: another training is writing there now") from error
        yield


def _clear(out: Path) -> None:
    """Remove what the earlier training left, by its names; the manifest last."""
    for member in out.glob("member_*"):
        if member.name.removeprefix("member_").isdigit():
            shutil.rmtree(member)
    shutil.rmtree(out / "tensorboard", ignore_errors=True)
    for name in (WEIGHTS, SUMMARY, MANIFEST):
        (out / name).unlink(missing_ok=True)


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        if manifest["program"] != PROGRAM or manifest["format"] != FORMAT:
            raise ValueError(f"made by {manifest['program']}, format {manifest['format']}")
        return dict(manifest["identity"])
    except (ValueError, KeyError, TypeError) as error:
        raise FolderError(f"--resume: {path} is not a training's that can be continued ({error})") from error


def _require_same(out: Path, now: Mapping[str, Any], then: Mapping[str, Any]) -> None:
    """Raise FolderError, naming the values that differ. More members than before are no contradiction."""
    before, after = flatten(then), flatten(now)
    changed = [k for k in sorted(before.keys() | after.keys()) if before.get(k) != after.get(k)]
    changed = [k for k in changed if k != "recipe.members"]
    if changed:
        told = "; ".join(f"{k} was {before.get(k)}, now {after.get(k)}" for k in changed[:_SHOWN])
        more = f" and {len(changed) - _SHOWN} more" if len(changed) > _SHOWN else ""
        raise FolderError(f"--resume: the training in {out} was started with other values: {told}{more}")
