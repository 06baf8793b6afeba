"""The tasks of an evaluation, one for each sequence, on an executor: processes of this computer, or a Dask cluster.

A task writes its sequence's records into the output folder, which all processes share. Finished records are not
computed again, so an evaluation that was killed, or that lost its cluster, continues with the same command.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import re
import signal
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, ProcessPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from threading import Lock, Thread
from typing import Any

import torch

from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.engine.progress import Progress
from ufmstar_torch.eval.engine.stream import Stopped
from ufmstar_torch.eval.run.folder import output_folder
from ufmstar_torch.eval.run.machine import available_cores, device_of
from ufmstar_torch.eval.suite.evaluate import evaluate_item
from ufmstar_torch.eval.suite.folder import EVALUATION, STOP
from ufmstar_torch.eval.suite.job import EvalJob
from ufmstar_torch.eval.suite.work_items import WorkItem
from ufmstar_torch.runtime.optional import optional

_POLL_SECONDS = 0.1
_CONNECT_SECONDS = 30

Stop = Callable[[], bool]
Report = Callable[[str], None]
Shown = Callable[[Progress], object]


@dataclass(frozen=True)
class EvalOutcome:
    """The outcome of an evaluation."""

    finished: bool  # False if it was stopped, or processes were lost
    stopped: bool  # True if the caller stopped it
    failed: Mapping[str, str]  # by a sequence's label, why it cannot be evaluated


def evaluate_suite(
    job: EvalJob,
    executor: Executor | None = None,
    *,
    threads: int | None = None,
    overwrite: bool = False,
    stop: Stop = lambda: False,
    report: Report = lambda _: None,
    progress: Shown = lambda _: None,
) -> EvalOutcome:
    """Evaluate the sequences of a job.

    Args:
        job: the evaluation.
        executor: of the sequences, such as :func:`process_pool` or :func:`dask_cluster`; None = this process. Its
            processes need this package, and all files and the working folder under the paths that they have here.
            Each evaluates one sequence at a time, whatever its number of threads.
        threads: CPU threads of each process of the executor; None = its own choice.
        overwrite: see ``output_folder``.
        stop: called before every frame; True ends the work.
        report: receives a line for every finished sequence.
        progress: called after every frame, with the sequence's label as the stage; with an executor, after every
            sequence.

    Raises:
        FolderError, FileNotFoundError, ValueError, ImportError: the work cannot begin.
        CacheError, OSError: a file cannot be written.
        RuntimeError: the task of a sequence failed; the message names it.
    """
    device = torch.device(device_of(job.device, 0) if executor is None else "cpu")
    networks, folder = job.load(device), job.folder
    with output_folder(job.out, EVALUATION, job.about(networks), overwrite=overwrite), warned_once():
        if executor is None:
            finished = _one_by_one(job, networks, device, stop, report, progress)
        else:
            finished = _on_executor(executor, job, threads, stop, report, progress)
    failed, labels = folder.failures(), {(item.dataset, item.sequence): item.label for item in job.items}
    return EvalOutcome(finished, stop(), {labels[where]: failed[where] for where in labels.keys() & failed})


def _one_by_one(
    job: EvalJob, networks: Mapping[str, DepthSource], device: torch.device, stop: Stop, report: Report, progress: Shown
) -> bool:
    """Evaluate the sequences in this process. Returns False if it was stopped."""
    with suppress(Stopped):
        for item in job.items:
            if line := evaluate_item(job, item, networks, device, stop=stop, progress=progress):
                report(line)
        return True
    return False


# ---- executors ----


@contextmanager
def executor_of(processes: int, scheduler: str | None, device: str) -> Iterator[Executor | None]:
    """The executor of a command's options; None for one process, this one. Raises as :func:`dask_cluster`."""
    if scheduler is not None:
        with dask_cluster(scheduler) as cluster:
            yield cluster
    elif processes > 1:
        with process_pool(processes, device) as pool:
            yield pool
    else:
        yield None


