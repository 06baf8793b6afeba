"""What no implementation of a stage can fall below: its least memory traffic and arithmetic, over this machine's rates.

Bytes are those that enter and leave a stage once (float32 maps, 44 bytes a Gaussian: mean, six of the covariance,
disagreement and weight), operations those of its formulas for the pixels, segments, pairs and components of the frames
measured. A stage's floor is the larger of the two times. Pixels of several components, culling and sorting come on top.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import torch

_GAUSSIAN = 44  # bytes
_COPIED = 2**26  # bytes, beyond the caches of most processors
_MATRIX = 768
_ROUNDS = 8
# Operations: of a pixel in segmentation (unproject 6, moments 18, tests 8), of a projected component (rotate 15,
# project 12, covariance 72), of a pair's overlap (20), of a pair's fusion (two square roots of 3 x 3 matrices and
# products), and of one component at a pixel (quadratic form 9, exponential 8, conditional mean and sums 8).
_SEGMENT, _PROJECT, _OVERLAP, _FUSE, _REGRESS = 32, 99, 20, 600, 25


def machine_rates() -> dict[str, float]:
    """The best of several turns: "bytes_per_second" of a copy (read and written), "flops_per_second" of a product of
    single-precision matrices."""
    source = torch.ones(_COPIED // 4)
    target = torch.empty_like(source)
    matrix = torch.rand(_MATRIX, _MATRIX)
    copied, multiplied = float("inf"), float("inf")
    for _ in range(_ROUNDS):
        started = time.perf_counter()
        target.copy_(source)
        between = time.perf_counter()
        matrix @ matrix
        copied = min(copied, between - started)
        multiplied = min(multiplied, time.perf_counter() - between)
    return {"bytes_per_second": 2 * _COPIED / copied, "flops_per_second": 2 * _MATRIX**3 / multiplied}


def stage_floors(size: int, counts: Mapping[str, Mapping[str, float]], rates: Mapping[str, float]) -> dict[str, Any]:
    """By stage "bytes", "flops" and "ms".

    Args:
        size: of the square maps [px].
        counts: "segments", "matched", "new" and "in_view" of the frames, with their "median".
        rates: :func:`machine_rates`.
    """
    pixels = size**2
    segments, matched, new, seen = (counts[name]["median"] for name in ("segments", "matched", "new", "in_view"))
    work = {
        "check": (4 * pixels, pixels),
        "segment": (4 * pixels + _GAUSSIAN * segments, _SEGMENT * pixels),
        "correspond": (_GAUSSIAN * (segments + seen), _PROJECT * seen + _OVERLAP * matched),
        "fuse": (3 * _GAUSSIAN * matched, _FUSE * matched),
        "append": (2 * _GAUSSIAN * new, 0),
        "regress": (8 * pixels + _GAUSSIAN * seen, _REGRESS * pixels),
        "average": (12 * pixels, 3 * pixels),
    }
    return {
        stage: {
            "bytes": moved,
            "flops": flops,
            "ms": 1000 * max(moved / rates["bytes_per_second"], flops / rates["flops_per_second"]),
        }
        for stage, (moved, flops) in work.items()
    }
