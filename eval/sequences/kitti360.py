"""KITTI-360: rectified images of a drive, poses by frame number, sparse depth from the laser or the user's maps.

``data_2d_raw/DRIVE/image_00/data_rect/NNNNNNNNNN.png`` (or image_01), ``data_poses/DRIVE/cam0_to_world.txt`` (the
rectified camera 00) or ``poses.txt`` (the car), by frame number, ``calibration/``, and
``data_3d_raw/DRIVE/velodyne_points/data/*.bin``. Frames without a pose, while the car did not move, are skipped.
image_02 and image_03 are fisheye cameras, which do not fit a pinhole model.
https://www.cvlibs.net/datasets/kitti-360/documentation.php

Calibration: ``perspective.txt`` has for each camera NN of the stereo pair ``P_rect_NN`` (3x4), ``R_rect_NN`` (3x3, from
the mounted to the rectified camera) and ``S_rect_NN`` (width, height); ``calib_cam_to_pose.txt`` has the poses of the
mounted cameras in the car (``image_NN:`` and 3x4 numbers), ``calib_cam_to_velo.txt`` that of camera 00 in the laser.

Laser: a scan is ``f32`` x y z (forward, left, up [m]) and reflectance. The head turns clockwise, seen from above, and
points forward at the scan's time: a point at azimuth a was measured a / 2 pi of a turn earlier, from another position.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ufmstar_torch.eval.sequences.assemble import assemble
from ufmstar_torch.eval.sequences.attach import UNKNOWN, frame_of_image, pair_depth
from ufmstar_torch.eval.sequences.frame import Entry, FrameError, FrameSequence, Size, Skipped
from ufmstar_torch.eval.sequences.ground_truth import project
from ufmstar_torch.eval.sequences.images import depth_loader, first_image_size
from ufmstar_torch.eval.sequences.lens import Lens
from ufmstar_torch.eval.sequences.options import Options, resolve
from ufmstar_torch.eval.sequences.paths import list_files
from ufmstar_torch.eval.sequences.poses import numbered_lines, numbers, read_matrix, read_trajectory

LOOKED_FOR = "data_2d_raw/DRIVE/image_00/data_rect (the root, the drive's folder or the camera's)"
_RAW = "data_2d_raw"
_CAMERAS = ("image_00", "image_01")
_CAMERA = re.compile(r"image_0\d")
_SCALE = 1 / 256  # [m] per unit of 16-bit depth maps, as KITTI's
_LASER = "calib_cam_to_velo.txt"
_COLUMNS = 4
_MIN_RANGE = 2.0  # [m] nearer returns are the car's roof


def detect(path: Path) -> bool:
    """True if the path is the dataset's root, a drive or a camera of one."""
    if (path / _RAW).is_dir():
        return bool(parts(path))
    camera = _camera(path)
    return camera is not None and camera.is_dir()


def parts(root: Path) -> list[Path]:
    """The drives of a root with rectified images, sorted; for a drive or camera the path itself."""
    if not (root / _RAW).is_dir():
        return [root]
    return sorted(d for d in (root / _RAW).iterdir() if any((d / camera / "data_rect").is_dir() for camera in _CAMERAS))


def read(path: Path, options: Options) -> FrameSequence:
    """Open a drive: ``path`` is the root (with the option ``drive``, unless there is only one), or the drive's folder
    (its first rectified camera), or the camera's. Depth comes from the folder ``truth`` (16 bits, 1/256 m), or else
    from the laser: the frame's scan, unrolled, and those of ``scans`` frames before and after it. Raises
    FileNotFoundError: no poses or calibration; ValueError: no or several drives fit, a fisheye camera, malformed
    files."""
    folder = _camera(_drive(path, options.drive))
    if folder is None or folder.name not in _CAMERAS:
        raise ValueError(f"{path}: of KITTI-360, {' and '.join(_CAMERAS)} can be read; the others are fisheye cameras")
    root, drive, camera = folder.parents[2], folder.parent.name, folder.name.removeprefix("image_")
    images = list_files(folder / "data_rect")
    if not images:
        raise ValueError(f"{folder / 'data_rect'} holds no image")
    size = first_image_size(images)
    perspective = root / "calibration" / "perspective.txt"
    width, height = (int(value) for value in _values(perspective, f"S_rect_{camera}", 2))
    P = _values(perspective, f"P_rect_{camera}", 12).reshape(3, 4)
    for image in images:
        if not image.stem.isdecimal():
            raise ValueError(f"{image}: expected a frame number as the file's name")
    numbers = [int(image.stem) for image in images]
    times = _times(folder / "timestamps.txt", numbers)
    poses = _poses(root, drive, camera) if options.trajectory is None else dict.fromkeys(numbers, UNKNOWN)
    maps = {} if options.truth is None else pair_depth([i.stem for i in images], resolve(folder, options.truth))
    loaders = {image.stem: depth_loader(maps.get(image.stem), options.truth_scale, _SCALE) for image in images}
    frames = [
        frame_of_image(image.stem, image, loaders[image.stem], poses[number], time)
        if number in poses
        else Skipped(image.stem, "no pose for this frame number")
        for image, number, time in zip(images, numbers, times, strict=True)
    ]
    lens, name = Lens.of(P[:, :3], (height, width)), drive if camera == "00" else f"{drive}_{folder.name}"
    sequence = assemble("kitti360", folder, frames, lens, options, name=name, size=size)
    if options.truth is None:
        if options.depth_intrinsics is not None:
            raise ValueError("depth_intrinsics goes with a folder of depth maps, not with depth from the laser")
        return _with_laser(sequence, root, drive, camera, poses, options)
    if options.scans is not None:
        raise ValueError("scans goes with depth from the laser, not with a folder of depth maps")
    return sequence


