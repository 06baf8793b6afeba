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

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.epipolar import FAR, NEAR, median, off_lines, on_lines
from ufmstar_torch.anchors.saved_state import POSITIVE, SavedState
from ufmstar_torch.anchors.time_offset import TimeOffset

# [px] Standard deviations of a position by errors of the poses: at first (best on tours whose poses err by .05 to .15
# degrees and 2 mm), and their limits when they are learnt.
_FIRST, _LEAST, _LARGEST = 0.5, 0.003, 20.0
# Share of the running estimates that remains after a frame.
_MEMORY = 0.8
# A pose starts another trajectory if the score of its error, chi-squared with six degrees of freedom, exceeds _SCORE
# and _TIMES the recent scores, and its shift of positions is clear (``kernels.bundle``). Otherwise the poses are
# noisier than learnt so far.
_SCORE, _TIMES = 60.0, 5.0
# Least share of the tracks that do not fit the input poses, for them to be taken for tracks of things that move, which
# the poses would follow; below .2 on recordings of still scenes. Least number of tracks that is judged.
_MOVING, _FEWEST = 0.25, 8
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
        from ufmstar_torch.anchors.kernels.bundle import refined  # compiles when it is first needed

        self.shared, self.jumped = 0.0, False
        views = np.flatnonzero(seen.any(0))
        if len(views) < _VIEWS:
            return T_world_cam
        unit = np.array([[1], [depth]]) / K[0, 0]  # w [rad] and s [m] that shift a position by a pixel
        stated, prior = T_world_cam[views], np.tile(np.repeat(1 / (self._variance * unit[:, 0] ** 2), 3), len(views))
        shift, most = self.offset.shift(stated), max(_SCORE, _TIMES * self._recent_score)
        pixel, seen = pixel[:, views], seen[:, views]
        seen = seen & _static(pixel, seen, stated, K, depth)[:, None]
        result, score, self.jumped = refined(pixel, seen, stated, K, depth, shift, prior, most)
        if score == score:
            self._recent_score = max(score, _MEMORY * self._recent_score)
        if result is None:
            return T_world_cam
        self.shared = median(result.depth_variance)
        self._offset_variance = float(np.square(shift[-1].reshape(2, 3) / unit).sum()) / 3
        self._learn(result.error[-6:].reshape(2, 3) / unit, result.covariance.diagonal()[-6:].reshape(2, 3) / unit**2)
        self.offset.learn(stated, prior, result.error, result.covariance)
        poses = T_world_cam.copy()
        poses[views] = result.poses
        return poses

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


def _static(
    pixel: NDArray[np.float64], seen: NDArray[np.bool_], T_world_cam: NDArray[np.float64], K: NDArray[np.float64],
    depth: float,
) -> NDArray[np.bool_]:  # fmt: skip
    """Which tracks [N] refine the poses [W, 4, 4]: the largest group that fits them between its first view and the
    newest. All, where few do not fit: their Student-t weights suffice. Arguments as in :meth:`PoseRefinement.refine`.
    """
    from ufmstar_torch.anchors.kernels.bundle import position_variance

    tracks = np.flatnonzero(seen[:, -1] & (seen.sum(1) > 1))
    result = np.ones(len(pixel), np.bool_)
    if len(tracks) < _FEWEST:
        return result
    first, newest = seen[tracks].argmax(1), pixel[tracks, -1]
    views = newest, pixel[tracks, first], T_world_cam[-1], T_world_cam[first]
    distance, *_ = off_lines(*views, K, NEAR * depth, FAR * depth)
    sigma = np.sqrt(position_variance(seen.shape[1] - 1 - first))
    fits, _ = on_lines(distance / sigma, newest, 2 * K[:2, 2], 1.0)
    result[tracks] = fits | bool(fits.mean() > 1 - _MOVING)
    return result
