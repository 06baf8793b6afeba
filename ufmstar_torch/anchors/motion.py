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

from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.saved_state import SavedState

KINDS = SEARCH, LANDMARK, LINE = range(3)
# By kind: c_k, weight, and the first F_k, which counts as _FIRST tests.
_CAUGHT, _WEIGHT = np.array([0.4, 0.4, 0.1]), np.array([0.22, 0.43, 0.87])
_FAILING, _FIRST = np.array([0.4, 0.06, 0.06]), 50.0
_LEAST, _MOST = 0.02, 0.98  # limits of F_k
_WINDOW = 1.5  # standard deviation of the window [cells]
_CERTAIN = 1.9  # log ratio from which a surface counts as moving: motion is then more probable, by the prior odds
OFF_LINE = 9.0  # squared distance of a match from its line, over its variance, from which the test fails


class Tested(NamedTuple):
    """N tests of one image.

    Attributes:
        pixel: [N, 2] (u, v).
        kind: [N] of ``KINDS``.
        failed: [N] bool.
    """

    pixel: NDArray[np.float64]
    kind: NDArray[np.int64]
    failed: NDArray[np.bool_]

    @classmethod
    def of(cls, *parts: tuple[NDArray[np.float64], int, NDArray[np.bool_]]) -> Tested:
        """Tests by kind: pixels [n, 2], kind, and [n] whether they failed."""
        kinds = [np.full(len(pixel), kind) for pixel, kind, _ in parts]
        pixels, failed = [pixel for pixel, *_ in parts], [failed for *_, failed in parts]
        return cls(np.concatenate(pixels), np.concatenate(kinds), np.concatenate(failed))


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

    def log_ratios(self, tested: Tested, size: tuple[int, int], cell: int) -> NDArray[np.float64]:
        """[R, C] log likelihood ratio of motion against rest in each cell, 0 without a test; updates F_k.

        Args:
            tested: of the image.
            size: (H, W) of the image [px].
            cell: side of a cell [px].
        """
        count = np.bincount(tested.kind, minlength=len(KINDS))
        self._count = self._memory * self._count + count
        self._failed = self._memory * self._failed + np.bincount(tested.kind, tested.failed, len(KINDS))
        failing = (self._failed / np.maximum(self._count, 1e-9)).clip(_LEAST, _MOST)
        fails = _WEIGHT * np.log((failing + (1 - failing) * _CAUGHT) / failing)
        passes = _WEIGHT * np.log(1 - _CAUGHT)
        rows, cols = -(-size[0] // cell), -(-size[1] // cell)
        column, row = (tested.pixel / cell).astype(np.int64).clip(0, [cols - 1, rows - 1]).T
        value = np.where(tested.failed, fails[tested.kind], passes[tested.kind])
        cells = np.bincount(row * cols + column, value, rows * cols).reshape(rows, cols)
        around: NDArray[np.float64] = _window(rows) @ cells @ _window(cols)
        return around


def moves(ratios: NDArray[np.float64], pixel: NDArray[np.float64], cell: int) -> NDArray[np.bool_]:
    """Which pixels [N, 2] lie in a cell that moves, from the log ratios [R, C] of the cells."""
    column, row = (pixel / cell).astype(np.int64).T
    return ratios[row.clip(0, len(ratios) - 1), column.clip(0, ratios.shape[1] - 1)] > _CERTAIN


def located(ratios: NDArray[np.float64], cell: int) -> NDArray[np.float64]:
    """[R C, 3] the centre (u, v) of every cell [px], and its log ratio [R, C]."""
    row, column = np.indices(ratios.shape)
    centres = ((x + 0.5) * cell - 0.5 for x in (column, row))
    return np.stack([*centres, ratios], -1).reshape(-1, 3)


def _window(count: int) -> NDArray[np.float64]:
    """[count, count] Gaussian weights between cells."""
    position = np.arange(count) / _WINDOW
    return np.exp(-np.square(position[:, None] - position) / 2)
