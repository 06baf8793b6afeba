"""Errors of the poses and of the camera, estimated from all pixels of a frame.

An error (w, s) of a keyframe's relative pose shifts all pixels of its image consistently, and so do errors of the focal
length, the centre or the distortion. A shift across the epipolar lines is measured directly. A shift along them is
measured where keyframes of other baselines, or other pixels, contradict it. To first order, with the errors d and the
Jacobians of ``anchors.kernels.poses``,

    value_k = rho + c_k d + noise,      across_k = a_k d + noise,

where value_k is the inverse depth measured in keyframe k, and across_k the distance of the patch from its line. The
errors have a Gaussian prior. Their posterior N(d, C) corrects the depths; C includes the errors that no pixel
determines:

    rho = mean(value) - mean(c) d,      variance = match + mean(c) C mean(c)^T,

with means over the keyframes, weighted by precision. ``match`` is the variance of the match alone, the smallest of the
keyframes' because they share the patch. The prior is updated after each frame: the variances of the poses' errors from
d^2 for each baseline, as far as the pixels determine d, and the camera's errors from their posterior.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.epipolar import MEDIAN_SQUARE, median
from ufmstar_torch.anchors.kernels.dense import Measured, Views
from ufmstar_torch.anchors.kernels.poses import CAMERA, POSE, Corrected, corrected
from ufmstar_torch.anchors.saved_state import SavedState

# Least number of matches for an update of the running estimates.
_ENOUGH = 10
# [px] Standard deviation of a position by errors of the refined poses: first value and lower limit.
_FIRST, _LEAST = 0.1, 0.003
# The variance of a pixel is _PATCH times that of its match times the mean squared residual of its views, in which the
# running mean counts as one more view. The factor, fitted on tours, stands for errors that views share in the patch.
_PATCH = 2.0
# [px] First standard deviation of a position that pose errors do not explain.
_FIRST_UNEXPLAINED = 0.1
# Correlation of the errors of two keyframes' relative poses: the present view contributes half of each variance.
_SHARED = 0.5
# Prior standard deviations of the camera's errors: focal length as a share, centre as a share of the width, and radial
# distortion. Share of a frame's information in an update, as frames share keyframes; weight of the prior in an update.
_CAMERA, _PART, _FADE = (0.003, 0.003, 0.003, 0.01), 0.2, 0.02


@dataclass(frozen=True, eq=False)
class Fit:
    """Inverse depths of N pixels after the correction.

    Attributes:
        rho: [N] [1/m].
        variance: [N] of ``rho`` [1/m^2].
        off_line: [N] largest squared distance of a match from its epipolar line, over its variance, of all views; NaN
            where no view measures it.
    """

    rho: NDArray[np.float64]
    variance: NDArray[np.float64]
    off_line: NDArray[np.float64]


class PoseErrors(SavedState):
    """Estimated errors of the poses and of the camera.

    Args:
        baselines: number of separate baselines.
        memory: share of the running estimates that remains after a frame.
    """

    HELD: ClassVar = {
        "_initialised": "pose_known",
        "_variance": "pose_variance",
        "_unexplained": "pose_left",
        "_disagreement": "pose_disagreement",
        "_camera": "camera_error",
        "_covariance": "camera_covariance",
    }

    def __init__(self, baselines: int, memory: float) -> None:
        self._baselines, self._memory = baselines, memory
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._initialised = False
        self._variance = np.zeros((self._baselines, 2))  # of w and s [rad^2, m^2]
        self._unexplained = np.full(self._baselines, _FIRST_UNEXPLAINED**2)  # [px^2]
        self._disagreement = 1.0
        self._camera: NDArray[np.float64] = np.zeros(CAMERA)
        self._covariance: NDArray[np.float64] = np.eye(CAMERA)

    def positions(self, K: NDArray[np.float64], width: int, depth: float) -> NDArray[np.float64]:
        """[baselines] variance of a position in a keyframe by all errors [px^2], at a depth [m], in an image of a
        ``width`` [px]."""
        f = K[0, 0]
        if not self._initialised:
            self._variance[:] = _FIRST**2 / 2 / f**2 * np.array([1, depth**2])
            self._covariance = self._camera_prior(width)
            self._initialised = True
        return self._unexplained + f**2 * (self._variance @ [1, 1 / depth**2])

    def camera(self, K: NDArray[np.float64]) -> NDArray[np.float64]:
        """[3, 3] the intrinsics K [3, 3], corrected for their estimated errors [px]."""
        focal, u, v, _ = self._camera
        return np.array([[K[0, 0] * (1 + focal), 0, K[0, 2] + u], [0, K[1, 1] * (1 + focal), K[1, 2] + v], [0, 0, 1]])

    def corrected(
        self,
        pixel: NDArray[np.float64],
        found: NDArray[np.int64],
        measured: Measured,
        shares: NDArray[np.int64],
        views: Views,
        K: NDArray[np.float64],
        depth: float,
        trusted: bool = True,
    ) -> Fit:
        """Correct the depths for errors of the poses and the camera, and update the estimates of these errors.

        Args:
            pixel: [M, 2] (u, v).
            found: [N] indices of the pixels to use, each with a match in at least one view.
            measured: matches of the M pixels in V views.
            shares: [V] index of each view's baseline.
            views: V keyframes.
            K: [3, 3] from :meth:`camera`, as in the views [px].
            depth: median of the scene [m].
            trusted: False = poses and images contradict each other; the camera's errors are not updated.

        Returns:
            Of the N pixels.
        """
        if not len(found):
            return Fit(np.zeros(0), np.zeros(0), np.zeros(0))
        prior = self._prior(shares)
        result = corrected(pixel, found, measured, views, K, self._unexplained[shares], *prior)
        if not np.isfinite(result.covariance).all():  # never store NaN
            return Fit(measured.rho[found], np.full(len(found), np.inf), np.full(len(found), np.nan))
        self._learn_poses(result, shares, K, depth)
        if trusted:
            self._learn_camera(result, prior[0][-CAMERA:, -CAMERA:], views.image.shape[2])
        compared = np.isfinite(measured.value[found]) & (measured.agreed[found] > 1)[:, None]
        self._learn_noise(result.residual.T[compared], result.across_residual.T, measured.across_noise[found], shares)
        dispersion = (self._disagreement + result.residual.sum(0)) / np.maximum(measured.agreed[found], 1)
        return Fit(result.rho, _PATCH * dispersion * result.match + result.common, result.off_line)

    def _prior(self, shares: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Prior precision [S, S] and mean [S] of the errors of V keyframes and of the camera, S = 6 V + 4."""
        over = np.repeat(1 / np.sqrt(self._variance[shares]), 3, axis=1).ravel()
        n = POSE * len(shares)
        precision = np.zeros((n + CAMERA, n + CAMERA))
        precision[:n, :n] = _shared_precision(len(shares)) * over * over[:, None]
        precision[n:, n:] = np.linalg.inv(self._covariance)
        return precision, np.concatenate([np.zeros(n + 3), self._camera[3:]])  # K includes the first three

    def _learn_poses(
        self, solution: Corrected, shares: NDArray[np.int64], K: NDArray[np.float64], depth: float
    ) -> None:
        remaining = solution.covariance.diagonal()[:-CAMERA].reshape(-1, 2, 3).sum(2)
        square = np.square(solution.error[:-CAMERA]).reshape(-1, 2, 3).sum(2)
        least = np.square(_LEAST / K[0, 0]) * np.array([1, depth**2])
        before = self._variance[shares]
        determined = 3 - remaining / before  # how many of 3 components
        step = (1 - self._memory) * (square - determined * before) / np.maximum(determined, 1)
        self._variance[shares] = np.maximum(before + step, least)

    def _learn_camera(self, solution: Corrected, precision: NDArray[np.float64], width: int) -> None:
        prior = np.diag(1 / self._camera_prior(width).diagonal())
        posterior = np.linalg.inv(solution.covariance[-CAMERA:, -CAMERA:])
        measured = solution.error[-CAMERA:] + np.append(self._camera[:3], 0)
        weighted = (1 - _PART) * precision @ self._camera + _PART * posterior @ measured
        combined = (1 - _PART) * precision + _PART * posterior
        self._covariance = np.asarray(np.linalg.inv((1 - _FADE) * combined + _FADE * prior), np.float64)
        self._camera = self._covariance @ weighted * (1 - _FADE)

    def _learn_noise(
        self,
        residual: NDArray[np.float64],
        across_residual: NDArray[np.float64],
        noise: NDArray[np.float64],
        shares: NDArray[np.int64],
    ) -> None:
        if len(residual) < _ENOUGH:
            return
        shows = np.isfinite(noise)
        unexplained = (_medians(across_residual, shows) / MEDIAN_SQUARE - _medians(noise, shows)).clip(_LEAST**2)
        enough = shows.sum(0) >= _ENOUGH
        seen = shares[enough]
        self._unexplained[seen] = self._memory * self._unexplained[seen] + (1 - self._memory) * unexplained[enough]
        newest = median(residual) / MEDIAN_SQUARE
        self._disagreement = self._memory * self._disagreement + (1 - self._memory) * newest

    def _camera_prior(self, width: int) -> NDArray[np.float64]:
        """[4, 4] prior covariance of the camera's errors."""
        return np.diag(np.square(np.array(_CAMERA) * [1, width, width, 1]))


@functools.lru_cache(maxsize=8)
def _shared_precision(views: int) -> NDArray[np.float64]:
    """[6 V, 6 V] inverse of the correlation of the errors of V keyframes' relative poses."""
    shared = np.where(np.eye(views), 1.0, _SHARED)
    return np.asarray(np.kron(np.linalg.inv(shared), np.eye(POSE)))


def _medians(values: NDArray[np.float64], where: NDArray[np.bool_]) -> NDArray[np.float64]:
    """[V] upper medians of the masked columns of values [N, V]; 0 for an empty column."""
    ordered = np.sort(np.where(where, values, np.inf), axis=0)
    middle = np.minimum(where.sum(0) // 2, len(values) - 1)
    return np.where(where.any(0), ordered[middle, np.arange(values.shape[1])], 0.0)
