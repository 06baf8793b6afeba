"""The division of an evaluation: static shards of its sequences.

A shard is chosen by ``--shard`` (one job of a cluster's array, say) or by torchrun's rank, and is divided among
``--processes`` in the same way. A sequence belongs to one shard; a record that exists is not computed again, so that a
killed evaluation continues where it was.
"""

from __future__ import annotations

import logging
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch.multiprocessing import ProcessExitedException, ProcessRaisedException, spawn

from ufmstar_torch.eval.engine.evaluate import evaluate_sequence
from ufmstar_torch.eval.engine.progress import Progress
from ufmstar_torch.eval.engine.stream import Stopped
from ufmstar_torch.eval.run.machine import available_cores, device_of
from ufmstar_torch.eval.suite.evaluate import Evaluate, evaluate_item
from ufmstar_torch.eval.suite.folder import EvalFolder
from ufmstar_torch.eval.suite.job import EvalJob
from ufmstar_torch.eval.suite.work_items import Shard

_TORCHRUN = ("RANK", "WORLD_SIZE", "LOCAL_RANK")
_POLL_SECONDS = 0.1
KILLED = "a process was killed (for want of memory?), which ends the others too"

Stop = Callable[[], bool]
Report = Callable[[str], None]
Shown = Callable[[Progress], object]


@dataclass(frozen=True)
class EvalOutcome:
    """The outcome of an evaluation, or of one shard of it."""

    finished: bool  # False: it was stopped, or a process was killed
    stopped: bool  # by the caller
    complete: bool  # whether every sequence of all shards is finished, or has failed
    failed: Mapping[str, str]  # why a sequence cannot be judged, by its label


def evaluate_suite(
    job: EvalJob,
    *,
    shard: Shard | None = None,
    processes: int = 1,
    threads: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    stop: Stop = lambda: False,
    report: Report = lambda _: None,
    progress: Shown = lambda _: None,
    evaluate: Evaluate = evaluate_sequence,
) -> EvalOutcome:
    """Evaluate the sequences of a shard.

    Args:
        job: what is evaluated.
        shard: which part; None: torchrun's rank, or else everything.
        processes: number of processes on this computer, each of which evaluates a part of the shard.
        threads: of the CPU for each process; None: torch's choice for one process, all cores divided among several.
        resume, overwrite: see ``EvalFolder.open``. The shards of an evaluation start in any order, so that each of
            several resumes what the first one has begun.
        stop: called before every frame; True ends the work.
        report: receives a line for every finished sequence; that of several processes goes to standard error.
        progress: called after every frame, with the sequence's label as the stage; one process alone.
        evaluate: see :func:`evaluate_item`; one process alone.

    Raises:
        FolderError, FileNotFoundError, ValueError, ImportError: the work cannot be begun.
        CacheError, OSError: nothing can be written.
        RuntimeError: one of several processes failed.
    """
    shard, local = (shard, 0) if shard is not None else rank_of(os.environ)
    if overwrite and shard.count > 1:
        raise ValueError("--overwrite goes without shards: another one may have begun")
    how = {"resume": resume or shard.count > 1, "overwrite": overwrite}
    if processes > 1:
        with EvalFolder.open(job.out, job.about(job.load(torch.device("cpu"))), shard=shard, **how):
            pass  # mistakes are reported once, before any process starts
        threads = threads or max(1, available_cores() // processes)
        part = partial(_evaluate_part, job, shard, local, processes, threads)
        finished = in_processes(part, processes, stop, report)
    else:
        finished = _evaluate(job, shard, local, threads, how, stop, report, progress, evaluate)
    folder = EvalFolder(job.out)
    complete = all(folder.is_finished(item, job.suite.rows) for item in job.items)
    return EvalOutcome(finished, stop(), complete, folder.failures(job.items))


def rank_of(environment: Mapping[str, str]) -> tuple[Shard, int]:
    """The shard of a process, and its number on its computer, as torchrun states them in the environment; the whole
    where it has not started the process. Raises ValueError: the variables are not such numbers."""
    if any(name not in environment for name in _TORCHRUN):
        return Shard(), 0
    try:
        rank, world, local = (int(environment[name]) for name in _TORCHRUN)
    except ValueError as error:
        raise ValueError(f"{', '.join(_TORCHRUN)} in the environment must be numbers: {error}") from error
    if not (0 <= rank < world and local >= 0):
        raise ValueError(f"RANK {rank} must be in [0, WORLD_SIZE {world}) and LOCAL_RANK {local} at least 0")
    return Shard(rank + 1, world), local


def in_processes(task: Callable[[int], object], processes: int, stop: Stop, report: Report) -> bool:
    """Run a task in processes, with the number of each, and wait for them; whether all finished. They end with this
    one, also when it is killed. Raises RuntimeError: one failed; the others are ended."""
    context = spawn(_child, (task,), processes, join=False)
    finished = False
    try:
        while not finished and not stop():
            finished = context.join(_POLL_SECONDS)
    except ProcessExitedException:
        if not stop():  # a signal to all processes of a terminal or a cluster's job
            report(KILLED)
    except ProcessRaisedException as error:
        if not stop():
            raise RuntimeError(str(error).strip().splitlines()[-1]) from error
    finally:
        for process in context.processes:
            process.terminate()
            process.join()
    return finished


def _child(number: int, task: Callable[[int], object]) -> None:
    """Run the task in its process."""
    # torch sends SIGINT to a process whose parent has died; a shell's background jobs ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    task(number)


def _evaluate_part(job: EvalJob, shard: Shard, local: int, processes: int, threads: int, number: int) -> None:
    """Evaluate one of equal parts of a shard."""
    part = Shard(shard.index + shard.count * number, shard.count * processes)
    how = {"resume": True, "overwrite": False}

    def report(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    _evaluate(job, part, local * processes + number, threads, how, lambda: False, report)


def _evaluate(
    job: EvalJob,
    shard: Shard,
    local: int,
    threads: int | None,
    how: Mapping[str, Any],
    stop: Stop,
    report: Report,
    progress: Shown = lambda _: None,
    evaluate: Evaluate = evaluate_sequence,
) -> bool:
    """Evaluate one sequence of a shard after another in this process; whether all were done."""
    if threads is not None:
        torch.set_num_threads(threads)
    device = torch.device(device_of(job.device, local))
    networks = job.load(device)
    try:
        with EvalFolder.open(job.out, job.about(networks), shard=shard, **how), warned_once():
            judge = job.judge(networks, device)
            for item in shard.of(job.items):
                if stop():
                    return False

                def shown(now: Progress, label: str = item.label) -> None:
                    progress(replace(now, stage=label))

                if line := evaluate_item(job, item, judge, stop=stop, progress=shown, evaluate=evaluate):
                    report(line)
    except Stopped:
        return False
    return True


@contextmanager
def warned_once() -> Iterator[None]:
    """Within the context, a warning of the package is logged once, whichever stream and numbers it names: the rows of a
    suite are many streams."""
    logger, logged = logging.getLogger("ufmstar_torch"), set[str]()

    def first(record: logging.LogRecord) -> bool:
        text = re.sub(r"\d+", "", record.getMessage())
        known = text in logged
        logged.add(text)
        return not known

    logger.addFilter(first)
    try:
        yield
    finally:
        logger.removeFilter(first)
