"""Train a job: every member, then one file of all of them, with a summary."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch

from ufmstar_torch.eval.engine.files import write_json_atomic
from ufmstar_torch.eval.report.table import aligned
from ufmstar_torch.eval.run.folder import FolderError
from ufmstar_torch.eval.run.machine import hardware, versions
from ufmstar_torch.frames.warnings import LOGGER
from ufmstar_torch.models.trained import save_trained
from ufmstar_torch.runtime.checked import flat
from ufmstar_torch.train.data import sources
from ufmstar_torch.train.folder import SUMMARY, WEIGHTS, identity, open_folder
from ufmstar_torch.train.member import (
    make_trainer,
    quiet_lightning,
    read_checkpoint,
    result_of,
    train_member,
    trained_network,
)
from ufmstar_torch.train.module import FIGURES
from ufmstar_torch.train.settings import Job


def fit(job: Job, *, overwrite: bool = False, command: Sequence[str] = ()) -> dict[str, Any]:
    """Train all members that are not finished, and write OUT/trained.safetensors and OUT/summary.json.

    Args:
        job: recipe, data and settings.
        overwrite: True to replace an earlier training in the folder, which otherwise continues.
        command: the command line, for the summary.

    Returns:
        The summary; its "stopped" is the reason if not all members are finished. In a distributed training, all
        processes except the first return an empty one.

    Raises:
        FolderError: the folder cannot be used.
        NonFiniteLossError: a training has diverged.
        ResumeError: a checkpoint cannot be read.
        KeyboardInterrupt: Ctrl-C or SIGTERM. After this and after other errors, the weights of the checkpoints are
            written first.
    """
    began = time.monotonic()
    # The trainer determines the rank of this process, for every launcher.
    with quiet_lightning():
        trainer = make_trainer(job, 0)
    first = trainer.is_global_zero
    folder = open_folder(job, overwrite=overwrite) if first else nullcontext()
    with folder, torch.random.fork_rng(devices=range(torch.cuda.device_count())):
        try:
            _meet(trainer, job.settings.out)
            train_members(job, began)
        except BaseException as error:
            if first:
                stopped = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
                try:
                    _conclude(job, stopped, time.monotonic() - began, command)
                except (OSError, ValueError) as unwritten:  # the reason of the stop matters more
                    LOGGER.warning("the weights so far cannot be written: %s", unwritten)
            raise
        return _conclude(job, None, time.monotonic() - began, command) if first else {}


def plan(job: Job) -> str:
    """The values of a training by their names in ``--set``, and the number of its frames and steps, as lines. Writes
    nothing, and renders no tour. Raises OSError, ValueError: as ``DepthDataModule.setup``."""
    d, r = job.data, job.recipe
    tours = [d.tour_frames * count for count in (d.tours, d.validation_tours)]
    frames, validated = tours if d.kind == "tour" else [len(part) for part in sources(d)]
    values = identity(job)
    by_name = flat({**values.pop("recipe"), "session.precision": values.pop("precision"), **values})
    lines = [f"{name.replace('data.augmentation.', 'augment.'):32} {value}" for name, value in by_name.items()]
    steps = f"{r.max_steps or r.epochs * (frames // r.batch_size)} steps for each of {r.members} trained networks"
    return "\n".join([*lines, f"{frames} frames to train on, {validated} to validate on; at most {steps}"])


def _meet(trainer: pl.Trainer, out: Path) -> None:
    """Wait until the first process has prepared the folder, after which it joins Lightning's process group. Raises
    FolderError: the folder does not exist on this machine."""
    if trainer.world_size == 1:
        return
    launcher: Any = trainer.strategy.launcher
    launcher.launch(trainer.strategy.setup_environment)
    trainer.strategy.barrier("the folder is prepared")
    if not out.is_dir():
        raise FolderError(f"--out {out} does not exist: all machines must see the folder of the first process")


def train_members(job: Job, began: float) -> None:
    """Train the unfinished members. The time that remains of ``max_minutes`` since ``began``, in
    ``time.monotonic()``'s seconds, is divided evenly among them."""
    members = [member for member in range(job.recipe.members) if not _result(job, member).get("finished")]
    most = 60 * job.settings.max_minutes
    for index, member in enumerate(members):
        remaining = (began + most - time.monotonic()) / (len(members) - index)
        # Timer takes whole microseconds, at least one.
        train_member(job, member, seconds=max(1e-6, remaining) if most else None)


def _result(job: Job, member: int) -> dict[str, Any]:
    stored = read_checkpoint(job, member)
    return {} if stored is None else result_of(job, member, stored)


def _conclude(job: Job, stopped: str | None, seconds: float, command: Sequence[str]) -> dict[str, Any]:
    """Write all members that have weights to one file, and the summary. ``stopped`` is the reason of a stop; None: the
    time budget, if members are unfinished."""
    r, out = job.recipe, job.settings.out
    stored = {m: content for m in range(r.members) if (content := read_checkpoint(job, m)) is not None}
    results = [result_of(job, m, content) for m, content in stored.items()]
    if stopped is None and (len(results) < r.members or not all(result["finished"] for result in results)):
        stopped = "time budget spent"
    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    summary = {
        "program": "ufmstar train",
        "command": list(command),
        "stopped": stopped,
        "recipe": r.to_dict(),
        "data": asdict(job.data),
        "settings": asdict(job.settings),
        "mean": _mean_figures(results),
        "members": results,
        "seconds": round(seconds, 1),
        "versions": versions(),
        "hardware": {**hardware(), "threads": torch.get_num_threads(), "gpus": gpus},
    }
    if stored:
        networks = [trained_network(job, m, content) for m, content in stored.items()]
        info = {"recipe": r.to_dict(), "mean": summary["mean"], "command": list(command)}
        save_trained(out / WEIGHTS, networks, r.network, half=r.half, info=info)
    write_json_atomic(out / SUMMARY, summary)
    return summary


def _mean_figures(results: Sequence[dict[str, Any]]) -> dict[str, float]:
    """The last validation figures, averaged over members (not the figures of the ensemble)."""
    figures = [result["figures"] for result in results if result.get("figures")]
    common = [name for name in FIGURES if figures and all(name in of_member for of_member in figures)]
    return {name: sum(of_member[name] for of_member in figures) / len(figures) for name in common}


def report(summary: dict[str, Any]) -> str:
    """The members' figures as a table."""
    rows: list[tuple[str, ...]] = [("member", "steps", "seconds", *FIGURES)]
    for result in summary["members"]:
        figures = [f"{result['figures'][name]:.4g}" if name in result["figures"] else "-" for name in FIGURES]
        rows.append((str(result["member"]), str(result["steps"]), f"{result['seconds']:g}", *figures))
    return "\n".join(aligned(rows))
