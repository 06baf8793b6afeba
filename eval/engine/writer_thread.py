"""Computes metrics and writes files in another thread, while network and step process the next frames.

Compressing and writing release Python's lock. The thread processes frames in order.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

# Largest number of waiting calls; each holds the maps of a frame, about 3 MB at 224 x 224.
_WAITING = 4


class WriterThread:
    """Calls functions in another thread, in order.

    Use it as a context manager; its exit waits until all calls have ended. The error of a call is raised at the next
    call or at the exit; no later call is made.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1)
        self._waiting: deque[Future[None]] = deque()
        self._intact = True

    def __enter__(self) -> WriterThread:
        return self

    def __exit__(self, *_: object) -> None:
        """Wait until all calls have ended; a second interrupt cancels those that have not begun."""
        try:
            self._wait(0)
        finally:
            self._thread.shutdown(cancel_futures=True)

    def call(self, function: Callable[..., object], *arguments: Any) -> None:
        """Queue a call; wait if the queue is full. Raises the error of an earlier call."""
        self._wait(_WAITING)
        self._waiting.append(self._thread.submit(self._work, function, arguments))

    def _wait(self, most: int) -> None:
        """Wait until at most ``most`` calls are queued. Raises the error of a finished one."""
        while self._waiting and (len(self._waiting) > most or self._waiting[0].done()):
            self._waiting.popleft().result()

    def _work(self, function: Callable[..., object], arguments: tuple[Any, ...]) -> None:
        if self._intact:
            self._intact = False
            function(*arguments)
            self._intact = True