@contextmanager
def process_pool(count: int, device: str = "cpu") -> Iterator[Executor]:
    """Processes of this computer, which divide its cores, and the GPUs of "cuda"; they end with this process."""
    method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
    context = multiprocessing.get_context(method)
    context.set_forkserver_preload([__name__])
    numbers = context.SimpleQueue()
    for number in range(count):
        numbers.put(number)
    threads = max(1, available_cores() // count)
    with ProcessPoolExecutor(count, context, _begin, (numbers, device, threads)) as pool:
        yield pool


def _begin(numbers: Any, device: str, threads: int) -> None:
    """Prepare a process of the pool."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal also signals the parent, which stops the tasks
    Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(threads)
    if device == "cuda":
        torch.cuda.set_device(device_of(device, numbers.get()))


def _end_with_parent() -> None:
    """End this process when its parent has ended in any way; a process of a pool would wait forever."""
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os._exit(1)


@contextmanager
def dask_cluster(address: str) -> Iterator[Executor]:
    """The workers of the Dask scheduler at "tcp://HOST:8786". Raises ModuleNotFoundError: Dask is not installed;
    OSError: no scheduler answers."""
    distributed = optional("distributed", "--scheduler needs Dask", "'ufmstar-torch[cluster]'")
    with distributed.Client(address, timeout=_CONNECT_SECONDS, set_as_default=False) as client:
        yield client.get_executor(pure=False)


def _is_loss(error: BaseException) -> bool:
    """True if processes were lost; their records remain. Dask gives up on a task that killed several workers."""
    return isinstance(error, BrokenExecutor | CancelledError) or type(error).__name__ == "KilledWorker"


# ---- tasks ----


def _on_executor(
    executor: Executor, job: EvalJob, threads: int | None, stop: Stop, report: Report, progress: Shown
) -> bool:
    """Evaluate the sequences on an executor, a task each. Returns True if all tasks ended. Raises RuntimeError: a task
    failed; the others end after their current frame."""
    folder, total, stop_file = job.folder, len(job.items), job.out.absolute() / STOP
    content = pickle.dumps((replace(job, out=job.out.absolute()), threads, Path.cwd()))
    stop_file.unlink(missing_ok=True)  # of a process that was killed
    running = {executor.submit(evaluate_task, content, item): item for item in job.items}
    lost, failure = False, None
    while running:
        if stop() and not stop_file.exists():
            stop_file.touch()
        for future in wait(running, _POLL_SECONDS, FIRST_COMPLETED).done:
            item = running.pop(future)
            error = CancelledError() if future.cancelled() else future.exception()
            if error is None:
                if line := future.result():
                    report(line)
                progress(Progress("sequences", total - len(running), total))
            elif _is_loss(error):
                lost = True
            elif not isinstance(error, Stopped):
                failure = failure or (item, error)
                stop_file.touch()
    stop_file.unlink(missing_ok=True)
    if failure is not None:
        item, error = failure
        raise RuntimeError(f"{item.label}: {type(error).__name__}: {error}") from error
    if lost and not stop():  # a signal to all processes of a terminal or a cluster's job stops them too
        begun = [item.label for item in job.items if folder.has_begun(item, job.suite.rows)]
        at = f" at one of {', '.join(begun)}" if begun else ""
        report(f"processes were lost (killed for want of memory, or their scheduler ended){at}; finished rows remain")
    return not lost and not stop()


def evaluate_task(content: bytes, item: WorkItem) -> str:
    """Evaluate a sequence in a process of an executor. Returns and raises as ``evaluate_item``.

    Args:
        content: the pickled job, with an absolute output folder, its number of threads (None = unchanged), and the
            folder to which other paths are relative.
        item: the sequence.
    """
    job, threads, folder = pickle.loads(content)
    stop_file = job.out / STOP
    if stop_file.exists():
        raise Stopped
    if threads is not None:
        torch.set_num_threads(threads)
    networks, device, lock = _loaded(content)
    with lock:
        os.chdir(folder)
        return evaluate_item(job, item, networks, device, stop=stop_file.exists)


@lru_cache(maxsize=1)
def _loaded(content: bytes) -> tuple[dict[str, DepthSource], torch.device, Lock]:
    """The networks of a pickled job, loaded once in every process, their device, and the lock of the thread that uses
    them."""
    job, _, folder = pickle.loads(content)
    os.chdir(folder)
    logging.getLogger("ufmstar_torch").addFilter(_once())
    device = torch.device(job.device)
    return job.load(device), device, Lock()


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
