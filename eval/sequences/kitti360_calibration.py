"""KITTI-360's calibration files, put together for one rectified camera.

``perspective.txt`` has for each camera NN of the stereo pair ``P_rect_NN`` (3x4), ``R_rect_NN`` (3x3, from the camera
as it is mounted to the rectified one) and ``S_rect_NN`` (width, height); ``calib_cam_to_pose.txt`` has the mounted
cameras in the car (``image_NN:`` and 3x4 numbers), ``calib_cam_to_velo.txt`` camera 00 as mounted in the laser (3x4).
https://www.cvlibs.net/datasets/kitti-360/documentation.php
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.frame import Size
from ufmstar_torch.eval.sequences.poses import read_matrix

PERSPECTIVE = "perspective.txt"
CAM_TO_POSE = "calib_cam_to_pose.txt"
CAM_TO_LASER = "calib_cam_to_velo.txt"


@dataclass(frozen=True, eq=False)
class Calibration:
    """The folder ``calibration``, for one camera.

    Attributes:
        folder: it.
        camera: "00" or "01".
    """

    folder: Path
    camera: str

    def intrinsics(self) -> tuple[np.ndarray, Size]:
        """K [3, 3] of the rectified images [px], and (H, W) for which it holds.

        Raises:
            FileNotFoundError, ValueError: as :func:`read_values`.
        """
        file = self.folder / PERSPECTIVE
        width, height = read_values(file, f"S_rect_{self.camera}", 2)
        return read_values(file, f"P_rect_{self.camera}", 12).reshape(3, 4)[:, :3].copy(), (int(height), int(width))

    def T_rect0_rect(self) -> np.ndarray:
        """[4, 4] from this rectified camera into the rectified camera 00."""
        if self.camera == "00":
            return np.eye(4)
        return np.linalg.inv(self._T_car_rect("00")) @ self._T_car_rect(self.camera)

    def T_car_rect0(self) -> np.ndarray:
        """[4, 4] from the rectified camera 00 into the car, whose poses poses.txt holds."""
        return self._T_car_rect("00")

    def T_rect_laser(self) -> np.ndarray:
        """[4, 4] from the laser into this rectified camera."""
        T_laser_mounted = _affine(read_matrix(_existing(self.folder / CAM_TO_LASER)), self.folder / CAM_TO_LASER)
        T_rect0_laser = self._T_rect_mounted("00") @ np.linalg.inv(T_laser_mounted)
        return np.linalg.inv(self.T_rect0_rect()) @ T_rect0_laser

    def has_laser(self) -> bool:
        """Whether the laser's place is known."""
        return (self.folder / CAM_TO_LASER).is_file()

    def _T_rect_mounted(self, camera: str) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3] = read_values(self.folder / PERSPECTIVE, f"R_rect_{camera}", 9).reshape(3, 3)
        return T

    def _T_car_rect(self, camera: str) -> np.ndarray:
        file = self.folder / CAM_TO_POSE
        T_car_mounted = _affine(read_values(file, f"image_{camera}", 12), file)
        return T_car_mounted @ np.linalg.inv(self._T_rect_mounted(camera))


def read_values(path: Path, key: str, count: int) -> np.ndarray:
    """[count] the numbers behind ``key:`` in a calibration file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no such line, or not as many numbers in it.
    """
    for number, line in enumerate(_existing(path).read_text(encoding="utf-8").splitlines(), start=1):
        name, _, rest = line.partition(":")
        if name.strip() != key:
            continue
        try:
            values = [float(word) for word in rest.split()]
        except ValueError:
            values = []
        if len(values) != count or not np.isfinite(values).all():
            raise ValueError(f"{path}:{number}: expected {count} numbers behind {key!r}, got {rest.strip()!r}")
        return np.array(values)
    raise ValueError(f"{path}: no line {key!r}")


def _affine(values: np.ndarray, path: Path) -> np.ndarray:
    """[4, 4] of 3x4 numbers."""
    if values.size != 12 or not np.isfinite(values).all():
        raise ValueError(f"{path}: expected the 12 numbers of a 3x4 matrix, got {values.size}")
    T = np.eye(4)
    T[:3] = values.reshape(3, 4)
    return T


def _existing(path: Path) -> Path:
    if not path.is_file():
        raise FileNotFoundError(f"KITTI-360's calibration is missing: no file {path}")
    return path
