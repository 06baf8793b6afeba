"""The division of an evaluation: static shards of its sequences, and processes that share a shard.

A shard is chosen by ``--shard``, by torchrun's rank, or is a job of a SLURM array. A sequence belongs to one shard; a
record that exists is not computed again, so that a killed evaluation continues where it was.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from logging.handlers import QueueHandler
from multiprocessing.connection import Connection
from typing import Any

import torch

from ufmstar_torch.eval.engine.evaluate import Judge, evaluate_sequence
from ufmstar_torch.eval.engine.progress import Progress
from ufmstar_torch.eval.engine.stream import Stopped
from ufmstar_torch.eval.run.machine import available_cores, device_of
from ufmstar_torch.eval.suite.evaluate import Evaluate, evaluate_item
from ufmstar_torch.eval.suite.folder import EvalFolder
from ufmstar_torch.eval.suite.job import EvalJob
from ufmstar_torch.eval.suite.work_items import Shard, WorkItem
from ufmstar_torch.optional import optional
from ufmstar_torch.stream_warnings import LOGGER

_TORCHRUN = ("RANK", "WORLD_SIZE", "LOCAL_RANK")
_POLL_SECONDS = 0.1
_LAST_RECORDS = 2.0  # [s] for what was sent before the end
KILLED = "a process was killed (for want of memory?), which ends the others too"
# submitit's own names of parameters; others are SLURM's, as partition, account, constraint.
_SUBMITIT = ("name", "timeout_min", "mem_gb", "cpus_per_task", "gpus_per_node")

Stop = Callable[[], bool]
Report = Callable[[str], None]
Frames = Callable[[str, int, int], None]


@dataclass(frozen=True)
class EvalOutcome:
    """How an evaluation, or one shard of it, ended."""

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
    progress: Frames = lambda *_: None,
    evaluate: Evaluate = evaluate_sequence,
) -> EvalOutcome:
    """Evaluate the sequences of a shard.

    Args:
        job: what is evaluated.
        shard: which part; None: torchrun's rank, or else everything.
        processes: number of processes on this computer, each of which evaluates one sequence after another.
        threads: of the CPU for each process; None: torch's choice for one process, all cores divided among several.
        resume, overwrite: see ``EvalFolder.open``. The shards of an evaluation start in any order, so that each of
            several resumes what the first one has begun.
        stop: called before every frame; True ends the work.
        report: receives a line for every finished sequence.
        progress: receives a sequence's label, its number of finished frames, and the number of all of them; one process
            alone.
        evaluate: see :func:`evaluate_item`; one process alone.

    Raises:
        FolderError, FileNotFoundError, ValueError, ImportError: the work cannot be begun.
        CacheError, OSError: nothing can be written.
    """
    shard, local = (shard, 0) if shard is not None else rank_of(os.environ)
    if overwrite and shard.count > 1:
        raise ValueError("--overwrite goes without shards: another one may have begun")
    if threads is not None and processes == 1:
        torch.set_num_threads(threads)
    device = torch.device(device_of(job.device, local))
    networks = job.load(device if processes == 1 else torch.device("cpu"))
    about, resume = job.about(networks), resume or shard.count > 1
    with EvalFolder.open(job.out, about, shard=shard, resume=resume, overwrite=overwrite) as folder:
        items = shard.of(job.items)
        if processes > 1:
            threads = threads or max(1, available_cores() // processes)
            finished = run_pool(partial(_evaluate_alone, job), items, processes, threads, stop=stop, report=report)
        else:
            judge = job.judge(networks, device)
            finished = _evaluate_here(job, items, judge, stop, report, progress, evaluate)
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


# ---- processes ----


def run_pool(
    task: Callable[[WorkItem], str],
    items: Sequence[WorkItem],
    processes: int,
    threads: int,
    *,
    stop: Stop,
    report: Report,
) -> bool:
    """Do a task for every item in a pool of processes, and report what it returns; whether all were done. The processes
    end with this one, also when it is killed. Their warnings are logged here. Raises what the task raises."""
    spawn = multiprocessing.get_context("spawn")
    parent_alive, alive = spawn.Pipe(duplex=False)
    warnings: multiprocessing.Queue[logging.LogRecord | None] = spawn.Queue()
    # A process that is killed while it writes leaves half a record, for whose end a reader waits for ever.
    reader = threading.Thread(target=_log, args=(warnings,), daemon=True)
    reader.start()
    warnings.cancel_join_thread()
    pool = ProcessPoolExecutor(processes, spawn, initializer=_begin, initargs=(parent_alive, warnings, threads))
    try:
        waiting = {pool.submit(task, item) for item in items}
        # Python's pool does not watch the process that it started last until the next submission wakes it: without
        # this one, nobody would notice that the process was killed.
        pool.submit(os.getpid)
        while waiting and not stop():
            done, waiting = wait(waiting, _POLL_SECONDS, FIRST_COMPLETED)
            for line in filter(None, [one.result() for one in done]):
                report(line)
        if not waiting:
            pool.shutdown()
        return not waiting
    except BrokenProcessPool:
        if not stop():  # a signal to all processes of a terminal or a cluster's job
            report(KILLED)
        return False
    finally:
        alive.close()  # ends those processes that are at work
        pool.shutdown(cancel_futures=True)
        warnings.put(None)
        reader.join(_LAST_RECORDS)


def _log(warnings: multiprocessing.Queue[logging.LogRecord | None]) -> None:
    """Log in this process what others send, up to a None."""
    while (record := warnings.get()) is not None:
        LOGGER.handle(record)


def _begin(parent_alive: Connection, warnings: multiprocessing.Queue[logging.LogRecord | None], threads: int) -> None:
    """In each process, before its first task."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes of a terminal: the parent decides
    LOGGER.addHandler(QueueHandler(warnings))
    LOGGER.propagate = False
    torch.set_num_threads(threads)
    threading.Thread(target=_end_with_parent, args=(parent_alive,), daemon=True).start()


