"""KITTI-360: rectified images of a drive, poses by frame number, sparse depth from the laser or the user's maps.

``data_2d_raw/DRIVE/image_00/data_rect/NNNNNNNNNN.png`` (or image_01), ``data_poses/DRIVE/cam0_to_world.txt`` (the
rectified camera 00) or ``poses.txt`` (the car), by frame number, ``calibration/``, and
``data_3d_raw/DRIVE/velodyne_points/data/*.bin``. Frames without a pose, where the car stood still, are skipped.
image_02 and image_03 are fisheye cameras, which a pinhole model does not describe. https://www.cvlibs.net/datasets/kitti-360/documentation.php

Calibration: ``perspective.txt`` has for each camera NN of the stereo pair ``P_rect_NN`` (3x4), ``R_rect_NN`` (3x3, from
the camera as it is mounted to the rectified one) and ``S_rect_NN`` (width, height); ``calib_cam_to_pose.txt`` has the
mounted cameras in the car (``image_NN:`` and 3x4 numbers), ``calib_cam_to_velo.txt`` camera 00 as mounted in the laser.

Laser: a scan is ``f32`` x y z (forward, left, up [m]) and reflectance. The head turns clockwise, seen from above, and
looks forward at the scan's time: a point at azimuth a was measured a / 2 pi of a turn earlier, from elsewhere.
"""

from __future__ import annotations

import os
import re
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ufmstar_torch.eval.sequences.attach import UNKNOWN, attach_given, pair_depth
from ufmstar_torch.eval.sequences.frame import Entry, FrameError, FrameSequence, Loader, Size, Skipped, make_sequence
from ufmstar_torch.eval.sequences.ground_truth import project
from ufmstar_torch.eval.sequences.images import (
    IMAGE_SUFFIXES,
    depth_size,
    first_image_size,
    list_files,
    read_color,
    read_depth,
)
from ufmstar_torch.eval.sequences.intrinsics import camera_matrix, depth_camera_matrix
from ufmstar_torch.eval.sequences.options import Options, resolve
from ufmstar_torch.eval.sequences.poses import numbered_lines, read_matrix, read_trajectory

LOOKED_FOR = "data_2d_raw/DRIVE/image_00/data_rect (the root, the drive's folder or the camera's)"
_RAW = "data_2d_raw"
_CAMERAS = ("image_00", "image_01")
_CAMERA = re.compile(r"image_0\d")
_SCALE = 1 / 256  # [m] per unit of 16-bit depth maps, as KITTI's
_LASER = "calib_cam_to_velo.txt"
_COLUMNS = 4
_MIN_RANGE = 2.0  # [m] nearer returns are the car's own roof
# A laser scan: its file; [4, 4] from the laser at the scan's time into the camera that looks [m]; and [4, 4] from the
# laser one scan earlier into it now [m], None where it is not known: its points are then taken as they are.
Scan = tuple[Path, np.ndarray, np.ndarray | None]


def detect(path: Path) -> bool:
    """Whether the path is the dataset's root, a drive or a camera of one."""
    if (path / _RAW).is_dir():
        return bool(drives(path))
    camera = _camera(path)
    return camera is not None and camera.is_dir()


def drives(root: Path) -> list[Path]:
    """The drives of a root that have rectified images, sorted; a drive or camera itself."""
    if not (root / _RAW).is_dir():
        return [root]
    return sorted(d for d in (root / _RAW).iterdir() if any((d / camera / "data_rect").is_dir() for camera in _CAMERAS))


