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

KINDS = SEARCH, LANDMARK, LINE = range(3)
# By kind: c_k, weight, and the first F_k, which counts as _FIRST tests.
_CAUGHT, _WEIGHT = np.array([0.4, 0.4, 0.1]), np.array([0.22, 0.43, 0.87])
_FAILING, _FIRST = np.array([0.4, 0.06, 0.06]), 50.0
OFF_LINE = 9.0  # squared distance of a match from its line, over its variance, from which the test fails


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
        from ufmstar_torch.anchors.kernels.motion import combine, tally  # compiles when it is first needed

        shape = -(-size[0] // cell), -(-size[1] // cell)
        counts, ratios = np.zeros((len(KINDS), 2, *shape)), np.empty(shape)
        for kind, pixel, failed, used in tests:
            tally(pixel, failed, used, cell, counts[kind])
        combine(counts, self._count, self._failed, self._memory, _CAUGHT, _WEIGHT, ratios)
        return ratios


def moves(ratios: NDArray[np.float64], pixel: NDArray[np.float64], cell: int) -> NDArray[np.bool_]:
    """Which pixels [N, 2] lie in a cell that moves, from the log ratios [R, C] of the cells."""
    from ufmstar_torch.anchors.kernels.motion import mark  # compiles when it is first needed

    result = np.empty(len(pixel), np.bool_)
    mark(ratios, pixel, cell, result)
    return result


def located(ratios: NDArray[np.float64], cell: int) -> NDArray[np.float64]:
    """[R C, 3] the centre (u, v) of every cell [px], and its log ratio [R, C]."""
    result = np.empty((*ratios.shape, 3))
    result[..., 0], result[..., 2] = (np.arange(ratios.shape[1]) + 0.5) * cell - 0.5, ratios
    result[..., 1] = ((np.arange(ratios.shape[0]) + 0.5) * cell - 0.5)[:, None]
    return result.reshape(-1, 3)
