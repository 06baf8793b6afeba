"""Clocks of the benchmark: pinned threads, robust statistics, and the stages of a step.

Wall-clock times on a machine that does other work too have a long upper tail: reported are the median and
the quartiles, which the tail hardly moves, and the minimum. The processor time beside it counts what
the process itself computed (over all its threads, waiting ones that spin included), not what others took.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch

from ufmstar_torch.backend import Backend
from ufmstar_torch.eval.engine.clock import spread

# Every moment of a step belongs to one of these; see StageClock.stages.
STAGES = ("check", "segment", "correspond", "fuse", "append", "regress", "average")
_TIMED = ("spgf", "floor_covariance", "correspond", "fuse", "regress_image")


@contextmanager
def pinned_threads(count: int) -> Iterator[None]:
    """Let torch and numba (where it is installed) use ``count`` threads each; afterwards what they used before.

    Raises:
        ValueError: ``count`` is not positive or more than numba has started.
    """
    if count < 1:
        raise ValueError(f"threads must be at least 1, got {count}")
    numba: Any = import_module("numba") if find_spec("numba") is not None else None
    if numba is not None and count > numba.config.NUMBA_NUM_THREADS:
        raise ValueError(f"threads must be at most numba's {numba.config.NUMBA_NUM_THREADS}, got {count}")
    before, before_numba = torch.get_num_threads(), numba and numba.get_num_threads()
    try:
        # torch last: where numba's loops run on OpenMP, setting its number sets torch's as well.
        if numba is not None:
            numba.set_num_threads(count)
        torch.set_num_threads(count)
        yield
    finally:
        if numba is not None:
            numba.set_num_threads(before_numba)
        torch.set_num_threads(before)


class StageClock:
    """Times the stages of one step after the other by wrapping a backend's functions.

    Use: ``start()``, then ``checked()`` between the check and the step, then ``stop()``. What lies between
    two kernels (changes of frame, padding, masks) counts to the stage that needs it:

    check: the checks of the frame's input. segment: SPGF and the floor of its covariances. correspond:
    the mixture into the camera frame, and the matching. fuse: making room, the segments into the first
    camera's frame, and the fusion. append: the new components, and the mixture into the camera frame.
    regress: the mixture made ready, and the dense regression. average: masks, moving average, statistics,
    the new state.
    """

    def __init__(self) -> None:
        self.stages: dict[str, list[float]] = {name: [] for name in STAGES}
        self.kernels: dict[str, list[float]] = {name: [] for name in _TIMED}
        self._calls: list[tuple[str, float, float]] = []
        self._start = self._checked = 0.0

    def wrap(self, backend: Backend) -> Backend:
        """The same backend, every function of which notes when it begins and ends."""
        noted: dict[str, Any] = {name: self._noted(name, getattr(backend, name)) for name in _TIMED}
        return replace(backend, **noted)

    def start(self) -> None:
        """A step begins, with its check."""
        self._calls = []
        self._start = time.perf_counter()

    def checked(self) -> None:
        """The check is done."""
        self._checked = time.perf_counter()

    def stop(self) -> None:
        """The step is done: add the time of every stage and of every kernel [ms].

        Raises:
            RuntimeError: the step did not call its backend's functions in the order of the stages.
        """
        stop = time.perf_counter()
        names = [name for name, _, _ in self._calls]
        if list(dict.fromkeys(names)) != list(_TIMED):
            raise RuntimeError(f"expected the step to call {', '.join(_TIMED)} first in this order, got {names}")
        end = {name: last for name, _, last in reversed(self._calls)}  # of the first call
        after_fusion = self._calls[names.index("fuse") + 1][1]
        edges = (
            self._start, self._checked, end["floor_covariance"], end["correspond"], end["fuse"], after_fusion,
            end["regress_image"], stop,
        )  # fmt: skip
        for name, low, high in zip(STAGES, edges[:-1], edges[1:], strict=True):
            self.stages[name].append(1e3 * (high - low))
        for kernel in _TIMED:
            self.kernels[kernel].append(1e3 * sum(high - low for name, low, high in self._calls if name == kernel))

    def drop(self, count: int) -> None:
        """Forget the first ``count`` steps: the warm-up."""
        for times in (*self.stages.values(), *self.kernels.values()):
            del times[:count]

    def summary(self) -> Mapping[str, Any]:
        """Spread of every stage, of every kernel (all its calls in a step), and of the steps' sums."""
        totals = np.sum([self.stages[name] for name in STAGES], axis=0)
        return {
            "stages": {name: spread(times) for name, times in self.stages.items()},
            "kernels": {name: spread(times) for name, times in self.kernels.items()},
            "stages_total": spread(totals),
        }

    def _noted(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def noted(*args: Any, **kwargs: Any) -> Any:
            begin = time.perf_counter()
            result = function(*args, **kwargs)
            self._calls.append((name, begin, time.perf_counter()))
            return result

        return noted
