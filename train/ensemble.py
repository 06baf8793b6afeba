"""The members of an ensemble: which are finished, and training of the others, one after another."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

from ufmstar_torch.train.member import RESULT, train_member
from ufmstar_torch.train.settings import Job


def read_result(job: Job, member: int) -> dict[str, Any]:
    """The content of a member's result.json; empty where there is none."""
    file = job.folder(member) / RESULT
    return dict(json.loads(file.read_text(encoding="utf-8"))) if file.is_file() else {}


def train_members(job: Job, *, end: float | None = None, asked: Callable[[], bool] | None = None) -> str | None:
    """Train the members that are not finished, up to ``end``, in ``time.monotonic()``'s seconds, or until ``asked``
    returns True. The remaining time is divided evenly among the members. Returns None when all are finished, otherwise
    why not."""
    members = [member for member in range(job.recipe.members) if not read_result(job, member).get("finished")]
    first: str | None = None
    for index, member in enumerate(members):
        if asked is not None and asked():
            return first or "stopped"
        reason = train_member(job, member, deadline=share_of_time(end, len(members) - index), asked=asked)
        first = first or reason
    return first


def share_of_time(end: float | None, members: int) -> float | None:
    """End of the first of ``members`` equal parts of the time from now to ``end``, in ``time.monotonic()``'s
    seconds."""
    now = time.monotonic()
    return None if end is None else now + max(0.0, end - now) / members
