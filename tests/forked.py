"""Starts test processes quickly: forks of one process that has imported the package."""

from __future__ import annotations

import importlib
import multiprocessing
import os

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    ["lightning", "matplotlib.pyplot", "ufmstar_torch.train.fit"]
    + [f"ufmstar_torch.{name}" for name in ("train.command", "eval.commands.evaluate", "eval.commands.report")]
)


def _call(begun, environment, module, name, arguments):
    os.setsid()
    os.environ.update(environment)
    begun.set()
    getattr(importlib.import_module(module), name)(*arguments)


def start(function, *arguments, **environment):
    """Start a process in a new process group that calls a function of a test file; return once it runs."""
    begun, module = CONTEXT.Event(), function.__module__.rpartition(".")[2]  # pytest imports the file as tests.MODULE
    process = CONTEXT.Process(target=_call, args=(begun, environment, module, function.__name__, arguments))
    process.start()
    begun.wait()
    return process
