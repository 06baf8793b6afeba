"""Statistics of times, the stages of a step, and a fixed number of threads.

Wall-clock times on a machine with other load have a long upper tail, so the median, the quartiles and the minimum are
reported.
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
from numpy.typing import NDArray

from ufmstar_torch import UfMStar
from ufmstar_torch.eval.engine.progress import synchronize
from ufmstar_torch.eval.run.machine import available_cores

# Seconds since an arbitrary moment: wall-clock time, or the processor's time for this process.
Clock = Callable[[], float]
CLOCKS: dict[str, Clock] = {"wall": time.perf_counter, "cpu": time.process_time}
# The stages of a step, without gaps between them; see ``ufmstar_torch.steps.step.StepObserver``.
STAGES = ("check", "segment", "correspond", "fuse", "append", "regress", "average")
_CPU = torch.device("cpu")


def most_threads() -> int:
    """The number of cores of this process, at most ``NUMBA_NUM_THREADS``."""
    numba: Any = import_module("numba")
    return min(available_cores(), int(numba.config.NUMBA_NUM_THREADS))


@contextmanager
def pinned_threads(count: int) -> Iterator[None]:
    """Set the number of threads of torch, numba and OpenCV; restore the previous numbers afterwards. Raises ValueError:
    ``count`` is not positive, or larger than numba's number of threads."""
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
    """Median and quartiles of the ratios of consecutive measurements. A load that slows both down cancels, which it
    does not in a ratio of medians."""
    low, middle, high = np.percentile(np.divide(numerator, denominator), (25, 50, 75)).tolist()
    return {"median": middle, "q1": low, "q3": high, "count": len(numerator)}


class StagedStep:
    """Times the stages of UfM*'s steps, as the observer (``ufmstar_torch.steps.step.StepObserver``) of a module
    on a device. ``step`` runs the module once. The assembly of the output, after the last stage, is not timed."""

    def __init__(
        self, module: UfMStar, step: Callable[..., Any], device: torch.device = _CPU, clock: Clock = time.perf_counter
    ) -> None:
        self.module, self._step, self._device, self._clock = module, step, device, clock
        self.stages: dict[str, list[float]] = {name: [] for name in STAGES}
        module.observer = self

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Run one step."""
        self._before = self._clock()
        return self._step(*args, **kwargs)

    def stage(self, name: str) -> None:
        """Record the time of the stage that has ended."""
        synchronize(self._device)
        end = self._clock()
        self.stages[name].append(1000 * (end - self._before))
        self._before = end

    def _shares(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Times of the stages that are not the paper's (check and average), and of all stages, by step [ms]."""
        return np.add(self.stages["check"], self.stages["average"]), np.sum(list(self.stages.values()), axis=0)

    def summary(self, *, warm_up: int) -> dict[str, Any]:
        """Spread of every stage's times and of their sums per step, without the first ``warm_up`` steps."""
        return {
            "stages": {name: spread(times[warm_up:]) for name, times in self.stages.items()},
            "stages_total": spread(np.sum(list(self.stages.values()), axis=0)[warm_up:]),
            "beyond_the_paper": paired_ratio(*(times[warm_up:].tolist() for times in self._shares())),
        }
