"""Runs compiled code, which releases the GIL, on several threads.

numba's parallel loops start OpenMP, which resets torch's number of threads to all cores. This module uses a thread pool
instead, which lasts from call to call.
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
    # The calls are independent: their distribution over threads changes no result. This thread has the last share.
    pool = _pool(os.getpid(), threads - 1)
    local = range(threads - 1, len(arguments), threads)
    others = {i: pool.submit(function, *arguments[i]) for i in range(len(arguments)) if i not in local}
    results = {i: function(*arguments[i]) for i in local} | {i: other.result() for i, other in others.items()}
    return [results[i] for i in range(len(arguments))]


def shares_of_stream(streams: int, pixels: int) -> int:
    """Number of parts of the work on each of ``streams`` images with so many ``pixels``."""
    return max(1, min(-(-torch.get_num_threads() // streams), pixels // _SHARE))


@functools.lru_cache(maxsize=2)
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """The threads of a process, by its id: a forked process has none of its parent's threads."""
    return ThreadPoolExecutor(threads, thread_name_prefix="ufmstar")
