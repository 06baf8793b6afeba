"""Frames that are read ahead: decoded and prepared in a thread while the frames before them are computed."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor

from ufmstar_torch.eval.sequences.frame import Frame, FrameSequence

_AHEAD = 2  # frames; decoding releases Python's lock


class Prefetch:
    """The frames of a sequence at some indices, in order, read by one thread that is at most two frames ahead and calls
    ``prepare`` with each. Use it as a context; the thread ends with the block."""

    def __init__(
        self, sequence: FrameSequence, indices: Iterable[int], prepare: Callable[[Frame], None] = lambda _: None
    ) -> None:
        self._sequence, self._left, self._prepare = sequence, iter(indices), prepare
        self._thread = ThreadPoolExecutor(1)
        self._reading: deque[Future[Frame]] = deque()

    def __enter__(self) -> Prefetch:
        return self

    def __exit__(self, *_: object) -> None:
        self._thread.shutdown(cancel_futures=True)

    def next(self) -> Frame:
        """The next frame.

        Raises:
            FrameError: it cannot be read.
            StopIteration: the last one was read before.
        """
        while len(self._reading) <= _AHEAD and (index := next(self._left, None)) is not None:
            self._reading.append(self._thread.submit(self._read, index))
        if not self._reading:
            raise StopIteration
        return self._reading.popleft().result()

    def _read(self, index: int) -> Frame:
        frame = self._sequence[index]
        self._prepare(frame)
        return frame
