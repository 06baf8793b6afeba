"""An evaluation as jobs of a SLURM cluster, through submitit."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from ufmstar_torch.eval.results.worker import Share, work

# submitit's own names; others are SLURM's, as partition, account, constraint.
_GENERAL = ("name", "timeout_min", "mem_gb", "nodes", "cpus_per_task", "gpus_per_node", "tasks_per_node")
_POLL_SECONDS = 0.2


@dataclass(frozen=True)
class Slurm:
    """What ``--slurm`` says.

    Attributes:
        jobs: how many share the work.
        cluster: of submitit: "slurm"; "local" and "debug" run on this computer.
        parameters: of ``submitit.AutoExecutor``.
    """

    jobs: int
    cluster: str
    parameters: Mapping[str, Any]

    @classmethod
    def parse(cls, words: Iterable[str]) -> Slurm:
        """From KEY=VALUE words.

        Raises:
            ValueError: another form, a key twice, or a number of jobs below 1.
        """
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
            raise ValueError("--slurm: every job is one process; jobs=N says how many")
        named = {key if key in _GENERAL or key.startswith("slurm_") else f"slurm_{key}": v for key, v in values.items()}
        return cls(jobs, cluster, named)


@dataclass(frozen=True)
class Job:
    """What a job runs; submitit calls ``checkpoint`` before its time is up or it makes room, and queues it again."""

    share: Share

    def __call__(self) -> bool:
        return work(self.share, stop=lambda: False, tell=print)

    def checkpoint(self, *_: object) -> Any:
        """The same again: what is finished by then is skipped."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


def run_slurm(options: Mapping[str, Any], *, stop: Callable[[], bool], tell: Callable[[str], None]) -> bool:
    """Submit the jobs and wait for all of them; OUT/slurm has their output.

    Args:
        options: of ``ufmstar eval``; the output folder is prepared.
        stop: True: the jobs are cancelled.
        tell: gets a line for each job that was submitted, and for each that failed.

    Returns:
        Whether every job came to its end.

    Raises:
        ImportError: submitit is missing.
        ValueError: a parameter that submitit does not take, or no SLURM here.
    """
    try:
        import submitit
    except ImportError as error:
        raise ImportError("--slurm needs submitit: pip install 'ufmstar-torch[cluster]'") from error
    slurm, launch = Slurm.parse(options["slurm"]), secrets.token_hex(8)
    folder = f"{options['out']}/slurm"
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=slurm.cluster)
        executor.update_parameters(**{"name": "ufmstar-eval", **slurm.parameters})
    except (NameError, RuntimeError, TypeError) as error:  # NameError: a parameter that there is not
        raise ValueError(f"--slurm: {' '.join(str(error).split())}") from error
    jobs = []
    with executor.batch():
        for n in range(slurm.jobs):
            share = Share(options, n + 1, slurm.jobs, 0, launch, options["threads"])
            jobs.append(executor.submit(Job(share)))
    tell(f"jobs {', '.join(job.job_id for job in jobs)}; their output is in {folder}")
    return _wait(jobs, stop, tell)


def _wait(jobs: list[Any], stop: Callable[[], bool], tell: Callable[[str], None]) -> bool:
    running, well = list(jobs), True
    try:
        while running:
            if stop():
                return False
            for job in [job for job in running if job.done()]:
                running.remove(job)
                error = job.exception()
                if error is not None:
                    well = False
                    tell(f"job {job.job_id} failed: {' '.join(str(error).split())[-300:]}")
                else:
                    well = well and bool(job.result())
            time.sleep(_POLL_SECONDS)
        return well
    finally:
        for job in running:
            job.cancel()
