"""One thread that reads frames ahead of the loop, and threads that write and judge them behind it.

Decoding, compressing and writing release Python's lock, while network and step process the next frames.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

_AHEAD = 2  # frames
_WAITING = 2  # largest number of waiting calls of a thread; each holds the maps of a frame, about 3 MB at 224 x 224
Read = TypeVar("Read")


def read_ahead(read: Callable[[int], Read], indices: Iterable[int]) -> Generator[Future[Read]]:
    """Yield what ``read`` returns for some indices, in order, read by one thread at most two ahead. Its error is raised
    by ``result()``. Closing the generator ends the thread."""
    thread, reading = ThreadPoolExecutor(1), deque[Future[Read]]()
    try:
        for index in indices:
            reading.append(thread.submit(read, index))
            if len(reading) > _AHEAD:
                yield reading.popleft()
        yield from reading
    finally:
        thread.shutdown(cancel_futures=True)


@contextmanager
def call_behind() -> Iterator[Callable[..., None]]:
    """A function that calls a function with arguments in another thread, in order, and waits if the queue is full. The
    end of the context waits until all calls have ended; a second interrupt cancels those that have not begun. The error
    of a call is raised at the next call or at the end; no later call is made."""
    thread, waiting, intact = ThreadPoolExecutor(1), deque[Future[None]](), True

    def work(function: Callable[..., object], arguments: tuple[Any, ...]) -> None:
        nonlocal intact
        if intact:
            intact = False
            function(*arguments)
            intact = True

    def settle(most: int) -> None:
        """Wait until at most ``most`` calls are queued. Raises the error of a finished one."""
        while waiting and (len(waiting) > most or waiting[0].done()):
            waiting.popleft().result()

    def call(function: Callable[..., object], *arguments: Any) -> None:
        settle(_WAITING)
        waiting.append(thread.submit(work, function, arguments))

    try:
        try:
            yield call
        finally:
            settle(0)
    finally:
        thread.shutdown(cancel_futures=True)
