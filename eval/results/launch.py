"""How an evaluation is carried out: in this process, by further ones, by torchrun's, or by jobs of a cluster.

Processes on this computer are started and watched here rather than by submitit's local executor, whose jobs end after
some minutes, are cancelled by SIGINT, outlive a killed starter and write to files instead of the terminal.

``stop`` is asked before every frame, or while processes or jobs run, and ends the work; ``report`` receives a line for
everything that a user should see.
"""

from __future__ import annotations

import os
import pickle
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch

from ufmstar_torch.eval.engine.evaluate import evaluate_sequences
from ufmstar_torch.eval.results.eval_folder import EvalFolder
from ufmstar_torch.eval.results.machine import available_cores
from ufmstar_torch.eval.results.work import EvalJob, Evaluate, WorkerContext, failures, run_job
from ufmstar_torch.eval.results.worker import DONE, STOPPED, WorkerTask, device_of, work
from ufmstar_torch.eval.results.worklist import Shard
from ufmstar_torch.optional import optional

_TORCHRUN = ("RANK", "WORLD_SIZE", "LOCAL_RANK")
_POLL_SECONDS = 0.05
_PATIENCE_SECONDS = 10.0  # for a process that was killed
_WORKER = (sys.executable, "-P", "-m", "ufmstar_torch.eval.results.worker")
# submitit's own names of parameters; others are SLURM's, as partition, account, constraint.
_SUBMITIT = ("name", "timeout_min", "mem_gb", "nodes", "cpus_per_task", "gpus_per_node", "tasks_per_node")

Stop = Callable[[], bool]
Report = Callable[[str], None]


@dataclass(frozen=True)
class LaunchOptions:
    """Who carries an evaluation out: options of ``ufmstar eval``, under their names."""

    processes: int = 1  # on this computer
    slurm: Sequence[str] = ()  # KEY=VALUE words; see ``Slurm``. () = no cluster
    shard: str | None = None  # "i/n", the part of the sequences that this process does; None = all
    threads: int | None = None  # of the CPU, for each process; None = all, divided among them
    # resume, overwrite: see ``EvalFolder.open``.
    resume: bool = False
    overwrite: bool = False
    debug: bool = False  # show tracebacks


@dataclass(frozen=True)
class EvalOutcome:
    """How an evaluation ended."""

    job: EvalJob  # what was evaluated
    finished: bool  # False: it was stopped, or a process ended early
    stopped: bool  # by the caller
    failed: Mapping[str, str]  # why a sequence is broken, by its label
    left: int  # number of sequences without all of their rows, broken ones left out
    reports: bool = True  # whether this process reports the results; further ones of torchrun are silent


@dataclass(frozen=True)
class Rank:
    """Rank, world size and local rank of a process, as torchrun sets them."""

    rank: int
    world: int
    local: int

    @classmethod
    def of(cls, environment: Mapping[str, str]) -> Rank | None:
        """The rank in an environment; None where torchrun has not started several processes. Raises ValueError: the
        variables are not such numbers."""
        if any(name not in environment for name in _TORCHRUN):
            return None
        try:
            rank, world, local = (int(environment[name]) for name in _TORCHRUN)
        except ValueError as error:
            raise ValueError(f"{', '.join(_TORCHRUN)} in the environment must be numbers: {error}") from error
        if not (0 <= rank < world and local >= 0):
            raise ValueError(f"RANK {rank} must be in [0, WORLD_SIZE {world}) and LOCAL_RANK {local} at least 0")
        return None if world == 1 else cls(rank, world, local)


@dataclass(frozen=True)
class Slurm:
    """The words of ``--slurm``."""

    jobs: int  # how many share the work
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
            raise ValueError("--slurm: every job is one process; jobs=N sets their number")
        plain = {key for key in values if key in _SUBMITIT or key.startswith("slurm_")}
        return cls(jobs, cluster, {key if key in plain else f"slurm_{key}": v for key, v in values.items()})


def evaluate_suite(
    job: EvalJob,
    options: LaunchOptions,
    *,
    stop: Stop,
    report: Report,
    progress: Callable[[str, int, int], None],
    evaluate: Evaluate = evaluate_sequences,
) -> EvalOutcome:
    """Evaluate a job; ``progress`` (see ``WorkerContext``) and ``evaluate`` (see ``evaluate_sequences``) are of this
    process's own work.

    Raises:
        FolderError, FileNotFoundError, ValueError, ImportError: the work cannot be begun.
        CacheError, OSError: nothing can be written.
    """
    rank = Rank.of(os.environ)
    if rank is not None:
        _require_plain(options, rank)
        # No common launch: torchrun starts all processes again when one was killed, and the sequence is tried again.
        task = WorkerTask(job, rank.rank + 1, rank.world, rank.local, "", options.threads)
        finished = work(task, stop=stop, report=report, waits=rank.rank == 0, evaluate=evaluate)
        return _outcome(job, finished, stop(), reports=rank.rank == 0)
    if options.slurm or options.processes > 1:
        slurm = Slurm.parse(options.slurm) if options.slurm else None
        # Opened once before any process starts, which reports mistakes once.
        about = job.about(job.load(torch.device("cpu")))
        EvalFolder.open(job.out, about, resume=options.resume, overwrite=options.overwrite)
        if slurm is None:
            finished = run_processes(tasks_of(job, options), stop=stop, report=report)
        else:
            finished = run_slurm(slurm, tasks_of(job, options, slurm.jobs), stop=stop, report=report)
        return _outcome(job, finished, stop())
    job = replace(job, device=device_of(job.device, 0))
    shard = Shard.parse(options.shard or "1/1")
    networks = job.load(torch.device(job.device))
    # The parts of a divided evaluation begin in any order: whichever is first makes the folder.
    resume = options.resume or shard.count > 1
    folder = EvalFolder.open(job.out, job.about(networks), resume=resume, overwrite=options.overwrite)
    context = WorkerContext(shard, stop=stop, report=report, progress=progress, evaluate=evaluate)
    return _outcome(job, run_job(job, folder, networks, context), stop())


