"""The two clocks: time per stage of a frame, and times of single calls with their robust statistics."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch


class StageTimer:
    """Milliseconds per named stage since the last :meth:`take`. On an accelerator, its work is waited for.

    Args:
        device: whose work belongs to the stages.
    """

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
    """Wait for what a device still computes."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


@dataclass
class CallTimes:
    """Wall-clock and processor times of calls by name [ms]."""

    wall: dict[Hashable, list[float]] = field(default_factory=dict)
    cpu: dict[Hashable, list[float]] = field(default_factory=dict)

    def time(self, name: Hashable, function: Callable[..., Any], *args: Any) -> Any:
        """Call ``function(*args)``, keep its times under ``name``, and return what it returned."""
        cpu, wall = time.process_time(), time.perf_counter()
        result = function(*args)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        self.wall.setdefault(name, []).append(1e3 * wall)
        self.cpu.setdefault(name, []).append(1e3 * cpu)
        return result

    def drop(self, count: int) -> None:
        """Forget the first ``count`` calls of every name: the warm-up."""
        for times in (*self.wall.values(), *self.cpu.values()):
            del times[:count]

    def spread(self, name: str) -> dict[str, float | int]:
        """:func:`spread` of the wall-clock times, and the median of the processor times."""
        return {**spread(self.wall[name]), "cpu_median_ms": float(np.median(self.cpu[name]))}

    def ratio(self, name: str, other: str) -> dict[str, float | int]:
        """:func:`paired_ratio` of the wall-clock times, and the median of that of the processor times."""
        cpu = paired_ratio(self.cpu[name], self.cpu[other])
        return {**paired_ratio(self.wall[name], self.wall[other]), "cpu_median": cpu["median"]}


def spread(milliseconds: Sequence[float]) -> dict[str, float | int]:
    """Median, interquartile range, quartiles and minimum [ms] of at least one measurement, and their count.

    Quartiles are interpolated linearly between the sorted values (NumPy's default).

    Raises:
        ValueError: no measurement.
    """
    if not len(milliseconds):
        raise ValueError("milliseconds must hold at least one measurement")
    low, middle, high = (float(q) for q in np.percentile(np.asarray(milliseconds, np.float64), (25, 50, 75)))
    return {
        "median_ms": middle,
        "iqr_ms": high - low,
        "q1_ms": low,
        "q3_ms": high,
        "min_ms": float(min(milliseconds)),
        "count": len(milliseconds),
    }


def paired_ratio(numerator: Sequence[float], denominator: Sequence[float]) -> dict[str, float | int]:
    """Median and quartiles of the ratios of measurements taken one right after the other.

    Another program that slows both down for a while then cancels, as it does not in a ratio of medians.

    Raises:
        ValueError: the two differ in length or are empty.
    """
    if len(numerator) != len(denominator) or not len(numerator):
        raise ValueError(f"expected as many numerators as denominators, got {len(numerator)} and {len(denominator)}")
    ratios = np.asarray(numerator, np.float64) / np.asarray(denominator, np.float64)
    low, middle, high = (float(q) for q in np.percentile(ratios, (25, 50, 75)))
    return {"median": middle, "q1": low, "q3": high, "count": len(ratios)}
