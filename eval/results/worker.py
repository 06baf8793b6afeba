"""One process of several that share an evaluation; ``python -m ufmstar_torch.eval.results.worker`` starts one."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from ufmstar_torch.eval.commands.eval_options import job_from
from ufmstar_torch.eval.engine.evaluate import evaluate_sequence
from ufmstar_torch.eval.results.eval_folder import EvalFolder
from ufmstar_torch.eval.results.run_suite import Conduct, EvalJob, Evaluate, run_job
from ufmstar_torch.eval.results.worklist import Shard

DONE, FAILED, STOPPED = 0, 1, 130


@dataclass(frozen=True)
class Share:
    """What a process is told.

    Attributes:
        options: of ``ufmstar eval``; the output folder is there already.
        index, count: which part it begins with, from 1, of how many.
        local: number of the process on its computer, from 0, which decides its GPU.
        launch: the same for all processes that were started together.
        threads: of the CPU; None = torch's own choice.
    """

    options: Mapping[str, Any]
    index: int
    count: int
    local: int
    launch: str
    threads: int | None = None

    @property
    def label(self) -> str:
        """For people."""
        return f"{self.index}/{self.count}"


def work(
    share: Share,
    *,
    stop: Callable[[], bool],
    tell: Callable[[str], None],
    waits: bool = False,
    evaluate: Evaluate = evaluate_sequence,
) -> bool:
    """Take part; True when there is nothing left to take.

    Raises:
        FolderError, OSError, ValueError, ImportError: the work cannot be begun, or nothing can be written.
    """
    if share.threads is not None:
        torch.set_num_threads(share.threads)
    job = job_from(share.options)
    job = replace(job, device=device_of(job.device, share.local))
    networks = job.load(torch.device(job.device))
    folder = EvalFolder.open(job.out, job.about(networks), resume=True, overwrite=False)
    conduct = Conduct(
        shard=Shard(share.index, share.count), helps=True, waits=waits, launch=share.launch, stop=stop, tell=tell
    )
    return run_job(job, folder, networks, conduct, evaluate)


def device_of(name: str, local: int) -> str:
    """The device of the process with that number on its computer: "cuda" is the GPU in turn, else as it stands.

    Raises:
        ValueError: there is no such device.
    """
    if name == "cuda" and torch.cuda.is_available():
        name = f"cuda:{local % torch.cuda.device_count()}"
    try:
        torch.zeros((), device=name)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"--device {name} is not available: {str(error).splitlines()[0]}") from error
    return name


def prepare(job: EvalJob, *, resume: bool, overwrite: bool) -> EvalFolder:
    """Open the output folder for processes that are then started: what is wrong is told once.

    Raises:
        FolderError, FileNotFoundError, ValueError, ImportError: see ``EvalFolder.open`` and ``NetworkChoice.load``.
    """
    about = job.about(job.load(torch.device("cpu")))
    return EvalFolder.open(job.out, about, resume=resume, overwrite=overwrite)


def main() -> int:
    """Do the share that standard input holds as JSON; 0 done, 1 failed, 130 stopped."""
    share = Share(**json.loads(sys.stdin.read()))
    parent, received = os.getppid(), list[int]()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda n, _: received.append(n))

    def stop() -> bool:
        # An orphan ends too: whoever started it was killed and cannot say so.
        return bool(received) or os.getppid() != parent

    def tell(line: str) -> None:
        print(f"[{share.label}] {line}", file=sys.stderr, flush=True)

    try:
        return DONE if work(share, stop=stop, tell=tell) else STOPPED
    except (ImportError, OSError, RuntimeError, ValueError) as error:
        if share.options["debug"]:
            raise
        tell(f"failed: {' '.join(str(error).split()) or type(error).__name__}")
        return FAILED


def as_json(share: Share) -> str:
    """What :func:`main` reads."""
    return json.dumps(asdict(share))


if __name__ == "__main__":
    sys.exit(main())
