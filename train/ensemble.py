"""The members of an ensemble: which are finished, and training of the others, in turn or side by side."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from typing import Any

import torch

from ufmstar_torch.train.member import RESULT, train_member
from ufmstar_torch.train.settings import Job

_POLL_SECONDS = 0.2


def read_result(job: Job, member: int) -> dict[str, Any]:
    """The content of a member's result.json; empty where there is none."""
    file = job.folder(member) / RESULT
    return dict(json.loads(file.read_text(encoding="utf-8"))) if file.is_file() else {}


def train_members(job: Job, *, end: float | None = None, asked: Callable[[], bool] | None = None) -> str | None:
    """Train the members that are not finished, ``settings.member_processes`` of them at the same time, up to ``end``,
    in ``time.monotonic()``'s seconds, or until ``asked`` returns True. The remaining time is divided evenly among the
    members. Returns None when all are finished, otherwise why not."""
    members = [member for member in range(job.recipe.members) if not read_result(job, member).get("finished")]
    if job.settings.member_processes > 1 and len(members) > 1:
        return _side_by_side(job, members, end, asked)
    reasons = []
    for turn, member in enumerate(members):
        stop = asked is not None and asked()
        deadline = share_of_time(end, len(members) - turn)
        reasons.append("stopped" if stop else train_member(job, member, deadline=deadline, asked=asked))
        if stop:
            break
    return _first_reason(reasons)


def share_of_time(end: float | None, turns: int) -> float | None:
    """End of the first of ``turns`` equal turns from now to ``end``, in ``time.monotonic()``'s seconds."""
    now = time.monotonic()
    return None if end is None else now + max(0.0, end - now) / turns


def _side_by_side(job: Job, members: Sequence[int], end: float | None, asked: Callable[[], bool] | None) -> str | None:
    """Train each member in a process of its own, on a GPU of its own where there are several."""
    context = get_context("spawn")
    count = min(job.settings.member_processes, len(members))
    stop, slots = context.Event(), context.Queue()
    for slot in range(count):
        slots.put(slot)
    job = replace(job, settings=replace(job.settings, progress=False))
    with ProcessPoolExecutor(count, context, _join, (stop, slots, count)) as pool:
        turns = [-(-(len(members) - i) // count) for i in range(len(members))]
        futures = [pool.submit(_in_worker, job, m, end, n) for m, n in zip(members, turns, strict=True)]
        while not all(future.done() for future in futures):
            failed = any(future.done() and future.exception() is not None for future in futures)
            if failed or (asked is not None and asked()):
                stop.set()
            time.sleep(_POLL_SECONDS)
    return _first_reason([future.result() for future in futures])


def _first_reason(reasons: Sequence[str | None]) -> str | None:
    return next((reason for reason in reasons if reason is not None), None)


class _Worker:
    """State of a worker process: the event at which it stops, and its number."""

    stop: Any = None
    slot: int = 0


def _join(stop: Any, slots: Any, count: int) -> None:
    _Worker.stop, _Worker.slot = stop, slots.get()
    torch.set_num_threads(max(1, torch.get_num_threads() // count))


def _in_worker(job: Job, member: int, end: float | None, turns: int) -> str | None:
    if _Worker.stop.is_set():
        return "stopped"
    if torch.cuda.is_available() and job.settings.accelerator in ("auto", "gpu", "cuda"):
        device = f"{_Worker.slot % torch.cuda.device_count()},"
        job = replace(job, settings=replace(job.settings, devices=device))
    return train_member(job, member, deadline=share_of_time(end, turns), asked=_Worker.stop.is_set)
