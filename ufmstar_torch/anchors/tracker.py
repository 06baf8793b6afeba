"""Anchors from the images themselves: corners tracked over a few frames, which refine the poses (``bundle``) and are
triangulated with them.

Needs OpenCV (``opencv-python-headless``), on the CPU; nothing else of the package does. One tracker a camera. What it
keeps is of fixed size: a window of views, and the positions of at most ``max_points`` corners in them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.bundle import PoseRefinement
from ufmstar_torch.anchors.corners import find, follow
from ufmstar_torch.anchors.epipolar import NEAREST, median, off_lines, weighted_median
from ufmstar_torch.anchors.landmarks import REPEATED, Landmarks, OtherCameraError, checked
from ufmstar_torch.anchors.saved_state import SavedState, saved_image
from ufmstar_torch.checked import Checked, number

if TYPE_CHECKING:
    from ufmstar_torch.kernels.triangulate_cpu import Triangulated

# Tracks by which a frame's poses are judged.
_ENOUGH = 5
# Errors of a tracked position add up from view to view: the variance of a track of v views is _DRIFT (v - 1) times that
# of independent positions. On four rendered tours the squared errors grow with v like this, and of the size.
_DRIFT = 0.6
# Share of the running estimate of the residuals' variance that remains after a frame; views of the tracks that it is
# from.
_MEMORY, _LONG = 0.8, 4
# Why an image has no landmark.
_NO_TRACK, _NO_DEPTH = "no corner followed from the frame before", "no parallax, or no track that fits the poses"
# Entries of two poses that differ by no more are of one pose [1, m].
_SAME = 1e-6
# Depths of a scene, over the median: where the poses allow a corner's point to be. Half of the corners lie nearer than
# the median, which says little while it is not known well; of an image without motion, as of one that is frozen, all
# would be farther.
_NEAR, _FAR, _MEDIAN_DEPTH = 1 / 50, 10.0, 1.0
# Share of the running comparison with the poses that remains after a frame; the motion of a corner that shows a depth,
# and of an image that stands still [px].
_FOLLOWS, _MOVES, _STILL = 0.6, 1.0, 0.2
# Least baseline of the corners, a median, over the depth of the scene: refined poses of a camera that stands or only
# turns are as far apart as the given ones may err.
_PARALLAX = 0.005
# Least share of the corners whose parallax is clear. Where fewer have it, theirs is mostly their error, and they seem
# too near: by a factor of 7 with a share of .05, of 1.2 with .3 (a camera that turns, on tours); where the camera moves
# it is more than half.
_CLEAR_SHARE = 1 / 3
# Cells of the image, in a row, that count alike in what corners show of the poses.
_CELLS = 6
# The median of the absolute value of a standard normal variable.
_MEDIAN = 0.6745


@dataclass(frozen=True)
class TrackerConfig(Checked):
    """Settings of the search for corners, of their tracking and acceptance. Lengths in pixels are the camera's.

    Attributes:
        max_points: corners followed at a time.
        window: views kept, and used for triangulation.
        min_views: of a corner, before it is triangulated.
        spacing: least distance between two corners [px] in an image 640 wide; it follows the width.
        back_tolerance: a corner tracked forward and back must return this near to where it was [px].
        pixel_noise: standard deviation of a tracked position [px], poses' errors included, until the residuals of the
            tracks tell it.
        max_error: largest root mean square reprojection error of a track [px]. Poses err too; a track that fits
            worse than the others gets a variance by as much larger.
        max_relative_sigma: largest standard deviation of the depth, as a share of it, that independent errors of
            ``pixel_noise`` would make: less parallax is no anchor. Not less than needed: what is far away has little
            parallax, and to leave it out would hide the error there.
        min_share: least share of the triangulated tracks that fit, 0 to 1. Where fewer do, poses and image contradict
            each other, and those that fit do so by chance: none is used.
        max_pose_error: largest distance of tracked corners from the epipolar lines of the refined poses, a standard
            deviation, as a share of the image's width: beyond, poses and images contradict each other, and no depth is
            used.
        start_depth: median depth of the scene before one is known [m]; right to a factor of 5.

    Raises:
        ValueError: an impossible value.
    """

    max_points: int = number(300, "", "1", 1)
    window: int = number(10, "", "1", 2)
    min_views: int = number(2, "", "1", 2)
    spacing: float = number(14.0, "", "px", 0, open_low=True)
    back_tolerance: float = number(0.5, "", "px", 0, open_low=True)
    pixel_noise: float = number(1.0, "", "px", 0, open_low=True)
    max_error: float = number(3.0, "", "px", 0, open_low=True)
    max_relative_sigma: float = number(0.4, "", "1", 0, open_low=True)
    min_share: float = number(0.2, "", "1", 0, 1)
    max_pose_error: float = number(0.012, "", "width", 0, open_low=True)
    start_depth: float = number(2.0, "", "m", 0, open_low=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_views > self.window:
            raise ValueError(f"TrackerConfig.min_views must be at most window = {self.window}, got {self.min_views}")


class LandmarkTracker(SavedState):
    """Follows corners from image to image and triangulates them.

    Args:
        config: see :class:`TrackerConfig`; None = its defaults.

    Attributes:
        baseline: of the corners of the last image, the median over their first views [m].

    Example::

        tracker = LandmarkTracker()
        for image, T_world_cam in video:
            landmarks = tracker.update(image, T_world_cam, K)
            out = ufm(depth, T_world_cam, K_map, anchors=landmarks.anchors(K, K_map))
    """

    needs_image = True
    HELD: ClassVar = {
        "_K": "K",
        "_pixel": "pixel",
        "_seen": "seen",
        "_given": "given_poses",
        "_poses": "poses",
        "_number": "number",
        "_view": "view",
        "_noise": "noise",
        "_off": "off",
        "_now": "off_now",
        "baseline": "baseline",
        "_depth": "depth",
        "_judged": "depths_judged",
    }

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
        self._given, self._poses = np.tile(np.eye(4), (2, w, 1, 1))  # as given, and refined
        self._number = np.full(w, -1)  # of the views, counted from the first image
        self._view = -1
        self._refinement.reset()
        self._noise = self.config.pixel_noise**2
        # Standard deviation of corners from their epipolar lines [px], lately and in the newest image; negative = not
        # measured.
        self._off = self._now = -1.0
        self.baseline, self._depth = 0.0, self.config.start_depth  # of the views, and of the scene [m]
        self._judged = 0  # images that showed the scene's depth
        self._point = np.full((n, 3), np.nan)  # of the corners in the newest image [m]; the window decides it

    def state(self) -> dict[str, Tensor]:
        """All that is remembered, for :meth:`load_state`: the window, and the last image in gray, which is shared and
        must not be written to."""
        return {"gray": torch.from_numpy(self._gray)} | super().state() | self._refinement.state()

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue where :meth:`state` was taken; ValueError: another ``max_points`` or ``window``."""
        gray = saved_image(state, "gray")
        super().load_state(state)
        self._refinement.load_state(state)
        self._gray = gray
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
            The landmarks that it shows; none before there is parallax.

        Raises:
            TypeError: ``image`` is no array.
            ValueError: wrong shape or dtype, a pose that is not finite, another size or camera than before (call
                :meth:`reset` first); the tracker is as it was then.
            ModuleNotFoundError: OpenCV is not installed.
        """
        gray, T, K = checked(image, T_world_cam, K)
        if self._gray.size:
            if gray.shape != self._gray.shape or not np.array_equal(K, self._K):
                raise OtherCameraError
            if self.repeats(gray, T):
                return Landmarks.skipped(REPEATED)
            position, alive = self._followed(gray, T)
        else:
            position, alive = np.zeros((self.config.max_points, 2)), np.zeros(self.config.max_points, dtype=bool)
        last, self._view = self._view, (self._view + 1) % self.config.window
        self._number[self._view] = self._number[last] + 1
        self._seen[~alive] = False  # a lost corner's slot is free
        self._seen[:, self._view] = alive
        self._pixel[:, self._view] = position
        self._given[self._view] = self._poses[self._view] = T
        tracked = int(alive.sum())
        self._gray, self._K = gray, K
        self._refine()
        self._compare_with_poses()
        self._fill(gray)
        return self._landmarks(tracked)

    def repeats(self, gray: NDArray[np.uint8], T_world_cam: NDArray[np.float64]) -> bool:
        """True if a gray image is the last one again, pixel by pixel, with another pose: a frozen or doubled image."""
        return np.array_equal(gray, self._gray) and not np.allclose(T_world_cam, self._given[self._view], atol=_SAME)

    @property
    def pose(self) -> NDArray[np.float64]:
        """[4, 4] refined pose of the last image, camera-to-world [m]."""
        return np.array(self._poses[self._view])

    @property
    def jumped(self) -> bool:
        """True where the last pose begins another trajectory: what was seen before is of no use."""
        return self._refinement.jumped

    @property
    def refined(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Numbers [W] of the images in the window, the first one 0, and their refined poses [W, 4, 4]."""
        return self._number, self._poses

    @property
    def depth(self) -> float:
        """Median depth of the scene [m], as the corners show it."""
        return self._depth

    @property
    def focal(self) -> float:
        """Focal length of the last image [px]."""
        return float(self._K[0, 0])

    @property
    def pose_error(self) -> float:
        """Standard deviation of corners from their epipolar lines by the given poses [px]; NaN = not measured."""
        return (self._off**2 + self._refinement.pose_variance) ** 0.5 if self._off >= 0 else float("nan")

    @property
    def lag(self) -> float:
        """By how many images the given poses are late; negative = early, 0 = not shown."""
        return self._refinement.offset.lag

    @property
    def remaining_error(self) -> float:
        """That by the refined poses, with the errors that successive given poses share [px]; 0 = not measured."""
        return (max(self._off, 0.0) ** 2 + self._refinement.correlated) ** 0.5

    @property
    def refined_variance(self) -> float:
        """Variance of inverse depths by the errors that remain in the refined poses [1/m^2]; 0 = not refined."""
        return self._refinement.shared

    @property
    def pose_variance(self) -> float:
        """Variance that errors of the poses add to a tracked position [px^2]."""
        off = max(self._off, 0.0) ** 2 - self.config.pixel_noise**2
        return max(off, 0.0) + self._refinement.correlated

    @property
    def contradicted(self) -> bool:
        """True where the poses contradict the images, lately or the newest one alone."""
        return max(self.remaining_error, self._now) > self._limit

    @property
    def _limit(self) -> float:
        """Largest error of positions by the poses [px]."""
        return self.config.max_pose_error * self._gray.shape[1]

    def _refine(self) -> None:
        """Refine the window's poses by its corners."""
        order = (self._view + 1 + np.arange(self.config.window)) % self.config.window
        views = self._pixel[:, order], self._seen[:, order], self._given[order]
        self._poses[order] = self._refinement.refine(*views, self._K, self._depth)
        if self.jumped:
            self._seen[:, order[:-1]] = False

    def _compare_with_poses(self) -> None:
        """Follow how far corners lie from where the poses allow them to be, each in the first view that has it."""
        order = (self._view + 1 + np.arange(self.config.window)) % self.config.window
        seen = self._seen[:, order]
        chosen = np.flatnonzero(seen[:, -1] & seen[:, :-1].any(1))
        if len(chosen) < _ENOUGH:
            return
        first = order[seen[chosen].argmax(1)]
        views = self._pixel[chosen, self._view], self._pixel[chosen, first], self._poses[self._view], self._poses[first]
        motion = np.linalg.norm(views[0] - views[1], axis=1)
        far = self._depth * (_MEDIAN_DEPTH if median(motion) < _STILL else _FAR)
        distance, rho, baseline = off_lines(*views, self._K, _NEAR * self._depth, far)
        cell = (views[0] * _CELLS / self._gray.shape[::-1]).astype(np.int64).clip(0, _CELLS - 1) @ [1, _CELLS]
        weight = 1 / np.bincount(cell)[cell]  # by area: a thing that moves by itself may have most of the corners
        self._now = weighted_median(distance, weight) / _MEDIAN
        self._off = self._now if self._off < 0 else _FOLLOWS * self._off + (1 - _FOLLOWS) * self._now
        self.baseline = median(baseline)
        shows = (rho > 0) & (motion > _MOVES)
        if shows.sum() >= _ENOUGH:
            self._judged += 1
            share = max(1 - _MEMORY, 1 / self._judged)
            self._depth *= (1 / weighted_median(rho[shows], weight[shows]) / self._depth) ** share

    def _followed(self, gray: NDArray[np.uint8], T: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
        """Positions [N, 2] in the new image and which corners could be followed there and back [N]."""
        position, alive = self._pixel[:, self._view].copy(), self._seen[:, self._view].copy()
        if alive.any():
            start, expected = position[alive], self._expected(alive, T)
            position[alive], alive[alive] = follow(self._gray, gray, start, self.config.back_tolerance, expected)
        return position, alive

    def _expected(self, chosen: NDArray[np.bool_], T: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Predict the positions of the chosen corners in the image of a camera T [4, 4]: each moves as its
        point does. One without a point has the others' median depth; None where too few have one."""
        last, K = self._poses[self._view], self._K
        position, point = self._pixel[chosen, self._view], self._point[chosen]
        depth = (point - last[:3, 3]) @ last[:3, 2]
        finite = np.isfinite(depth)
        if finite.sum() < _ENOUGH:
            return None
        rays = np.concatenate([position, np.ones((len(position), 1))], axis=1) @ np.linalg.inv(K).T
        usual = median(depth[finite])
        point = np.where(finite[:, None], point, usual * rays @ last[:3, :3].T + last[:3, 3])

        def seen_by(pose: NDArray[np.float64]) -> NDArray[np.float64]:
            cam = (point - pose[:3, 3]) @ pose[:3, :3]
            return np.asarray(cam @ K[:2].T / np.maximum(cam[:, 2:], NEAREST * usual))

        return np.asarray(position + seen_by(T) - seen_by(last))

    def _fill(self, gray: NDArray[np.uint8]) -> None:
        """New corners in free slots, away from those that are followed."""
        followed = self._seen[:, self._view]
        free = np.flatnonzero(~followed)
        # Not for a few: a search costs half of following them all.
        if len(free) < max(1, self.config.max_points // 5):
            return
        spacing = self.config.spacing * gray.shape[1] / 640
        result = find(gray, len(free), spacing, self._pixel[followed, self._view])
        slots = free[: len(result)]
        self._seen[slots] = False
        self._seen[slots, self._view] = True
        self._pixel[slots, self._view] = result

    def _triangulated(self) -> tuple[NDArray[np.bool_], Triangulated | None]:
        """Triangulate the corners of the newest image that have enough views in the window (mask [N]), and store the
        points that fit."""
        chosen = self._seen[:, self._view] & (self._seen.sum(1) >= self.config.min_views)
        self._point = np.full((self.config.max_points, 3), np.nan)
        if not chosen.any():
            return chosen, None
        from ufmstar_torch.kernels.triangulate_cpu import triangulate  # compiles when it is first needed

        result = triangulate(self._pixel[chosen], self._seen[chosen], self._poses, self._K)
        fine = result.ahead & (result.error <= self.config.max_error)
        self._point[chosen] = np.where(fine[:, None], result.point, np.nan)
        return chosen, result

    def _landmarks(self, tracked: int) -> Landmarks:
        """Triangulate the newest image's corners from the views in the window."""
        config = self.config
        chosen, result = self._triangulated()
        none = _NO_DEPTH if tracked else _NO_TRACK
        if self.contradicted:
            none = contradiction(max(self.remaining_error, self._now), self._limit)
        if result is None or self.contradicted or self.baseline < _PARALLAX * self._depth:
            nothing, shared = np.zeros(0), self.shared(self.baseline)
            pixel = np.zeros((0, 2))
            judged = self.pose_error, shared, self.contradicted
            return Landmarks(pixel, nothing, nothing, tracked, none, *judged, lag=self.lag)
        T = self._poses[self._view]
        axis = T[:3, 2]
        depth = (result.point - T[:3, 3]) @ axis
        fits, views = result.error <= config.max_error, self._seen[chosen].sum(1)
        residual = np.square(result.error) * 2 * views / np.maximum(2 * views - 3, 1)
        long = fits & result.ahead & (views >= _LONG)
        if long.sum() >= _ENOUGH:
            self._noise = _MEMORY * self._noise + (1 - _MEMORY) * median(residual[long])
        # A track that fits worse than the noise allows is as uncertain as it fits.
        one_pixel = np.einsum("i,nij,j->n", axis, result.covariance, axis)
        variance = _DRIFT * (views - 1) * np.maximum(residual, self._noise) * one_pixel
        safe = np.maximum(depth, 1e-9)
        # Two views contradict each other across the epipolar line only; three tell, if enough tracks have them.
        telling = fits[views > 2] if (views > 2).sum() >= _ENOUGH else fits
        fine = fits & result.ahead & (depth > 0) & (telling.mean() >= config.min_share)
        # Hopeless geometry can make the covariance indefinite.
        independent = np.maximum(residual, config.pixel_noise**2) * one_pixel
        fine &= (variance >= 0) & (independent <= np.square(config.max_relative_sigma * safe))
        fine &= fine.mean() >= _CLEAR_SHARE
        pixel = self._pixel[chosen][fine, self._view]
        shared = self.shared(self.baseline) + self._refinement.shared
        variance = variance[fine] + shared * depth[fine] ** 4
        return Landmarks(pixel, depth[fine], variance, tracked, none, self.pose_error, shared, lag=self.lag)

    def shared(self, baseline: float) -> float:
        """Variance of inverse depths by errors of the poses over a baseline [m], alike for all points [1/m^2]; infinite
        where the poses contradict more images than the newest: what earlier ones taught may be as wrong."""
        if self.remaining_error > self._limit:
            return float("inf")
        return self.pose_variance / max(self._K[0, 0] * baseline, 1e-9) ** 2 if self.pose_variance else 0.0


def contradiction(error: float, limit: float) -> str:
    """The warning that no depth is used, where corners lie ``error`` px from their epipolar lines."""
    return f"poses contradict the images: corners lie {error:.1f} px from their epipolar lines, at most {limit:.1f}"
