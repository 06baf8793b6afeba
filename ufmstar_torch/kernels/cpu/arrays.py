"""Tensors as arrays for compiled code."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_HALVES = (torch.float16, torch.bfloat16)


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
