"""Anchors from images: corners tracked over a few frames refine the poses (``bundle``) and are triangulated with them.

Needs OpenCV (``opencv-python-headless``), on the CPU. Each camera needs its own tracker. Its state has a fixed size: a
window of views, and the positions of at most ``max_points`` corners in them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.bundle import PoseRefinement
from ufmstar_torch.anchors.corners import find, follow
from ufmstar_torch.anchors.kernels.tracks import Limits, accept, compare, predict
from ufmstar_torch.anchors.kernels.triangulate import Triangulated, triangulate
from ufmstar_torch.anchors.landmarks import REPEATED, Landmarks, OtherCameraError, checked
from ufmstar_torch.anchors.saved_state import POSITIVE, SavedState
from ufmstar_torch.gaussians.camera import inverse_intrinsics
from ufmstar_torch.runtime.checked import Checked, number
from ufmstar_torch.runtime.kinds import check_kinds

# Why an image has no landmark.
_NO_TRACK, _NO_DEPTH = "no corner followed from the frame before", "no parallax, or no track that fits the poses"
# Largest difference of the entries of equal poses [1, m].
_SAME = 1e-6
# Share of the running distance from the epipolar lines, and of the scene's depth, that remains after a frame.
_FADE, _MEMORY = 0.6, 0.8
# Least median baseline of the corners over the depth of the scene. Refined poses of a camera that stands or only turns
# still differ by their errors.
_PARALLAX = 0.005


@dataclass(frozen=True)
class TrackerConfig(Checked):
    """Settings of the search for corners, of their tracking and acceptance. Lengths in pixels are the camera's.

    Attributes:
        max_points: corners followed at a time.
        window: number of stored views, which are used for triangulation.
        spacing: least distance between two corners in an image 640 px wide [px]; proportional to the width.
        pixel_noise: standard deviation of a tracked position, including errors of the poses, until it is estimated from
            the residuals of the tracks [px].
        max_relative_sigma: largest standard deviation of the depth, as a share of it, by independent errors of
            ``pixel_noise``: tracks with less parallax yield no anchor. A low limit excludes distant points, which have
            little parallax, and hides errors there.
        start_depth: initial median depth of the scene, right to a factor of 5 [m].

    Raises:
        ValueError: an impossible value.
    """

    max_points: int = number(300, "", "1", 1)
    window: int = number(10, "", "1", 2)
    spacing: float = number(14.0, "", "px", 0, open_low=True)
    pixel_noise: float = number(1.0, "", "px", 0, open_low=True)
    max_relative_sigma: float = number(0.4, "", "1", 0, open_low=True)
    start_depth: float = number(2.0, "", "m", 0, open_low=True)

    # [1]: least number of views of a triangulated corner
    min_views: ClassVar[int] = 2
    # [px]: largest distance of a corner tracked forward and back from its start
    back_tolerance: ClassVar[float] = 0.5
    # [px]: largest root mean square reprojection error of a track; one that fits worse than the others gets a larger
    # variance
    max_error: ClassVar[float] = 3.0
    # [1]: least share of the triangulated tracks that fit; where fewer fit, poses and image contradict each other, the
    # tracks that fit do so by chance, and none is used
    min_share: ClassVar[float] = 0.2
    # [width]: largest standard deviation of tracked corners from the epipolar lines of the refined poses; where it is
    # larger, poses and images contradict each other, and no depth is used
    max_pose_error: ClassVar[float] = 0.012


class LandmarkTracker(SavedState):
    """Tracks corners from image to image and triangulates them.

    Args:
        config: see :class:`TrackerConfig`; None = its defaults.

    Attributes:
        baseline: median baseline of the last image's corners to their first views [m].

    Example::

        tracker = LandmarkTracker()
        for image, T_world_cam in video:
            landmarks = tracker.update(image, T_world_cam, K)
            out = ufm(depth, T_world_cam, K_map, anchors=landmarks.anchors(K, K_map))
    """

    needs_image = True
    HELD: ClassVar = {
        "_gray": "gray", "_K": "K", "_pixel": "pixel", "_seen": "seen", "_input_poses": "given_poses",
        "_poses": "poses", "_number": "number", "_noise": "noise", "_line_error": "off",
        "_newest_line_error": "off_now", "baseline": "baseline", "_depth": "depth", "_depth_count": "depths_judged",
    }  # fmt: skip
    RANGES: ClassVar = {"_depth": POSITIVE}

    @check_kinds
    def __init__(self, config: TrackerConfig | None = None) -> None:
        self.config = config if config is not None else TrackerConfig()
        self._refinement = PoseRefinement()
        self.reset()

    @property
    def identity(self) -> dict[str, Any]:
        """Plain values on which the landmarks depend."""
        return {"anchors": "corners", "tracker": self.config.to_dict()}

    def reset(self) -> None:
        """Forget everything."""
        n, w = self.config.max_points, self.config.window
        self._gray, self._K = np.zeros((0, 0), np.uint8), np.eye(3)  # of the last image
        self._pixel = np.zeros((n, w, 2))
        self._seen = np.zeros((n, w), dtype=bool)
        self._input_poses, self._poses = np.tile(np.eye(4), (2, w, 1, 1))  # of the input, and refined
        self._number = np.full(w, -1)  # index of each view's image; the newest view is the last
        self._refinement.reset()
        self._noise = self.config.pixel_noise**2
        # Standard deviation of corners from their epipolar lines [px], running and in the newest image; negative = not
        # measured.
        self._line_error = self._newest_line_error = -1.0
        self.baseline, self._depth = 0.0, self.config.start_depth  # of the views, and of the scene [m]
        self._depth_count = 0  # images from which the scene's depth was estimated
        self._point = np.full((n, 3), np.nan)  # of the newest image's corners [m]; derived from the window

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of :meth:`state`; ValueError: another ``max_points`` or ``window``."""
        super().load_state(state)
        self._triangulated()

    def update(
        self, image: NDArray[np.uint8] | None, T_world_cam: NDArray[np.float64], K: NDArray[np.float64]
    ) -> Landmarks:
        """Process the next image.

        Args:
            image: [H, W, 3] RGB or [H, W] gray, uint8.
            T_world_cam: [4, 4] camera-to-world [m].
            K: [3, 3] of the image [px]; the same for all images.

        Returns:
            The image's landmarks; none before there is parallax.

        Raises:
            TypeError: ``image`` is no array.
            ValueError: wrong shape or dtype, a pose that is not finite, another size or camera than before (call
                :meth:`reset` first); the tracker stays unchanged.
            ModuleNotFoundError: OpenCV is not installed.
        """
        return self.track(*checked(image, T_world_cam, K))

    def track(self, gray: NDArray[np.uint8], T: NDArray[np.float64], K: NDArray[np.float64]) -> Landmarks:
        """:meth:`update` with checked arguments and a gray image."""
        if self._gray.size:
            if gray.shape != self._gray.shape or not np.array_equal(K, self._K):
                raise OtherCameraError
            if self._repeats(gray, T):
                return Landmarks.skipped(REPEATED)
        position, alive = self._followed(gray, T)
        tracked = int(np.count_nonzero(alive))
        self._number = np.append(self._number[1:], self._number[-1] + 1)
        self._pixel = np.concatenate([self._pixel[:, 1:], position[:, None]], 1)
        self._seen = np.concatenate(
            [self._seen[:, 1:] & alive[:, None], alive[:, None]], 1
        )  # lost corners are free slots
        self._input_poses = np.concatenate([self._input_poses[1:], T[None]])
        self._gray, self._K = gray, K
        self._poses = self._refinement.refine(self._pixel, self._seen, self._input_poses, K, self._depth)
        if self.jumped:
            self._seen[:, :-1] = False
        self._compare_with_poses()
        self._fill(gray)
        return self._landmarks(tracked)

    def _repeats(self, gray: NDArray[np.uint8], T_world_cam: NDArray[np.float64]) -> bool:
        """True if a gray image equals the last one but has another pose: a frozen or duplicated image."""
        return np.array_equal(gray, self._gray) and not np.allclose(T_world_cam, self._input_poses[-1], atol=_SAME)

    @property
    def pose(self) -> NDArray[np.float64]:
        """[4, 4] refined pose of the last image, camera-to-world [m]."""
        return np.array(self._poses[-1])

    @property
    def jumped(self) -> bool:
        """True if the last pose starts another trajectory: earlier images are of no use."""
        return self._refinement.jumped

    @property
    def refined(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Indices [W] of the images in the window, from 0, -1 = none, and their refined poses [W, 4, 4]."""
        return self._number, self._poses

    @property
    def depth(self) -> float:
        """Median depth of the scene, estimated from the corners [m]."""
        return self._depth

    @property
    def focal(self) -> float:
        """Focal length of the last image [px]."""
        return float(self._K[0, 0])

    @property
    def pose_error(self) -> float:
        """Standard deviation of corners from the epipolar lines of the input poses [px]; NaN = not measured."""
        return (self._line_error**2 + self._refinement.pose_variance) ** 0.5 if self._line_error >= 0 else float("nan")

    @property
    def lag(self) -> float:
        """Delay of the input poses [images]; negative = early, 0 = not significant."""
        return self._refinement.offset.lag

    @property
    def remaining_error(self) -> float:
        """Standard deviation of corners from the epipolar lines of the refined poses, with the errors that successive
        input poses share [px]; 0 = not measured."""
        return (max(self._line_error, 0.0) ** 2 + self._refinement.correlated) ** 0.5

    @property
    def refined_variance(self) -> float:
        """Variance of inverse depths by the errors of the refined poses [1/m^2]; 0 = not refined."""
        return self._refinement.shared

    @property
    def pose_variance(self) -> float:
        """Variance that errors of the poses add to a tracked position [px^2]."""
        excess = max(self._line_error, 0.0) ** 2 - self.config.pixel_noise**2
        return max(excess, 0.0) + self._refinement.correlated

    @property
    def contradicted(self) -> bool:
        """True if the poses contradict the recent images or the newest one."""
        return max(self.remaining_error, self._newest_line_error) > self._limit

    @property
    def _limit(self) -> float:
        """Largest standard deviation of corners from their epipolar lines [px]."""
        return self.config.max_pose_error * self._gray.shape[1]

    def _compare_with_poses(self) -> None:
        """Update the distance of corners from their epipolar lines, each in its first view, and the scene's depth."""
        camera = self._poses, self._K, inverse_intrinsics(self._K), self._gray.shape[::-1]
        newest, baseline, rho = compare(self._pixel, self._seen, *camera, self._depth, self.config.pixel_noise)
        if newest < 0:
            return
        self._newest_line_error, self.baseline = newest, baseline
        self._line_error = newest if self._line_error < 0 else _FADE * self._line_error + (1 - _FADE) * newest
        if rho > 0:
            self._depth_count += 1
            share = max(1 - _MEMORY, 1 / self._depth_count)
            self._depth *= (1 / rho / self._depth) ** share

    def _followed(self, gray: NDArray[np.uint8], T: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
        """Positions [N, 2] in the new image, and [N] True for corners that were tracked there and back."""
        position, alive = self._pixel[:, -1].copy(), self._seen[:, -1].copy()
        corners = np.flatnonzero(alive)
        if len(corners):
            start, expected = position[corners], np.empty((len(corners), 2))
            cameras = self._poses[-1], T, self._K, inverse_intrinsics(self._K)
            predicted = predict(start, self._point[corners], *cameras, expected)
            found = follow(self._gray, gray, start, self.config.back_tolerance, expected if predicted else None)
            position[corners], alive[corners] = found
        return position, alive

    def _fill(self, gray: NDArray[np.uint8]) -> None:
        """Detect new corners for free slots, away from tracked ones."""
        followed = self._seen[:, -1]
        free = np.flatnonzero(~followed)
        # Not for a few slots: a search takes half as long as tracking all corners.
        if len(free) < max(1, self.config.max_points // 5):
            return
        spacing = self.config.spacing * gray.shape[1] / 640
        result = find(gray, len(free), spacing, self._pixel[followed, -1])
        slots = free[: len(result)]
        self._seen[slots] = False
        self._seen[slots, -1] = True
        self._pixel[slots, -1] = result

    def _triangulated(self) -> tuple[NDArray[np.int64], Triangulated | None]:
        """Triangulate the corners [N] of the newest image that have enough views in the window, and store the points
        that fit."""
        chosen = np.flatnonzero(self._seen[:, -1] & (self._seen.sum(1) >= self.config.min_views))
        self._point = np.full((self.config.max_points, 3), np.nan)
        if not len(chosen):
            return chosen, None
        result = triangulate(self._pixel[chosen], self._seen[chosen], self._poses, self._K)
        fine = result.ahead & (result.error <= self.config.max_error)
        self._point[chosen] = np.where(fine[:, None], result.point, np.nan)
        return chosen, result

    def _landmarks(self, tracked: int) -> Landmarks:
        """Landmarks of the newest image, into which ``tracked`` corners were tracked."""
        config = self.config
        chosen, result = self._triangulated()
        none = _NO_DEPTH if tracked else _NO_TRACK
        if self.contradicted:
            none = contradiction(max(self.remaining_error, self._newest_line_error), self._limit)
        if result is None or self.contradicted or self.baseline < _PARALLAX * self._depth:
            nothing, shared = np.zeros(0), self.shared(self.baseline)
            pixel = np.zeros((0, 2))
            judged = self.pose_error, shared, self.contradicted
            return Landmarks(pixel, nothing, nothing, tracked, none, *judged, lag=self.lag)
        depth, variance, fine = *np.empty((2, len(chosen))), np.empty(len(chosen), np.bool_)
        limits = Limits(config.pixel_noise, config.max_relative_sigma, config.max_error, config.min_share)
        arguments = result, self._seen[chosen], self._poses[-1], limits, self._noise
        self._noise = accept(*arguments, depth, variance, fine)
        depth, shared = depth[fine], self.shared(self.baseline) + self._refinement.shared
        pixel, variance = self._pixel[chosen[fine], -1], variance[fine] + shared * depth**4
        return Landmarks(pixel, depth, variance, tracked, none, self.pose_error, shared, lag=self.lag)

    def shared(self, baseline: float) -> float:
        """Variance of the inverse-depth error that wrong poses cause in all points over a baseline [m] [1/m^2].

        It is infinite if the poses contradict more images than the newest: earlier estimates may be as wrong.
        """
        if self.remaining_error > self._limit:
            return float("inf")
        return self.pose_variance / max(self._K[0, 0] * baseline, 1e-9) ** 2 if self.pose_variance else 0.0


def contradiction(error: float, limit: float) -> str:
    """Reason that no depth is used, where corners lie ``error`` px from their epipolar lines."""
    return f"poses contradict the images: corners lie {error:.1f} px from their epipolar lines, at most {limit:.1f}"
