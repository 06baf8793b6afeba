"""Errors of the poses and of the camera, estimated from all pixels of a frame.

An error (w, s) of a keyframe's relative pose shifts all pixels of its image consistently, and so do errors of the focal
length, the centre or the distortion. A shift across the epipolar lines is measured directly. A shift along them is
measured where keyframes of other baselines, or other pixels, contradict it. To first order, with the errors d and the
Jacobians of ``anchors.kernels.pose_equations``,

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

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.kernels.dense import Measured, Views
from ufmstar_torch.anchors.kernels.poses import CAMERA, Errors, camera_variance, correct
from ufmstar_torch.anchors.saved_state import SavedState
from ufmstar_torch.gaussians.camera import inverse_intrinsics

# [px] First standard deviations of a position by errors of the refined poses, and by what they do not explain.
_FIRST, _FIRST_UNEXPLAINED = 0.1, 0.1


class PoseErrors(SavedState):
    """Estimated errors of the poses and of the camera.

    Args:
        baselines: number of separate baselines.
        memory: share of the running estimates that remains after a frame.
    """

    HELD: ClassVar = {
        "_initialised": "pose_known", "_variance": "pose_variance", "_unexplained": "pose_left",
        "_disagreement": "pose_disagreement", "_camera": "camera_error", "_covariance": "camera_covariance",
    }  # fmt: skip

    def __init__(self, baselines: int, memory: float) -> None:
        self._baselines, self._memory = baselines, memory
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._initialised = False
        self._variance = np.zeros((self._baselines, 2))  # of w and s [rad^2, m^2]
        self._unexplained = np.full(self._baselines, _FIRST_UNEXPLAINED**2)  # [px^2]
        self._disagreement = np.ones(1)
        self._camera, self._covariance = np.zeros(CAMERA), np.eye(CAMERA)

    def positions(self, K: NDArray[np.float64], width: int, depth: float) -> NDArray[np.float64]:
        """[baselines] variance of a position in a keyframe by all errors [px^2], at a depth [m], in an image of a
        ``width`` [px]."""
        f = K[0, 0]
        if not self._initialised:
            self._variance[:] = _FIRST**2 / 2 / f**2 * np.array([1, depth**2])
            self._covariance = np.diag([camera_variance(i, width) for i in range(CAMERA)])
            self._initialised = True
        return self._unexplained + f**2 * (self._variance @ [1, 1 / depth**2])

    def camera(self, K: NDArray[np.float64]) -> NDArray[np.float64]:
        """[3, 3] the intrinsics K [3, 3], corrected for their estimated errors [px]."""
        focal, u, v, _ = self._camera
        return np.array([[K[0, 0] * (1 + focal), 0, K[0, 2] + u], [0, K[1, 1] * (1 + focal), K[1, 2] + v], [0, 0, 1]])

    def corrected(
        self, pixel: NDArray[np.float64], accepted: NDArray[np.bool_], measured: Measured, views: Views,
        K: NDArray[np.float64], depth: float, trusted: bool = True,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:  # fmt: skip
        """Correct depths for errors of the poses and the camera, and update the estimates of these errors.

        The arguments are those of :func:`ufmstar_torch.anchors.kernels.poses.correct`, with ``K`` from :meth:`camera`.
        Returns its ``rho``, ``variance`` and ``off``, which are 0, 0 and NaN for pixels that are not accepted.
        """
        rho, variance, off_line = np.zeros(len(pixel)), np.zeros(len(pixel)), np.full(len(pixel), np.nan)
        errors = Errors(self._variance, self._unexplained, self._camera, self._covariance, self._disagreement)
        cameras = views, K, inverse_intrinsics(K), depth, trusted, self._memory
        correct(pixel, accepted, measured, *cameras, errors, rho, variance, off_line)
        return rho, variance, off_line
