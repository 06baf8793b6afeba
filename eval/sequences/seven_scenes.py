"""7-Scenes: ``frame-NNNNNN.{color.png|color.jpg, depth.png, pose.txt}``, depth in mm, 0 and 65535 invalid.

The authors publish the depth camera's K = 585, 585, 320, 240, and state that colour and depth were not calibrated to
each other. The poses are the depth camera's (KinectFusion tracks it). The colour camera is a Kinect's: K = 525, 525,
320, 240 and a baseline of 2.5 cm along x are customary in the literature, accurate to a few pixels. Pass ``intrinsics``
and ``T_color_depth`` if better values are known. Other recordings have the same file names and a file of intrinsics in
the folder: there, depth has the camera of the images, unless another file or an option names its camera.
https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ufmstar_torch.eval.sequences.assemble import assemble
from ufmstar_torch.eval.sequences.attach import frame_of_files
from ufmstar_torch.eval.sequences.frame import Entry, FrameSequence, Loader
from ufmstar_torch.eval.sequences.ground_truth import register_depth
from ufmstar_torch.eval.sequences.images import depth_loader, first_depth_size, first_image_size
from ufmstar_torch.eval.sequences.intrinsics import camera_matrix, pinhole
from ufmstar_torch.eval.sequences.lens import Lens
from ufmstar_torch.eval.sequences.options import Options, resolve, with_camera_files
from ufmstar_torch.eval.sequences.paths import natural_key
from ufmstar_torch.eval.sequences.poses import read_pose

LOOKED_FOR = "frame-NNNNNN.pose.txt files"
_NATIVE_SIZE = (480, 640)
_K_COLOR = (525.0, 525.0, 320.0, 240.0)
_K_DEPTH = (585.0, 585.0, 320.0, 240.0)
_NO_DEPTH = 65535
# [m] An approximation: the colour camera is 2.5 cm to the right of the depth camera, with the same orientation.
_T_COLOR_DEPTH = np.array([[1.0, 0, 0, -0.025], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
_FRAME = re.compile(r"(frame-\d+)\.(color\.png|color\.jpg|depth\.png|pose\.txt)", re.IGNORECASE)


def detect(path: Path) -> bool:
    """True if the folder has this layout."""
    return path.is_dir() and any(path.glob("frame-*.pose.txt"))


def read(path: Path, options: Options) -> FrameSequence:
    """Open a 7-Scenes sequence folder (``seq-NN``).

    Depth is warped into the colour camera, and ``T_world_cam`` is the colour camera's, as must be ``trajectory``.
    """
    others = with_camera_files(options, path)
    if options.intrinsics is None and others.intrinsics is not None:
        registered = others.intrinsics if others.depth_intrinsics is None else others.depth_intrinsics
        one_camera = np.eye(4) if options.T_color_depth is None else options.T_color_depth
        others = replace(others, depth_intrinsics=registered, T_color_depth=one_camera)
    options = others
    files: dict[str, dict[str, Path]] = {}
    for file in sorted(path.iterdir(), key=natural_key):
        found = _FRAME.fullmatch(file.name)
        if found:
            files.setdefault(found[1].lower(), {})[found[2].lower().split(".")[0]] = file
    color_size = first_image_size(kinds["color"] for kinds in files.values() if "color" in kinds) or _NATIVE_SIZE
    frames = []
    for name, kinds in files.items():
        load = depth_loader(kinds.get("depth"), options.truth_scale, invalid=_NO_DEPTH)
        frames.append(frame_of_files(name, kinds.get("color"), kinds.get("pose"), load, options))
    depth_size = first_depth_size(frames)
    K_color = camera_matrix(options.intrinsics, pinhole(*_K_COLOR), _NATIVE_SIZE, color_size)
    K_depth = camera_matrix(options.depth_intrinsics, pinhole(*_K_DEPTH), _NATIVE_SIZE, depth_size)
    T_color_depth = _T_COLOR_DEPTH if options.T_color_depth is None else options.T_color_depth
    if not isinstance(T_color_depth, np.ndarray):
        T_color_depth = read_pose(resolve(path, T_color_depth))
    cameras = (K_depth, K_color, T_color_depth, color_size)
    for i, frame in enumerate(frames):
        if isinstance(frame, Entry):
            load = frame.load_depth and partial(_registered, frame.load_depth, *cameras)
            frames[i] = replace(frame, T_world_cam=frame.T_world_cam @ np.linalg.inv(T_color_depth), load_depth=load)
    options = replace(options, depth_intrinsics=None)
    return assemble("7scenes", path, frames, Lens.of(K_color, color_size), options, depth_size=color_size)


def _registered(load: Loader, *cameras: Any) -> np.ndarray:
    return register_depth(load(), *cameras)
