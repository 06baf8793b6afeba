"""Stray Scanner (iOS): ``rgb.mp4, odometry.csv, camera_matrix.csv, depth/NNNNNN.png, confidence/NNNNNN.png``.

Poses are ARKit's, camera-to-world, with our axes. Depth is the laser's, 256x192, in mm; pixels with confidence 0 (of 0
to 2) are invalid. Later versions of the app write the camera of each frame into odometry.csv.
https://docs.strayrobots.io/apps/scanner/format.html
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.assemble import assemble
from ufmstar_torch.eval.sequences.frame import Entry, FrameError, FrameSequence, Skipped
from ufmstar_torch.eval.sequences.images import read_color, read_depth
from ufmstar_torch.eval.sequences.intrinsics import pinhole_values
from ufmstar_torch.eval.sequences.lens import Lens
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.eval.sequences.paths import on_disk
from ufmstar_torch.eval.sequences.poses import csv_rows, number, poses_from_columns, read_matrix
from ufmstar_torch.eval.sequences.video import Video

_VIDEO, _ODOMETRY, _CAMERA = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
LOOKED_FOR = f"{_VIDEO}, {_ODOMETRY} and {_CAMERA}"
_COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_FOCAL = ("fx", "fy", "cx", "cy")


def detect(path: Path) -> bool:
    """True if the folder has this layout."""
    return all((path / name).is_file() for name in (_VIDEO, _ODOMETRY, _CAMERA))


def read(path: Path, options: Options) -> FrameSequence:
    """Open a recording; frames are named by their number. Rows beyond the video's end are skipped. Raises ValueError: a
    malformed file (named by line), no video, or no usable frame."""
    (names, _), *rows = csv_rows(path / _ODOMETRY) or [([], "")]
    names = [name.lower() for name in names]
    if missing := [name for name in _COLUMNS if name not in names]:
        found = ", ".join(names)[:99]
        raise ValueError(f"{path / _ODOMETRY}: the first line must name the column {missing[0]!r}, got {found!r}")
    video, K, expected = Video(path / _VIDEO), read_matrix(path / _CAMERA), "expected 3 lines of 3 numbers"
    if K.shape != (3, 3) or not np.isfinite(K).all():
        raise ValueError(f"{path / _CAMERA}: {expected}")
    frames: list[Entry | Skipped] = []
    lenses = {}
    for words, where in rows:
        if len(words) != len(names):
            raise ValueError(f"{where}: expected {len(names)} numbers as in the first line, got {len(words)}")
        value = {name: number(word, where) for name, word in zip(names, words, strict=True)}
        T = poses_from_columns(np.array([[value[name] for name in _COLUMNS[2:]]]), [where])[0]
        index, time = value["frame"], value["timestamp"]
        if not (0 <= index < np.inf and index == np.floor(index)):
            raise ValueError(f"{where}: the frame must be a number from 0 on, got {index}")
        if not np.isfinite(time):
            raise ValueError(f"{where}: the timestamp must be finite [s], got {time}")
        name = f"{int(index):06d}"
        if index >= len(video):
            frames.append(Skipped(name, "beyond the end of the video"))
            continue
        camera = tuple(value[name] for name in _FOCAL) if set(_FOCAL) <= value.keys() else pinhole_values(K)
        lenses[name] = Lens(camera, video.size)
        file, confidence = (on_disk(path / kind / f"{name}.png") for kind in ("depth", "confidence"))
        load = partial(_depth, file, confidence, options.truth_scale) if file.is_file() else None
        frames.append(Entry(name, T, partial(video.read, int(index)), load, time))
    return assemble("stray", path, frames, lenses, options)


def _depth(file: Path, confidence: Path, scale: float | None) -> np.ndarray:
    """[H, W] float32 [m], 0 where the sensor is not confident. Raises FrameError: a file cannot be decoded."""
    depth = read_depth(file, scale)
    if not confidence.is_file():
        return depth
    level = read_color(confidence)[..., 0]
    if level.shape != depth.shape:
        raise FrameError(confidence, f"the confidence is {level.shape[::-1]}, the depth map {depth.shape[::-1]}")
    return np.where(level > 0, depth, np.float32(0))
