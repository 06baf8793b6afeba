"""The options of opening sequences, which ``data check``, ``run``, ``eval`` and others share."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from ufmstar_torch.eval.commands.options import option
from ufmstar_torch.eval.sequences.intrinsics import parse_intrinsics
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.eval.sequences.poses import CONVENTIONS, OURS

# Names in `open_sequence` of the options for ground truth.
_TRUTH = {"truth": "depth", "truth_scale": "depth_scale"}


@dataclass(frozen=True, kw_only=True)
class SequenceOptions:
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
        register: leave 7-Scenes' depth in its own camera
        T_color_depth: 7-Scenes: file with the 4x4 transform from the depth to the colour camera [m]
        topics: topics of a ROS bag; write a pose's as TOPIC=FRAME with the frame that it moves
        drive: KITTI-360: name or number of a drive below the root
        scans: KITTI-360: also use the laser scans of this many neighbouring frames
        plugin: Python files with READERS (eval: also METHODS, METRICS)
    """

    layout: str = "auto"
    intrinsics: tuple[str, ...] = ()
    distortion: tuple[str, ...] = ()
    depth_intrinsics: tuple[str, ...] = ()
    truth_scale: float | None = None
    max_truth: float | None = None
    trajectory: str | None = None
    poses: str = option(OURS, choices=tuple(CONVENTIONS))
    pose_scale: float | None = None
    fps: float | None = None
    time_offset: float = 0.0
    max_pose_gap: float = 0.1
    max_time_difference: float = 0.02
    images: str | None = None
    truth: str | None = None
    register: bool = True
    T_color_depth: str | None = None
    topics: tuple[str, ...] = ()
    drive: str | None = None
    scans: int | None = None
    plugin: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        Options(**{name: value for name, value in self.arguments().items() if name not in ("layout", "poses")})

    def changed(self) -> dict[str, Any]:
        """The options that differ from their defaults."""
        return {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) != f.default}

    def arguments(self) -> dict[str, Any]:
        """The arguments of ``open_sequence`` that differ from its defaults, as plain values. Raises ValueError:
        intrinsics are neither a file nor four numbers."""
        changed = self.changed()
        for name in ("intrinsics", "depth_intrinsics"):
            if name in changed:
                changed[name] = parse_intrinsics(changed[name], f"--{name.replace('_', '-')}")
        return {_TRUTH.get(name, name): list(v) if isinstance(v, tuple) else v for name, v in changed.items()}
