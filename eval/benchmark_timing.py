"""Clocks of the benchmark: pinned threads, robust statistics, and the stages of a step.

Wall-clock times on a machine that does other work too have a long upper tail: reported are the median and
the quartiles, which the tail hardly moves, and the minimum. The processor time beside it counts what
the process itself computed (over all its threads, waiting ones that spin included), not what others took.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch

from ufmstar_torch.backend import Backend

# Every moment of a step belongs to one of these; see StageClock.stages.
STAGES = ("check", "segment", "correspond", "fuse", "append", "regress", "average")
_TIMED = ("spgf", "floor_covariance", "correspond", "fuse", "regress_image")


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


@contextmanager
def pinned_threads(count: int) -> Iterator[None]:
    """Let torch and numba (where it is installed) use ``count`` threads each; afterwards what they used before.

    Raises:
        ValueError: ``count`` is not positive or more than numba has started.
    """
    if count < 1:
        raise ValueError(f"threads must be at least 1, got {count}")
    numba = None
    if find_spec("numba") is not None:
        import numba
    before, before_numba = torch.get_num_threads(), numba and numba.get_num_threads()
    if numba is not None and count > numba.config.NUMBA_NUM_THREADS:
        raise ValueError(f"threads must be at most numba's {numba.config.NUMBA_NUM_THREADS}, got {count}")
    try:
        torch.set_num_threads(count)
        if numba is not None:
            numba.set_num_threads(count)
        yield
    finally:
        torch.set_num_threads(before)
        if numba is not None:
            numba.set_num_threads(before_numba)


@dataclass
class Stopwatch:
    """Wall-clock and processor times of calls by name [ms]."""

    wall: dict[str, list[float]] = field(default_factory=dict)
    cpu: dict[str, list[float]] = field(default_factory=dict)

    def time(self, name: str, function: Callable[..., Any], *args: Any) -> Any:
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


class StageClock:
    """Times the stages of one step after the other by wrapping a backend's functions.

    Use: ``start()``, then ``checked()`` between the check and the step, then ``stop()``. What lies between
    two kernels (changes of frame, padding, masks) counts to the stage that needs it:

    check: the checks of the frame's input. segment: SPGF and the floor of its covariances. correspond:
    the mixture into the camera frame, and the matching. fuse: making room, the segments into the first
    camera's frame, and the fusion. append: the new components, and the mixture into the camera frame.
    regress: the dense regression alone. average: masks, moving average, statistics, the new state.
    """

    def __init__(self) -> None:
        self.stages: dict[str, list[float]] = {name: [] for name in STAGES}
        self.kernels: dict[str, list[float]] = {name: [] for name in _TIMED}
        self._begin: dict[str, float] = {}
        self._end: dict[str, float] = {}

    def wrap(self, backend: Backend) -> Backend:
        """The same backend, every function of which notes when it begins and ends."""
        return replace(backend, **{name: self._noted(name, getattr(backend, name)) for name in _TIMED})

    def start(self) -> None:
        """A step begins, with its check."""
        self._begin, self._end = {"step": time.perf_counter()}, {}

    def checked(self) -> None:
        """The check is done."""
        self._end["check"] = time.perf_counter()

    def stop(self) -> None:
        """The step is done: add the time of every stage [ms].

        Raises:
            RuntimeError: a function of the backend was not called since ``start``.
        """
        self._end["step"] = time.perf_counter()
        missing = [name for name in _TIMED if name not in self._end]
        if missing:
            raise RuntimeError(f"the step did not call {', '.join(missing)} of its backend")
        end, begin = self._end, self._begin
        edges = (
            begin["step"], end["check"], end["floor_covariance"], end["correspond"], end["fuse"],
            begin["regress_image"], end["regress_image"], end["step"],
        )  # fmt: skip
        for name, start, stop in zip(STAGES, edges[:-1], edges[1:], strict=True):
            self.stages[name].append(1e3 * (stop - start))
        for name in _TIMED:
            self.kernels[name].append(1e3 * (end[name] - begin[name]))

    def drop(self, count: int) -> None:
        """Forget the first ``count`` steps: the warm-up."""
        for times in (*self.stages.values(), *self.kernels.values()):
            del times[:count]

    def summary(self) -> Mapping[str, Any]:
        """Spread of every stage, of every kernel within its stage, and of the steps' sums."""
        totals = np.sum([self.stages[name] for name in STAGES], axis=0)
        return {
            "stages": {name: spread(times) for name, times in self.stages.items()},
            "kernels": {name: spread(times) for name, times in self.kernels.items()},
            "stages_total": spread(totals),
        }

    def _noted(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def noted(*args: Any, **kwargs: Any) -> Any:
            self._begin[name] = time.perf_counter()
            result = function(*args, **kwargs)
            self._end[name] = time.perf_counter()
            return result

        return noted
