"""Compiled code that releases the GIL, on several threads at a time.

Threads of our own and not numba's parallel loops: those start OpenMP, which puts torch's number of threads back to all
cores. They are kept from call to call.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch

_SHARE = 160 * 160  # pixels; below that a thread costs more than it saves


def each(function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
    """The results of ``function`` for every tuple of arguments, on as many threads as torch may use."""
    threads = min(torch.get_num_threads(), len(arguments))
    if threads <= 1:
        return [function(*one) for one in arguments]
    # The calls are independent: which thread takes which changes no result. The last one is this thread's own.
    pool = _pool(os.getpid(), threads - 1)
    here = range(threads - 1, len(arguments), threads)
    others = {i: pool.submit(function, *arguments[i]) for i in range(len(arguments)) if i not in here}
    results = {i: function(*arguments[i]) for i in here} | {i: other.result() for i, other in others.items()}
    return [results[i] for i in range(len(arguments))]


def shares_of_stream(streams: int, pixels: int) -> int:
    """Into how many parts to divide the work on each of ``streams`` images of so many pixels."""
    return max(1, min(-(-torch.get_num_threads() // streams), pixels // _SHARE))


@functools.lru_cache(maxsize=2)
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """The kept threads of a process; a forked one has none of its parent's."""
    return ThreadPoolExecutor(threads, thread_name_prefix="ufmstar")
