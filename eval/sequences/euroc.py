"""EuRoC and other recordings in ASL's layout (TUM-VI): ``mav0/cam0/{data.csv, sensor.yaml, data/}``.

Poses are those of the body in ``mav0/state_groundtruth_estimate0`` (or ``mocap0``, ``vicon0``, ``leica0`` with an
orientation), moved to the camera by both sensors' ``T_BS`` and interpolated at the images' times. Images are
undistorted.
https://projects.asl.ethz.ch/datasets/kmavvisualinertialdatasets
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ufmstar_torch.eval.sequences.assemble import assemble
from ufmstar_torch.eval.sequences.attach import frame_of_image
from ufmstar_torch.eval.sequences.frame import Entry, FrameSequence, Size, Skipped, is_rotation
from ufmstar_torch.eval.sequences.images import first_image_size
from ufmstar_torch.eval.sequences.lens import FISHEYE, Lens
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.eval.sequences.paths import listed_file
from ufmstar_torch.eval.sequences.poses import csv_rows, is_header, number, numbers, read_matrix, trajectory_of
from ufmstar_torch.gaussians.trajectory import Trajectory

LOOKED_FOR = "mav0/cam0/data.csv and sensor.yaml (also in mav0, or in a camera's folder itself)"
_TRUTHS = ("state_groundtruth_estimate0", "mocap0", "vicon0", "leica0")
_RADIAL = ("radial-tangential", "radtan", "plumb_bob", "none", "")
_FISHEYES = ("equidistant", FISHEYE)
_NANOSECOND = 1e-9
_LARGEST_YAML, _DEEPEST_YAML = 100_000, 8  # [bytes], [levels]


def detect(path: Path) -> bool:
    """True if the path contains a camera's folder."""
    return _camera_folder(path) is not None


def read(path: Path, options: Options) -> FrameSequence:
    """Open the recording of one camera; ``path`` may be the folder of a camera other than ``cam0``. Raises ValueError:
    a malformed file (named), no ground truth and no ``trajectory``, or no usable frame."""
    folder = _camera_folder(path)
    assert folder is not None
    images: list[Path] = []
    frames: list[Entry | Skipped] = []
    for words, where in csv_rows(folder / "data.csv"):
        if not images and is_header(words):
            continue
        images.append(listed_file(folder / "data", words[1] if len(words) > 1 else f"{words[0]}.png"))
        time = number(words[0], where) * _NANOSECOND
        frames.append(frame_of_image(images[-1].stem, images[-1], timestamp=time))
    lens = _lens(folder / "sensor.yaml", first_image_size(images))
    name = folder.parent.parent.resolve().name if folder.parent.name == "mav0" else folder.resolve().name
    return assemble("euroc", path, frames, lens, options, name=name, read_poses=partial(_trajectory, folder))


def _camera_folder(path: Path) -> Path | None:
    for folder in (path / "mav0" / "cam0", path / "cam0", path):
        if (folder / "data.csv").is_file() and (folder / "sensor.yaml").is_file() and (folder / "data").is_dir():
            return folder
    return None


def _trajectory(camera: Path) -> Trajectory:
    """The camera's poses. Raises ValueError: there is no ground truth with an orientation next to its folder."""
    truth = next((camera.parent / name for name in _TRUTHS if (camera.parent / name / "data.csv").is_file()), None)
    if truth is None:
        raise ValueError(f"{camera.parent}: none of {', '.join(_TRUTHS)} holds poses; pass trajectory")
    table = read_matrix(truth / "data.csv")
    if table.ndim != 2 or table.shape[1] < 8:
        raise ValueError(f"{truth / 'data.csv'}: expected a time [ns], x y z [m] and qw qx qy qz; pass trajectory")
    table = table[np.isfinite(table[:, :8]).all(axis=1) & (np.linalg.norm(table[:, 4:8], axis=1) > 0.5)]
    quaternions = np.roll(table[:, 4:8], -1, axis=1)
    of_sensor = trajectory_of(table[:, 0] * _NANOSECOND, table[:, 1:4], quaternions, truth / "data.csv")
    to_camera = _extrinsics(camera / "sensor.yaml")
    if (truth / "sensor.yaml").is_file():
        to_camera = np.linalg.inv(_extrinsics(truth / "sensor.yaml")) @ to_camera
    return replace(of_sensor, T_world_cam=of_sensor.T_world_cam @ to_camera)


def _extrinsics(file: Path) -> np.ndarray:
    """T_BS [4, 4] of a sensor's file: sensor to body [m]; the identity if the file has none."""
    value = _yaml(file).get("T_BS", np.eye(4).tolist())
    value, error = value.get("data") if isinstance(value, Mapping) else value, f"{file}: T_BS must be 4x4 numbers"
    T = numbers(value, (4, 4), f"{error}, got {value!r:.80}")
    if not is_rotation(T[:3, :3], 1e-3):
        raise ValueError(f"{error}, a rotation and a position, got {T.tolist()}")
    return T


def _lens(file: Path, size: Size | None) -> Lens:
    values = _yaml(file)
    model = str(values.get("distortion_model", "")).lower()
    if model not in (*_RADIAL, *_FISHEYES) or str(values.get("camera_model", "pinhole")).lower() != "pinhole":
        raise ValueError(f"{file}: expected a pinhole camera with one of {', '.join(_RADIAL[:3])}, {_FISHEYES[0]}")
    try:
        fx, fy, cx, cy = (float(value) for value in values["intrinsics"])
        coefficients = tuple(float(value) for value in values.get("distortion_coefficients") or ())
        width, height = values.get("resolution") or (size or (0, 0))[::-1]
        return Lens((fx, fy, cx, cy), (int(height), int(width)), coefficients, model in _FISHEYES)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{file}: expected intrinsics fu fv cu cv and resolution W H [px]: {error}") from error


def _yaml(file: Path) -> dict[str, Any]:
    import yaml

    expected = f"a sensor's YAML of names and values without aliases, below {_LARGEST_YAML:,} bytes"
    raw, depth = file.read_bytes()[: _LARGEST_YAML + 1], 0
    try:
        text = raw.decode().removeprefix("%YAML:1.0")  # OpenCV's first line, which is no directive of YAML
        # Nested aliases can expand to gigabytes when they are printed or converted; deep nesting takes minutes.
        for event in yaml.parse(text):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if len(raw) > _LARGEST_YAML or depth > _DEEPEST_YAML or isinstance(event, yaml.AliasEvent):
                raise ValueError(f"{file}: expected {expected}")
        content = yaml.safe_load(text)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{file}: expected YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{file}: expected {expected}")
    return content
