"""Stray Scanner (iOS): ``rgb.mp4, odometry.csv, camera_matrix.csv, depth/NNNNNN.png, confidence/NNNNNN.png``.

Poses are ARKit's, camera-to-world, with our axes. Depth is the laser's, 256x192, in mm; where the confidence is 0, of
0 to 2, it is left out. Later versions of the app write the camera of each frame into odometry.csv.
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
from ufmstar_torch.eval.sequences.poses import csv_numbers, csv_rows, poses_from_columns, read_matrix
from ufmstar_torch.eval.sequences.video import Video

_VIDEO, _ODOMETRY, _CAMERA = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
LOOKED_FOR = f"{_VIDEO}, {_ODOMETRY} and {_CAMERA}"
_COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_FOCAL = ("fx", "fy", "cx", "cy")


def detect(path: Path) -> bool:
    """True if the folder has this layout."""
    return all((path / name).is_file() for name in (_VIDEO, _ODOMETRY, _CAMERA))


def read(path: Path, options: Options) -> FrameSequence:
    """Opens a recording; frames are called by their number. Rows beyond the video's end are skipped. Raises ValueError:
    a malformed file (named by line), no video, or no usable frame."""
    rows = csv_rows(path / _ODOMETRY)
    names = [word.lower() for word in rows[0][0]] if rows else []
    if missing := [name for name in _COLUMNS if name not in names]:
        found = ", ".join(names)[:99]
        raise ValueError(f"{path / _ODOMETRY}: the first line must name the column {missing[0]!r}, got {found!r}")
    lines = [where for _, where in rows[1:]]
    for words, where in rows[1:]:
        if len(words) != len(names):
            raise ValueError(f"{where}: expected {len(names)} numbers as in the first line, got {len(words)}")
    table = np.array([csv_numbers(*row) for row in rows[1:]], dtype=np.float64).reshape(-1, len(names))
    column = {name: table[:, names.index(name)] for name in names}
    poses = poses_from_columns(np.stack([column[name] for name in _COLUMNS[2:]], axis=-1), lines)
    video, K = Video(path / _VIDEO), read_matrix(path / _CAMERA, commas=True)
    if K.shape != (3, 3):
        raise ValueError(f"{path / _CAMERA}: expected 3 lines of 3 numbers")
    own = np.stack([column[name] for name in _FOCAL], axis=-1) if set(_FOCAL) <= set(names) else None
    frames: list[Entry | Skipped] = []
    lenses = {}
    for row, T in enumerate(poses):
        number = column["frame"][row]
        if not (0 <= number < np.inf and number == np.floor(number)):
            raise ValueError(f"{lines[row]}: the frame must be a number from 0 on, got {number}")
        if not np.isfinite(column["timestamp"][row]):
            raise ValueError(f"{lines[row]}: the timestamp must be finite [s], got {column['timestamp'][row]}")
        name = f"{int(number):06d}"
        if number >= len(video):
            frames.append(Skipped(name, "beyond the end of the video"))
            continue
        fx, fy, cx, cy = pinhole_values(K) if own is None else own[row].tolist()
        lenses[name] = Lens((fx, fy, cx, cy), video.size)
        file = path / "depth" / f"{name}.png"
        load = partial(_depth, file, path / "confidence" / file.name, options.depth_scale) if file.is_file() else None
        time = float(column["timestamp"][row])
        frames.append(Entry(name, T, partial(video.read, int(number)), load, time))
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
