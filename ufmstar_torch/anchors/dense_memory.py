"""A memory of fixed size for landmarks that a camera has measured, which later images confirm or refute."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.epipolar import MEDIAN_SQUARE, median
from ufmstar_torch.anchors.saved_state import SavedState

if TYPE_CHECKING:
    from ufmstar_torch.anchors.kernels.landmarks import Columns

# Two measurements confirm each other if they differ by at most _SIGMAS standard deviations and the share _SHARE of the
# inverse depth, added in quadrature.
_SIGMAS, _SHARE = 3.5, 0.01
# Running estimate ``apart``: least number of measurements for an update, first value, and steps of the bisection.
_ENOUGH, _FIRST_APART, _STEPS = 10, 0.01**2, 8


@dataclass(frozen=True, eq=False)
class Sighted:
    """Landmarks in the present view.

    Attributes:
        slot: [n] in the memory.
        pixel: [n, 2] (u, v).
        rho: [n] inverse depth [1/m].
        variance: [n] of ``rho`` [1/m^2].
        due: [n] bool, True where they must be measured again.
        compared: [m, 2] pixels of all landmarks whose patch was compared with the image.
        hidden: [m] bool, True where the image shows something else there.
    """

    slot: NDArray[np.int64]
    pixel: NDArray[np.float64]
    rho: NDArray[np.float64]
    variance: NDArray[np.float64]
    due: NDArray[np.bool_]
    compared: NDArray[np.float64]
    hidden: NDArray[np.bool_]


class Memory(SavedState):
    """At most ``count`` landmarks.

    Args:
        count: number of landmarks.
        fading: share of the running estimate that remains after a frame.

    Attributes:
        apart: variance of an inverse depth, as a share of its square, beyond the stated one, from errors that views of
            one time share. It is estimated from measurements of the same landmarks at different times.
        confirmed: [count] number of later views that confirmed each landmark.
        frame: number of images so far.
    """

    HELD: ClassVar = {
        "_point": "landmark_point",
        "_pose": "landmark_pose",
        "_sigma": "landmark_sigma",
        "_patch": "landmark_patch",
        "_used": "landmark_used",
        "confirmed": "landmark_confirmed",
        "_failed": "landmark_failed",
        "_seen": "landmark_seen",
        "frame": "landmark_frame",
        "apart": "landmark_apart",
    }

    def __init__(self, count: int, fading: float) -> None:
        self._count, self._fading = count, fading
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        from ufmstar_torch.anchors.kernels.windows import SIDE

        n = self._count
        self._point, self._pose = np.zeros((n, 3)), np.tile(np.eye(4), (n, 1, 1))
        self._sigma = np.zeros(n)  # of the distance from the measuring camera, as a share of it
        self._patch = np.zeros((n, SIDE, SIDE), np.float32)
        self._used = np.zeros(n, dtype=np.bool_)
        self.confirmed, self._failed, self._seen = (np.zeros(n, np.int64) for _ in range(3))
        self.frame, self.apart = 0, _FIRST_APART

    def sighted(
        self, image: NDArray[np.uint8], T_world_cam: NDArray[np.float64], K: NDArray[np.float64], cell: int
    ) -> Sighted:
        """Find the landmarks that an image shows, at most one in a cell, and count failures of those it should show.

        Args:
            image: [H, W].
            T_world_cam: [4, 4] [m].
            K: [3, 3] [px].
            cell: side of a cell [px].
        """
        from ufmstar_torch.anchors.kernels.landmarks import sight

        self.frame += 1
        seen = sight(self._columns(), self.frame, image, T_world_cam, K, cell)
        compared = np.flatnonzero(seen.shown)
        tests = seen.pixel[compared], seen.shown[compared] < 0
        slot = seen.slot
        depth, spread = seen.depth[slot], seen.spread[slot]
        return Sighted(slot, seen.pixel[slot], 1 / depth, np.square(spread / np.square(depth)), seen.due, *tests)

    def _columns(self) -> Columns:
        from ufmstar_torch.anchors.kernels.landmarks import Columns

        of_cameras = self._point, self._pose, self._sigma, self._patch
        return Columns(*of_cameras, self._used, self.confirmed, self._failed, self._seen)

    @property
    def empty(self) -> bool:
        """True if there is no landmark."""
        return not self._used.any()

    def forget(self) -> None:
        """Delete all landmarks, but retain the running estimate."""
        self._used[:] = False

    def compare(
        self, sighted: Sighted, rho: NDArray[np.float64], variance: NDArray[np.float64], measured: NDArray[np.bool_]
    ) -> tuple[Sighted, NDArray[np.bool_]]:
        """Confirm or refute landmarks by new measurements.

        Args:
            sighted: n landmarks.
            rho: [n] new measurements [1/m].
            variance: [n] of ``rho`` [1/m^2].
            measured: [n] bool, True where there is a new measurement.

        Returns:
            The landmarks with old and new measurements merged; [n] True where not refuted.
        """
        from ufmstar_torch.anchors.kernels.landmarks import FAILURES

        spread, square = sighted.variance + variance, np.square(sighted.rho)
        difference = np.square(rho - sighted.rho)
        consistent = difference <= _SIGMAS**2 * (spread + self.apart * square) + _SHARE**2 * square
        if measured.sum() >= _ENOUGH:
            measured_variance = _beyond((difference / square)[measured], (spread / square)[measured])
            self.apart = self._fading * self.apart + (1 - self._fading) * measured_variance
        confirmed, refuted = measured & consistent, measured & ~consistent
        self.confirmed[sighted.slot[confirmed]] += 1
        self._failed[sighted.slot[refuted]] += 2
        self._used[sighted.slot[refuted & (self.confirmed[sighted.slot] == 0)]] = False
        again = sighted.slot[refuted]
        self._used[again[self._failed[again] > FAILURES + self.confirmed[again]]] = False
        old, new = 1 / sighted.variance, 1 / np.where(confirmed, variance, 1)
        merged = np.where(confirmed, (sighted.rho * old + rho * new) / (old + new), sighted.rho)
        # Measurements share keyframes and patches: merging them does not reduce the smaller variance.
        least = np.where(confirmed, np.minimum(sighted.variance, variance), sighted.variance)
        return replace(sighted, rho=merged, variance=least), ~refuted

    def write(
        self,
        slot: NDArray[np.int64] | None,
        image: NDArray[np.uint8],
        pixel: NDArray[np.float64],
        rho: NDArray[np.float64],
        variance: NDArray[np.float64],
        T_world_cam: NDArray[np.float64],
        K: NDArray[np.float64],
    ) -> None:
        """Store landmarks as the present view measured them.

        Args:
            slot: [n] of landmarks already stored; None = new ones, which replace those not seen for longest.
            image: [H, W].
            pixel: [n, 2] (u, v).
            rho: [n] > 0 [1/m].
            variance: [n] of ``rho`` [1/m^2].
            T_world_cam: [4, 4] [m].
            K: [3, 3] [px].
        """
        from ufmstar_torch.anchors.kernels.landmarks import store

        if slot is None:
            slot = np.flatnonzero(~self._used)[: len(rho)]
            if len(slot) < len(rho):
                age = np.where(self._used, self._seen, -1)
                slot = np.argsort(age, kind="stable")[: len(rho)]
            self.confirmed[slot] = 0
        store(self._columns(), slot, self.frame, image, pixel, rho, variance, T_world_cam, K)


def _beyond(square: NDArray[np.float64], variance: NDArray[np.float64]) -> float:
    """Variance to add to the stated ones so that the normalised squared differences have the median of a normal one."""
    low, high = 1e-7, 0.3**2
    if median(square / (variance + low)) <= MEDIAN_SQUARE:
        return 0.0
    for _ in range(_STEPS):
        middle = float(np.sqrt(low * high))
        too_small = median(square / (variance + middle)) > MEDIAN_SQUARE
        low, high = (middle, high) if too_small else (low, middle)
    return high
