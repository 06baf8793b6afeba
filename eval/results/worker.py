"""One process of several that share an evaluation; ``python -m ufmstar_torch.eval.results.worker`` starts one."""

from __future__ import annotations

import os
import pickle
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch

from ufmstar_torch.eval.results.eval_folder import EvalFolder
from ufmstar_torch.eval.results.machine import require_device
from ufmstar_torch.eval.results.work import Worker, WorkerTask

DONE, FAILED, STOPPED = 0, 1, 130


def work(
    task: WorkerTask, *, resume: bool = True, overwrite: bool = False, stop: Callable[[], bool], **context: Any
) -> bool:
    """Take part; True when nothing is left to do.

    Args:
        task: which part.
        resume, overwrite: as ``EvalFolder.open`` takes them.
        stop, **context: as :class:`Worker` takes them.

    Raises:
        FolderError, OSError, ValueError, ImportError: the work cannot be begun, or nothing can be written.
    """
    if task.threads is not None:
        torch.set_num_threads(task.threads)
    job = replace(task.job, device=device_of(task.job.device, task.local))
    networks = job.load(torch.device(job.device))
    folder = EvalFolder.open(job.out, job.about(networks), resume=resume, overwrite=overwrite)
    return Worker(replace(task, job=job), folder, networks, stop=stop, **context).run()


def device_of(name: str, local: int) -> str:
    """The device of the process with that number on its computer: "cuda" is the GPU in turn, else as it stands. Raises
    ValueError: the device does not exist."""
    if name == "cuda" and torch.cuda.is_available():
        name = f"cuda:{local % torch.cuda.device_count()}"
    return require_device(name)


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


if __name__ == "__main__":
    sys.exit(main())
