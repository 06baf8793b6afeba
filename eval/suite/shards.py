"""The division of an evaluation: static shards of its sequences, and a task for each sequence of a shard.

``--shard`` chooses a shard, as for one job of a cluster's array; ``--processes`` evaluates it in a pool of processes.
Existing records are not computed again, so a killed evaluation can continue.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import re
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from threading import Thread
from typing import Any

import torch

from ufmstar_torch.eval.engine.progress import Progress
from ufmstar_torch.eval.engine.stream import Stopped
from ufmstar_torch.eval.run.machine import available_cores, device_of
from ufmstar_torch.eval.suite.evaluate import evaluate_item
from ufmstar_torch.eval.suite.folder import evaluation_folder
from ufmstar_torch.eval.suite.job import EvalJob
from ufmstar_torch.eval.suite.work_items import ALL, Shard, WorkItem

_POLL_SECONDS = 0.1

Stop = Callable[[], bool]
Report = Callable[[str], None]
Shown = Callable[[Progress], object]


@dataclass(frozen=True)
class EvalOutcome:
    """The outcome of an evaluation, or of one shard of it."""

    finished: bool  # False if it was stopped, or a process was killed
    stopped: bool  # True if the caller stopped it
    complete: bool  # True if every sequence of all shards is finished or has failed
    failed: Mapping[str, str]  # by a sequence's label, why it cannot be evaluated


def evaluate_suite(
    job: EvalJob,
    *,
    shard: Shard = ALL,
    processes: int = 1,
    threads: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    stop: Stop = lambda: False,
    report: Report = lambda _: None,
    progress: Shown = lambda _: None,
) -> EvalOutcome:
    """Evaluate the sequences of a shard.

    Args:
        job: the evaluation.
        shard: part of its sequences.
        processes: number of processes on this computer.
        threads: CPU threads of each of several processes; None = all cores divided among them.
        resume, overwrite: see ``evaluation_folder``. Shards start in any order; with several, each one resumes.
        stop: called before every frame; True ends the work.
        report: receives a line for every finished sequence.
        progress: called after every frame, with the sequence's label as the stage; with several processes, after every
            sequence.

    Raises:
        FolderError, FileNotFoundError, ValueError, ImportError: the work cannot begin.
        CacheError, OSError: a file cannot be written.
        RuntimeError: one of several processes failed; the message names the sequence.
    """
    if overwrite and shard.count > 1:
        raise ValueError("--overwrite goes without shards: another one may have begun")
    device = torch.device(device_of(job.device, 0) if processes == 1 else "cpu")
    networks, items, folder = job.load(device), shard.of(job.items), job.folder
    how = {"resume": resume or shard.count > 1, "overwrite": overwrite}
    with evaluation_folder(job.out, job.about(networks), shard=shard, **how), warned_once():
        if processes > 1:
            finished = _in_processes(job, items, processes, threads, stop, report, progress)
        else:
            judge, finished = job.judge(networks, device), False
            with suppress(Stopped):
                for item in items:
                    if line := evaluate_item(job, item, judge, stop=stop, progress=progress):
                        report(line)
                finished = True
    complete = all(folder.is_finished(item, job.suite.rows) for item in job.items)
    failed, labels = folder.failures(), {(item.dataset, item.sequence): item.label for item in job.items}
    return EvalOutcome(finished, stop(), complete, {labels[where]: failed[where] for where in labels.keys() & failed})


def _in_processes(
    job: EvalJob,
    items: Sequence[WorkItem],
    processes: int,
    threads: int | None,
    stop: Stop,
    report: Report,
    progress: Shown,
) -> bool:
    """Evaluate sequences in a pool of processes, one task each. Returns True if all tasks ended. Raises RuntimeError: a
    task failed; the others end after their current frame."""
    context = multiprocessing.get_context("spawn")
    stopped, queue = context.Event(), context.SimpleQueue()
    for number in range(processes):
        queue.put(number)
    threads = threads or max(1, available_cores() // processes)
    waiting, running = list(items), dict[Future[str], WorkItem]()
    with ProcessPoolExecutor(processes, context, _begin, (job, queue, threads, stopped)) as pool:
        try:
            while (waiting or running) and not stop():
                while waiting and len(running) < processes:
                    item = waiting.pop(0)
                    running[pool.submit(_evaluate, item)] = item
                for future in wait(running, _POLL_SECONDS, FIRST_COMPLETED).done:
                    error = future.exception()
                    if error is not None and not isinstance(error, BrokenProcessPool):
                        raise RuntimeError(f"{running[future].label}: {type(error).__name__}: {error}") from error
                    if line := future.result():
                        report(line)
                    del running[future]
                    progress(Progress("sequences", len(items) - len(waiting) - len(running), len(items)))
        except BrokenProcessPool:
            if not stop():  # a signal to all processes of a terminal or a cluster's job
                labels = ", ".join(item.label for item in running.values())
                report(f"a process was killed (for want of memory?) at one of {labels}, which ends the others too")
        finally:
            stopped.set()
    return not (waiting or running)


_evaluate_here: Callable[[WorkItem], str]  # in a process of the pool


def _begin(job: EvalJob, numbers: Any, threads: int, stopped: Any) -> None:
    """Prepare a process of the pool."""
    global _evaluate_here
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal also signals the parent, which sets ``stopped``
    Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(threads)
    logging.getLogger("ufmstar_torch").addFilter(_once())
    device = torch.device(device_of(job.device, numbers.get()))
    _evaluate_here = partial(evaluate_item, job, judge=job.judge(job.load(device), device), stop=stopped.is_set)


def _evaluate(item: WorkItem) -> str:
    return _evaluate_here(item)


def _end_with_parent() -> None:
    """End this process when its parent has ended in any way; a process of a pool would wait forever."""
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os._exit(1)


def _once() -> Callable[[logging.LogRecord], bool]:
    """A filter that passes each warning once, ignoring the numbers in it, because a suite has many streams."""
    logged: set[str] = set()

    def first(record: logging.LogRecord) -> bool:
        text = re.sub(r"\d+", "", record.getMessage())
        repeated = text in logged
        logged.add(text)
        return not repeated

    return first


@contextmanager
def warned_once() -> Iterator[None]:
    """Within the context, each warning of the package is logged once."""
    logger, once = logging.getLogger("ufmstar_torch"), _once()
    logger.addFilter(once)
    try:
        yield
    finally:
        logger.removeFilter(once)
