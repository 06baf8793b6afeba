"""The clock: time per stage of a frame."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def timed(ms: dict[str, float], stage: str, device: torch.device) -> Iterator[None]:
    """Record the time of a block, with the work that it queues on a device, as ``ms[stage]`` [ms], unless it raises."""
    synchronize(device)
    started = time.perf_counter()
    yield
    synchronize(device)
    ms[stage] = 1000 * (time.perf_counter() - started)


def synchronize(device: torch.device) -> None:
    """Wait for the work that is queued on a device."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
