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
from functools import partial
from typing import Any

import torch

from ufmstar_torch.eval.engine.evaluate import evaluate_sequence
from ufmstar_torch.eval.results.eval_folder import EvalFolder
from ufmstar_torch.eval.results.work import EvalJob, Evaluate, Worker, WorkerTask
from ufmstar_torch.eval.results.worklist import Shard
from ufmstar_torch.eval.run.machine import available_cores, device_of
from ufmstar_torch.optional import optional

_TORCHRUN = ("RANK", "WORLD_SIZE", "LOCAL_RANK")
_POLL_SECONDS = 0.05
_PATIENCE_SECONDS = 10.0  # for a process that was killed
WORKER = (sys.executable, "-P", "-c", f"from {__name__} import main; raise SystemExit(main())")
DONE, FAILED, STOPPED = 0, 1, 130  # exit codes of a process
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

    finished: bool  # False: it was stopped, or a process ended early
    stopped: bool  # by the caller
    failed: Mapping[str, str]  # why a sequence is broken, by its label
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
    evaluate: Evaluate = evaluate_sequence,
) -> EvalOutcome:
    """Evaluate a job; ``progress`` and ``evaluate`` (see ``Worker``) are of this process's own work.

    Raises:
        FolderError, FileNotFoundError, ValueError, ImportError: the work cannot be begun.
        CacheError, OSError: nothing can be written.
    """
    rank = Rank.of(os.environ)
    if rank is not None:
        _require_plain(options, rank)
        # No common launch: torchrun starts all processes again when one was killed, and the sequence is tried again.
        shard, first = Shard(rank.rank + 1, rank.world), rank.rank == 0
        task = WorkerTask(job, shard, rank.local, helps=True, waits=first, threads=options.threads)
        finished = work(task, stop=stop, report=report, evaluate=evaluate)
        return _outcome(job, finished, stop(), reports=first)
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
    shard = Shard.parse(options.shard or "1/1")
    # The parts of a divided evaluation begin in any order: whichever is first makes the folder.
    how = {"resume": options.resume or shard.count > 1, "overwrite": options.overwrite}
    own: dict[str, Any] = {"stop": stop, "report": report, "progress": progress, "evaluate": evaluate}
    return _outcome(job, work(WorkerTask(job, shard), **how, **own), stop())


def tasks_of(job: EvalJob, options: LaunchOptions, jobs: int | None = None) -> list[WorkerTask]:
    """The tasks of processes that share a job: ``options.processes`` on this computer, or ``jobs`` on a cluster."""
    launch, count = secrets.token_hex(8), jobs or options.processes
    threads = options.threads if jobs else options.threads or max(1, available_cores() // count)
    how: dict[str, Any] = {"helps": True, "launch": launch, "threads": threads, "debug": options.debug}
    return [WorkerTask(job, Shard(n + 1, count), 0 if jobs else n, **how) for n in range(count)]


def run_processes(tasks: Sequence[WorkerTask], *, stop: Stop, report: Report, command: Sequence[str] = WORKER) -> bool:
    """Start a process for every task by ``command``, which runs :func:`main`, and wait for all; whether every one came
    to its end. One that ends early loses only the sequence in hand: the others do the rest."""
    children: list[subprocess.Popen[bytes]] = []

    def terminate() -> None:
        for child in children:
            child.terminate()

    try:
        for task in tasks:
            # In a session of its own, so that Ctrl-C reaches this process alone, which passes it on.
            child = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)
            children.append(child)
            assert child.stdin is not None
            pickle.dump(task, child.stdin)
            child.stdin.close()
        outcomes = [partial(_of_process, *pair) for pair in zip(tasks, children, strict=True)]
        return _wait(outcomes, stop, report, terminate)
    finally:
        for child in children:
            child.kill()
        for child in children:
            child.wait(_PATIENCE_SECONDS)