def read(path: Path, options: Options) -> FrameSequence:
    """Opens a drive: ``path`` is the root (with the option ``drive``, unless there is only one), or the drive's folder
    (its first rectified camera), or the camera's.

    Depth comes from the folder ``depth`` (16 bits, 1/256 m), or else from the laser: the frame's own scan, unrolled,
    and those of ``scans`` frames before and after it. Poses are camera 00's, moved to the camera opened.

    Raises:
        FileNotFoundError: no poses, or a calibration file that is needed is missing.
        ValueError: no or several drives fit; a fisheye camera; no usable frame; malformed files.
    """
    folder = _camera(_drive(path, options.drive))
    if folder is None or folder.name not in _CAMERAS:
        raise ValueError(f"{path}: of KITTI-360, {' and '.join(_CAMERAS)} can be read; the others are fisheye cameras")
    root, drive, camera = folder.parents[2], folder.parent.name, folder.name.removeprefix("image_")
    images = list_files(folder / "data_rect", IMAGE_SUFFIXES)
    if not images:
        raise ValueError(f"{folder / 'data_rect'} holds no image")
    size = first_image_size(images)
    perspective = root / "calibration" / "perspective.txt"
    width, height = (int(value) for value in _values(perspective, f"S_rect_{camera}", 2))
    P = _values(perspective, f"P_rect_{camera}", 12).reshape(3, 4)
    K = camera_matrix(options.intrinsics, P[:, :3].copy(), (height, width), size)
    numbers = [_number(image) for image in images]
    times = _times(folder / "timestamps.txt", numbers)
    poses = _poses(root, drive, camera) if options.trajectory is None else dict.fromkeys(numbers, UNKNOWN)
    frames: list[Entry | Skipped] = [
        Entry(image.stem, poses[number], partial(read_color, image), None, None if times is None else float(times[i]))
        if number in poses
        else Skipped(image.stem, "no pose for this frame number")
        for i, (image, number) in enumerate(zip(images, numbers, strict=True))
    ]
    frames = attach_given(frames, folder, options, times)
    if options.trajectory is not None:
        poses = {int(frame.name): frame.T_world_cam for frame in frames if isinstance(frame, Entry)}
    loaders = _depth(folder, poses, [image.stem for image in images], options, K, size or (height, width))
    frames = [replace(f, load_depth=loaders.get(f.name)) if isinstance(f, Entry) else f for f in frames]
    maps_size = size if options.depth is None else depth_size(frames)
    return make_sequence(
        drive if camera == "00" else f"{drive}_{folder.name}",
        "kitti360",
        frames,
        K,
        image_size=size,
        depth_intrinsics=depth_camera_matrix(options.depth_intrinsics, K, size, maps_size),
        depth_size=maps_size if loaders else None,
    )


def _camera(path: Path) -> Path | None:
    """The camera's folder, ROOT/data_2d_raw/DRIVE/image_0N, that a folder below ``data_2d_raw`` means."""
    path = Path(os.path.abspath(path))
    if path.name in ("data_rect", "data_rgb"):
        path = path.parent
    if path.parent.name == _RAW:
        have = [camera for camera in _CAMERAS if (path / camera / "data_rect").is_dir()]
        path = path / (have or sorted(p.name for p in path.glob("image_0?")) or _CAMERAS)[0]
    return path if _CAMERA.fullmatch(path.name) and path.parents[1].name == _RAW else None


def _drive(path: Path, drive: str | int | None) -> Path:
    """The folder of the drive that ``path`` and the option mean; ValueError where none or several fit."""
    if not (path / _RAW).is_dir():
        if drive is not None:
            raise ValueError(f"drive goes with the dataset's root, which holds {_RAW}; {path} does not")
        return path
    fitting = [d for d in drives(path) if drive is None or str(drive) == d.name or _same_number(str(drive), d.name)]
    if len(fitting) != 1:
        known = [d.name for d in drives(path)]
        raise ValueError(f"{path}: drive must name one of {known}, by name or number: {drive!r}")
    return fitting[0]


def _same_number(drive: str, name: str) -> bool:
    result = re.search(r"drive_(\d+)", name)
    return result is not None and drive.isdecimal() and int(drive) == int(result[1])


def _number(image: Path) -> int:
    if not image.stem.isdecimal():
        raise ValueError(f"{image}: expected a frame number as the file's name")
    return int(image.stem)


def _times(path: Path, numbers: list[int]) -> np.ndarray | None:
    """[N] times of the frames [s since 1970], of lines ``2013-05-28 08:46:02.904546304``; None if not known."""
    if not path.is_file():
        return None
    lines = [text for _, text in numbered_lines(path)]
    if max(numbers) >= len(lines):
        return None
    try:
        stamps = [datetime.fromisoformat(lines[n].strip()).replace(tzinfo=UTC).timestamp() for n in numbers]
    except ValueError as error:
        raise ValueError(f"{path}: expected lines of date and time: {error}") from error
    return np.array(stamps)


def _poses(root: Path, drive: str, camera: str) -> dict[int, np.ndarray]:
    """T_world_cam of the rectified camera by frame number."""
    of_camera, of_car = (root / "data_poses" / drive / name for name in ("cam0_to_world.txt", "poses.txt"))
    if not of_camera.is_file() and not of_car.is_file():
        raise FileNotFoundError(f"{of_car.parent} has neither {of_camera.name} nor {of_car.name}: pass trajectory")
    file = of_camera if of_camera.is_file() else of_car
    trajectory = read_trajectory(file)
    if trajectory.timestamps is None:
        raise ValueError(f"{file}: expected the frame's number before each pose")
    calibration = root / "calibration"
    T = trajectory.T_world_cam if file == of_camera else trajectory.T_world_cam @ _T_car_rect(calibration, "00")
    T = T @ _T_rect0_rect(calibration, camera)
    return dict(zip(trajectory.timestamps.astype(int).tolist(), T, strict=True))


