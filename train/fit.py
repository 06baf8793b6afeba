"""Train a job: every member, then one file of all of them, with a summary."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch

from ufmstar_torch.eval.run.files import write_json_atomic
from ufmstar_torch.eval.run.folder import FolderError
from ufmstar_torch.eval.run.machine import hardware, versions
from ufmstar_torch.files.limits import read_text
from ufmstar_torch.models.trained import load_for_training, save_trained
from ufmstar_torch.train.checkpoints import ResumeError
from ufmstar_torch.train.folder import SUMMARY, open_folder
from ufmstar_torch.train.member import RESULT, WEIGHTS, make_trainer, quiet_lightning, train_member
from ufmstar_torch.train.presets import text_table
from ufmstar_torch.train.progress import FIGURES
from ufmstar_torch.train.settings import Job


def fit(
    job: Job,
    *,
    resume: bool = False,
    overwrite: bool = False,
    asked: Callable[[], bool] | None = None,
    command: Sequence[str] = (),
) -> dict[str, Any]:
    """Train all members that are not finished, and write OUT/trained.safetensors and OUT/summary.json.

    Args:
        job: recipe, data and settings.
        resume, overwrite: treatment of an earlier training in the folder; see ``folder.open_folder``.
        asked: returns True to stop, after the current step.
        command: the command line, for the summary.

    Returns:
        The summary; its "stopped" is the reason if not all members are finished. In a distributed training, all
        processes except the first return only "stopped".

    Raises:
        FolderError: the folder cannot be used with these options.
        NonFiniteLossError: a training has diverged. Finished members are written first.
        ResumeError: a checkpoint cannot be read.
    """
    began = time.monotonic()
    end = began + 60 * job.settings.max_minutes if job.settings.max_minutes else None
    # The trainer determines the rank of this process, for every launcher.
    with quiet_lightning():
        trainer = make_trainer(job, 0)
    first = trainer.is_global_zero
    folder = open_folder(job, resume=resume, overwrite=overwrite) if first else nullcontext()
    with folder, torch.random.fork_rng(devices=range(torch.cuda.device_count())):
        stopped: str | None = "failed"
        try:
            _meet(trainer, job.settings.out)
            stopped = train_members(job, end=end, asked=asked)
        finally:
            if first:
                summary = _conclude(job, stopped, time.monotonic() - began, command)
    return summary if first else {"stopped": stopped}


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


def read_result(job: Job, member: int) -> dict[str, Any]:
    """The content of a member's result.json; empty if there is none."""
    file = job.folder(member) / RESULT
    if not file.is_file():
        return {}
    try:
        result = json.loads(read_text(file))
    except (ValueError, RecursionError) as error:
        raise ResumeError(f"{file} is not the result of a member: {error}; --overwrite starts again") from error
    if not isinstance(result, dict):
        raise ResumeError(
            f"{file} is not the result of a member, but {type(result).__name__}; --overwrite starts again"
        )
    return result


def train_members(job: Job, *, end: float | None = None, asked: Callable[[], bool] | None = None) -> str | None:
    """Train the unfinished members until ``end``, in ``time.monotonic()``'s seconds, or until ``asked`` returns True.
    The remaining time is divided evenly among them. Returns the reason of a stop, or None if all are finished."""
    members = [member for member in range(job.recipe.members) if not read_result(job, member).get("finished")]
    first: str | None = None
    for index, member in enumerate(members):
        if asked is not None and asked():
            return first or "stopped"
        now, remaining = time.monotonic(), len(members) - index
        deadline = None if end is None else now + max(0.0, end - now) / remaining
        reason = train_member(job, member, deadline=deadline, asked=asked)
        first = first or reason
    return first


def _conclude(job: Job, stopped: str | None, seconds: float, command: Sequence[str]) -> dict[str, Any]:
    """Write all members that have weights to one file, and the summary."""
    r, out = job.recipe, job.settings.out
    members = [m for m in range(r.members) if (job.folder(m) / WEIGHTS).is_file()]
    results = [read_result(job, m) for m in members]
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
    if members:
        networks = [load_for_training(job.folder(m) / WEIGHTS, job.backbone)[0] for m in members]
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
    return text_table(rows, str.rjust)
