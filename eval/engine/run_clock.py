"""Time per stage of a frame, also inside modules that call each other."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import Any

import torch
from torch import nn


class Stopwatch:
    """Milliseconds per named stage since the last :meth:`take`. On an accelerator, its work is waited for.

    Args:
        device: whose work belongs to the stages.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._ms: dict[str, float] = {}
        self._started: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of a block to a stage; a block that raises adds nothing."""
        self._start(name)
        yield
        self._stop(name)

    def watch(self, module: nn.Module, name: str) -> None:
        """Add the time of every call of ``module`` to a stage."""

        def before(*_: Any) -> None:
            self._start(name)

        def after(*_: Any) -> None:
            self._stop(name)

        module.register_forward_pre_hook(before)
        module.register_forward_hook(after)

    def take(self) -> dict[str, float]:
        """The stages' times [ms], and start again from nothing."""
        taken, self._ms = self._ms, {}
        return taken

    def _start(self, name: str) -> None:
        self._wait()
        self._started[name] = perf_counter()

    def _stop(self, name: str) -> None:
        self._wait()
        self._ms[name] = self._ms.get(name, 0.0) + 1000 * (perf_counter() - self._started[name])

    def _wait(self) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