def _camera(path: Path) -> Path | None:
    """The camera's folder, ROOT/data_2d_raw/DRIVE/image_0N, of a folder below ``data_2d_raw``, or None."""
    path = Path(os.path.abspath(path))
    if path.name in ("data_rect", "data_rgb"):
        path = path.parent
    if path.parent.name == _RAW:
        rectified = [camera for camera in _CAMERAS if (path / camera / "data_rect").is_dir()]
        path = path / (rectified or sorted(p.name for p in path.glob("image_0?")) or _CAMERAS)[0]
    return path if _CAMERA.fullmatch(path.name) and path.parents[1].name == _RAW else None


def _drive(path: Path, drive: str | int | None) -> Path:
    """The folder of the drive of ``path`` and the option. Raises ValueError: none or several fit."""
    if not (path / _RAW).is_dir():
        if drive is not None:
            raise ValueError(f"drive goes with the dataset's root, which holds {_RAW}; {path} does not")
        return path
    number = rf"drive_0*{int(drive)}(?!\d)" if drive is not None and str(drive).isdecimal() else "$^"
    fitting = [d for d in parts(path) if drive is None or str(drive) == d.name or re.search(number, d.name)]
    if len(fitting) != 1:
        drives = [d.name for d in parts(path)]
        raise ValueError(f"{path}: drive must name one of {drives}, by name or number: {drive!r}")
    return fitting[0]


def _times(path: Path, numbers: list[int]) -> Sequence[float | None]:
    """Times of the frames [s since 1970], from lines ``2013-05-28 08:46:02.904546304``; None = unknown."""
    lines = [text for _, text in numbered_lines(path)] if path.is_file() else []
    if max(numbers) >= len(lines):
        return [None] * len(numbers)
    try:
        return [datetime.fromisoformat(lines[n].strip()).replace(tzinfo=UTC).timestamp() for n in numbers]
    except ValueError as error:
        raise ValueError(f"{path}: expected lines of date and time: {error}") from error


def _poses(root: Path, drive: str, camera: str) -> dict[int, np.ndarray]:
    """T_world_cam of the rectified camera by frame number."""
    of_camera, of_car = files = [root / "data_poses" / drive / name for name in ("cam0_to_world.txt", "poses.txt")]
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        raise FileNotFoundError(f"{of_car.parent} has neither {of_camera.name} nor {of_car.name}: pass trajectory")
    trajectory = read_trajectory(file)
    if trajectory.timestamps is None:
        raise ValueError(f"{file}: expected the frame's number before each pose")
    calibration = root / "calibration"
    T = trajectory.T_world_cam if file == of_camera else trajectory.T_world_cam @ _T_car_rect(calibration, "00")
    T = T @ _T_rect0_rect(calibration, camera)
    return dict(zip(trajectory.timestamps.astype(int).tolist(), T, strict=True))


def _with_laser(
    sequence: FrameSequence, root: Path, drive: str, camera: str, poses: dict[int, np.ndarray], options: Options
) -> FrameSequence:
    """The sequence with depth from the laser, for frames with a scan."""
    folder, calibration = root / "data_3d_raw" / drive / "velodyne_points" / "data", root / "calibration"
    if not folder.is_dir() or not (calibration / _LASER).is_file():
        return sequence
    scans = {int(file.stem): file for file in folder.glob("*.bin") if file.stem.isdecimal()}
    if options.trajectory is not None:
        poses = {int(entry.name): entry.T_world_cam for entry in sequence.entries}
    poses = {number: T for number, T in poses.items() if np.isfinite(T).all()}
    assert sequence.image_size is not None
    T_cam_laser = _T_rect_laser(calibration, camera)
    laser = _Laser(scans, poses, T_cam_laser, sequence.intrinsics, sequence.image_size, options.scans or 0)

    def with_depth(entry: Entry) -> Entry:
        number = int(entry.name)
        return replace(entry, load_depth=partial(laser.depth, number)) if laser.sees(number) else entry

    return replace(sequence.changed(with_depth), depth_size=sequence.image_size)


