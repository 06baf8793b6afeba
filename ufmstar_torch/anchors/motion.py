"""Tests in the images of whether a surface stands still, and the log likelihood ratio of motion that they add up to.

A surface that stands still passes three tests, up to errors of the matching:

- search: a textured pixel that two keyframes show has a depth on which they agree;
- landmark: a landmark of earlier images appears where the pose puts it, unless something hides it;
- line: a match lies on its epipolar line.

A test of kind k fails on a still surface with the probability F_k, estimated from the stream, and on a surface that
moves with F_k + (1 - F_k) c_k. So a test contributes log((F_k + (1 - F_k) c_k)/F_k) if it fails, else log(1 - c_k).
Neighbouring tests are not independent, which the weights of the kinds account for. The log ratio of a cell is the sum
of the contributions around it in a Gaussian window. Motion along the epipolar line, in proportion to the camera's,
passes all tests.

The constants are fitted to tours with moving things (eight tours of 60 frames, 6 things each).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.saved_state import SavedState
from ufmstar_torch.kernels.compile_cpu import empty, reordered

KINDS = SEARCH, LANDMARK, LINE = range(3)
# By kind: c_k, weight, and the first F_k, which counts as _FIRST tests.
_CAUGHT, _WEIGHT = np.array([0.4, 0.4, 0.1]), np.array([0.22, 0.43, 0.87])
_FAILING, _FIRST = np.array([0.4, 0.06, 0.06]), 50.0
OFF_LINE = 9.0  # squared distance of a match from its line, over its variance, from which the test fails
_LEAST, _MOST = 0.02, 0.98  # limits of F_k
_WINDOW = 1.5  # standard deviation of the window [cells]
_CERTAIN = 1.9  # log ratio from which a surface counts as moving: motion is then more probable, by the prior odds


class MotionTest(NamedTuple):
    """N tests of one kind in an image.

    Attributes:
        kind: of ``KINDS``.
        pixel: [N, 2] (u, v).
        failed: [N] bool.
        used: [N] bool, False where there was no test.
    """

    kind: int
    pixel: NDArray[np.float64]
    failed: NDArray[np.bool_]
    used: NDArray[np.bool_]


class MotionTests(SavedState):
    """The log likelihood ratios of motion of an image's cells.

    Args:
        memory: share of the running estimates that remains after a frame.
    """

    HELD: ClassVar = {"_failed": "motion_failed", "_count": "motion_count"}

    def __init__(self, memory: float) -> None:
        self._memory = memory
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._count = np.full(len(KINDS), _FIRST)
        self._failed = _FAILING * _FIRST

    def log_ratios(self, tests: Iterable[MotionTest], size: tuple[int, int], cell: int) -> NDArray[np.float64]:
        """[R, C] log likelihood ratio of motion against rest in each cell, 0 without a test; updates F_k.

        Args:
            tests: of the image.
            size: (H, W) of the image [px].
            cell: side of a cell [px].
        """
        shape = -(-size[0] // cell), -(-size[1] // cell)
        counts, ratios = np.zeros((len(KINDS), 2, *shape)), np.empty(shape)
        for kind, pixel, failed, used in tests:
            _tally(pixel, failed, used, cell, counts[kind])
        _combine(counts, self._count, self._failed, self._memory, _CAUGHT, _WEIGHT, ratios)
        return ratios


def moves(ratios: NDArray[np.float64], pixel: NDArray[np.float64], cell: int) -> NDArray[np.bool_]:
    """Which pixels [N, 2] lie in a cell that moves, from the log ratios [R, C] of the cells."""
    result = np.empty(len(pixel), np.bool_)
    _mark(ratios, pixel, cell, result)
    return result


def located(ratios: NDArray[np.float64], cell: int) -> NDArray[np.float64]:
    """[R C, 3] the centre (u, v) of every cell [px], and its log ratio [R, C]."""
    result = np.empty((*ratios.shape, 3))
    result[..., 0], result[..., 2] = (np.arange(ratios.shape[1]) + 0.5) * cell - 0.5, ratios
    result[..., 1] = ((np.arange(ratios.shape[0]) + 0.5) * cell - 0.5)[:, None]
    return result.reshape(-1, 3)


@reordered
def _tally(pixel, failed, used, cell, out):
    """Count the used ones of N tests, passed or failed [N], in ``out`` [2, R, C] by cells of the pixels [N, 2]."""
    rows, columns = out.shape[1:]
    for n in range(len(pixel)):
        if used[n]:
            row, column = int(pixel[n, 1] / cell), int(pixel[n, 0] / cell)
            out[1 if failed[n] else 0, min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)] += 1


@reordered
def _combine(tests, count, failures, memory, caught, weight, ratios):
    """Write the log likelihood ratios of motion [R, C].

    Args:
        tests: [K, 2, R, C] by kind, see :func:`_tally`.
        count, failures: [K] running numbers of tests and of failed ones, updated.
        memory: share of them that remains.
        caught, weight: [K] c_k, and the weights of the tests.
        ratios: overwritten.
    """
    rows, columns = ratios.shape
    cells, smooth = empty((rows, columns), np.float64), empty((rows, columns), np.float64)
    window = empty(max(rows, columns), np.float64)
    for i in range(len(window)):
        window[i] = np.exp(-((i / _WINDOW) ** 2) / 2)
    for k in range(len(tests)):
        count[k] *= memory
        failures[k] *= memory
        for row in range(rows):
            for column in range(columns):
                count[k] += tests[k, 0, row, column] + tests[k, 1, row, column]
                failures[k] += tests[k, 1, row, column]
        failing = min(max(failures[k] / max(count[k], 1e-9), _LEAST), _MOST)
        fails = weight[k] * np.log((failing + (1 - failing) * caught[k]) / failing)
        passes = weight[k] * np.log(1 - caught[k])
        for row in range(rows):
            for column in range(columns):
                before = cells[row, column] if k > 0 else 0.0
                cells[row, column] = before + passes * tests[k, 0, row, column] + fails * tests[k, 1, row, column]
    for row in range(rows):
        for column in range(columns):
            smooth[row, column] = 0.0
        for other in range(rows):
            for column in range(columns):
                smooth[row, column] += window[abs(row - other)] * cells[other, column]
    for row in range(rows):
        for column in range(columns):
            total = 0.0
            for other in range(columns):
                total += window[abs(column - other)] * smooth[row, other]
            ratios[row, column] = total


@reordered
def _mark(ratios, pixel, cell, moving):
    """Write which pixels [N, 2] lie in a cell that moves, from the log ratios [R, C] of the cells."""
    rows, columns = ratios.shape
    for n in range(len(pixel)):
        row, column = int(pixel[n, 1] / cell), int(pixel[n, 0] / cell)
        moving[n] = ratios[min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)] > _CERTAIN
