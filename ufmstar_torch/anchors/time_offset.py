"""Time offset between poses and images, from the pose errors that bundle adjustment estimates.

The input pose of image k may be that of the camera at the time k - lag, in images. To first order its error is lag m_k,
with the motion m_k of the input poses from one image to the next. For the errors d of all views of the window, the
images contribute A d = b to the normal equations, and the prior has the precision P. The posterior has the covariance
C = (A + P)^-1 and the mean e. For d = lag m the expected e is lag (1 - C P) m, so a window yields

    lag = m^T P e / m^T P (m - C P m)

with the denominator as its information. During a steady motion, an offset changes no relative pose: it cannot be
measured, and it does not change depths. The motion at an image is computed from the poses of its neighbours alone,
because noise of the image's pose is also in e and would bias the result.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.saved_state import SavedState
from ufmstar_torch.kernels.compile_cpu import empty, reordered, reordered_leaf

# Share of the sums over earlier windows that remains after an image.
_MEMORY = 0.9
# [images] Standard deviation of the lag before any image, and that of a window's estimate in addition to the computed
# one, since no motion is as steady as in the model.
_PRIOR, _WINDOW = 1.0, 0.5
# The lag is 0 unless its square exceeds this multiple of its variance, and shrinks towards that limit. On recordings
# and tours without an offset it stays 0, also with noise of 1 and 2 degrees.
_SIGNIFICANT = 2.0
_LARGEST = 3.0  # [images]
_MOST = 1.001 / _WINDOW**2 / (1 - _MEMORY)  # of the information, with rounding


class TimeOffset(SavedState):
    """Estimates the delay of the input poses.

    Attributes:
        lag: delay as far as it is significant [images]; negative = early.
    """

    HELD: ClassVar = {"_sum": "lag_sum", "_information": "lag_information", "lag": "lag"}
    # An information is at most 1 / _WINDOW^2; the sums are geometric.
    RANGES: ClassVar = {
        "_sum": (-_LARGEST * _MOST, _LARGEST * _MOST), "_information": (0.0, _MOST), "lag": (-_LARGEST, _LARGEST)
    }  # fmt: skip

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._sum = self._information = self.lag = 0.0

    def shift(self, T_world_cam: NDArray[np.float64]) -> NDArray[np.float64]:
        """[W, 6] change of input poses [W, 4, 4], W >= 2, by the lag: rotation about the camera's axes [rad] and shift
        along the world's [m]. The motion at the newest pose is extrapolated."""
        if not self.lag:
            return np.zeros((len(T_world_cam), 6))
        result = np.empty((len(T_world_cam), 6))
        motion = result[1:] if self.lag < 0 else result[:-1]
        _steps(T_world_cam, motion)
        result[0 if self.lag < 0 else -1] = motion[0 if self.lag < 0 else -1]
        return self.lag * result

    def learn(
        self, T_world_cam: NDArray[np.float64], precision: NDArray[np.float64], error: NDArray[np.float64],
        covariance: NDArray[np.float64],
    ) -> None:  # fmt: skip
        """Update the lag by the pose errors of a window.

        Args:
            T_world_cam: [W, 4, 4] input poses, W >= 3.
            precision: [6 W] of the prior of their errors, P.
            error: [6 W] e, beyond :meth:`shift`.
            covariance: [6 W, 6 W] C.
        """
        window_information, beyond = _late(T_world_cam, precision, error, covariance)
        lag = self.lag + beyond
        if not (window_information > 0 and math.isfinite(lag)):
            return
        information = 1 / (1 / window_information + _WINDOW**2)
        self._sum = _MEMORY * self._sum + information * min(max(lag, -_LARGEST), _LARGEST)
        self._information = _MEMORY * self._information + information
        mean = self._sum / (self._information + 1 / _PRIOR**2)
        self.lag = mean * max(0.0, 1 - _SIGNIFICANT / max(mean**2 * self._information, 1e-9))


@reordered
def _steps(T, out):
    """Write the motion [W - 1, 6] from each pose [W, 4, 4] to the next one: rotation vector in the camera's axes [rad],
    shift along the world's [m]."""
    axis = empty(3, np.float64)
    for k in range(len(T) - 1):
        _motion(T[k], T[k + 1], 1.0, axis, out[k])


@reordered
def _late(T, precision, error, covariance):
    """The information of a window on the lag, and the lag by it beyond the present one [images]; arguments as
    :meth:`TimeOffset.learn`."""
    views, size = len(T), 6 * len(T)
    motion, axis = empty((views, 6), np.float64), empty(3, np.float64)
    for k in range(views):  # before and after each view; neighbours of the first and the last view
        before, after = max(k - 1, 0), min(k + 1, views - 1)
        if k == 0:
            before, after = 1, 2
        elif k == views - 1:
            before, after = views - 3, views - 2
        _motion(T[before], T[after], 0.5 if 0 < k < views - 1 else 1.0, axis, motion[k])
    information = total = 0.0
    for i in range(size):
        m = motion[i // 6, i % 6]
        expected = m
        for j in range(size):
            expected -= covariance[i, j] * precision[j] * motion[j // 6, j % 6]
        information += precision[i] * m * expected
        total += precision[i] * m * error[i]
    information /= views  # windows overlap: each pose is in W windows
    return information, total / views / information


@reordered_leaf
def _motion(T, T_next, share, axis, out):
    """Write a share of the motion between two poses [4, 4] to ``out`` [6]; ``axis`` is a buffer [3]."""
    trace = 0.0
    for i in range(3):
        one, other = (i + 1) % 3, (i + 2) % 3
        axis[i] = 0.0
        for m in range(3):
            trace += T[m, i] * T_next[m, i]
            axis[i] += (T[m, other] * T_next[m, one] - T[m, one] * T_next[m, other]) / 2
    sine = np.sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2])
    over = share * np.arctan2(sine, (trace - 1) / 2) / max(sine, 1e-12)
    for i in range(3):
        out[i], out[3 + i] = axis[i] * over, share * (T_next[i, 3] - T[i, 3])
