"""Bundle adjustment of a window of views: tracked corners refine the poses, with the input poses as the prior.

Each input pose errs by a rotation w and a shift s, normal with the standard deviations sigma_w and sigma_s. As this
prior holds for every view, the refined poses do not drift and keep the scale. A corner's position in an earlier view is
distributed about its point's projection as Student's t. Its variance grows with the number of views between, since
errors of tracking add up. Gauss-Newton steps on poses and inverse depths, with the inverse depths eliminated
(``anchors.kernels.bundle``), yield the most likely poses.

sigma_w and sigma_s are learnt (EM). The error d of the newest pose has the prior variance sigma^2 and the posterior
variance c, so the mean of d^2 should be sigma^2 - c. Images determine independent errors. They hardly determine errors
that successive poses share; the mean product of successive d estimates these. Errors of a late trajectory are
proportional to the motion: ``time_offset`` estimates the offset, and the poses are corrected for it first. A single
pose with a far larger error than the others starts another trajectory: SLAM has closed a loop.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.epipolar import median
from ufmstar_torch.anchors.saved_state import POSITIVE, SavedState
from ufmstar_torch.anchors.time_offset import TimeOffset

# [px] Standard deviations of a position: by errors of the poses at first (best on tours whose poses err by .05 to .15
# degrees and 2 mm), their limits when they are learnt, and by tracking from one view to the next (.25 to .4 on
# recordings and tours).
_FIRST, _LEAST, _LARGEST, _TRACKING = 0.5, 0.003, 20.0, 0.35
# A corner's position v views ago has 1 + _DRIFT (v - 1) times the variance of its position one view ago.
_DRIFT = 0.6
# Information of a position as a share of that of an independent one: errors of neighbouring corners are correlated, and
# so are those of a corner in several views. On tours .3 is best with noisy poses, .05 with a rolling shutter.
_INFORMATION = 0.15
# Share of the running estimates that remains after a frame.
_MEMORY = 0.8
# Degrees of freedom of a position's distribution; Gauss-Newton steps; earlier steps on inverse depths alone.
_STUDENT, _STEPS, _DEPTH_STEPS = 4.0, 4, 6
# A pose starts another trajectory if the score of its error, chi-squared with six degrees of freedom, exceeds _SCORE
# and _TIMES the recent scores, and the error's mean square, as shifts of a position, exceeds _SHIFT [px^2]. Otherwise
# the poses are noisier than learnt so far.
_SCORE, _TIMES, _SHIFT = 60.0, 5.0, 1.0
# Least numbers of corners and views for a refinement.
_ENOUGH, _VIEWS = 8, 3


class PoseRefinement(SavedState):
    """Refines poses and learns how large their errors are.

    Attributes:
        shared: variance of the corners' inverse depths by the errors of the refined poses, which all corners share; the
            median over the corners [1/m^2]. 0 where nothing was refined.
        correlated: variance of a position by the errors that successive input poses share [px^2].
        jumped: the newest input pose starts another trajectory.
        offset: time offset of the input poses.
    """

    HELD: ClassVar = {
        "_variance": "given_pose_variance",
        "_learnt": "pose_errors_learnt",
        "_last_error": "last_pose_error",
        "_recent_score": "surprise_lately",
        "correlated": "correlated_pose_variance",
        "shared": "remaining_pose_variance",
        "_offset_variance": "pose_variance_by_offset",
    }
    RANGES: ClassVar = {"_variance": POSITIVE}

    def __init__(self) -> None:
        self.offset = TimeOffset()
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._variance = np.full(2, _FIRST**2 / 2)  # of a position, by w and by s [px^2]
        self._last_error = np.zeros((2, 3))  # w and s of the last pose as shifts of a position [px]
        self._learnt = 0  # number of pose errors in the variance
        self.correlated, self.shared, self.jumped = 0.0, 0.0, False
        self._recent_score = _SCORE
        self._offset_variance = 0.0  # variance of a position by the time offset [px^2]
        self.offset.reset()

    def state(self) -> dict[str, Tensor]:
        """Copy the state, for :meth:`load_state`."""
        return super().state() | self.offset.state()

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of :meth:`state`; ValueError: an impossible value."""
        super().load_state(state)
        self.offset.load_state(state)

    @property
    def pose_variance(self) -> float:
        """Variance of a position by errors of the input poses [px^2]."""
        return float(self._variance.sum()) + self._offset_variance

    def refine(
        self, pixel: NDArray[np.float64], seen: NDArray[np.bool_], T_world_cam: NDArray[np.float64],
        K: NDArray[np.float64], depth: float,
    ) -> NDArray[np.float64]:  # fmt: skip
        """Compute the most likely poses of W successive views.

        Args:
            pixel: [N, W, 2] positions (u, v) of corners; the newest view is the last.
            seen: [N, W] bool, True where the view shows the corner.
            T_world_cam: [W, 4, 4] input poses, camera-to-world [m].
            K: [3, 3] [px].
            depth: median of the scene [m].

        Returns:
            [W, 4, 4] refined poses; the input poses if too few corners are seen, or after a jump.
        """
        from ufmstar_torch.anchors.kernels.bundle import adjusted, equations, inverse_depths, moved

        self.shared, self.jumped = 0.0, False
        tracks, views = seen[:, -1] & (seen.sum(1) > 1), np.flatnonzero(seen.any(0))
        if tracks.sum() < _ENOUGH or len(views) < _VIEWS:
            return T_world_cam
        unit = np.array([[1], [depth]]) / K[0, 0]  # w [rad] and s [m] that shift a position by a pixel
        ray = (pixel[np.ix_(tracks, views)] - K[:2, 2]) / K.diagonal()[:2]
        growth = 1 + _DRIFT * np.arange(len(views) - 2, -1, -1)
        precision = seen[np.ix_(tracks, views[:-1])] / growth * (K[0, 0] / _TRACKING) ** 2
        prior = np.broadcast_to(1 / (self._variance[:, None] * unit**2), (len(views), 2, 3)).ravel()
        shift = self.offset.shift(T_world_cam[views])
        poses = moved(T_world_cam[views], shift.ravel())
        rho = inverse_depths(ray, precision, poses, 1 / depth, _STUDENT, _DEPTH_STEPS)
        A, b, by_error, rho_step = equations(ray, precision, poses, rho, 1 / depth, _STUDENT)
        try:
            self.jumped = self._jumps(_INFORMATION * A[-6:, -6:], _INFORMATION * b[-6:], prior[-6:], unit)
        except np.linalg.LinAlgError:  # singular: values far out of scale
            return T_world_cam
        if self.jumped:
            return T_world_cam
        first = A, b, by_error, rho_step
        result = adjusted(ray, precision, poses, rho, 1 / depth, _STUDENT, first, prior, _INFORMATION, _STEPS)
        if result is None:
            return T_world_cam
        error, covariance, by_poses = result
        if not (np.isfinite(poses).all() and np.isfinite(covariance).all()):
            return T_world_cam
        self.shared = median(by_poses)
        self._offset_variance = float(np.square(shift[-1].reshape(2, 3) / unit).sum()) / 3
        self._learn(error[-6:].reshape(2, 3) / unit, covariance.diagonal()[-6:].reshape(2, 3) / unit**2)
        self.offset.learn(T_world_cam[views], prior, error, covariance)
        refined = T_world_cam.copy()
        refined[views] = poses
        return refined

    def _jumps(
        self, A: NDArray[np.float64], b: NDArray[np.float64], prior: NDArray[np.float64], unit: NDArray[np.float64]
    ) -> bool:
        """True if the newest input pose starts another trajectory, from its block of the equations A d = b."""
        score = float(b @ np.linalg.solve(A + 2 * A / prior @ A, b))  # earlier views have errors, too
        shift = np.linalg.solve(A, b).reshape(2, 3) / unit
        jumps = score > max(_SCORE, _TIMES * self._recent_score) and np.square(shift).sum() > 3 * _SHIFT
        self._recent_score = max(score, _MEMORY * self._recent_score)
        return bool(jumps)

    def _learn(self, error: NDArray[np.float64], posterior_variance: NDArray[np.float64]) -> None:
        """Update the variances by the newest pose's error [2, 3] and its posterior variance [2, 3], in pixels, as far
        as the images determine them."""
        determined = (1 - posterior_variance / self._variance[:, None]).sum(1)  # how many of 3 components
        excess = np.square(error).sum(1) - determined * self._variance
        self._learnt += 1
        share = max(1 - _MEMORY, 1 / (self._learnt + 1))  # at first the mean with the prior
        variance = self._variance + share * excess / np.maximum(determined, 1)
        self._variance = variance.clip(_LEAST**2 / 2, _LARGEST**2 / 2)
        product = float((error * self._last_error).sum()) / 3
        self.correlated = max(_MEMORY * self.correlated + (1 - _MEMORY) * product, 0.0)
        self._last_error = error
