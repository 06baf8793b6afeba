"""Launch of Triton kernels."""

from __future__ import annotations

import os
from contextlib import nullcontext
from typing import Any

import torch
from torch import Tensor


def interpreted() -> bool:
    """True if Triton was imported to run kernels in its interpreter, on CPU tensors."""
    return os.environ.get("TRITON_INTERPRET", "0") == "1"


def launch(
    kernel: Any, grid: tuple[int, ...], *arguments: Any, warps: int = 4, fused: bool = False, **meta: Any
) -> None:
    """Queue a kernel on the current stream of its tensors' device.

    Args:
        kernel: compiled by ``triton.jit``.
        grid: numbers of programs; if one is 0, nothing runs.
        arguments: tensors (contiguous), integers.
        warps: number of warps of 32 threads in a program.
        fused: whether to contract products and sums (fused multiply-add). Kernels that decide by thresholds must not:
            their decisions would differ from the CPU's.
        meta: compile-time constants. Floats must be constants, since an argument would be rounded to float32.
    """
    if 0 in grid:
        return
    device = next(a.device for a in arguments if isinstance(a, Tensor))
    with torch.cuda.device(device) if device.type == "cuda" else nullcontext():
        kernel[grid](*arguments, num_warps=warps, enable_fp_fusion=fused, **meta)


def power_of_two(n: int) -> int:
    """The least power of two that is at least n, and at least 1."""
    return 1 << max(n - 1, 0).bit_length()
