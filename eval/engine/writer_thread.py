"""Computes metrics and writes files in another thread, while network and step process the next frames.

Compressing and writing release Python's lock. The thread processes frames in order.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from time import perf_counter

from ufmstar_torch.eval.engine.stream import FrameResult, FrameSink, FrameStream

# Largest number of queued frames; each holds its maps and the state after it, about 3 MB at 224 x 224.
_WAITING = 4


class WriterThread(FrameSink):
    """A sink that passes the results to other sinks in another thread, with the stream's state after each frame.

    Use it as a context manager; its exit waits until the sinks have processed all results. The error of a sink is
    raised in the loop, at the next frame or at the end; no sink gets a later frame. ``FrameResult.ms`` gets "cycle",
    the time since the previous frame [ms], waiting for these sinks included.
    """

    def __init__(self, sinks: Sequence[FrameSink]) -> None:
        self._sinks = tuple(sinks)
        self._thread = ThreadPoolExecutor(1)
        self._waiting: deque[Future[None]] = deque()
        self._intact = True

    def __enter__(self) -> WriterThread:
        return self

    def __exit__(self, *_: object) -> None:
        """Wait until all results are processed; a second interrupt cancels those that have not begun."""
        try:
            self._wait(0)
        finally:
            self._thread.shutdown(cancel_futures=True)

    def begin(self, stream: FrameStream) -> None:
        self._stream = stream
        for sink in self._sinks:
            sink.begin(stream)
        self._last = perf_counter()

    def take(self, result: FrameResult) -> None:
        """Queue a frame; wait if the queue is full. Raises the error of a sink for an earlier frame."""
        self._wait(_WAITING)
        rows = self._stream.state().items()
        state = {key: {name: value.clone() for name, value in tensors.items()} for key, tensors in rows}
        time = perf_counter()
        result.ms["cycle"] = 1000 * (time - self._last)
        self._last = time
        self._waiting.append(self._thread.submit(self._work, replace(result, state=state)))

    def end(self) -> None:
        self._wait(0)
        for sink in self._sinks:
            sink.end()

    def _wait(self, most: int) -> None:
        """Wait until at most ``most`` frames are queued. Raises the error of a finished frame."""
        while self._waiting and (len(self._waiting) > most or self._waiting[0].done()):
            self._waiting.popleft().result()

    def _work(self, result: FrameResult) -> None:
        if not self._intact:
            return
        self._intact = False
        for sink in self._sinks:
            sink.take(result)
        self._intact = True
