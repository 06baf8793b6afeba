"""ARKitScenes: ``lowres_wide/, lowres_wide_intrinsics/*.pincam, lowres_wide.traj, lowres_depth/``, by a frame's time.

A line of the .traj is a time [s], an axis times an angle [rad] and a translation [m], world-to-camera; poses are
interpolated at the images' times. Files are VIDEO_TIME.png, and a camera's numbers w h fx fy cx cy.
https://github.com/apple/ARKitScenes/blob/main/DATA.md
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ufmstar_torch.eval.sequences.assemble import assemble
from ufmstar_torch.eval.sequences.attach import frame_of_image
from ufmstar_torch.eval.sequences.frame import Entry, FrameSequence, Skipped
from ufmstar_torch.eval.sequences.images import depth_loader
from ufmstar_torch.eval.sequences.lens import Lens
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.eval.sequences.paths import DEPTH_SUFFIXES, list_files
from ufmstar_torch.eval.sequences.poses import associate, numbers, read_matrix, trajectory_of
from ufmstar_torch.gaussians.trajectory import Trajectory

_IMAGES, _CAMERAS, _DEPTHS, _POSES = "lowres_wide", "lowres_wide_intrinsics", "lowres_depth", "lowres_wide.traj"
LOOKED_FOR = f"{_IMAGES}/, {_CAMERAS}/ and {_POSES}, also in VIDEO_frames/"
_PINCAM = (".pincam",)
_SAME_FRAME = 2e-3  # [s] names of one frame's files are rounded to 1 ms


def detect(path: Path) -> bool:
    """True if the folder, or one VIDEO_frames in it, has this layout."""
    return _root(path) is not None


def _root(path: Path) -> Path | None:
    for folder in (path, *(sorted(path.glob("*_frames")) if path.is_dir() else ())):
        if (folder / _POSES).is_file() and all((folder / name).is_dir() for name in (_IMAGES, _CAMERAS)):
            return folder
    return None


def read(path: Path, options: Options) -> FrameSequence:
    """Open the low-resolution images of a video. Raises ValueError: a malformed file (named), a file whose name is not
    its time, or no usable frame."""
    root = _root(path)
    assert root is not None
    images, cameras = list_files(root / _IMAGES), list_files(root / _CAMERAS, _PINCAM)
    depths = list_files(root / _DEPTHS, DEPTH_SUFFIXES) if (root / _DEPTHS).is_dir() else []
    times = _times(images)
    camera_of = associate(times, _times(cameras), _SAME_FRAME)
    depth_of = associate(times, _times(depths), _SAME_FRAME)
    frames: list[Entry | Skipped] = []
    lenses = {}
    for number, image in enumerate(images):
        if number not in camera_of:
            frames.append(Skipped(image.stem, "no camera at its time"))
            continue
        lenses[image.stem] = _lens(cameras[camera_of[number]])
        load_depth = depth_loader(depths[depth_of[number]] if number in depth_of else None, options.truth_scale)
        frames.append(frame_of_image(image.stem, image, load_depth, timestamp=float(times[number])))
    return assemble("arkitscenes", path, frames, lenses, options, read_poses=partial(_trajectory, root / _POSES))


def _times(files: list[Path]) -> np.ndarray:
    """[N] times of files VIDEO_TIME [s]."""
    try:
        return np.array([float(file.stem.rpartition("_")[2]) for file in files])
    except ValueError as error:
        raise ValueError(f"{files[0].parent}: files must be called VIDEO_TIME: {error}") from None


def _lens(file: Path) -> Lens:
    error = f"{file}: expected width height fx fy cx cy [px], the size in whole ones"
    values = numbers(read_matrix(file), (6,), error)
    if min(values) <= 0 or not (values[:2] % 1 == 0).all():
        raise ValueError(f"{error}, got {values.tolist()}")
    width, height, fx, fy, cx, cy = values.tolist()
    return Lens((fx, fy, cx, cy), (int(height), int(width)))


def _trajectory(file: Path) -> Trajectory:
    """The camera-to-world trajectory. Raises ValueError: lines do not have 7 numbers."""
    table = read_matrix(file)
    if table.ndim != 2 or table.shape[1] != 7:
        raise ValueError(f"{file}: expected lines of 7 numbers: time [s], rotation vector [rad], translation [m]")
    table = table[np.isfinite(table).all(axis=1)]
    quaternions = Rotation.from_rotvec(table[:, 1:4]).as_quat()
    world_to_camera = trajectory_of(table[:, 0], table[:, 4:], quaternions, file)
    return replace(world_to_camera, T_world_cam=np.linalg.inv(world_to_camera.T_world_cam))
