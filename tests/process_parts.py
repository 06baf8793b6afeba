"""Work of processes that are started anew: they import it by the name of this file."""

from __future__ import annotations

import os
import signal
import time
from functools import partial
from pathlib import Path

from ufmstar_torch.eval.suite import shards

__all__ = ["Path", "at_work", "in_parts"]


def part(folder, ends, number):
    """Stands for the work of a process; ``ends`` says what becomes of each."""
    (folder / f"{number}-{os.getpid()}").touch()
    if ends[number] == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if ends[number] == "fail":
        raise OSError("disk full")
    while ends[number] == "wait":
        time.sleep(0.02)


def in_parts(folder, *ends, stop=lambda: False):
    """True if all of some processes finished, and their report."""
    folder.mkdir()
    lines: list[str] = []
    return shards.in_processes(partial(part, folder, ends), len(ends), stop, lines.append), lines


def at_work(folder):
    """The numbers of the processes that have begun."""
    return [int(path.name.rpartition("-")[2]) for path in folder.glob("*-*")]