@dataclass(frozen=True, eq=False)
class _Laser:
    """The scans of a drive in one of its cameras."""

    scans: dict[int, Path]  # by frame number
    poses: dict[int, np.ndarray]  # [4, 4] T_world_cam by frame number, finite ones
    T_cam_laser: np.ndarray  # [4, 4]
    K: np.ndarray  # [3, 3] of the camera [px]
    size: Size  # of its images
    neighbours: int  # number of scans before and after a frame that are added to the frame's scan

    def sees(self, number: int) -> bool:
        """True if a frame has a scan and a pose."""
        return number in self.scans and number in self.poses

    def depth(self, number: int) -> np.ndarray:
        """[H, W] float32 [m] of a frame: the nearest point in each pixel, 0 = none."""
        points = []
        for other in filter(self.sees, range(number - self.neighbours, number + self.neighbours + 1)):
            scan, T_laser_before = read_scan(self.scans[other]), self._turn(other)
            if T_laser_before is not None:
                scan = unroll(scan, T_laser_before)
            T = np.linalg.inv(self.poses[number]) @ self.poses[other] @ self.T_cam_laser
            points.append(T[:3, :3] @ scan + T[:3, 3:])
        return project(np.concatenate(points, axis=1), self.K, self.size)

    def _turn(self, number: int) -> np.ndarray | None:
        """[4, 4] from the laser one scan earlier to the laser at a frame [m]; None if no neighbour has a pose."""
        for before, after in ((number - 1, number), (number, number + 1)):
            if before in self.poses and after in self.poses:
                motion = np.linalg.inv(self.poses[after]) @ self.poses[before]
                return np.linalg.inv(self.T_cam_laser) @ motion @ self.T_cam_laser
        return None


def _T_rect0_rect(calibration: Path, camera: str) -> np.ndarray:
    """[4, 4] from the rectified camera ("00" or "01") into the rectified camera 00."""
    if camera == "00":
        return np.eye(4)
    return np.linalg.inv(_T_car_rect(calibration, "00")) @ _T_car_rect(calibration, camera)


def _T_rect_laser(calibration: Path, camera: str) -> np.ndarray:
    """[4, 4] from the laser into the rectified camera."""
    file = calibration / _LASER
    values = numbers(read_matrix(file), (12,), f"{file}: expected the 12 numbers of a 3x4 matrix")
    T_rect0_laser = _T_rect_mounted(calibration, "00") @ np.linalg.inv(_affine(values))
    return np.linalg.inv(_T_rect0_rect(calibration, camera)) @ T_rect0_laser


def _T_rect_mounted(calibration: Path, camera: str) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = _values(calibration / "perspective.txt", f"R_rect_{camera}", 9).reshape(3, 3)
    return T


def _T_car_rect(calibration: Path, camera: str) -> np.ndarray:
    """[4, 4] from the rectified camera into the car, whose poses are in poses.txt."""
    T_car_mounted = _affine(_values(calibration / "calib_cam_to_pose.txt", f"image_{camera}", 12))
    return T_car_mounted @ np.linalg.inv(_T_rect_mounted(calibration, camera))


def _affine(values: np.ndarray) -> np.ndarray:
    """[4, 4] of 3x4 numbers."""
    return np.vstack([values.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])


def _values(path: Path, key: str, count: int) -> np.ndarray:
    """[count] the numbers after ``key:`` in a calibration file."""
    if not path.is_file():
        raise FileNotFoundError(f"KITTI-360's calibration is missing: no file {path}")
    for number, line in numbered_lines(path):
        name, _, rest = line.partition(":")
        if name.strip() != key:
            continue
        error = f"{path}:{number}: expected {count} numbers behind {key!r}, got {rest.strip()!r}"
        return numbers(rest.split(), (count,), error)
    raise ValueError(f"{path}: no line {key!r}")


def read_scan(path: Path) -> np.ndarray:
    """[3, N] float64 points of a scan in the laser's frame [m], without those on the car and those that are not finite.
    Raises FrameError: the file is missing, or its size is not that of a scan."""
    try:
        values = np.fromfile(path, "<f4")
    except OSError as error:
        raise FrameError(path, f"cannot be read: {error}") from error
    if values.size == 0 or path.stat().st_size % (4 * _COLUMNS):
        raise FrameError(path, f"is no scan: its size must be a multiple of {4 * _COLUMNS} bytes, and not 0")
    with np.errstate(invalid="ignore"):  # NaN of a damaged file
        points = values.reshape(-1, _COLUMNS)[:, :3].T.astype(np.float64)
    distance = np.linalg.norm(points, axis=0)
    return points[:, np.isfinite(distance) & (distance > _MIN_RANGE)]


def unroll(points: np.ndarray, T_laser_before: np.ndarray) -> np.ndarray:
    """Points [3, N] of one turn, moved to the scan's time, when the head points forward. The motion during the turn,
    ``T_laser_before`` [4, 4], is assumed to be uniform (rotation vector and translation)."""
    share = np.arctan2(points[1], points[0]) / (2 * np.pi)
    turn = Rotation.from_matrix(T_laser_before[:3, :3]).as_rotvec()
    moved = Rotation.from_rotvec(share[:, None] * turn).apply(points.T).T
    return moved + share * T_laser_before[:3, 3:]