def run_slurm(slurm: Slurm, tasks: Sequence[WorkerTask], *, stop: Stop, report: Report) -> bool:
    """Submit a job for every task, and wait for all of them; whether every one came to its end. OUT/slurm has their
    output; stopping cancels them. Raises ImportError: submitit is missing; ValueError: a parameter that submitit does
    not take, or no SLURM here."""
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
    try:
        return _wait([partial(_of_job, job) for job in jobs], stop, report, None)
    finally:
        for job in jobs:
            if not job.done():
                job.cancel()


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


def work(task: WorkerTask, *, resume: bool = True, overwrite: bool = False, **context: Any) -> bool:
    """Take part; True when nothing is left to do. ``resume`` and ``overwrite`` are as ``EvalFolder.open`` takes them,
    ``context`` as ``Worker`` does. Raises FolderError, OSError, ValueError, ImportError: the work cannot be begun, or
    nothing can be written."""
    if task.threads is not None:
        torch.set_num_threads(task.threads)
    job = replace(task.job, device=device_of(task.job.device, task.local))
    networks = job.load(torch.device(job.device))
    folder = EvalFolder.open(job.out, job.about(networks), resume=resume, overwrite=overwrite)
    return Worker(replace(task, job=job), folder, networks, **context).run()


def main() -> int:
    """Do the task that standard input contains as a pickle; 0 done, 1 failed, 130 stopped."""
    task: WorkerTask = pickle.load(sys.stdin.buffer)
    parent, received = os.getppid(), list[int]()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda n, _: received.append(n))

    def stop() -> bool:
        # An orphan ends too: its starter was killed and can no longer stop it.
        return bool(received) or os.getppid() != parent

    def report(line: str) -> None:
        print(f"[{task.shard}] {line}", file=sys.stderr, flush=True)

    try:
        return DONE if work(task, stop=stop, report=report) else STOPPED
    except (ImportError, OSError, RuntimeError, ValueError) as error:
        if task.debug:
            raise
        report(f"failed: {' '.join(str(error).split()) or type(error).__name__}")
        return FAILED


# Whether a process or job came to its end, and a line about what went wrong, or ""; None while it runs.
_Outcome = tuple[bool, str] | None


def _of_process(task: WorkerTask, child: subprocess.Popen[bytes]) -> _Outcome:
    code = child.poll()
    if code is None:
        return None
    how = f"signal {-code}" if code < 0 else f"code {code}"
    return code == DONE, "" if code in (DONE, STOPPED) else f"process {task.shard} ended early ({how})"


def _of_job(job: Any) -> _Outcome:
    if not job.done():
        return None
    error = job.exception()
    if error is not None:
        return False, f"job {job.job_id} failed: {' '.join(str(error).split())[-300:]}"
    return bool(job.result()), ""


def _wait(
    running: Iterable[Callable[[], _Outcome]], stop: Stop, report: Report, end: Callable[[], None] | None
) -> bool:
    """Wait for all outcomes; whether all came to their end. At a stop, ``end`` asks all to end after the frame in hand;
    with None they are not awaited."""
    left, finished, stopping = list(running), True, False
    while left:
        if not stopping and stop():
            if end is None:
                return False
            stopping = True
            end()
        for one in list(left):
            outcome = one()
            if outcome is not None:
                left.remove(one)
                finished = finished and outcome[0]
                if outcome[1]:
                    report(outcome[1])
        if left:
            time.sleep(_POLL_SECONDS)
    return finished


def _require_plain(options: LaunchOptions, rank: Rank) -> None:
    """Raise ValueError for an option that contradicts torchrun."""
    several = {"shard": options.shard, "slurm": options.slurm, "overwrite": options.overwrite}
    for name, given in {**several, "processes": options.processes > 1}.items():
        if given:
            raise ValueError(f"--{name} goes without torchrun, which has started {rank.world} processes")


def _outcome(job: EvalJob, finished: bool, stopped: bool, *, reports: bool = True) -> EvalOutcome:
    return EvalOutcome(finished, stopped, EvalFolder(job.out).failures(job.items), reports)
