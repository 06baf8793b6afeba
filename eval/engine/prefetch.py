"""Frames that are read ahead: decoded and prepared in a thread while the frames before them are computed."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor

from ufmstar_torch.eval.sequences.frame import Frame, FrameSequence

_AHEAD = 2  # frames; decoding releases Python's lock


def prefetch(
    sequence: FrameSequence, indices: Iterable[int], prepare: Callable[[Frame], None] = lambda _: None
) -> Generator[Future[Frame]]:
    """The frames of a sequence at some indices, in order, read by one thread that is at most two frames ahead and calls
    ``prepare`` with each. A frame's ``result()`` raises FrameError if it cannot be read. Closing it ends the thread."""

    def read(index: int) -> Frame:
        frame = sequence[index]
        prepare(frame)
        return frame

    thread, reading = ThreadPoolExecutor(1), deque[Future[Frame]]()
    try:
        for index in indices:
            reading.append(thread.submit(read, index))
            if len(reading) > _AHEAD:
                yield reading.popleft()
        yield from reading
    finally:
        thread.shutdown(cancel_futures=True)