def tasks_of(job: EvalJob, options: LaunchOptions, jobs: int | None = None) -> list[WorkerTask]:
    """The tasks of processes that share a job: ``options.processes`` on this computer, or ``jobs`` on a cluster."""
    launch, count = secrets.token_hex(8), jobs or options.processes
    threads = options.threads if jobs else options.threads or max(1, available_cores() // count)
    return [WorkerTask(job, n + 1, count, 0 if jobs else n, launch, threads, options.debug) for n in range(count)]


def run_processes(tasks: Sequence[WorkerTask], *, stop: Stop, report: Report, command: Sequence[str] = _WORKER) -> bool:
    """Start a process for every task by ``command``, which runs ``worker.main``, and wait for all; whether every one
    came to its end. One that ends early loses only the sequence in hand: the others do the rest."""
    running: list[_Process] = []
    try:
        for task in tasks:
            # In a session of its own, so that Ctrl-C reaches this process alone, which passes it on.
            child = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)
            running.append(_Process(task.label, child))
            assert child.stdin is not None
            pickle.dump(task, child.stdin)
            child.stdin.close()
        return _wait(running, stop, report)
    finally:
        for process in running:
            process.child.kill()
        for process in running:
            process.child.wait(_PATIENCE_SECONDS)


def run_slurm(slurm: Slurm, tasks: Sequence[WorkerTask], *, stop: Stop, report: Report) -> bool:
    """Submit a job for every task, and wait for all of them; whether every one came to its end. OUT/slurm has their
    output; stopping cancels them.

    Raises:
        ImportError: submitit is missing.
        ValueError: a parameter that submitit does not take, or no SLURM here.
    """
    submitit = optional("submitit", "--slurm needs submitit", "'ufmstar-torch[cluster]'")
    folder = f"{tasks[0].job.out}/slurm"
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=slurm.cluster)
        executor.update_parameters(**{"name": "ufmstar-eval", **slurm.parameters})
    except (NameError, RuntimeError, TypeError) as error:  # NameError: an unknown parameter
        raise ValueError(f"--slurm: {' '.join(str(error).split())}") from error
    with executor.batch():
        jobs = [executor.submit(ClusterTask(task)) for task in tasks]
    report(f"jobs {', '.join(job.job_id for job in jobs)}; their output is in {folder}")
    running = [_ClusterJob(job) for job in jobs]
    try:
        return _wait(running, stop, report)
    finally:
        for job in running:
            job.stop()


@dataclass(frozen=True)
class ClusterTask:
    """What a job runs; submitit calls ``checkpoint`` before its time is up or it makes room, and queues it again."""

    task: WorkerTask

    def __call__(self) -> bool:
        return work(self.task, stop=lambda: False, report=print)

    def checkpoint(self, *_: object) -> Any:
        """The same again: what is finished by then is skipped."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


@dataclass
class _Process:
    """A process on this computer."""

    label: str
    child: subprocess.Popen[bytes]

    def outcome(self) -> tuple[bool, str] | None:
        """Whether it came to its end, and a line about what went wrong, or ""; None while it runs."""
        code = self.child.poll()
        if code is None:
            return None
        how = f"signal {-code}" if code < 0 else f"code {code}"
        return code == DONE, "" if code in (DONE, STOPPED) else f"process {self.label} ended early ({how})"

    def stop(self) -> None:
        """Ask it to end after the frame in hand."""
        self.child.send_signal(signal.SIGTERM)


@dataclass
class _ClusterJob:
    """A job of submitit; once it is cancelled, its end is not awaited."""

    job: Any
    cancelled: bool = False

    def outcome(self) -> tuple[bool, str] | None:
        """As ``_Process.outcome``."""
        if self.cancelled or not self.job.done():
            return (False, "") if self.cancelled else None
        error = self.job.exception()
        if error is not None:
            return False, f"job {self.job.job_id} failed: {' '.join(str(error).split())[-300:]}"
        return bool(self.job.result()), ""

    def stop(self) -> None:
        """Cancel it."""
        self.cancelled = True
        self.job.cancel()


_Started = TypeVar("_Started", _Process, _ClusterJob)


def _wait(running: list[_Started], stop: Stop, report: Report) -> bool:
    """Wait until the list is empty, from which those that have ended are removed; whether all came to their end."""
    finished, stopping = True, False
    while running:
        if not stopping and stop():
            stopping = True
            for one in running:
                one.stop()
        for one in list(running):
            outcome = one.outcome()
            if outcome is not None:
                running.remove(one)
                finished = finished and outcome[0]
                if outcome[1]:
                    report(outcome[1])
        if running:
            time.sleep(_POLL_SECONDS)
    return finished


def _require_plain(options: LaunchOptions, rank: Rank) -> None:
    """Raise ValueError for an option that contradicts torchrun."""
    several = {"shard": options.shard, "slurm": options.slurm, "overwrite": options.overwrite}
    for name, given in {**several, "processes": options.processes > 1}.items():
        if given:
            raise ValueError(f"--{name} goes without torchrun, which has started {rank.world} processes")


def _outcome(job: EvalJob, finished: bool, stopped: bool, *, reports: bool = True) -> EvalOutcome:
    folder = EvalFolder(job.out, {})
    failed = failures(folder, job.items)
    open_items = [item for item in job.items if item.label not in failed and folder.missing(item, job.suite.rows)]
    return EvalOutcome(job, finished, stopped, failed, len(open_items), reports)
