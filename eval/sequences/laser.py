"""Depth maps from the scans of a rotating laser: KITTI-360's Velodyne, seen by a rectified camera.

A scan is ``f32`` x y z (forward, left, up [m]) and reflectance. The head turns clockwise, seen from above, and looks
forward at the scan's time: a point at azimuth a was measured a / 2 pi of a turn earlier, when the car was elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ufmstar_torch.eval.sequences.frame import FrameError, Size
from ufmstar_torch.eval.sequences.register import project

_COLUMNS = 4
_MIN_RANGE = 2.0  # [m] nearer returns are the car's own roof


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan's file and what turns its points into the camera's frame.

    Attributes:
        path: the ``.bin`` file.
        T_cam_laser: [4, 4] from the laser at this scan's time into the camera that looks [m].
        T_laser_before: [4, 4] from the laser one scan earlier into it now [m]; None = not known, or standing still:
            its points are taken as they are.
    """

    path: Path
    T_cam_laser: np.ndarray
    T_laser_before: np.ndarray | None = None

    def points(self) -> np.ndarray:
        """[3, N] float64 in the camera's frame [m].

        Raises:
            FrameError: the file is missing, or no scan.
        """
        points = read_scan(self.path)
        if self.T_laser_before is not None:
            points = unroll(points, self.T_laser_before)
        return self.T_cam_laser[:3, :3] @ points + self.T_cam_laser[:3, 3:]


@dataclass(frozen=True, eq=False)
class LaserDepth:
    """Loads the depth map that the scans give: each pixel takes the nearest point that falls on it.

    Attributes:
        scans: the frame's own, and neighbours if they are accumulated.
        K: [3, 3] of the camera [px].
        size: (H, W) of its images.
    """

    scans: tuple[Scan, ...]
    K: np.ndarray
    size: Size

    def __call__(self) -> np.ndarray:
        """[H, W] float32 [m], 0 = no point.

        Raises:
            FrameError: a scan is missing or broken.
        """
        return project(np.concatenate([scan.points() for scan in self.scans], axis=1), self.K, self.size)


def read_scan(path: Path) -> np.ndarray:
    """[3, N] float64 points of a scan in the laser's frame [m], without the car's own and those that are not finite.

    Raises:
        FrameError: the file is missing, or its size is not that of a scan.
    """
    try:
        values = np.fromfile(path, "<f4")
    except OSError as error:
        raise FrameError(path, f"cannot be read: {error}") from error
    if values.size == 0 or path.stat().st_size % (4 * _COLUMNS):
        raise FrameError(path, f"is no scan: its size must be a multiple of {4 * _COLUMNS} bytes, and not 0")
    points = values.reshape(-1, _COLUMNS)[:, :3].T.astype(np.float64)
    distance = np.linalg.norm(points, axis=0)
    return points[:, np.isfinite(distance) & (distance > _MIN_RANGE)]


def unroll(points: np.ndarray, T_laser_before: np.ndarray) -> np.ndarray:
    """Points [3, N] of one turn as if all had been measured at the scan's time, when the head looks forward.

    The motion of one turn, ``T_laser_before`` [4, 4], is taken as even: a point measured a share s of a turn earlier
    is moved by that share of it (rotation vector and translation).
    """
    share = np.arctan2(points[1], points[0]) / (2 * np.pi)
    turn = Rotation.from_matrix(T_laser_before[:3, :3]).as_rotvec()
    moved = Rotation.from_rotvec(share[:, None] * turn).apply(points.T).T
    return moved + share * T_laser_before[:3, 3:]
