"""A memory of fixed size for landmarks that a camera has measured, which later images confirm or refute."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.kernels.landmarks import Columns, Sighted, settle, sight
from ufmstar_torch.anchors.kernels.windows import SIDE
from ufmstar_torch.anchors.saved_state import SavedState
from ufmstar_torch.gaussians.camera import inverse_intrinsics

_FIRST_APART = 0.01**2  # first value of the running estimate


class Memory(SavedState):
    """At most ``count`` landmarks.

    Args:
        count: number of landmarks.
        fading: share of the running estimate that remains after a frame.

    Attributes:
        apart: variance of an inverse depth, as a share of its square, beyond the stated one, from errors that views of
            one time share. It is estimated from measurements of the same landmarks at different times.
        frame: number of images so far.
    """

    HELD: ClassVar = {
        "_point": "landmark_point", "_pose": "landmark_pose", "_sigma": "landmark_sigma", "_patch": "landmark_patch",
        "_used": "landmark_used", "_confirmed": "landmark_confirmed", "_failed": "landmark_failed",
        "_seen": "landmark_seen", "frame": "landmark_frame", "apart": "landmark_apart",
    }  # fmt: skip

    def __init__(self, count: int, fading: float) -> None:
        self._count, self._fading = count, fading
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        n = self._count
        self._point, self._pose = np.zeros((n, 3)), np.tile(np.eye(4), (n, 1, 1))
        self._sigma = np.zeros(n)  # of the distance from the measuring camera, as a share of it
        self._patch = np.zeros((n, SIDE, SIDE), np.float32)
        self._used = np.zeros(n, dtype=np.bool_)
        self._confirmed, self._failed, self._seen = (np.zeros(n, np.int64) for _ in range(3))
        self.frame, self.apart = 0, _FIRST_APART

    def sighted(
        self, image: NDArray[np.uint8], T_world_cam: NDArray[np.float64], K: NDArray[np.float64], cell: int
    ) -> Sighted:
        """Find the landmarks that the next image shows, see :func:`ufmstar_torch.anchors.kernels.landmarks.sight`."""
        self.frame += 1
        return sight(self._columns(), self.frame, image, T_world_cam, K, cell)

    def _columns(self) -> Columns:
        of_cameras = self._point, self._pose, self._sigma, self._patch
        return Columns(*of_cameras, self._used, self._confirmed, self._failed, self._seen)

    @property
    def empty(self) -> bool:
        """True if there is no landmark."""
        return not self._used.any()

    def forget(self) -> None:
        """Delete all landmarks, but retain the running estimate."""
        self._used[:] = False

    def settle(
        self, sighted: Sighted, image: NDArray[np.uint8], T_world_cam: NDArray[np.float64], K: NDArray[np.float64],
        depth: float, measured: tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]],
        trusted: bool,
    ) -> tuple[int, int, float]:  # fmt: skip
        """Confirm or refute landmarks by new measurements, and store these; arguments as of
        :func:`ufmstar_torch.anchors.kernels.landmarks.settle`.

        Args:
            sighted: of the image; its first n pixels, inverse depths and variances are overwritten by those with a
                depth.
            depth: median of the scene [m].
            measured: of the searched pixels: ``agreed``, ``accepted``, ``rho`` and ``variance``.

        Returns:
            n; the number of refuted landmarks; the new median of the scene's depth [m].
        """
        numbers, camera = np.array([self.apart, depth]), (T_world_cam, inverse_intrinsics(K))
        arguments = sighted, *measured, trusted, self._fading, numbers
        found, refuted = settle(self._columns(), self.frame, image, *camera, *arguments)
        self.apart = float(numbers[0])
        return found, refuted, float(numbers[1])
