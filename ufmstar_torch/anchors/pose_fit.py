"""Comparison of poses and intrinsics with corners followed in the images.

In a second image, a corner x lies on the half line from its point at infinity, K R K^-1 x, towards the epipole; each
point of the half line is one positive depth. The followed corner's distance from the half line is noise, or a mistake
in poses or intrinsics. Its position along the half line gives its depth in the unit of the poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.corners import find, follow
from ufmstar_torch.gaussians.conventions import CONVENTIONS, OURS

# Largest number of frames of a track, and two median motions, as shares of the image's width, at which corners are
# compared: near, where errors of good recordings are below a pixel, and far, where a smooth trajectory that is late by
# a frame has a visible error.
TRACK, _NEAR, _FAR = 12, 0.02, 0.08
_CORNERS, _SPACING, _BACK = 200, 14 / 640, 0.5  # as in the tracker of anchors
_FEWEST, _STILL = 20, 2.0  # smallest number of corners of a pair, and their smallest median motion [px]
# Other readings: frames by which the trajectory is late, and factors of the intrinsics. Those near 1 are calibration.
_LATE, _FACTORS = (-3, -2, -1, 1, 2, 3), 2.0 ** np.arange(-2, 2.01, 0.125)
_FACTORS = _FACTORS[np.abs(np.log2(_FACTORS)) > 0.3]
# Another reading is better if it halves the distance and reduces it by at least _APART [px]. On eight rendered tours,
# correct input is at .2 to .4 px and no reading halves it; a trajectory one frame late is at 1.1 px or more, four times
# the correct one's distance.
_HALVES, _APART = 2.0, 0.2
# Number of frames from which a delay or a factor of the intrinsics is inferred. The errors of a few successive poses of
# good recordings look like such a reading (in a tenth of all parts of 4 to 8 frames); they do not like a convention.
_SPAN = 12
# Largest distance of right poses, as a share of the width, and at least [px].
_LARGEST, _FINE = 0.005, 1.0


class FollowedCorners(NamedTuple):
    """Corners [N, 2] (u, v) [px] in frame ``first`` (``start``) and in frame ``last`` (``end``)."""

    first: int
    last: int
    start: np.ndarray
    end: np.ndarray

    @property
    def motion(self) -> float:
        """Median motion [px]."""
        return float(np.median(np.linalg.norm(self.end - self.start, axis=1)))


@dataclass(frozen=True)
class Reading:
    """A reading of poses and intrinsics: another convention, late by some frames, intrinsics times a factor."""

    poses: str = OURS
    late: int = 0
    factor: float = 1.0

    def __str__(self) -> str:
        if self.poses != OURS:
            return f"the poses look {CONVENTIONS[self.poses].description}"
        if self.late:
            frames = f"{abs(self.late)} frame{'s' if abs(self.late) > 1 else ''}"
            return f"the trajectory looks {frames} {'late' if self.late > 0 else 'early'}"
        return f"the intrinsics look as if given for images {1 / self.factor:.2g} times as large"


UNCHANGED = Reading()
_CONVENTIONS = tuple(Reading(poses=name) for name in CONVENTIONS if name != OURS)
_OTHERS = (
    *_CONVENTIONS, *(Reading(late=frames) for frames in _LATE),
    *(Reading(factor=float(factor)) for factor in _FACTORS),
)  # fmt: skip


@dataclass(frozen=True)
class ImageFit:
    """The distance of tracked corners from where poses and intrinsics allow them to be."""

    pairs: int  # number of pairs of frames
    motion: float  # median motion of a corner between the frames of a pair [px]
    error: float  # median distance from the half lines [px]
    limit: float  # largest ``error`` of right poses [px]
    reading: Reading  # the best one; ``UNCHANGED`` unless another one is much better
    problem: str  # "" = none

    @property
    def words(self) -> str:
        """The outcome as one line."""
        return f"{self._distance} (limit: {self.limit:.1f})"

    @property
    def _distance(self) -> str:
        return f"poses disagree with the images by {self.error:.1f} px"


@dataclass(frozen=True)
class Cameras:
    """Cameras of F images.

    Attributes:
        T_world_cam: [F, 4, 4] camera-to-world.
        K: [F, 3, 3] [px].
    """

    T_world_cam: NDArray[np.float64]
    K: NDArray[np.float64]


class CornerTrack:
    """Corners of one image, followed through the next ones.

    Args:
        index: number of the image.
        gray: [H, W] uint8.
    """

    def __init__(self, index: int, gray: NDArray[np.uint8]) -> None:
        self._pairs: list[FollowedCorners] = []
        self._first, self._gray = index, gray
        self._start = find(gray, _CORNERS, _SPACING * gray.shape[1], np.zeros((0, 2)))
        self._position = self._start

    @property
    def pairs(self) -> list[FollowedCorners]:
        """At most two pairs of the image, without those of little motion: with the first image at which the corners'
        motion reaches a fiftieth of the width, and with the one at which it reaches a twelfth or the track ends."""
        return [one for one in self._pairs if one.motion >= _STILL]

    def add(self, index: int, gray: NDArray[np.uint8]) -> bool:
        """Follow the corners into the next image, number ``index``. Returns False if the track has ended."""
        width = gray.shape[1]
        if gray.shape != self._gray.shape or len(self._start) < _FEWEST:
            return False
        position, alive = follow(self._gray, gray, self._position, _BACK)
        self._start, self._position, self._gray = self._start[alive], position[alive], gray
        if len(self._start) < _FEWEST:
            return False
        one = FollowedCorners(self._first, index, self._start, self._position)
        self._pairs = [*self._pairs[: bool(self._pairs) and self._pairs[0].motion >= _NEAR * width], one]
        return one.motion < _FAR * width and index - self._first < TRACK


def pose_fit(cameras: Cameras, width: float, corners: Sequence[FollowedCorners]) -> ImageFit | None:
    """The fit of the cameras of all images, ``width`` px wide, to followed corners; None without corners."""
    if not corners:
        return None
    limit = max(_FINE, _LARGEST * width)
    near = list({one.first: one for one in reversed(corners)}.values())
    far = list({one.first: one for one in corners}.values())
    fits = [_errors(cameras, pairs) for pairs in (near, far)]
    reading, error, best = UNCHANGED, fits[0][0], fits[0][0]
    span = max(one.last for one in corners) - min(one.first for one in corners) + 1
    tried = len(_OTHERS) if span >= _SPAN else len(_CONVENTIONS)
    for baseline, *others in fits:
        least = min(others[:tried])
        if reading == UNCHANGED and baseline > _HALVES * least and baseline - least > _APART and least <= limit:
            reading, error, best = _OTHERS[others.index(least)], baseline, least
    motion = float(np.median([one.motion for one in near]))
    fit = ImageFit(len(near), motion, error, limit, reading, "")
    if reading != UNCHANGED:
        return replace(fit, problem=f"{fit._distance}, but by {best:.1f} px under another reading: {reading}")
    if error > limit:
        text = "poses, intrinsics and images belong together under no reading tried"
        return replace(fit, problem=f"{fit.words}: {text}")
    return fit


def _errors(cameras: Cameras, corners: Sequence[FollowedCorners]) -> list[float]:
    """By reading, ``UNCHANGED`` and ``_OTHERS``: median over pairs of the median distance [px]; inf without poses."""
    last, medians = len(cameras.T_world_cam) - 1, []
    for one in corners:
        distance = np.median(epipolar_offsets(cameras, one, (UNCHANGED, *_OTHERS))[0], -1)
        inside = [one.first + r.late >= 0 and one.last + r.late <= last for r in (UNCHANGED, *_OTHERS)]
        medians.append(np.where(inside, distance, np.nan))
    with_poses = ~np.isnan(medians).all(0)
    return list(map(float, np.nanmedian(np.where(with_poses, medians, np.inf), 0)))


def epipolar_offsets(
    cameras: Cameras, corners: FollowedCorners, readings: Sequence[Reading] = (UNCHANGED,)
) -> tuple[NDArray[np.float64], ...]:
    """[R, N] each, by reading: distance of the followed corners from their half lines [px], position along them [px],
    and inverse depth in the first image [1/unit of the poses]. Where a late or early reading needs a pose before the
    first one or after the last one, that one is used."""
    last = len(cameras.T_world_cam) - 1
    T_a, T_b = (
        np.stack([CONVENTIONS[r.poses].convert(cameras.T_world_cam[min(max(at + r.late, 0), last)]) for r in readings])
        for at in (corners.first, corners.last)
    )
    factor = np.array([[[r.factor], [r.factor], [1.0]] for r in readings])
    K_a, K_b = (cameras.K[at] * factor for at in (corners.first, corners.last))
    T_b_a = np.linalg.inv(T_b) @ T_a
    rays = np.column_stack([corners.start, np.ones(len(corners.start))]) @ np.linalg.inv(K_a).swapaxes(1, 2)
    infinite = rays @ (K_b @ T_b_a[:, :3, :3]).swapaxes(1, 2)
    shift = (K_b @ T_b_a[:, :3, 3:]).swapaxes(1, 2)  # [R, 1, 3]
    ahead = infinite[..., 2] > 1e-3
    z = np.where(ahead, infinite[..., 2], 1.0)
    origin = infinite[..., :2] / z[..., None]
    speed = (shift[..., :2] - origin * shift[..., 2:]) / z[..., None]  # d x / d rho at rho = 0
    length = np.maximum(np.linalg.norm(speed, axis=2), 1e-12)
    offset = corners.end - origin
    along = (offset * speed).sum(2) / length
    across = np.abs(offset[..., 0] * speed[..., 1] - offset[..., 1] * speed[..., 0]) / length
    distance = np.where(along > 0, across, np.linalg.norm(offset, axis=2))
    # x(rho) = (infinite + rho shift) / (z + rho shift_z), so along = rho length z / (z + rho shift_z).
    rho = along / (length - along * shift[..., 2] / z)
    return np.where(ahead, distance, np.inf), along, np.where(ahead, rho, np.nan)
