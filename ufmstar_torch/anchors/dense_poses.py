"""Errors of the poses and of the camera, from what all pixels of a frame show together.

A keyframe's relative pose that is wrong by (w, s) moves the pixels of its whole image together, and so does a camera
whose focal length, centre or distortion is wrong. Across the epipolar lines this shows at once; along them it shows
where keyframes of other baselines and other pixels contradict it. To first order, with the errors d and the Jacobians
of ``kernels.poses_cpu``,

    value_k = rho + c_k d + noise,      across_k = a_k d + noise,

where value_k is the inverse depth that keyframe k shows, and across_k where the patch lies across its line. The errors
have a Gaussian prior. Their posterior, N(d, C), corrects the depths, and what no pixel shows of them remains in C:

    rho = mean(value) - mean(c) d,      variance = own + mean(c) C mean(c)^T,

means over the keyframes by their precisions. ``own`` is the variance by the match alone, the smallest of the
keyframes': they share the patch. The prior follows: the variances of the poses' errors follow d^2 for each baseline, as
far as the pixels show d, and those of the camera's errors are what earlier frames left of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.epipolar import median
from ufmstar_torch.anchors.saved_state import SavedState
from ufmstar_torch.kernels.dense_cpu import Measured, Views
from ufmstar_torch.kernels.poses_cpu import CAMERA, POSE, Shown, Solution, linearised, solved

# Matches on which running estimates are based.
_ENOUGH = 10
# The median of the square of a standard normal variable.
_MEDIAN_SQUARE = 0.4549
# [px] Standard deviation of a position by errors of the refined poses before it is estimated, and the least one.
_FIRST, _LEAST = 0.1, 0.003
# A pixel's own variance over the one stated by its match is so many times the mean squared difference of its views,
# with the running one as that of one more: views share the patch and its errors. Fitted on tours.
_PATCH = 2.0
# Times that their effect is linearised.
_LINEARISED = 2
# [px] What errors of the poses leave of it.
_FIRST_LEFT = 0.1
# Correlation of the errors of two keyframes: half of each error is that of the present view.
_SHARED = 0.5
# Standard deviations of the camera's errors: the focal length as a share, its centre as a share of the width, and the
# radial distortion. Frames share keyframes: each counts as a part of its information. What is learnt fades.
_CAMERA, _PART, _FADES = (0.003, 0.003, 0.003, 0.01), 0.2, 0.02


@dataclass(frozen=True, eq=False)
class Fit:
    """Inverse depths of N pixels after the correction.

    Attributes:
        rho: [N] [1/m].
        variance: [N] of it [1/m^2].
    """

    rho: NDArray[np.float64]
    variance: NDArray[np.float64]


class PoseErrors(SavedState):
    """Estimated errors of the poses and of the camera.

    Args:
        baselines: number of baselines that are told apart.
        memory: share of the running estimates that remains after a frame.
    """

    HELD: ClassVar = {
        "_known": "pose_known",
        "_variance": "pose_variance",
        "_left": "pose_left",
        "_disagreement": "pose_disagreement",
        "_camera": "camera_error",
        "_covariance": "camera_covariance",
    }

    def __init__(self, baselines: int, memory: float) -> None:
        self._baselines, self._memory = baselines, memory
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._known = False
        self._variance = np.zeros((self._baselines, 2))  # of w and s [rad^2, m^2]
        self._left = np.full(self._baselines, _FIRST_LEFT**2)  # [px^2]
        self._disagreement = 1.0
        self._camera, self._covariance = np.zeros(CAMERA), np.eye(CAMERA)

    def positions(self, K: NDArray[np.float64], width: int, depth: float) -> NDArray[np.float64]:
        """[baselines] variance of a position in a keyframe by all errors [px^2], at a depth [m], in an image ``width``
        wide."""
        f = K[0, 0]
        if not self._known:
            self._variance[:] = _FIRST**2 / 2 / f**2 * np.array([1, depth**2])
            self._covariance = self._prior(width)
            self._known = True
        return self._left + f**2 * (self._variance @ [1, 1 / depth**2])

    def camera(self, K: NDArray[np.float64]) -> NDArray[np.float64]:
        """[3, 3] the intrinsics K [3, 3] with what is known of their errors [px]."""
        focal, u, v, _ = self._camera
        return np.array([[K[0, 0] * (1 + focal), 0, K[0, 2] + u], [0, K[1, 1] * (1 + focal), K[1, 2] + v], [0, 0, 1]])

    def corrected(
        self,
        pixel: NDArray[np.float64],
        measured: Measured,
        shares: NDArray[np.int64],
        views: Views,
        K: NDArray[np.float64],
        depth: float,
        trusted: bool = True,
    ) -> Fit:
        """Depths without the errors that the pixels show together. What is known of the errors follows.

        Args:
            pixel: [N, 2] (u, v).
            measured: N pixels in V views, each in one at least.
            shares: [V] to which baseline each view belongs.
            views: V keyframes.
            K: [3, 3] of :meth:`camera` [px], which the views have.
            depth: median of the scene [m].
            trusted: False = nothing is learnt of the camera: poses and images contradict each other.
        """
        if not len(pixel):
            return Fit(measured.rho, measured.variance)
        used = np.isfinite(measured.value)
        shows = used & np.isfinite(measured.across)
        speed, slope = (np.where(used, x, 1.0) for x in (measured.speed, measured.slope))
        along = np.where(used[..., None], measured.along, 0.0)
        left = self._left[shares]
        noise = np.where(used, (measured.noise + left * (1 + slope**2)) / speed**2, np.inf)
        value = np.where(used, measured.value - measured.rho[:, None], 0.0)
        across = np.where(shows, measured.across, 0.0)
        across_variance = np.where(shows, measured.across_noise + left, np.inf)
        before, rho = self._before(shares), measured.rho
        for _ in range(_LINEARISED):  # errors of poses move the depths at which they are linearised
            on_line, across_change = linearised(pixel, rho, along, slope, views, K)
            shown = Shown(on_line / speed[..., None], value, noise, across_change, across, across_variance)
            solution = solved(shown, *before)
            rho = measured.rho + solution.rho
        if not np.isfinite(solution.covariance).all():  # nothing is stored that is not a number
            return Fit(measured.rho, np.full(len(pixel), np.inf))
        self._learn_poses(solution, shares, K, depth)
        if trusted:
            self._learn_camera(solution, views.image.shape[2])
        compared = used & (measured.agreed > 1)[:, None]
        self._learn_noise(solution.residual[compared], solution.across_residual, measured.across_noise, shows, shares)
        apart = (self._disagreement + solution.residual.sum(1)) / np.maximum(measured.agreed, 1)
        variance = _PATCH * apart * noise.min(1, initial=np.inf) + solution.common
        return Fit(rho, variance)

    def _before(self, shares: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Precision [S, S] and mean [S] of the errors of some keyframes and of the camera, S = 6 V + 4."""
        sigma = np.sqrt(np.repeat(self._variance[shares], 3, axis=1))
        shared = np.where(np.eye(len(shares)), 1.0, _SHARED)
        poses = np.einsum("kl,kc,lc,cd->kcld", np.linalg.inv(shared), 1 / sigma, 1 / sigma, np.eye(POSE))
        n = POSE * len(shares)
        precision = np.zeros((n + CAMERA, n + CAMERA))
        precision[:n, :n] = poses.reshape(n, n)
        precision[n:, n:] = np.linalg.inv(self._covariance)
        return precision, np.concatenate([np.zeros(n + 3), self._camera[3:]])  # K has the first three

    def _learn_poses(self, solution: Solution, shares: NDArray[np.int64], K: NDArray[np.float64], depth: float) -> None:
        remains = solution.covariance.diagonal()[:-CAMERA].reshape(-1, 2, 3).sum(2)
        square = np.square(solution.error[:-CAMERA]).reshape(-1, 2, 3).sum(2)
        least = np.square(_LEAST / K[0, 0]) * np.array([1, depth**2])
        for share, left, each in zip(shares, remains, square, strict=True):
            before = self._variance[share]
            shown = 3 - left / before  # of the three numbers, what the pixels showed
            step = (1 - self._memory) * (each - shown * before) / np.maximum(shown, 1)
            self._variance[share] = np.maximum(before + step, least)

    def _learn_camera(self, solution: Solution, width: int) -> None:
        before, first = np.linalg.inv(self._covariance), np.linalg.inv(self._prior(width))
        now = np.linalg.inv(solution.covariance[-CAMERA:, -CAMERA:])
        measured = solution.error[-CAMERA:] + np.append(self._camera[:3], 0)
        weighted = (1 - _PART) * before @ self._camera + _PART * now @ measured
        self._covariance = np.linalg.inv((1 - _FADES) * ((1 - _PART) * before + _PART * now) + _FADES * first)
        self._camera = self._covariance @ weighted * (1 - _FADES)

    def _learn_noise(
        self,
        residual: NDArray[np.float64],
        across_residual: NDArray[np.float64],
        noise: NDArray[np.float64],
        shows: NDArray[np.bool_],
        shares: NDArray[np.int64],
    ) -> None:
        if len(residual) < _ENOUGH:
            return
        left = (_medians(across_residual, shows) / _MEDIAN_SQUARE - _medians(noise, shows)).clip(_LEAST**2)
        for share, each, count in zip(shares, left, shows.sum(0), strict=True):
            if count >= _ENOUGH:
                self._left[share] = self._faded(self._left[share], each)
        self._disagreement = self._faded(self._disagreement, median(residual) / _MEDIAN_SQUARE)

    def _prior(self, width: int) -> NDArray[np.float64]:
        """[4, 4] covariance of the camera's errors before the first frame."""
        return np.diag(np.square(np.array(_CAMERA) * [1, width, width, 1]))

    def _faded(self, before: float, now: float) -> float:
        return self._memory * before + (1 - self._memory) * float(now)


def _medians(values: NDArray[np.float64], where: NDArray[np.bool_]) -> NDArray[np.float64]:
    """[V] of the columns of [N, V] values, the greater one of two in the middle; 0 of none."""
    ordered = np.sort(np.where(where, values, np.inf), axis=0)
    middle = np.minimum(where.sum(0) // 2, len(values) - 1)
    return np.where(where.any(0), ordered[middle, np.arange(values.shape[1])], 0.0)
