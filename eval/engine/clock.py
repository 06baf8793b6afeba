"""The clock: time per stage of a frame."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


class StageTimer:
    """Milliseconds per named stage since the last :meth:`take`. The work of the ``device`` is waited for."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._ms: dict[str, float] = {}
        self._lap = time.perf_counter()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of a block to a stage; a block that raises adds nothing."""
        synchronize(self._device)
        started = time.perf_counter()
        yield
        synchronize(self._device)
        self._ms[name] = self._ms.get(name, 0.0) + 1000 * (time.perf_counter() - started)

    def lap(self, name: str) -> None:
        """Add the time since the previous lap, or since :meth:`take`, to a stage."""
        synchronize(self._device)
        previous, self._lap = self._lap, time.perf_counter()
        self._ms[name] = self._ms.get(name, 0.0) + 1000 * (self._lap - previous)

    def take(self) -> dict[str, float]:
        """The stages' times [ms]; all stages begin again at 0, and the next lap begins."""
        taken, self._ms = self._ms, {}
        self._lap = time.perf_counter()
        return taken


def synchronize(device: torch.device) -> None:
    """Wait for the work that is queued on a device."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
