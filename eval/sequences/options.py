"""The options of ``open_sequence`` as one value, for every reader and for the commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from ufmstar_torch.eval.sequences.intrinsics import DEPTH_FILES, FILES, IntrinsicsLike, camera_file, parse_intrinsics
from ufmstar_torch.gaussians.conventions import CONVENTIONS
from ufmstar_torch.runtime.checked import Checked, choice, number
from ufmstar_torch.runtime.kinds import check_fields


@dataclass(frozen=True, eq=False, kw_only=True)
class Options(Checked):
    """Opening of sequences.

    Attributes:
        layout: name of the layout (docs/data.md); auto: detect it from the files
        intrinsics: camera of the images: a file, or fx fy cx cy [px]
        distortion: lens distortion to undo: k1 k2 p1 p2 [k3 [k4 k5 k6]], fisheye k1 k2 k3 k4, or none (default:
            TUM RGB-D's own)
        depth_intrinsics: camera of the sequence's own depth maps: a file, or fx fy cx cy [px]
        truth_scale: metres per unit of the sequence's own depth
        max_truth: ground truth beyond this depth is ignored [m]
        trajectory: file with poses (TUM or KITTI), used instead of the layout's own
        poses: axes of the poses; ned: x forward, z down; opengl: y up, z back
        pose_scale: metres per unit of poses and landmarks
        fps: frames per second of images without timestamps
        time_offset: seconds added to the times of the images [s]
        max_pose_gap: longest gap over which poses are interpolated [s]
        max_time_difference: longest time between a colour image and its depth map [s]
        images: folder or video file with the images of a generic sequence
        truth: folder with the ground-truth depth maps of a generic sequence
        T_color_depth: 7-Scenes: file with the 4x4 transform from the depth to the colour camera [m]
        topics: topics of a ROS bag; write a pose's as TOPIC=FRAME with the frame that it moves
        model_index: COLMAP: number of the model in sparse/; default: the one with most images
        drive: KITTI-360: name or number of a drive below the root
        scans: KITTI-360: also use the laser scans of this many neighbouring frames
        plugin: Python files with READERS (eval: also METHODS, METRICS)

    Raises:
        ValueError: a number is out of its range, or intrinsics are neither a file nor four numbers.
    """

    layout: str = "auto"
    intrinsics: IntrinsicsLike | None = None
    distortion: str | Sequence[str | float] | None = None
    depth_intrinsics: IntrinsicsLike | None = None
    truth_scale: float | None = None
    max_truth: float | None = number(None, "", "m", 0.0, open_low=True, open_high=True)
    trajectory: str | Path | None = None  # with our axes, camera-to-world
    poses: str = choice(*CONVENTIONS)
    pose_scale: float | None = number(None, "", "m", 0.0, open_low=True, open_high=True)
    fps: float | None = number(None, "", "1/s", 0.0, open_low=True)  # of images with numbers instead of times
    time_offset: float = number(0.0, "", "s", -np.inf, open_low=True, open_high=True)
    # At 0.1 s a hand that accelerates at 2 m/s^2 departs 2.5 mm from the straight line.
    max_pose_gap: float = number(0.1, "", "s", 0.0)
    max_time_difference: float = number(0.02, "", "s", 0.0)
    images: str | Path | None = None
    truth: str | Path | None = None
    T_color_depth: np.ndarray | str | Path | None = None
    topics: tuple[str, ...] = ()
    model_index: int | None = None
    drive: str | int | None = None
    scans: int | None = number(None, "", "", 0)  # moving things smear
    plugin: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, option in (("intrinsics", "--intrinsics"), ("depth_intrinsics", "--reader depth_intrinsics")):
            if isinstance(words := getattr(self, name), tuple) and all(isinstance(word, str) for word in words):
                object.__setattr__(self, name, parse_intrinsics(words, option))
        check_fields(self)
        check_scale("truth_scale", self.truth_scale)
        super().__post_init__()

    def changed(self) -> dict[str, Any]:
        """The options that are not the default, as arguments of ``open_sequence``."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) is not f.default}
        defaults = {f.name: f.default for f in fields(self)}
        return {name: value for name, value in values.items() if defaults[name] is None or value != defaults[name]}


def check_scale(name: str, scale: float | None) -> None:
    """Raises ValueError: the argument ``name``, metres per unit, is neither None nor in (0, 1]."""
    if scale is not None and not 0 < scale <= 1:
        raise ValueError(f"{name} is in metres per unit (0.001: millimetres, 1/5000: TUM), at most 1, got {scale}")


def with_camera_files(options: Options, folder: Path) -> Options:
    """The options with the cameras of files in a sequence's folder, which win over a layout's default cameras."""
    color = camera_file(folder, FILES) if options.intrinsics is None else options.intrinsics
    depth = camera_file(folder, DEPTH_FILES) if options.depth_intrinsics is None else options.depth_intrinsics
    return replace(options, intrinsics=color, depth_intrinsics=depth)


def resolve(root: Path, name: str | Path) -> Path:
    """A user's path relative to the sequence's folder, or else to the working folder. Raises FileNotFoundError: it is
    in neither."""
    for path in (root / name, Path(name)):
        if path.exists():
            return path
    raise FileNotFoundError(f"no such file or folder: {name} (neither in {root} nor in the working folder)")
