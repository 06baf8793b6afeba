"""How an evaluation is carried out: here, by a pool of processes, by torchrun's, or by jobs of a cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch

from ufmstar_torch.eval.commands.eval_options import job_from
from ufmstar_torch.eval.engine.evaluate import evaluate_sequence
from ufmstar_torch.eval.results.eval_folder import EvalFolder
from ufmstar_torch.eval.results.run_suite import Conduct, EvalJob, Evaluate, failures, run_job
from ufmstar_torch.eval.results.worker import Share, device_of, prepare, work
from ufmstar_torch.eval.results.worklist import Shard

_TORCHRUN = ("RANK", "WORLD_SIZE", "LOCAL_RANK")


@dataclass(frozen=True)
class Ended:
    """How it ended.

    Attributes:
        job: what was evaluated.
        finished: False: it was stopped, or a process ended early.
        stopped: by the caller.
        failed: why a sequence is broken, by its label.
        left: sequences without all of their rows, broken ones left out.
        tells: whether this process is the one that tells the results; further ones of torchrun are silent.
    """

    job: EvalJob
    finished: bool
    stopped: bool
    failed: Mapping[str, str]
    left: int
    tells: bool = True


@dataclass(frozen=True)
class Place:
    """torchrun's word on a process: its number of how many, and its number on the computer, all from 0."""

    rank: int
    world: int
    local: int

    @classmethod
    def of(cls, environment: Mapping[str, str]) -> Place | None:
        """The place; None where torchrun has not started several.

        Raises:
            ValueError: the variables hold no such numbers.
        """
        if any(name not in environment for name in _TORCHRUN):
            return None
        try:
            rank, world, local = (int(environment[name]) for name in _TORCHRUN)
        except ValueError as error:
            raise ValueError(f"{', '.join(_TORCHRUN)} in the environment must be numbers: {error}") from error
        if not (0 <= rank < world and local >= 0):
            raise ValueError(f"RANK {rank} must be in [0, WORLD_SIZE {world}) and LOCAL_RANK {local} at least 0")
        return None if world == 1 else cls(rank, world, local)


def evaluate_suite(
    options: Mapping[str, Any],
    *,
    stop: Callable[[], bool],
    tell: Callable[[str], None],
    progress: Callable[[str, int, int], None],
    evaluate: Evaluate = evaluate_sequence,
) -> Ended:
    """Do what the options (``parse_eval``) say.

    Args:
        options: checked or not.
        stop: asked before every frame.
        tell: gets a line when a sequence is finished.
        progress: see ``Conduct``; of this process's own work.
        evaluate: of this process's own work; see ``evaluate_sequence``.

    Raises:
        FolderError, FileNotFoundError, ValueError, ImportError: it cannot be begun.
        CacheError, OSError: nothing can be written.
    """
    job = job_from(options)
    place = Place.of(os.environ)
    if place is not None:
        finished = _as_torchruns(options, place, stop, tell, evaluate)
        return _ended(job, finished, stop(), tells=place.rank == 0)
    if options["slurm"] or options["processes"] > 1:
        from ufmstar_torch.eval.results.pool import run_pool
        from ufmstar_torch.eval.results.slurm import Slurm, run_slurm

        Slurm.parse(options["slurm"])
        prepare(job, resume=options["resume"], overwrite=options["overwrite"])
        run = run_slurm if options["slurm"] else run_pool
        return _ended(job, run(options, stop=stop, tell=tell), stop())
    job = replace(job, device=device_of(job.device, 0))
    shard = Shard.parse(options["shard"] or "1/1")
    networks = job.load(torch.device(job.device))
    # The parts of a divided evaluation begin in any order: whichever comes first makes the folder.
    resume = options["resume"] or shard.count > 1
    folder = EvalFolder.open(job.out, job.about(networks), resume=resume, overwrite=options["overwrite"])
    conduct = Conduct(shard=shard, stop=stop, tell=tell, progress=progress)
    return _ended(job, run_job(job, folder, networks, conduct, evaluate), stop())


def _as_torchruns(
    options: Mapping[str, Any],
    place: Place,
    stop: Callable[[], bool],
    tell: Callable[[str], None],
    evaluate: Evaluate,
) -> bool:
    """Take part as one of torchrun's processes; the first one stays to the end.

    Raises:
        ValueError: an option that contradicts it.
    """
    for name in ("shard", "slurm", "overwrite"):
        if options[name]:
            raise ValueError(f"--{name} goes without torchrun, which has started {place.world} processes")
    if options["processes"] > 1:
        raise ValueError(f"--processes goes without torchrun, which has started {place.world}")
    # No launch in common: torchrun starts all again when one was killed, and then its sequence is tried again.
    share = Share(options, place.rank + 1, place.world, place.local, "", options["threads"])
    return work(share, stop=stop, tell=tell, waits=place.rank == 0, evaluate=evaluate)


def _ended(job: EvalJob, finished: bool, stopped: bool, *, tells: bool = True) -> Ended:
    folder = EvalFolder(job.out, {})
    failed = failures(folder, job.items)
    open_items = [item for item in job.items if item.label not in failed and folder.missing(item, job.suite.rows)]
    return Ended(job, finished, stopped, failed, len(open_items), tells)
