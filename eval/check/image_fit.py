"""Checks poses, intrinsics and depth against corners tracked over a few frames.

In a second image, a corner x lies on the half line from its point at infinity, K R K^-1 x, towards the epipole; each
point of the half line is one positive depth. The tracked corner's distance from the half line is noise, or a mistake in
poses or intrinsics. Its position along the half line gives its depth in the unit of the poses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.stats import spearmanr

from ufmstar_torch.anchors.corners import find, follow
from ufmstar_torch.anchors.landmarks import checked
from ufmstar_torch.eval.sequences.frame import FrameError, FrameSequence
from ufmstar_torch.eval.sequences.poses import CONVENTIONS, OURS

# Number of start frames; largest number of frames of a track; and two median motions, as shares of the image's width,
# at which corners are compared: near, where errors of good recordings are below a pixel, and far, where a smooth
# trajectory that is late by a frame has a visible error.
_PLACES, _FRAMES, _NEAR, _FAR = 6, 12, 0.02, 0.08
_CORNERS, _SPACING, _BACK = 200, 14 / 640, 0.5  # as in the tracker of anchors
_FEWEST, _STILL = 20, 2.0  # smallest number of corners of a pair, and their smallest median motion [px]
# Other readings: frames by which the trajectory is late, and factors of the intrinsics. Those near 1 are calibration.
_LATE, _FACTORS = (-3, -2, -1, 1, 2, 3), 2.0 ** np.arange(-2, 2.01, 0.125)
_FACTORS = _FACTORS[np.abs(np.log2(_FACTORS)) > 0.3]
# Another reading is better if it halves the distance and reduces it by at least _APART [px]. On eight rendered tours,
# correct input is at .2 to .4 px and no reading halves it; a trajectory one frame late is at 1.1 px or more, four times
# the correct one's distance.
_HALVES, _APART = 2.0, 0.2
_FINE = 1.0  # [px] upper limit of good poses in messages
_LARGEST = 0.005  # largest distance under the best reading, as a share of the width
# Depth compared with that of corners: smallest number of pairs, and of corners of each; smallest shift along the line
# [px]; factor from which units differ (networks err by less than 2 on average); rank correlation of inverse depth.
_PAIRS, _POINTS, _SHIFT, _UNITS, _INVERSE = 2, 10, 2.0, 4.0, -0.3


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


@dataclass(frozen=True)
class ImageFit:
    """The distance of tracked corners from where poses and intrinsics allow them to be."""

    pairs: int  # number of pairs of frames
    motion: float  # median motion of a corner between the frames of a pair [px]
    error: float  # median distance from the half lines [px]
    reading: Reading  # the best one; ``UNCHANGED`` unless another one is much better
    best_error: float  # median distance under ``reading`` [px]
    problem: str  # "" = none

    @property
    def words(self) -> str:
        """The outcome as one line."""
        return f"poses disagree with the images by {self.error:.1f} px (good poses: below {_FINE:.0f})"


@dataclass(frozen=True)
class DepthFit:
    """Comparison of depth maps with the depths of tracked corners."""

    pairs: int  # number of compared pairs of frames
    ratio: float  # median of the maps' depth over the corners'
    order: float  # median rank correlation of the two
    problem: str  # "" = none


def track_corners(sequence: FrameSequence, indices: range | None = None) -> list[FollowedCorners]:
    """Track corners from evenly spaced frames of a sequence, or of its part between the first and the last of
    ``indices``. A frame whose image is missing or cannot be read ends a track. Pairs with little motion are dropped."""
    first, last = (0, len(sequence) - 1) if not indices else (min(indices), max(indices))
    starts = np.unique(np.linspace(first, max(first, last - _FRAMES // 2), _PLACES).astype(int)).tolist()
    tracked = (one for start in starts for one in _followed(sequence, start, min(start + _FRAMES, last)))
    return [one for one in tracked if one.motion >= _STILL]


def _followed(sequence: FrameSequence, first: int, last: int) -> list[FollowedCorners]:
    """Two pairs of frame ``first``: with the first frame at which the corners' motion reaches ``_NEAR``, and with the
    one at which it reaches ``_FAR`` or the track ends."""
    image = _gray(sequence, first)
    if image is None:
        return []
    width, result = image.shape[1], list[FollowedCorners]()
    start = find(image, _CORNERS, _SPACING * width, np.zeros((0, 2)))
    position = start
    for index in range(first + 1, last + 1):
        following = _gray(sequence, index)
        if following is None or following.shape != image.shape or len(start) < _FEWEST:
            break
        position, alive = follow(image, following, position, _BACK)
        start, position, image = start[alive], position[alive], following
        if len(start) < _FEWEST:
            break
        one = FollowedCorners(first, index, start, position)
        result = [*result[: bool(result) and result[0].motion >= _NEAR * width], one]
        if one.motion >= _FAR * width:
            break
    return result


def _gray(sequence: FrameSequence, index: int) -> np.ndarray | None:
    entry = sequence.entries[index]
    try:
        image = None if entry.load_image is None else entry.load_image()
    except FrameError:
        return None
    if image is None or (entry.image_size or sequence.image_size) not in (None, image.shape[:2]):
        return None
    return checked(image, entry.T_world_cam, sequence.intrinsics_of(entry))[0]


def image_fit(sequence: FrameSequence, corners: Sequence[FollowedCorners]) -> ImageFit | None:
    """The fit of a sequence's poses and intrinsics to tracked corners; None without corners or poses."""
    if not corners or not sequence.posed:
        return None
    others = [Reading(poses=name) for name in CONVENTIONS if name != OURS] + [Reading(late=n) for n in _LATE]
    others += [Reading(factor=float(factor)) for factor in _FACTORS]
    width = 2 * sequence.intrinsics[0, 2] if sequence.image_size is None else sequence.image_size[1]
    limit = max(_FINE, _LARGEST * width)
    near = list({one.first: one for one in reversed(corners)}.values())
    far = list({one.first: one for one in corners}.values())
    reading = UNCHANGED
    best = error = _error(sequence, near, UNCHANGED)
    for pairs in (near, far):
        baseline = _error(sequence, pairs, UNCHANGED)
        errors = [_error(sequence, pairs, other) for other in others]
        least = min(errors)
        if reading == UNCHANGED and baseline > _HALVES * least and baseline - least > _APART and least <= limit:
            reading, error, best = others[errors.index(least)], baseline, least
    motion = float(np.median([one.motion for one in near]))
    fit = ImageFit(len(near), motion, error, reading, best, "")
    if reading != UNCHANGED:
        return replace(fit, problem=f"{fit.words}: {reading}: corners fit to {best:.1f} px then")
    if error > limit:
        text = "poses, intrinsics and images belong together under no reading tried"
        return replace(fit, problem=f"{fit.words}: {text}")
    return fit


