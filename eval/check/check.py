"""Checks a sequence's depth, poses and images against each other, by warping depth between its frames and by corners
tracked in its images.

Wrong conventions raise no error: inverted poses or millimetres read as metres give a variance map that is merely
wrong. Depth of one frame, warped into a later one, must agree with that frame's depth, and tracked corners must agree
with poses and intrinsics. The check also tries common mistakes (inverse poses, other axes, another depth scale,
intrinsics of another size, a late trajectory) and reports the one that fits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ufmstar_torch.anchors.pose_fit import UNCHANGED, ImageFit
from ufmstar_torch.eval.check.depth_image_fit import DepthImageFit, depth_image_fit
from ufmstar_torch.eval.check.image_fit import image_fit, track_corners
from ufmstar_torch.eval.sequences.frame import Frame, FrameError, FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import nearest_pixels, points_of
from ufmstar_torch.frames.warnings import doubtful_centre
from ufmstar_torch.gaussians.conventions import CONVENTIONS, OURS

_SCALES = 10.0 ** np.arange(-4, 4.01, 0.125)
_POINTS = 2000
# A pair is compared if at least this share of its points lands on valid depth. The share is relative to the filled
# part of the map, because a laser's map has values at few pixels only.
_MIN_OVERLAP = 0.3
_GAPS = (5, 3, 2, 1)
# Two readings are equally good within this factor and this relative error (the noise of depth).
_SAME_FACTOR, _SAME_ERROR = 1.5, 0.003
_MAX_ERROR = 0.05  # above it no reading explains the data; registered sequences are at .001 to .02
# A scale within this factor of 1 is noise (1.15 was estimated from four pairs of fr1/xyz) or calibration.
_SCALE_TOLERANCE = 1.25
# See depth_image_fit(): with 10 frames, registered recordings have at least .5, displaced ones at most .2.
_ALIGNED, _NOT_ALIGNED, _REGISTRATION_FRAMES = 0.4, 0.25, 12
_MIN_EDGES, _MIN_CONTRAST = 500, 0.03  # contrast observed: .04 to .25
_READING, _DISAGREE, _APART = "the poses look", "depth and poses disagree", "no two frames overlap"


@dataclass(frozen=True)
class SequenceCheck:
    """Outcome of :func:`check_sequence`."""

    pairs: int  # number of compared pairs of frames
    gap: int  # frames between the two of a pair
    error: float  # median relative error of warped depth without correction; inf without overlap
    poses: str  # convention of the poses that fits best, as ``open_sequence`` names it
    scale: float  # factor of depth that fits best with ``poses``
    best_error: float  # median relative error with ``poses`` and ``scale``
    registration: DepthImageFit | None  # alignment of depth and image edges, None if it was not checked
    images: ImageFit | None  # fit of poses and intrinsics to the images, None if no corner could be tracked
    problems: tuple[str, ...]
    undecided: tuple[str, ...]  # questions that this sequence's data cannot answer

    @property
    def ok(self) -> bool:
        """True if no problem was detected (something may still be undecided)."""
        return not self.problems


class _Pair(NamedTuple):
    """Points [3, N] of frame a, and frame b, in which their depth is compared."""

    points: np.ndarray
    T_world_a: np.ndarray
    T_world_b: np.ndarray
    K_b: np.ndarray
    depth_b: np.ndarray


def check_sequence(sequence: FrameSequence, pairs: int = 8) -> SequenceCheck:
    """Check pose convention, depth scale and registration on evenly spaced pairs of frames.

    Without poses or depth there are no pairs, and ``error`` is NaN. Raises ValueError: ``pairs`` is not positive.
    """
    if pairs < 1:
        raise ValueError(f"pairs must be at least 1, got {pairs}")
    check = _Check(sequence)
    figures, images, registration = check.geometry(pairs), check.images(), check.registration()
    return SequenceCheck(*figures, registration, images, tuple(check.problems), tuple(check.undecided))


def warp_error(pair: _Pair, poses: str, scale: float) -> float:
    """Median |log(warped z / depth)| of a pair; inf if too few points land on valid depth. Positions are divided by
    ``scale``, which is equivalent to depth times ``scale`` and keeps the unit of the files."""
    convert = CONVENTIONS[poses].convert
    T_b_a = np.linalg.inv(convert(pair.T_world_b)) @ convert(pair.T_world_a)
    points = T_b_a[:3, :3] @ pair.points + T_b_a[:3, 3:] / scale
    u, v, z = pair.K_b @ points[:, points[2] > 1e-6]
    index, inside = nearest_pixels(u / z, v / z, (pair.depth_b.shape[0], pair.depth_b.shape[1]))
    depth_there = pair.depth_b.reshape(-1)[index[inside]]
    valid = depth_there > 0
    filled = np.count_nonzero(pair.depth_b > 0) / pair.depth_b.size
    if valid.sum() < max(1, _MIN_OVERLAP * filled * pair.points.shape[1]):
        return float("inf")
    return float(np.median(np.abs(np.log(z[inside][valid] / depth_there[valid]))))


class _Check:
    """A check in progress: problems and undecided questions so far."""

    def __init__(self, sequence: FrameSequence) -> None:
        self.sequence = sequence
        self.problems: list[str] = []
        self.undecided: list[str] = []

    def geometry(self, count: int) -> tuple[int, int, float, str, float, float]:
        """Check poses and depth scale. Returns the first six fields of :class:`SequenceCheck`."""
        if not self.sequence.posed:
            self.undecided.append("there are no poses: methods that compare views cannot be run")
            return 0, 0, float("nan"), OURS, 1.0, float("nan")
        errors: dict[str, np.ndarray] = {}
        pairs: list[_Pair] = []
        gap = 0
        for gap in (gap for gap in _GAPS if gap < len(self.sequence)):
            first = np.unique(np.linspace(0, len(self.sequence) - 1 - gap, count).astype(int)).tolist()
            read = [(self._read(i), self._read(i + gap)) for i in first]
            pairs = [_pair(*a, *b) for a, b in read if a is not None and b is not None]
            errors = {name: _errors(pairs, name, _SCALES) for name in CONVENTIONS} if pairs else {}
            if any(np.isfinite(curve).any() for curve in errors.values()):
                break
        if not pairs:
            self.undecided.append("no two readable frames have depth, whose scale and poses could be compared")
            return 0, 0, float("nan"), OURS, 1.0, float("nan")
        poses = min(errors, key=lambda name: float(errors[name].min()))
        coarse = _SCALES[int(np.argmin(errors[poses]))]
        fine = coarse * 10.0 ** np.linspace(-0.125, 0.125, 21)
        fine_errors = _errors(pairs, poses, fine)
        scale, best = float(fine[int(np.argmin(fine_errors))]), float(fine_errors.min())
        error = float(_errors(pairs, OURS, np.ones(1))[0])
        if _as_good(error, best):
            poses = OURS
        if _as_good(float(_errors(pairs, poses, np.ones(1))[0]), best):
            scale = 1.0
        self._judge_geometry(errors, error, best, poses, scale)
        return len(pairs), gap, error, poses, scale, best

    def images(self) -> ImageFit | None:
        """Check poses and intrinsics with tracked corners. Their problem replaces those that it explains."""
        fit = image_fit(self.sequence, track_corners(self.sequence))
        size = self.sequence.image_size
        if size is not None and (centre := doubtful_centre(self.sequence.intrinsics.tolist(), size)):
            self.problems.append(centre)
        if fit is not None and fit.problem and not any(_READING in problem for problem in self.problems):
            if fit.reading != UNCHANGED:
                self.problems = [p for p in self.problems if _DISAGREE not in p and _APART not in p]
            self.problems.append(fit.problem)
        return fit

    def registration(self) -> DepthImageFit | None:
        """Check the registration of depth to the images, unless the depth maps have their own intrinsics."""
        if self.sequence.depth_intrinsics is not None:
            return None
        indices = np.unique(np.linspace(0, len(self.sequence) - 1, _REGISTRATION_FRAMES).astype(int))
        frames = [self._read(int(i)) for i in indices]
        both = [(one[0].image, one[1]) for one in frames if one is not None and one[0].image is not None]
        if not both:
            return None
        fit = depth_image_fit(both)
        if fit.edges < _MIN_EDGES or fit.contrast < _MIN_CONTRAST:
            self.undecided.append("too few edges, or too many, to tell whether depth is registered to the images")
        elif fit.quality < _NOT_ALIGNED:
            zoomed = f"zoomed by {fit.zoom:.2f} and shifted by ({fit.shift_x:.0f}, {fit.shift_y:.0f}) px"
            self.problems.append(f"depth looks not registered to the images: {zoomed} its edges fit better")
        elif fit.quality < _ALIGNED:
            self.undecided.append("depth edges meet image edges too weakly to tell whether depth is registered")
        return fit

    def _read(self, index: int) -> tuple[Frame, np.ndarray] | None:
        """A frame and its depth, or None if it has no depth or cannot be decoded."""
        try:
            frame = self.sequence[index]
        except FrameError:  # counted by ``data_check``
            return None
        return None if frame.depth is None or not (frame.depth > 0).any() else (frame, frame.depth)

    def _judge_geometry(
        self, errors: dict[str, np.ndarray], error: float, best: float, poses: str, scale: float
    ) -> None:
        """Add problems and undecided questions of poses and depth scale."""
        if not np.isfinite(best):
            self.problems.append(f"{_APART} under any reading of the poses")
            return
        as_given = f"by {error:.1%} as given" if np.isfinite(error) else "as given frames do not overlap"
        measured = f"warped depth is off by {best:.1%} then, {as_given}"
        if best > _MAX_ERROR:
            self.problems.append(f"{_DISAGREE} under every reading tried ({measured})")
            return
        if poses != OURS:
            self.problems.append(f"{_READING} {CONVENTIONS[poses].description} ({measured})")
        if not 1 / _SCALE_TOLERANCE < scale < _SCALE_TOLERANCE:
            size = "small" if scale > 1 else "large"
            self.problems.append(f"depth looks too {size}: times {scale:.3g} fits ({measured})")
        equivalent = [name for name in errors if name != poses and _as_good(float(errors[name].min()), best)]
        if equivalent:
            others = ", or ".join(CONVENTIONS[name].description for name in equivalent)
            self.undecided.append(f"the motion does not tell the poses from {others}")
        fitting = _SCALES[[_as_good(float(value), best) for value in errors[poses]]]
        if fitting.size and fitting.max() / fitting.min() > 4:
            self.undecided.append("the motion is too small, relative to the depth, to tell the depth's scale")


def _pair(first: Frame, first_depth: np.ndarray, second: Frame, second_depth: np.ndarray) -> _Pair:
    v, u = np.nonzero(first_depth > 0)
    keep = np.unique(np.linspace(0, len(v) - 1, _POINTS).astype(int))
    K_a, K_b = (f.intrinsics if f.depth_intrinsics is None else f.depth_intrinsics for f in (first, second))
    points = points_of(u[keep], v[keep], first_depth[v[keep], u[keep]], K_a).T
    return _Pair(points, first.T_world_cam, second.T_world_cam, K_b, second_depth)


def _errors(pairs: list[_Pair], poses: str, scales: np.ndarray) -> np.ndarray:
    """[len(scales)] the median over pairs of the warp error."""
    return np.median([[warp_error(pair, poses, scale) for scale in scales] for pair in pairs], axis=0)


def _as_good(error: float, best: float) -> bool:
    return error <= max(_SAME_FACTOR * best, best + _SAME_ERROR)
