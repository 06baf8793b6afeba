"""Checks poses, intrinsics and depth of a sequence against corners followed over a few frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ufmstar_torch.anchors.landmarks import checked
from ufmstar_torch.anchors.pose_fit import (
    TRACK,
    Cameras,
    CornerTrack,
    FollowedCorners,
    ImageFit,
    epipolar_offsets,
    pose_fit,
)
from ufmstar_torch.eval.sequences.frame import FrameError, FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import nearest_pixels

_PLACES = 6  # number of start frames
# Depth compared with that of corners: smallest number of pairs, and of corners of each; smallest shift along the line
# [px]; factor from which units differ (networks err by less than 2 on average); rank correlation of inverse depth.
_PAIRS, _POINTS, _SHIFT, _UNITS, _INVERSE = 2, 10, 2.0, 4.0, -0.3


@dataclass(frozen=True)
class DepthFit:
    """Comparison of depth maps with the depths of tracked corners."""

    pairs: int  # number of compared pairs of frames
    ratio: float  # median of the maps' depth over the corners'
    order: float  # median rank correlation of the two
    problem: str  # "" = none


def track_corners(sequence: FrameSequence, indices: range | None = None) -> list[FollowedCorners]:
    """Track corners from evenly spaced frames of a sequence, or of its part between the first and the last of
    ``indices``. A frame whose image is missing or cannot be read ends a track."""
    first, last = (0, len(sequence) - 1) if not indices else (min(indices), max(indices))
    starts = np.unique(np.linspace(first, max(first, last - TRACK // 2), _PLACES).astype(int)).tolist()
    return [one for start in starts for one in _followed(sequence, start, min(start + TRACK, last))]


def _followed(sequence: FrameSequence, first: int, last: int) -> list[FollowedCorners]:
    image = _gray(sequence, first)
    if image is None:
        return []
    track = CornerTrack(first, image)
    for index in range(first + 1, last + 1):
        following = _gray(sequence, index)
        if following is None or not track.add(index, following):
            break
    return track.pairs


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
    if not sequence.posed:
        return None
    width = 2 * sequence.intrinsics[0, 2] if sequence.image_size is None else sequence.image_size[1]
    return pose_fit(_cameras(sequence), width, corners)


def _cameras(sequence: FrameSequence) -> Cameras:
    entries = sequence.entries
    poses, K = ([entry.T_world_cam for entry in entries], [sequence.intrinsics_of(entry) for entry in entries])
    return Cameras(np.stack(poses), np.stack(K))


def depth_at_pixels(
    depth: np.ndarray, valid: np.ndarray, K_map: np.ndarray, K_image: np.ndarray, pixel: np.ndarray
) -> np.ndarray:
    """[N] the depth of a map [H, W] at pixels [N, 2] of the image to which it belongs; 0 where it has none."""
    u, v, _ = K_map @ np.linalg.inv(K_image) @ np.vstack([pixel.T, np.ones(len(pixel))])
    index, inside = nearest_pixels(u, v, (depth.shape[0], depth.shape[1]))
    return np.where(inside & valid.reshape(-1)[index], depth.reshape(-1)[index], 0.0)


def depth_fit(
    sequence: FrameSequence,
    corners: Iterable[FollowedCorners],
    depth_at: Callable[[int, np.ndarray], np.ndarray | None],
) -> DepthFit | None:
    """Compare depth with the depth of corners by parallax, in the unit of the poses; None with too few of either.
    ``depth_at`` returns the depth [N] at pixels [N, 2] of a frame's image (not positive = none), or None."""
    ratios, orders = [], []
    cameras = _cameras(sequence)
    for one in corners:
        distance, along, rho = (values[0] for values in epipolar_offsets(cameras, one))
        depth = depth_at(one.first, one.start)
        if depth is None:
            continue
        good = (distance < _SHIFT) & (along > _SHIFT) & (rho > 0) & np.isfinite(depth) & (depth > 0)
        if good.sum() >= _POINTS:
            ratios.append(float(np.median(np.log(depth[good] * rho[good]))))
            orders.append(_rank_correlation(depth[good], -rho[good]) if np.ptp(depth[good]) > 0 else 0.0)
    if len(ratios) < _PAIRS:
        return None
    ratio, order, problem = float(np.exp(np.median(ratios))), float(np.median(orders)), ""
    if order < _INVERSE:
        problem = f"far is near in the depth (rank correlation {order:.2f} with tracked corners): is it inverse depth?"
    elif not 1 / _UNITS < ratio < _UNITS:
        factor = f"{_digits(ratio)} times" if ratio > 1 else f"1/{_digits(1 / ratio)} of"
        problem = f"depth is {factor} that of tracked corners by parallax: one of depth and poses is not in metres"
    return DepthFit(len(ratios), ratio, order, problem)


def _rank_correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Spearman's, ties at their mean rank. Importing scipy.stats takes 40 MB."""
    ranks = []
    for values in (x, y):
        _, index, count = np.unique(values, return_inverse=True, return_counts=True)
        ranks.append((np.cumsum(count) - count / 2)[index])
    return float(np.corrcoef(ranks[0], ranks[1])[0, 1])


def _digits(factor: float) -> str:
    return f"{factor:.0f}" if factor >= 10 else f"{factor:.1f}"
