"""The unit of poses from structure from motion, by a depth network's scale (``--scale-from network``)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.sequences.colmap import read_landmarks
from ufmstar_torch.eval.sequences.frame import FrameError, FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import nearest_pixels
from ufmstar_torch.frames.prediction import DepthPrediction

_MOST_FRAMES, _FEWEST_FRAMES = 24, 3
_FEWEST_LANDMARKS = 10  # smallest number of landmarks of a frame that is used
_NO_SCALE = (
    "sequence {name!r}: the unit of its poses is not known, which structure from motion cannot measure. Give "
    "--pose-scale M (metres per unit), make it with `ufmstar poses --length A B METRES` (or --trajectory), or accept "
    "the network's own scale with --scale-from network"
)

_NO_UNIT = (
    "sequence {name!r}: its files do not state the unit of its poses. Give --pose-scale M (metres per unit; 1 if they "
    "are in metres), or --trajectory FILE with poses in metres"
)


@dataclass(frozen=True)
class NetworkScale:
    """``metres`` per unit of the poses by a network's depth of landmarks: the median over ``frames`` of their median
    d / z, with the predicted depth d [m] and a landmark's depth z. ``spread`` is half the range of the middle 68 % of
    the frames' medians, as a share of ``metres``."""

    metres: float
    spread: float
    frames: int


def require_metric(sequence: FrameSequence) -> None:
    """Raises ValueError: the unit of the poses is unknown; the message names the options that help."""
    if not sequence.metric:
        raise ValueError((_NO_SCALE if sequence.layout == "colmap" else _NO_UNIT).format(name=sequence.name))


def network_scale(
    sequence: FrameSequence, source: DepthSource, indices: range, model_index: int | None = None
) -> NetworkScale:
    """The scale of a COLMAP model's poses by the depths of a source, on at most 24 of the frames ``indices``;
    ``model_index`` is the option with which the sequence was opened. Raises ValueError: the poses are metric or not a
    COLMAP model's, or fewer than three frames have ten landmarks each."""
    if sequence.metric or sequence.folder is None or sequence.layout != "colmap":
        raise ValueError(
            "--scale-from network is for COLMAP models whose scale is not known, which have landmarks to compare with"
        )
    landmarks = read_landmarks(sequence.folder, model_index)
    medians = []
    spaced = np.linspace(0, len(indices) - 1, min(_MOST_FRAMES, len(indices))).round().astype(int)
    for turn, number in enumerate(np.unique(spaced).tolist()):
        entry = sequence.entries[indices[number]]
        points = landmarks.get(entry.name, np.zeros((0, 3)))
        try:
            prediction = source.one(sequence[indices[number]], source.turn(turn))
        except FrameError:  # counted when its turn comes
            continue
        ratios = _ratios(points, entry.T_world_cam, prediction)
        if len(ratios) >= _FEWEST_LANDMARKS:
            medians.append(float(np.median(ratios)))
    if len(medians) < _FEWEST_FRAMES:
        raise ValueError(
            f"--scale-from network: {len(medians)} frames see {_FEWEST_LANDMARKS} landmarks of the model, at least "
            f"{_FEWEST_FRAMES} are needed"
        )
    metres = float(f"{np.median(medians):.4g}")  # rounded, to be equal in a repeated run despite a network's last bits
    low, high = np.percentile(medians, [16, 84])
    return NetworkScale(metres, float(high - low) / 2 / metres, len(medians))


def _ratios(points: np.ndarray, T_world_cam: np.ndarray, prediction: DepthPrediction) -> np.ndarray:
    """[M] predicted depth over the landmark's depth, for landmarks in the map."""
    T_cam_world = np.linalg.inv(T_world_cam)
    in_camera = points @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
    depth = prediction.depth[0].detach().float().cpu().numpy()
    u, v, z = prediction.K[0].numpy() @ in_camera[in_camera[:, 2] > 0].T
    index, inside = nearest_pixels(u / z, v / z, prediction.size)
    predicted, z = depth.reshape(-1)[index[inside]], z[inside]
    usable = np.isfinite(predicted) & (predicted > 0)
    return np.asarray(predicted[usable] / z[usable])