def _end_with_parent(parent_alive: Connection) -> None:
    """Nothing is ever sent: the pipe ends when the parent closes it, or is killed. Files are whole or absent."""
    with suppress(EOFError, OSError):
        parent_alive.recv()
    os._exit(1)


def _evaluate_alone(job: EvalJob, item: WorkItem) -> str:
    """The task of a process of the pool. Its number, which decides its GPU, is part of its name."""
    number = int(multiprocessing.current_process().name.rpartition("-")[2]) - 1
    device = torch.device(device_of(job.device, number))
    return evaluate_item(job, item, job.judge(job.load(device), device))


def _evaluate_here(
    job: EvalJob, items: Iterable[WorkItem], judge: Judge, stop: Stop, report: Report, progress: Frames, how: Evaluate
) -> bool:
    """One item after another in this process; whether all were done."""
    try:
        for item in items:
            if stop():
                return False

            def shown(now: Progress, label: str = item.label) -> None:
                progress(label, now.done, now.total)

            if line := evaluate_item(job, item, judge, stop=stop, progress=shown, evaluate=how):
                report(line)
    except Stopped:
        return False
    return True


# ---- clusters ----


@dataclass(frozen=True)
class Slurm:
    """The words of ``--slurm``."""

    jobs: int  # number of shards, each a job of one array
    cluster: str  # of submitit: "slurm"; "local" and "debug" run on this computer
    parameters: Mapping[str, Any]  # of ``submitit.AutoExecutor``

    @classmethod
    def parse(cls, words: Iterable[str]) -> Slurm:
        """From KEY=VALUE words. Raises ValueError: another form, a key twice, or a number of jobs below 1."""
        values: dict[str, Any] = {}
        for word in words:
            key, equals, value = word.partition("=")
            if not (key.isidentifier() and equals and value) or key in values:
                raise ValueError(f"--slurm must be KEY=VALUE, each key once, got {word!r}")
            values[key] = int(value) if value.isdecimal() else value
        jobs, cluster = values.pop("jobs", 1), values.pop("cluster", "slurm")
        if not isinstance(jobs, int) or jobs < 1:
            raise ValueError(f"--slurm jobs must be at least 1, got {jobs}")
        if cluster not in ("slurm", "local", "debug"):
            raise ValueError(f"--slurm cluster must be slurm, local or debug, got {cluster!r}")
        if {"nodes", "tasks_per_node"} & values.keys():
            raise ValueError("--slurm: every job is one shard; jobs=N sets their number")
        plain = {key for key in values if key in _SUBMITIT or key.startswith("slurm_")}
        return cls(jobs, cluster, {key if key in plain else f"slurm_{key}": v for key, v in values.items()})


def evaluate_on_slurm(job: EvalJob, slurm: Slurm, *, stop: Stop, report: Report, **options: Any) -> EvalOutcome:
    """Submit an array of a job for each shard, and wait for all of them. OUT/slurm has their output; stopping cancels
    them.

    Args:
        job, stop, report: as :func:`evaluate_suite`.
        slurm: the array.
        **options: processes, threads, resume and overwrite of :func:`evaluate_suite`.

    Raises:
        ImportError: submitit is missing.
        ValueError: a parameter that submitit does not take, or no SLURM here; and as :func:`evaluate_suite`.
    """
    submitit = optional("submitit", "--slurm needs submitit", "'ufmstar-torch[cluster]'")
    output = f"{job.out}/slurm"
    how = {name: options.pop(name, False) for name in ("resume", "overwrite")}
    # Opened once before any job starts, which reports mistakes once.
    with EvalFolder.open(job.out, job.about(job.load(torch.device("cpu"))), **how):
        pass
    try:
        executor = submitit.AutoExecutor(folder=output, cluster=slurm.cluster)
        executor.update_parameters(**{"name": "ufmstar-eval", **slurm.parameters})
    except (NameError, RuntimeError, TypeError) as error:  # NameError: an unknown parameter
        raise ValueError(f"--slurm: {' '.join(str(error).split())}") from error
    shards = [Shard(n + 1, slurm.jobs) for n in range(slurm.jobs)]
    jobs = executor.map_array(partial(_evaluate_shard, job, options), shards)
    report(f"jobs {', '.join(one.job_id for one in jobs)}; their output is in {output}")
    stopped = False
    while not stopped and not all(one.done() for one in jobs):
        time.sleep(_POLL_SECONDS)
        stopped = stop()
    errors = {one.job_id: None if stopped else one.exception() for one in jobs}
    for one in jobs:
        if stopped:
            one.cancel()
        elif errors[one.job_id] is not None:
            report(f"job {one.job_id} failed: {' '.join(str(errors[one.job_id]).split())[-300:]}")
    finished = not stopped and not any(errors.values()) and all(one.result() for one in jobs)
    folder = EvalFolder(job.out)
    complete = all(folder.is_finished(item, job.suite.rows) for item in job.items)
    return EvalOutcome(finished, stopped, complete, folder.failures(job.items))


def _evaluate_shard(job: EvalJob, options: Mapping[str, Any], shard: Shard) -> bool:
    """Run one job of the array; return whether it finished."""
    return evaluate_suite(job, shard=shard, resume=True, report=print, **options).finished
