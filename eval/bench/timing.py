"""Timed calls in alternating order, the stages of a step, and a fixed number of threads.

Wall-clock times on a machine with other load have a long upper tail: the median and the quartiles, which the tail
hardly moves, and the minimum are reported. The processor time is what the process itself computed, over all its
threads (threads that wait by spinning included), without what other processes took.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib import import_module
from importlib.util import find_spec
from typing import Any, TypeVar

import numpy as np
import torch

from ufmstar_torch import UfMStar
from ufmstar_torch.eval.engine.clock import CallTimes, StageTimer, spread, synchronize

F = TypeVar("F")
Name = TypeVar("Name", bound=Hashable)

# Every moment of a step belongs to one of these; see ``ufmstar_torch.step_parts.StepObserver``.
STAGES = ("check", "segment", "correspond", "fuse", "append", "regress", "average")
_CPU = torch.device("cpu")


@contextmanager
def pinned_threads(count: int) -> Iterator[None]:
    """Set the number of threads of torch, numba and OpenCV; restore the previous numbers afterwards.

    Raises:
        ValueError: ``count`` is not positive or more than numba has started.
    """
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


class TimedCalls:
    """Calls on the same frames, one after the other, each timed; ``times`` has them by name.

    On odd frames the order is reversed: no call always follows the same neighbour, and a busy machine slows all calls
    of a frame alike.
    """

    def __init__(self) -> None:
        self.times = CallTimes()
        self._number = 0

    def frames(self, frames: Iterable[F], *, warm_up: int = 0) -> Iterator[F]:
        """The frames; after the last one, the times of the first ``warm_up`` are dropped."""
        for self._number, frame in enumerate(frames):
            yield frame
        self.times.drop(warm_up)

    def call(self, calls: Mapping[Name, Callable[[], Any]], device: torch.device = _CPU) -> dict[Name, Any]:
        """Make every call on the current frame; the results by name.

        Args:
            calls: by name.
            device: where they compute; it is waited for before and within the timed span.
        """

        def finished(call: Callable[[], Any]) -> Any:
            result = call()
            synchronize(device)
            return result

        results = {}
        for name in list(calls)[:: -1 if self._number % 2 else 1]:
            synchronize(device)
            results[name] = self.times.time(name, finished, calls[name])
        return results


class StagedStep:
    """UfM* with the times of its steps' stages: the observer (``ufmstar_torch.step_parts.StepObserver``) of a module.

    The stages are those that the step names; what follows the last one, the output's assembly, belongs to none. The
    module's device is waited for at both ends of every stage.
    """

    def __init__(self, module: UfMStar, device: torch.device = _CPU) -> None:
        self.module, self._timer = module, StageTimer(device)
        self.stages: dict[str, list[float]] = {name: [] for name in STAGES}
        module.observer = self

    def __call__(self, *args: Any) -> Any:
        """One step of the module."""
        self._timer.take()
        return self.module(*args)

    def stage(self, name: str) -> None:
        """A stage has ended; the last one ends the step."""
        self._timer.lap(name)
        if name == STAGES[-1]:
            ms = self._timer.take()
            for stage, times in self.stages.items():
                times.append(ms.get(stage, 0.0))

    def kernel(self, name: str) -> AbstractContextManager[object]:
        """Kernels are not timed."""
        return nullcontext()

    def summary(self, *, warm_up: int) -> dict[str, Any]:
        """Spread of every stage and of the steps' sums; the first ``warm_up`` steps do not count."""
        return {
            "stages": {name: spread(times[warm_up:]) for name, times in self.stages.items()},
            "stages_total": spread(np.sum(list(self.stages.values()), axis=0)[warm_up:]),
        }