def _error(sequence: FrameSequence, corners: Iterable[FollowedCorners], reading: Reading) -> float:
    """Median over pairs of the median distance [px]; inf if no pair has poses under ``reading``."""
    last = len(sequence) - 1
    inside = (one for one in corners if one.first + reading.late >= 0 and one.last + reading.late <= last)
    distances = [np.median(_epipolar_offsets(sequence, one, reading)[0]) for one in inside]
    return float(np.median(distances)) if distances else float("inf")


def _epipolar_offsets(
    sequence: FrameSequence, corners: FollowedCorners, reading: Reading = UNCHANGED
) -> tuple[np.ndarray, ...]:
    """[N] each: distance of the tracked corners from their half lines [px], position along them [px], and inverse depth
    in the first image [1/unit of the poses]."""
    convert, entries, late = CONVENTIONS[reading.poses].convert, sequence.entries, reading.late
    T_a, T_b = (convert(entries[at + late].T_world_cam) for at in (corners.first, corners.last))
    K_a, K_b = (
        sequence.intrinsics_of(entries[at]) * np.array([[reading.factor], [reading.factor], [1.0]])
        for at in (corners.first, corners.last)
    )
    T_b_a = np.linalg.inv(T_b) @ T_a
    rays = np.column_stack([corners.start, np.ones(len(corners.start))]) @ np.linalg.inv(K_a).T
    infinite, shift = rays @ (K_b @ T_b_a[:3, :3]).T, K_b @ T_b_a[:3, 3]
    ahead = infinite[:, 2] > 1e-3
    z = np.where(ahead, infinite[:, 2], 1.0)
    origin = infinite[:, :2] / z[:, None]
    speed = (shift[:2] - origin * shift[2]) / z[:, None]  # d x / d rho at rho = 0
    length = np.maximum(np.linalg.norm(speed, axis=1), 1e-12)
    offset = corners.end - origin
    along = (offset * speed).sum(1) / length
    across = np.abs(offset[:, 0] * speed[:, 1] - offset[:, 1] * speed[:, 0]) / length
    distance = np.where(along > 0, across, np.linalg.norm(offset, axis=1))
    # x(rho) = (infinite + rho shift) / (z + rho shift_z), so along = rho length z / (z + rho shift_z).
    rho = along / (length - along * shift[2] / z)
    return np.where(ahead, distance, np.inf), along, np.where(ahead, rho, np.nan)


