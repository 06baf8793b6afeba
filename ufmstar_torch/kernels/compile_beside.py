"""A second process that compiles kernels into the cache on the disk, while this one compiles others (numba).

Threads would not do: numba compiles one function at a time. The process starts at the first function that this one has
to compile, so never where all are on the disk already. Whatever goes wrong with it, this process compiles the kernel
itself when it is called.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numba.core import event

Job = tuple[str, str, dict[str, Any]]  # module, function of it, keyword arguments


@contextmanager
def compiling_beside(jobs: Sequence[Job]) -> Iterator[Compiler]:
    """Within the context, the first compilation starts a process that runs the jobs; it ends with the context."""
    compiler = Compiler(jobs)
    with event.install_listener("numba:compile", compiler):
        try:
            yield compiler
        finally:
            compiler.stop()


class Compiler(event.Listener):
    """The other process, once there is one.

    Args:
        jobs: functions that call the kernels to compile; their arguments as JSON holds them.
    """

    def __init__(self, jobs: Sequence[Job]) -> None:
        self._jobs, self._begun, self._collects = jobs, False, False
        self._process: subprocess.Popen[bytes] | None = None

    def on_start(self, event: event.Event) -> None:
        """A function is about to be compiled here."""
        if not self._begun:
            self._begun, self._collects = True, gc.isenabled()
            gc.disable()  # a tenth of the time goes into it
            if self._jobs and event.data["dispatcher"].stats.cache_path is not None and _spare():
                self._process = _started(self._jobs)

    def on_end(self, event: event.Event) -> None:
        """Nothing is done."""

    def wait(self) -> None:
        """Return when the other process has ended, or at once where there is none."""
        if self._process is not None:
            self._process.wait()

    def stop(self) -> None:
        """End the other process; collect garbage again."""
        if self._collects:
            gc.enable()
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def _spare() -> bool:
    """Whether another process can be started, and has a core to run on."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    # The executable of a frozen program, or of one that embeds Python, is the program itself.
    interpreter = Path(sys.executable or "").stem.lower().startswith(("python", "pypy"))
    return cores > 1 and interpreter and not getattr(sys, "frozen", False)


def _started(jobs: Sequence[Job]) -> subprocess.Popen[bytes] | None:
    """A process that runs the jobs, of the same modules as this one; None where the system has no room for it."""
    command = [sys.executable, "-P", "-m", __name__, json.dumps(jobs)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    quiet: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    try:
        return subprocess.Popen(command, env=environment, **quiet)
    except OSError:
        return None


def main(jobs: str) -> None:
    """Run jobs, as JSON, as long as the process lives that started this one."""
    parent = os.getppid()
    for module, function, arguments in json.loads(jobs):
        if os.getppid() != parent:
            return
        getattr(importlib.import_module(module), function)(**arguments)


if __name__ == "__main__":
    gc.disable()  # as above
    main(sys.argv[1])
