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
pose with a far larger error than the others starts another trajectory: SLAM has closed a loop. Tracks of things that
move would turn the poses towards them: where many tracks fit the input poses much worse than the largest group, only
the group refines them.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.kernels.bundle import Learnt, refine
from ufmstar_torch.anchors.saved_state import POSITIVE, SavedState
from ufmstar_torch.anchors.time_offset import TimeOffset
from ufmstar_torch.gaussians.camera import inverse_intrinsics

# [px] First standard deviation of a position by errors of the poses: best on tours whose poses err by .05 to .15
# degrees and 2 mm.
_FIRST = 0.5
# A pose starts another trajectory if the score of its error, chi-squared with six degrees of freedom, exceeds _SCORE
# and _TIMES the recent scores, and its shift of positions is clear (``kernels.bundle``). Otherwise the poses are
# noisier than learnt so far.
_SCORE, _TIMES = 60.0, 5.0
# Least number of views for a refinement.
_VIEWS = 3


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
        "_variance": "given_pose_variance", "_learnt": "pose_errors_learnt", "_last_error": "last_pose_error",
        "_recent_score": "surprise_lately", "correlated": "correlated_pose_variance",
        "shared": "remaining_pose_variance", "_offset_variance": "pose_variance_by_offset",
    }  # fmt: skip
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
        self.shared, self.jumped = 0.0, False
        views = np.flatnonzero(seen.any(0))
        if len(views) < _VIEWS:
            return T_world_cam
        if len(views) < len(T_world_cam):
            poses = T_world_cam.copy()
            pixel, seen = np.ascontiguousarray(pixel[:, views]), np.ascontiguousarray(seen[:, views])
            poses[views] = self.refine(pixel, seen, T_world_cam[views], K, depth)
            return poses
        numbers = np.array([self._learnt, self.correlated, 0.0, self._recent_score, self._offset_variance])
        poses, shift = np.empty(T_world_cam.shape), self.offset.shift(T_world_cam)
        (prior, error), covariance = np.empty((2, shift.size)), np.empty((shift.size, shift.size))
        camera, learnt = (K, inverse_intrinsics(K), depth), Learnt(self._variance, self._last_error, numbers)
        most = max(_SCORE, _TIMES * self._recent_score)
        refined = refine(pixel, seen, T_world_cam, *camera, shift, most, learnt, poses, prior, error, covariance)
        count, self.correlated, self.shared, self._recent_score, self._offset_variance = numbers.tolist()
        self._learnt, self.jumped = int(count), refined < 0
        if refined <= 0:
            return T_world_cam
        self.offset.learn(T_world_cam, prior, error, covariance)
        return poses
