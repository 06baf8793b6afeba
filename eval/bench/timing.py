"""Statistics of times, the stages of a step, and a fixed number of threads.

Wall-clock times on a machine with other load have a long upper tail: the median and the quartiles, which the tail
hardly moves, and the minimum are reported.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch

from ufmstar_torch import UfMStar
from ufmstar_torch.eval.engine.clock import synchronize
from ufmstar_torch.eval.run.machine import available_cores

# Every moment of a step belongs to one of these; see ``ufmstar_torch.step_parts.StepObserver``.
STAGES = ("check", "segment", "correspond", "fuse", "append", "regress", "average")
_CPU = torch.device("cpu")


def most_threads() -> int:
    """The cores of this process, or as many threads as numba may start (``NUMBA_NUM_THREADS``)."""
    numba: Any = import_module("numba")
    return min(available_cores(), int(numba.config.NUMBA_NUM_THREADS))


@contextmanager
def pinned_threads(count: int) -> Iterator[None]:
    """Set the number of threads of torch, numba and OpenCV; restore the previous numbers afterwards. Raises ValueError:
    ``count`` is not positive or more than numba has started."""
    numba: Any = import_module("numba")
    if not 1 <= count <= numba.config.NUMBA_NUM_THREADS:
        raise ValueError(f"threads must be 1 to {numba.config.NUMBA_NUM_THREADS} (numba's), got {count}")
    # torch last: where numba's loops run on OpenMP, setting its number sets torch's as well.
    libraries = [(numba.get_num_threads, numba.set_num_threads), (torch.get_num_threads, torch.set_num_threads)]
    if find_spec("cv2") is not None:
        cv2: Any = import_module("cv2")
        libraries.insert(0, (cv2.getNumThreads, cv2.setNumThreads))
    before = [read() for read, _ in libraries]
    try:
        for _, write in libraries:
            write(count)
        yield
    finally:
        for (_, write), number in zip(libraries, before, strict=True):
            write(number)


def spread(milliseconds: Sequence[float]) -> dict[str, float | int]:
    """Median, interquartile range, quartiles and minimum [ms] of at least one measurement, and their count."""
    low, middle, high = np.percentile(milliseconds, (25, 50, 75)).tolist()
    quartiles = {"median_ms": middle, "iqr_ms": high - low, "q1_ms": low, "q3_ms": high}
    return {**quartiles, "min_ms": float(min(milliseconds)), "count": len(milliseconds)}


def paired_ratio(numerator: Sequence[float], denominator: Sequence[float]) -> dict[str, float | int]:
    """Median and quartiles of the ratios of measurements taken one right after the other. Another program that slows
    both down for a while then cancels, as it does not in a ratio of medians."""
    low, middle, high = np.percentile(np.divide(numerator, denominator), (25, 50, 75)).tolist()
    return {"median": middle, "q1": low, "q3": high, "count": len(numerator)}


class StagedStep:
    """Times the stages of UfM*'s steps: the observer (``ufmstar_torch.step_parts.StepObserver``) of a module on a
    device, which ``step`` runs once. The output's assembly after the last stage belongs to none."""

    def __init__(self, module: UfMStar, step: Callable[..., Any], device: torch.device = _CPU) -> None:
        self.module, self._step, self._device = module, step, device
        self.stages: dict[str, list[float]] = {name: [] for name in STAGES}
        module.observer = self

    def __call__(self, *args: Any) -> Any:
        """Run one step."""
        self._before = time.perf_counter()
        return self._step(*args)

    def stage(self, name: str) -> None:
        """A stage has ended."""
        synchronize(self._device)
        now = time.perf_counter()
        self.stages[name].append(1000 * (now - self._before))
        self._before = now

    def summary(self, *, warm_up: int) -> dict[str, Any]:
        """Spread of every stage and of the steps' sums; the first ``warm_up`` steps do not count."""
        return {
            "stages": {name: spread(times[warm_up:]) for name, times in self.stages.items()},
            "stages_total": spread(np.sum(list(self.stages.values()), axis=0)[warm_up:]),
        }
