"""Calls of compiled code: tensors as arrays, and work on several threads.

numba's parallel loops start OpenMP, which resets torch's number of threads to all cores. Compiled code, which releases
the GIL, therefore runs on a thread pool that lasts from call to call.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_HALVES = (torch.float16, torch.bfloat16)
_SHARE = 160 * 160  # pixels; below that a thread costs more than it saves


def array(value: Tensor) -> NDArray[Any]:
    """A contiguous array on the CPU that shares the tensor's memory where it can; half and bfloat16 become float32.

    A call of torch takes microseconds, and several times longer after a network has evicted the CPU's caches: calls
    without effect are skipped.
    """
    if value.requires_grad:
        value = value.detach()
    if value.dtype in _HALVES:
        value = value.to(torch.float32)
    return np.ascontiguousarray((value if value.is_cpu else value.cpu()).numpy())


def arrays(*tensors: Tensor) -> list[NDArray[Any]]:
    """As :func:`array`, of tensors on the CPU without a graph, none of which is half."""
    return list(map(np.ascontiguousarray, map(Tensor.numpy, tensors)))


def each(function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
    """The results of ``function`` for every tuple of arguments, on as many threads as torch may use."""
    if len(arguments) == 1:
        return [function(*arguments[0])]
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
    threads = torch.get_num_threads()
    return 1 if threads <= streams else max(1, min(-(-threads // streams), pixels // _SHARE))


@functools.lru_cache(maxsize=2)
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """The threads of a process, by its id: a forked process has none of its parent's threads."""
    return ThreadPoolExecutor(threads, thread_name_prefix="ufmstar")
