"""The options of ``open_sequence`` as one value, which every reader takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.images import check_scale
from ufmstar_torch.eval.sequences.intrinsics import IntrinsicsLike


@dataclass(frozen=True, eq=False)
class Options:
    """The options that a user may override. Raises ValueError: a number is out of its range."""

    # Instead of the layout's own [px]: a file, a 3x3 matrix, or fx, fy, cx, cy; and those of the depth maps (7-Scenes,
    # ScanNet, generic).
    intrinsics: IntrinsicsLike | None = None
    depth_intrinsics: IntrinsicsLike | None = None
    # File in TUM or KITTI format whose camera-to-world poses, with our axes, replace the layout's own: those of
    # ORB-SLAM3, BundleFusion, ... Inside the sequence's folder, or else from the working folder.
    trajectory: str | Path | None = None
    images: str | Path | None = None  # folder of images or video file (generic)
    depth: str | Path | None = None  # folder of depth maps (generic, KITTI-360)
    depth_scale: float | None = None  # metres per unit of the depth files, instead of the layout's own
    max_time_difference: float = 0.02  # between paired colour and depth images [s] (TUM, generic)
    # Poses are interpolated between samples at most this far apart [s]; at 0.1 s a hand that accelerates at 2 m/s^2
    # departs 2.5 mm from the straight line.
    max_pose_gap: float = 0.1
    # Frames per second of images without timestamps, or instead of the video's own, where a trajectory has timestamps.
    # Images of a layout that numbers them are counted by that number.
    fps: float | None = None
    time_offset: float = 0.0  # added to the images' times [s]
    register: bool = True  # warp 7-Scenes' depth into the colour camera
    T_color_depth: np.ndarray | str | Path | None = None  # [4, 4] depth to colour camera [m], or its file (7-Scenes)
    # Of the images' lens: k1 k2 p1 p2 [k3 [k4 k5 k6]], "fisheye" k1 k2 k3 k4, or "none". None: TUM's published one.
    distortion: str | Sequence[str | float] | None = None
    pose_scale: float | None = None  # metres per unit of the poses, and of a file of landmarks
    plugin: Sequence[str] = ()  # files with readers of one's own (``plugins``)
    max_truth: float | None = None  # depths beyond are no ground truth [m]: what a window shows
    topics: Sequence[str] | None = None  # of a bag that has several; a pose's with =FRAME, whose pose it is
    drive: str | int | None = None  # name or number of the drive, where the path is KITTI-360's root
    # Laser scans of as many frames before and after a frame that are added to its own (KITTI-360); moving things smear.
    scans: int | None = None

    def __post_init__(self) -> None:
        check_scale(self.depth_scale)
        for name in ("max_time_difference", "max_pose_gap"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be a time of at least 0 s, got {getattr(self, name)}")
        if self.fps is not None and not self.fps > 0:
            raise ValueError(f"fps must be positive frames per second, got {self.fps}")
        for name, unit in (("pose_scale", "metres per unit of the poses"), ("max_truth", "metres")):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise ValueError(f"{name} must be a positive number of {unit}, got {value}")
        if self.scans is not None and (self.scans < 0 or self.scans != int(self.scans)):
            raise ValueError(f"scans must be a number of laser scans on either side, at least 0, got {self.scans}")

    def reject(self, layout: str, *names: str) -> None:
        """Raises ValueError where an option was given that the layout has no use for."""
        for name in names:
            if getattr(self, name) is not None:
                other = "use layout='generic' to combine images, depth and a trajectory freely"
                raise ValueError(f"layout {layout!r} takes no {name}: its files hold that; {other}")


def resolve(root: Path, given: str | Path) -> Path:
    """A path as the user gave it: inside the sequence's folder, or else from the working folder. Raises
    FileNotFoundError: it is in neither."""
    for path in (root / given, Path(given)):
        if path.exists():
            return path
    raise FileNotFoundError(f"no such file or folder: {given} (neither in {root} nor in the working folder)")
