"""Anchors of a row: corners tracked in the sequence's own images, or ground truth as the upper bound."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from time import perf_counter

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch.anchors.given import Anchors
from ufmstar_torch.anchors.tracker import Landmarks, LandmarkTracker
from ufmstar_torch.eval.engine.predicted import Predicted
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import TRACKED, TRUTH, Setting
from ufmstar_torch.eval.sequences.frame import Frame

# Anchors of ground truth in a frame, about as many as a tracker finds, and their standard deviation as a share of the
# depth: a range sensor's. Their depths are exact.
TRUTH_COUNT, TRUTH_SIGMA = 100, 0.01
# What is drawn of a frame: which anchors are taken, and noise. Poses have the seed without a third number.
_TAKEN, _NOISE = 1, 2


class Tracks:
    """A tracker of rows that see the same images at the same poses: each image is tracked once."""

    def __init__(self) -> None:
        self._tracker = LandmarkTracker()
        self._known: tuple[Frame, Landmarks, float] | None = None

    @property
    def pixel_noise(self) -> float:
        """Standard deviation of a position that the tracker's variances stand for [px]."""
        return self._tracker.config.pixel_noise

    def of(self, frame: Frame, T_world_cam: NDArray[np.float64]) -> tuple[Landmarks, float]:
        """Landmarks of a frame, which follows those that were asked for before, and what they took [ms].

        Args:
            frame: with an image.
            T_world_cam: [4, 4], noise included [m].

        Raises:
            ModuleNotFoundError: OpenCV is not installed.
        """
        if self._known is None or self._known[0] is not frame:
            assert frame.image is not None
            started = perf_counter()
            landmarks = self._tracker.update(frame.image, T_world_cam, frame.intrinsics)
            self._known = frame, landmarks, 1000 * (perf_counter() - started)
        return self._known[1:]


class AnchorSource:
    """The anchors of a row.

    Noise on tracked positions acts where it would in the end: an anchor is moved in the image by it, and its depth
    errs by as much as one of that many pixels in every view makes it, to first order (``track_noise`` times the
    standard deviation that the tracker states for ``pixel_noise``). The variance is left as the tracker states it,
    which does not know of the noise. Frames are disturbed independently of each other.

    Args:
        setting: of the row, with anchors.
        tracks: where they are tracked.
    """

    def __init__(self, setting: Setting, tracks: Tracks | None) -> None:
        self._setting, self._tracks = setting, tracks

    def of(
        self, frame: Frame, T_world_cam: NDArray[np.float64], predicted: Predicted, truth: NDArray[np.float32]
    ) -> tuple[Anchors, float | None]:
        """Anchors [1, N] on the prediction's device, and the time of the tracker [ms].

        Args:
            frame: the next one.
            T_world_cam: [4, 4] as the row sees it [m].
            predicted: with the camera of the maps.
            truth: [h, w] at their pixels [m], 0 = none.
        """
        if self._tracks is None:
            return self._sampled(truth, frame.index).to(predicted.depth.device), None
        landmarks, ms = self._tracks.of(frame, T_world_cam)
        landmarks = self._thinned(self._disturbed(landmarks, frame.index), frame.index)
        anchors = landmarks.anchors(frame.intrinsics, predicted.intrinsics)
        return anchors.to(predicted.depth.device), ms

    def _sampled(self, truth: NDArray[np.float32], index: int) -> Anchors:
        v, u = np.nonzero(truth > 0)
        count = TRUTH_COUNT if self._setting.anchor_count is None else self._setting.anchor_count
        taken = self._drawn(index, _TAKEN).permutation(len(v))[:count]
        depth = truth[v[taken], u[taken]].astype(np.float64)
        pixel = np.stack([u[taken], v[taken]], axis=-1).astype(np.float64)
        found = (pixel, depth, np.square(TRUTH_SIGMA * depth))
        return Anchors(*(torch.from_numpy(values)[None] for values in found))

    def _disturbed(self, landmarks: Landmarks, index: int) -> Landmarks:
        size = self._setting.track_noise
        if not size or self._tracks is None:
            return landmarks
        drawn = size * self._drawn(index, _NOISE).standard_normal((len(landmarks.depth), 3))
        of_one_pixel = np.sqrt(landmarks.variance) / self._tracks.pixel_noise
        return replace(
            landmarks, pixel=landmarks.pixel + drawn[:, :2], depth=landmarks.depth + of_one_pixel * drawn[:, 2]
        )

    def _thinned(self, landmarks: Landmarks, index: int) -> Landmarks:
        count = self._setting.anchor_count
        if count is None or len(landmarks.depth) <= count:
            return landmarks
        taken = self._drawn(index, _TAKEN).permutation(len(landmarks.depth))[:count]
        parts = {name: getattr(landmarks, name)[taken] for name in ("pixel", "depth", "variance")}
        return replace(landmarks, **parts)

    def _drawn(self, index: int, what: int) -> np.random.Generator:
        return np.random.default_rng([self._setting.seed, index, what])


def anchor_sources(rows: Iterable[Row]) -> dict[Row, AnchorSource]:
    """The source of every row with anchors; rows of the same images and poses share a tracker."""
    tracks: dict[tuple[object, ...], Tracks] = {}
    found = {}
    for row in rows:
        setting = row.setting
        if setting.anchors == TRUTH:
            found[row] = AnchorSource(setting, None)
        elif setting.anchors == TRACKED:
            found[row] = AnchorSource(setting, tracks.setdefault((setting.skip, setting.pose_noise), Tracks()))
    return found
