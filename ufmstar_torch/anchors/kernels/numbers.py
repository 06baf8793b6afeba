"""Medians, and tests of numbers, in compiled code."""

from __future__ import annotations

import sys

from ufmstar_torch.kernels.compile_cpu import leaf
from ufmstar_torch.kernels.cpu.sample import smallest

# The median of the square of a standard normal variable.
MEDIAN_SQUARE = 0.4549
_LARGEST = sys.float_info.max


@leaf
def finite(value):
    """False for NaN and infinity. In a kernel whose sums may be reordered, ``np.isfinite`` of a sum is always true: it
    tests x - x, which cancels."""
    return abs(value) <= _LARGEST


@leaf
def median(values, count):
    """The median of the first ``count`` values, at least one, which are reordered."""
    return (smallest(values, count, (count - 1) // 2) + smallest(values, count, count // 2)) / 2
