"""Anchors of a row: corners tracked in images, landmarks of a file, the depth of the sequence's depth camera, or ground
truth as the upper bound.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.anchors.landmarks import Landmarks, LandmarkSource
from ufmstar_torch.anchors.sensor import SENSORS, SensorMemory, completed, sensor_landmarks
from ufmstar_torch.anchors.sources import CORNERS, DENSE, FILE_TYPES, LandmarkMap, landmark_source
from ufmstar_torch.anchors.streams import StreamLandmarks
from ufmstar_torch.anchors.tracker import TrackerConfig
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import TRUTH, Setting
from ufmstar_torch.eval.sequences.frame import Frame, FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import depth_camera, resample_nearest
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.eval.sequences.options import resolve
from ufmstar_torch.frames.prediction import DepthPrediction

# Number of anchors of ground truth in a frame, about that of a tracker, and their standard deviation as a share of the
# depth, a range sensor's. Their depths are exact.
TRUTH_COUNT, TRUTH_SIGMA = 100, 0.01
# Third number of the seeds for the choice of anchors and for noise. The seed of poses has two numbers.
_CHOICE, _NOISE = 1, 2
_NO_IMAGE = Landmarks(np.zeros((0, 2)), np.zeros(0), np.zeros(0), tracked=0, none="no image")
_NO_DEPTH = replace(_NO_IMAGE, none="no depth map")
SENSOR = "sensor"
# Layouts whose depth is that of a laser or time of flight; the depth cameras of the others measure disparities.
_TIME_OF_FLIGHT = ("stray", "arkitscenes", "transforms", "kitti360")


class AnchorSource:
    """The anchors of rows with the same images and poses, from ``landmarks`` in their initial state; each image is
    processed once. None = ground truth at random pixels. With a ``sensor``, a kind of ``SENSORS``, they are the
    frame's depth, completed by that of earlier frames and the landmarks; that depth is then no ground truth.

    Noise on tracked positions is applied to the anchors: it moves an anchor in the image, and gives its depth the
    first-order error of that noise in every view (``track_noise`` times the tracker's standard deviation per
    ``pixel_noise``). The variance stays the tracker's. Noise is independent between frames.
    """

    def __init__(self, landmarks: LandmarkSource | None, sensor: str | None = None) -> None:
        self.sensor, self._memory = sensor, SensorMemory()
        self._streams = None if landmarks is None else StreamLandmarks(landmarks)
        self._last: tuple[Frame, Landmarks, float] | None = None

    @property
    def bytes(self) -> int:
        """Size of the state."""
        streams = {} if self._streams is None else self._streams.state()
        return self._memory.bytes + sum(value.nbytes for value in streams.values())

    def tracked(self, frame: Frame, T_world_cam: NDArray[np.float64]) -> tuple[Landmarks, float] | None:
        """Landmarks of the next frame at the noisy pose [4, 4] [m], and the time to compute them [ms]; None if they
        need an image and the frame has none. Errors as ``StreamLandmarks.update``."""
        if self._last is not None and self._last[0] is frame:
            return self._last[1:]
        assert self._streams is not None
        if frame.image is None and self._streams.needs_image:
            return None
        image = None if frame.image is None else image_tensor(frame)
        started = perf_counter()
        pose, K = torch.from_numpy(T_world_cam), torch.from_numpy(frame.intrinsics)
        self._streams.update(image, pose, K, UfMStarConfig.rotation_tolerance)
        self._last = frame, self._streams.last[0], 1000 * (perf_counter() - started)
        return self._last[1:]

    def of(
        self,
        frame: Frame,
        T_world_cam: NDArray[np.float64],
        prediction: DepthPrediction,
        truth: NDArray[np.float32] | None,
        setting: Setting,
    ) -> tuple[Landmarks, Anchors | None, float | None]:
        """The anchors of the next frame.

        Args:
            frame: with the image to track.
            T_world_cam: [4, 4] the row's pose, with noise [m].
            prediction: defines the camera of the anchors' pixels.
            truth: [h, w] ground truth at the prediction's pixels [m], 0 = none, or None.
            setting: the row's, with the number of anchors and the noise on tracks.

        Returns:
            landmarks in the pixels of the image (for ground truth: of the depth map); the same as anchors [1, N] in the
            pixels of the depth map, None without an image; and the time to compute them [ms].

        Raises:
            FrameError: the sensor's depth map has no camera.
        """
        device, K = prediction.depth.device, prediction.K[0]
        if self._streams is None:
            depth = np.zeros(prediction.size, np.float32) if truth is None else truth
            drawn = _sampled(depth, setting, frame.index)
            values = (torch.from_numpy(part)[None] for part in (drawn.pixel, drawn.depth, drawn.variance))
            return drawn, Anchors(*values).to(device), None
        if self.sensor is not None:
            return self._completed(frame, T_world_cam, prediction)
        tracked = self.tracked(frame, T_world_cam)
        if tracked is None:
            return _NO_IMAGE, None, None
        landmarks = _thinned(_disturbed(tracked[0], setting, frame.index), setting, frame.index)
        return landmarks, landmarks.anchors(frame.intrinsics, K).to(device), tracked[1]

    def _completed(
        self, frame: Frame, T_world_cam: NDArray[np.float64], prediction: DepthPrediction
    ) -> tuple[Landmarks, Anchors, float]:
        """As :meth:`of`, from the frame's depth where it has one, and from earlier frames' and the tracks elsewhere."""
        assert self.sensor is not None
        started, landmarks, depth = perf_counter(), _NO_DEPTH, None
        if frame.depth is not None:
            K_depth = depth_camera(frame)
            landmarks = sensor_landmarks(frame.depth, K_depth, frame.intrinsics, self.sensor)
            if frame.image is not None:
                size = frame.image.shape[0], frame.image.shape[1]
                depth = resample_nearest(frame.depth, K_depth, frame.intrinsics, size)
                landmarks = self._memory.extended(landmarks, depth, T_world_cam, frame.intrinsics)
        tracked = self.tracked(frame, T_world_cam)
        if tracked is not None:
            landmarks = tracked[0] if depth is None else completed(landmarks, tracked[0], depth, self.sensor)
        anchors = landmarks.anchors(frame.intrinsics, prediction.K[0]).to(prediction.depth.device)
        return landmarks, anchors, 1000 * (perf_counter() - started)


def _sampled(truth: NDArray[np.float32], setting: Setting, index: int) -> Landmarks:
    v, u = np.nonzero(truth > 0)
    depth, pixel = truth[v, u].astype(np.float64), np.stack([u, v], axis=-1).astype(np.float64)
    landmarks = Landmarks(pixel, depth, np.square(TRUTH_SIGMA * depth), tracked=0, none="no ground truth")
    return _thinned(landmarks, setting, index, TRUTH_COUNT)


def _disturbed(landmarks: Landmarks, setting: Setting, index: int) -> Landmarks:
    if not setting.track_noise:
        return landmarks
    noise = setting.track_noise * _drawn(setting, index, _NOISE).standard_normal((len(landmarks.depth), 3))
    depth = landmarks.depth + np.sqrt(landmarks.variance) / TrackerConfig.pixel_noise * noise[:, 2]
    return replace(landmarks, pixel=landmarks.pixel + noise[:, :2], depth=depth)


def _thinned(landmarks: Landmarks, setting: Setting, index: int, most: int | None = None) -> Landmarks:
    count = most if setting.anchor_count is None else setting.anchor_count
    if count is None or len(landmarks.depth) <= count:
        return landmarks
    chosen = _drawn(setting, index, _CHOICE).permutation(len(landmarks.depth))[:count]
    return replace(landmarks, **{name: getattr(landmarks, name)[chosen] for name in ("pixel", "depth", "variance")})


def _drawn(setting: Setting, index: int, purpose: int) -> np.random.Generator:
    return np.random.default_rng([setting.seed, index, purpose])


def sensor_of(value: str | None, sequence: FrameSequence) -> str | None:
    """The kind of the sequence's depth camera for "sensor", which is that of its layout, or "sensor:KIND"; None for
    another source of anchors. Raises ValueError: an unknown kind, or the sequence has no depth."""
    name, colon, kind = str(value).partition(":")
    if name != SENSOR:
        return None
    if colon and kind not in SENSORS:
        raise ValueError(f"--anchors {value}: the kind of sensor must be one of {', '.join(SENSORS)}")
    if len(sequence.without_depth) == len(sequence):
        raise ValueError(f"--anchors {value}: the sequence {sequence.name!r} has no depth maps")
    return kind or ("tof" if sequence.layout in _TIME_OF_FLIGHT else "stereo")


def landmarks_of(value: str, folder: Path | None, scale: float = 1.0) -> LandmarkSource:
    """The source of landmarks of a sequence. Errors as ``landmark_source``.

    Args:
        value: as for ``landmark_source``, with files in the sequence's or the working folder.
        folder: of the sequence.
        scale: metres per unit of the poses, which is the unit of the file.
    """
    if value.partition(":")[0] == SENSOR:
        raise ValueError(f"anchors: {value!r} is the depth of a recording, for `ufmstar run` and `rank`")
    is_file = Path(value).suffix.lower() in FILE_TYPES
    source = landmark_source(resolve(folder or Path(), value) if is_file else value)
    if isinstance(source, LandmarkMap) and scale != 1:
        return LandmarkMap(scale * source.points_world, scale * source.sigma)
    return source


def landmark_digests(rows: Iterable[Row], folder: Path | None, scale: float = 1.0) -> dict[str, str]:
    """By slug, the digests of the landmarks of rows that read them from a file. Errors as :func:`landmarks_of`."""
    files = {row.slug: row.setting.anchors for row in rows if row.setting.anchors not in ("", CORNERS, DENSE, TRUTH)}
    identities = {file: landmarks_of(file, folder, scale).identity for file in set(files.values())}
    return {slug: identities[file]["landmarks"] for slug, file in files.items() if "landmarks" in identities[file]}


def anchor_sources(rows: Iterable[Row], folder: Path | None = None, scale: float = 1.0) -> dict[Row, AnchorSource]:
    """The source of every row with anchors. Rows with the same images and poses share a tracker. Errors as
    :func:`landmarks_of`."""
    sources: dict[Row, AnchorSource] = {}
    shared: dict[tuple[object, ...], AnchorSource] = {}
    for row in (row for row in rows if row.setting.anchors):
        setting = row.setting
        key = (setting.anchors, setting.skip, setting.pose_noise)
        if key not in shared:
            truth = setting.anchors == TRUTH
            shared[key] = AnchorSource(None if truth else landmarks_of(setting.anchors, folder, scale))
        sources[row] = shared[key]
    return sources
