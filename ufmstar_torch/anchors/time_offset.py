"""The time offset between poses and images, from the errors of the given poses that a bundle adjustment finds.

The pose that is given for image k may be the camera's at the time k - lag, in images. To first order its error is then
lag m_k, where m_k is the motion of the given poses from one image to the next. The images' part of the normal equations
is A d = b for the errors d of all views of the window, with the prior precision P; their posterior has the covariance
C = (A + P)^-1 and the mean e. With d = lag m the expected e is lag (1 - C P) m, so a window yields

    lag = m^T P e / m^T P (m - C P m)

and the denominator is the information about it. A steady motion shows nothing, as it changes no relative pose, but does
no harm to depths either. The motion of an image is taken from the poses of its neighbours alone: noise of its own pose,
which is in e too, would bias the result.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.saved_state import SavedState

# Share of what earlier windows have shown that remains after an image.
_MEMORY = 0.9
# Standard deviation of the lag before any image, and of what a window shows of it beyond the stated one: no motion is
# as steady as the model has it.
_PRIOR, _WINDOW = 1.0, 0.5
# A lag is used as far as its square exceeds so many times its variance. On recordings and tours without an offset, with
# noise of 1 and 2 degrees as well, none does.
_SIGNIFICANT = 2.0
_LARGEST = 3.0  # images


class TimeOffset(SavedState):
    """Estimates by how many images the given poses are late.

    Attributes:
        lag: in images, as far as it is significant; negative = early.
    """

    HELD: ClassVar = {"_sum": "lag_sum", "_information": "lag_information", "lag": "lag"}

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._sum = self._information = self.lag = 0.0

    def shift(self, T_world_cam: NDArray[np.float64]) -> NDArray[np.float64]:
        """[W, 6] rotation about the camera's axes [rad] and shift along the world's [m] that the lag makes of given
        poses [W, 4, 4], W >= 2. The newest one is extrapolated."""
        if not self.lag:
            return np.zeros((len(T_world_cam), 6))
        steps = _motion(T_world_cam[:-1], T_world_cam[1:])
        ends = [steps[:1], steps] if self.lag < 0 else [steps, steps[-1:]]
        return np.asarray(self.lag * np.concatenate(ends), np.float64)

    def learn(
        self, T_world_cam: NDArray[np.float64], precision: NDArray[np.float64], error: NDArray[np.float64],
        covariance: NDArray[np.float64],
    ) -> None:  # fmt: skip
        """Follow the errors that a window shows.

        Args:
            T_world_cam: [W, 4, 4] the given poses, W >= 3.
            precision: [6 W] of their errors' prior, P.
            error: [6 W] e, beyond :meth:`shift`.
            covariance: [6 W, 6 W] C.
        """
        steps = _motion(T_world_cam[:-1], T_world_cam[1:])
        inner = _motion(T_world_cam[:-2], T_world_cam[2:]) / 2
        motion = np.concatenate([steps[1:2], inner, steps[-2:-1]]).ravel()
        weighted = precision * motion
        # Views overlap: a pose is in as many windows as a window has views.
        shown = float(weighted @ (motion - covariance @ weighted)) / len(T_world_cam)
        if not shown > 0:
            return
        lag = self.lag + float(weighted @ error) / len(T_world_cam) / shown
        if not np.isfinite(lag):
            return
        information = 1 / (1 / shown + _WINDOW**2)
        self._sum = _MEMORY * self._sum + information * float(np.clip(lag, -_LARGEST, _LARGEST))
        self._information = _MEMORY * self._information + information
        mean = self._sum / (self._information + 1 / _PRIOR**2)
        self.lag = mean * max(0.0, 1 - _SIGNIFICANT / max(mean**2 * self._information, 1e-9))


def _motion(T_world_cam: NDArray[np.float64], then: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n, 6] from poses to other poses [n, 4, 4]: the rotation vector in the camera's axes and the world's shift."""
    R = T_world_cam[:, :3, :3].transpose(0, 2, 1) @ then[:, :3, :3]
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], 1) / 2
    sine, cosine = np.linalg.norm(axis, axis=1), (np.trace(R, axis1=1, axis2=2) - 1) / 2
    turn = axis * (np.arctan2(sine, cosine) / np.maximum(sine, 1e-12))[:, None]
    return np.concatenate([turn, then[:, :3, 3] - T_world_cam[:, :3, 3]], 1)
