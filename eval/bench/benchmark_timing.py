"""Clocks of the benchmark: pinned threads, robust statistics, and the stages of a step.

Wall-clock times on a machine that does other work too have a long upper tail: reported are the median and
the quartiles, which the tail hardly moves, and the minimum. The processor time beside it counts what
the process itself computed (over all its threads, waiting ones that spin included), not what others took.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch

from ufmstar_torch.eval.engine.clock import spread

# Every moment of a step belongs to one of these; see ``ufmstar_torch.step.StepObserver``.
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
    """Times the stages of one step after the other: an observer of the step (``ufmstar_torch.step.StepObserver``).

    Use: ``start()``, then a call of the module whose ``observer`` it is. The stages are those that the step names;
    what follows the last one, the output's assembly, belongs to none.

    Args:
        wait: waits for the device that computes, before every reading of the clock.
    """

    def __init__(self, wait: Callable[[], None] = lambda: None) -> None:
        self.stages: dict[str, list[float]] = {name: [] for name in STAGES}
        self.kernels: dict[str, list[float]] = {name: [] for name in _TIMED}
        self._wait, self._last = wait, 0.0
        self._in_step = dict.fromkeys(_TIMED, 0.0)

    def start(self) -> None:
        """A step begins, with its check."""
        self._in_step = dict.fromkeys(_TIMED, 0.0)
        self._last = self._now()

    def stage(self, name: str) -> None:
        """A stage has ended; the last one ends the step."""
        now = self._now()
        self.stages[name].append(1e3 * (now - self._last))
        self._last = now
        if name == STAGES[-1]:
            for kernel, seconds in self._in_step.items():
                self.kernels[kernel].append(1e3 * seconds)

    @contextmanager
    def kernel(self, name: str) -> Iterator[None]:
        """Around one call of a kernel."""
        begin = self._now()
        yield
        if name in self._in_step:
            self._in_step[name] += self._now() - begin

    def _now(self) -> float:
        self._wait()
        return time.perf_counter()

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