def _depth(
    folder: Path, poses: dict[int, np.ndarray], names: list[str], options: Options, K: np.ndarray, size: Size
) -> dict[str, Loader]:
    """What loads the depth of each frame that has any."""
    if options.depth is not None:
        if options.scans is not None:
            raise ValueError("scans goes with depth from the laser, not with a folder of depth maps")
        pairs = pair_depth(names, resolve(folder, options.depth))
        load = partial(read_depth, scale=options.depth_scale, default_scale=_SCALE)
        return {name: partial(load, file) for name, file in pairs.items()}
    calibration, camera = folder.parents[2] / "calibration", folder.name.removeprefix("image_")
    scans_folder = folder.parents[2] / "data_3d_raw" / folder.parent.name / "velodyne_points" / "data"
    if not scans_folder.is_dir() or not (calibration / _LASER).is_file():
        return {}
    T_cam_laser = _T_rect_laser(calibration, camera)
    scans = {int(file.stem): file for file in scans_folder.glob("*.bin") if file.stem.isdecimal()}
    known = {number: T for number, T in poses.items() if np.isfinite(T).all()}
    near = range(-(options.scans or 0), (options.scans or 0) + 1)
    result: dict[str, Loader] = {}
    for name in names:
        if int(name) in scans and int(name) in known:
            around = [n for n in (int(name) + step for step in near) if n in scans and n in known]
            seen = [_scan(scans[n], n, int(name), known, T_cam_laser) for n in around]
            result[name] = partial(_laser_depth, seen, K, size)
    return result


def _scan(path: Path, of: int, at: int, poses: dict[int, np.ndarray], T_cam_laser: np.ndarray) -> Scan:
    """Scan number ``of`` in the camera of frame ``at``."""
    turn = None
    for before, after in ((of - 1, of), (of, of + 1)):
        if turn is None and before in poses and after in poses:
            turn = np.linalg.inv(T_cam_laser) @ (np.linalg.inv(poses[after]) @ poses[before]) @ T_cam_laser
    return path, np.linalg.inv(poses[at]) @ poses[of] @ T_cam_laser, turn


def _laser_depth(scans: list[Scan], K: np.ndarray, size: Size) -> np.ndarray:
    """[H, W] float32 [m] that scans give: each pixel takes the nearest point that falls on it, 0 = none."""
    points = []
    for path, T_cam_laser, T_laser_before in scans:
        own = read_scan(path) if T_laser_before is None else unroll(read_scan(path), T_laser_before)
        points.append(T_cam_laser[:3, :3] @ own + T_cam_laser[:3, 3:])
    return project(np.concatenate(points, axis=1), K, size)


def _T_rect0_rect(calibration: Path, camera: str) -> np.ndarray:
    """[4, 4] from the rectified camera ("00" or "01") into the rectified camera 00."""
    if camera == "00":
        return np.eye(4)
    return np.linalg.inv(_T_car_rect(calibration, "00")) @ _T_car_rect(calibration, camera)


def _T_rect_laser(calibration: Path, camera: str) -> np.ndarray:
    """[4, 4] from the laser into the rectified camera."""
    T_laser_mounted = _affine(read_matrix(calibration / _LASER), calibration / _LASER)
    T_rect0_laser = _T_rect_mounted(calibration, "00") @ np.linalg.inv(T_laser_mounted)
    return np.linalg.inv(_T_rect0_rect(calibration, camera)) @ T_rect0_laser


def _T_rect_mounted(calibration: Path, camera: str) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = _values(calibration / "perspective.txt", f"R_rect_{camera}", 9).reshape(3, 3)
    return T


def _T_car_rect(calibration: Path, camera: str) -> np.ndarray:
    """[4, 4] from the rectified camera into the car, whose poses poses.txt holds."""
    file = calibration / "calib_cam_to_pose.txt"
    T_car_mounted = _affine(_values(file, f"image_{camera}", 12), file)
    return T_car_mounted @ np.linalg.inv(_T_rect_mounted(calibration, camera))


def _values(path: Path, key: str, count: int) -> np.ndarray:
    """[count] the numbers behind ``key:`` in a calibration file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no such line, or not as many numbers in it.
    """
    if not path.is_file():
        raise FileNotFoundError(f"KITTI-360's calibration is missing: no file {path}")
    for number, line in numbered_lines(path):
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
    return np.concatenate([values.reshape(3, 4), [[0.0, 0.0, 0.0, 1.0]]])


def read_scan(path: Path) -> np.ndarray:
    """[3, N] float64 points of a scan in the laser's frame [m], without the car's own and those that are not finite.
    Raises FrameError: the file is missing, or its size is not that of a scan."""
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
