"""Train what a recipe says: every member in turn, then all of them in one file."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from ufmstar_torch.eval.files import write_json_atomic
from ufmstar_torch.models.trained import save_trained
from ufmstar_torch.train.ensemble import finished, read_result, stored_networks
from ufmstar_torch.train.member import WEIGHTS, Job, train_member


def fit(job: Job, *, asked: Callable[[], bool] | None = None) -> dict[str, Any]:
    """Train all members that are not finished, and write OUT/trained.safetensors and OUT/summary.json.

    Args:
        job: what and how.
        asked: whether somebody wants it to stop; the step in hand is finished and kept.

    Returns:
        The summary.
    """
    began = time.monotonic()
    r, s = job.recipe, job.settings
    s.out.mkdir(parents=True, exist_ok=True)
    stopped: str | None = None
    for member in range(r.members):
        if finished(job, member):
            continue
        deadline = None
        if s.max_minutes:
            # What is left of the time is divided among the members that are left, so that none goes without.
            left = began + 60 * s.max_minutes - time.monotonic()
            deadline = time.monotonic() + max(0.0, left) / sum(not finished(job, m) for m in range(member, r.members))
        reason = train_member(job, member, deadline=deadline, asked=asked)
        stopped = reason or stopped
        if asked is not None and asked():
            break
    return _conclude(job, stopped, time.monotonic() - began)


def _conclude(job: Job, stopped: str | None, seconds: float) -> dict[str, Any]:
    """One file of all members that have weights, and the summary."""
    r, out = job.recipe, job.settings.out
    members = [m for m in range(r.members) if (job.folder(m) / WEIGHTS).is_file()]
    results = [read_result(job, m) for m in members]
    summary = {"recipe": r.to_dict(), "stopped": stopped, "seconds": round(seconds, 1), "members": results}
    if members:
        networks = [stored_networks(job.folder(m) / WEIGHTS) for m in members]
        save_trained(out / WEIGHTS, networks, r.network, half=r.half, info=summary)
    write_json_atomic(out / "summary.json", summary)
    return summary