def depth_at_pixels(
    depth: np.ndarray, valid: np.ndarray, K_map: np.ndarray, K_image: np.ndarray, pixel: np.ndarray
) -> np.ndarray:
    """[N] the depth of a map [H, W] at pixels [N, 2] of the image to which it belongs; 0 where it has none."""
    u, v, _ = np.rint(K_map @ np.linalg.inv(K_image) @ np.vstack([pixel.T, np.ones(len(pixel))])).astype(int)
    height, width = depth.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    v, u = np.where(inside, v, 0), np.where(inside, u, 0)
    return np.where(inside & valid[v, u], depth[v, u], 0.0)


def depth_fit(
    sequence: FrameSequence,
    corners: Iterable[FollowedCorners],
    depth_at: Callable[[int, np.ndarray], np.ndarray | None],
) -> DepthFit | None:
    """Compare depth with the depth of corners by parallax, in the unit of the poses; None with too few of either.
    ``depth_at`` returns the depth [N] at pixels [N, 2] of a frame's image (not positive = none), or None."""
    ratios, orders = [], []
    for one in corners:
        distance, along, rho = _epipolar_offsets(sequence, one)
        depth = depth_at(one.first, one.start)
        if depth is None:
            continue
        good = (distance < _SHIFT) & (along > _SHIFT) & (rho > 0) & np.isfinite(depth) & (depth > 0)
        if good.sum() >= _POINTS:
            ratios.append(float(np.median(np.log(depth[good] * rho[good]))))
            orders.append(float(spearmanr(depth[good], -rho[good])[0]) if np.ptp(depth[good]) > 0 else 0.0)
    if len(ratios) < _PAIRS:
        return None
    ratio, order, problem = float(np.exp(np.median(ratios))), float(np.median(orders)), ""
    if order < _INVERSE:
        problem = f"far is near in the depth (rank correlation {order:.2f} with tracked corners): is it inverse depth?"
    elif not 1 / _UNITS < ratio < _UNITS:
        factor = f"{_digits(ratio)} times" if ratio > 1 else f"1/{_digits(1 / ratio)} of"
        problem = f"depth is {factor} that of tracked corners by parallax: one of depth and poses is not in metres"
    return DepthFit(len(ratios), ratio, order, problem)


def _digits(factor: float) -> str:
    return f"{factor:.0f}" if factor >= 10 else f"{factor:.1f}"
