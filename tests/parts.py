"""Parts of compiled kernels as functions that Python calls."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numba


@functools.cache
def compiled(part: Callable[..., Any]) -> Callable[..., Any]:
    return numba.njit(lambda *arguments: part(*arguments))
