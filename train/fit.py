"""Train what a recipe says: every member, then all of them in one file, with a summary."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import torch

from ufmstar_torch.eval.results.files import write_json_atomic
from ufmstar_torch.eval.results.machine import hardware, versions
from ufmstar_torch.models.trained import save_trained
from ufmstar_torch.train.ensemble import read_result, stored_network, train_members
from ufmstar_torch.train.folder import SUMMARY, open_folder
from ufmstar_torch.train.launch import prepared_by_first
from ufmstar_torch.train.member import WEIGHTS, Job, make_trainer, quiet_lightning

# Figures that describe a validation, in metrics.csv's names.
FIGURES = ("val_nll", "val_nll_constant", "val_nll_constant_best", "val_delta1", "val_rmse", "val_rel")


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
        job: what and how.
        resume, overwrite: what to do with an earlier training in the folder; see ``folder.open_folder``.
        asked: whether somebody wants it to stop; the step in hand is finished and kept.
        command: that was given, for the summary.

    Returns:
        The summary; its "stopped" says why not everything is finished.

    Raises:
        FolderError: the folder cannot be used as asked.
        NonFiniteLossError: a training has diverged. The members that were finished are written before.
        ResumeError: a checkpoint cannot be read.
    """
    began = time.monotonic()
    end = began + 60 * job.settings.max_minutes if job.settings.max_minutes else None
    # Of several processes, a trainer knows which is the first, whoever started them.
    with quiet_lightning():
        trainer = make_trainer(job, 0)
    first = trainer.is_global_zero
    folder = prepared_by_first(open_folder(job, resume=resume, overwrite=overwrite), trainer, job.settings.out)
    with folder, torch.random.fork_rng(devices=range(torch.cuda.device_count())):
        stopped: str | None = "failed"
        try:
            stopped = train_members(job, end=end, asked=asked)
        finally:
            if first:
                summary = conclude(job, stopped, time.monotonic() - began, command)
    return summary if first else {"stopped": stopped}


def conclude(job: Job, stopped: str | None, seconds: float, command: Sequence[str] = ()) -> dict[str, Any]:
    """Write one file of all members that have weights, and the summary."""
    r, out = job.recipe, job.settings.out
    members = [m for m in range(r.members) if (job.folder(m) / WEIGHTS).is_file()]
    results = [read_result(job, m) for m in members]
    summary = {
        "program": "ufmstar train",
        "command": list(command),
        "stopped": stopped,
        "recipe": r.to_dict(),
        "data": asdict(job.data),
        "settings": asdict(job.settings),
        "mean": mean_figures(results),
        "members": results,
        "seconds": round(seconds, 1),
        "versions": versions(),
        "hardware": {**hardware(), "threads": torch.get_num_threads(), "gpus": gpus()},
    }
    if members:
        networks = [stored_network(job.folder(m) / WEIGHTS) for m in members]
        info = {"recipe": r.to_dict(), "mean": summary["mean"], "command": list(command)}
        save_trained(out / WEIGHTS, networks, r.network, half=r.half, info=info)
    write_json_atomic(out / SUMMARY, summary)
    return summary


def mean_figures(results: Sequence[dict[str, Any]]) -> dict[str, float]:
    """The members' last validation figures, averaged over members (not: of the ensemble)."""
    told = [result["figures"] for result in results if result.get("figures")]
    common = [name for name in FIGURES if told and all(name in figures for figures in told)]
    return {name: sum(figures[name] for figures in told) / len(told) for name in common}


def report(summary: dict[str, Any]) -> str:
    """The members' figures as a table."""
    rows: list[tuple[str, ...]] = [("member", "steps", "seconds", *FIGURES)]
    for result in summary["members"]:
        figures = [f"{result['figures'][name]:.4g}" if name in result["figures"] else "-" for name in FIGURES]
        rows.append((str(result["member"]), str(result["steps"]), f"{result['seconds']:g}", *figures))
    spaces = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join("  ".join(cell.rjust(s) for cell, s in zip(row, spaces, strict=True)) for row in rows)


def gpus() -> list[str]:
    """Names of the GPUs there are."""
    return [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
