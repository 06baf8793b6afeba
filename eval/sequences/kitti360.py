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
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ufmstar_torch.eval.sequences.attach import UNKNOWN, attach_given, pair_by_name
from ufmstar_torch.eval.sequences.frame import Entry, FrameError, FrameSequence, Loader, Size, Skipped, make_sequence
from ufmstar_torch.eval.sequences.ground_truth import project
from ufmstar_torch.eval.sequences.images import (
    DEPTH_SUFFIXES,
    IMAGE_SUFFIXES,
    common_size,
    depth_loader,
    first_image_size,
    list_files,
    read_color,
)
from ufmstar_torch.eval.sequences.intrinsics import read_intrinsics, scale_intrinsics
from ufmstar_torch.eval.sequences.options import Options, resolve
from ufmstar_torch.eval.sequences.poses import numbered_lines, read_matrix, read_trajectory

LOOKED_FOR = "data_2d_raw/DRIVE/image_00/data_rect (the root, the drive's folder or the camera's)"
_RAW = "data_2d_raw"
_CAMERAS = ("image_00", "image_01")
_CAMERA = re.compile(r"image_0\d")
_SCALE = 1 / 256  # [m] per unit of 16-bit depth maps, as KITTI's
PERSPECTIVE = "perspective.txt"
CAM_TO_POSE = "calib_cam_to_pose.txt"
CAM_TO_LASER = "calib_cam_to_velo.txt"
_COLUMNS = 4
_MIN_RANGE = 2.0  # [m] nearer returns are the car's own roof


@dataclass(frozen=True)
class _Place:
    """A camera of a drive."""

    root: Path
    drive: str
    camera: str

    @property
    def folder(self) -> Path:
        return self.root / _RAW / self.drive / self.camera

    @property
    def images(self) -> Path:
        return self.folder / "data_rect"

    @property
    def scans(self) -> Path:
        return self.root / "data_3d_raw" / self.drive / "velodyne_points" / "data"


def detect(path: Path) -> bool:
    """Whether the path is the dataset's root, a drive or a camera of one."""
    if (path / _RAW).is_dir():
        return bool(drives(path))
    place = _place(path)
    return place is not None and place.folder.is_dir()


def drives(root: Path) -> list[Path]:
    """The drives of a root that have rectified images, sorted; a drive or camera itself."""
    if not (root / _RAW).is_dir():
        return [root]
    return sorted(d for d in (root / _RAW).iterdir() if any((d / camera / "data_rect").is_dir() for camera in _CAMERAS))


def open_kitti360(path: Path, options: Options) -> FrameSequence:
    """Opens a drive: ``path`` is the root (with the option ``drive``, unless there is only one), or the drive's folder
    (its first rectified camera), or the camera's.

    Depth comes from the folder ``depth`` (16 bits, 1/256 m), or else from the laser: the frame's own scan, unrolled,
    and those of ``scans`` frames before and after it. Poses are camera 00's, moved to the camera opened.

    Raises:
        FileNotFoundError: no poses, or a calibration file that is needed is missing.
        ValueError: no or several drives fit; a fisheye camera; no usable frame; malformed files.
    """
    options.reject("kitti360", "images", "T_color_depth")
    options.only_attached("kitti360")
    place = _place(_drive(path, options.drive))
    if place is None or place.camera not in _CAMERAS:
        raise ValueError(f"{path}: of KITTI-360, {' and '.join(_CAMERAS)} can be read; the others are fisheye cameras")
    calibration = Calibration(place.root / "calibration", place.camera.removeprefix("image_"))
    images = list_files(place.images, IMAGE_SUFFIXES)
    if not images:
        raise ValueError(f"{place.images} holds no image")
    size = first_image_size(images)
    K, K_size = calibration.intrinsics()
    K = scale_intrinsics(K, K_size, size or K_size)
    if options.intrinsics is not None:
        K = read_intrinsics(options.intrinsics)
    numbers = [_number(image) for image in images]
    times = _times(place.folder / "timestamps.txt", numbers)
    poses = _poses(place, calibration) if options.trajectory is None else dict.fromkeys(numbers, UNKNOWN)
    frames = [
        _entry(image, number, poses, None if times is None else float(times[i]))
        for i, (image, number) in enumerate(zip(images, numbers, strict=True))
    ]
    frames = attach_given(frames, place.folder, options, times)
    if options.trajectory is not None:
        poses = {int(frame.name): frame.T_world_cam for frame in frames if isinstance(frame, Entry)}
    loaders = _depth(place, calibration, poses, [image.stem for image in images], options, K, size or K_size)
    frames = [replace(f, load_depth=loaders.get(f.name)) if isinstance(f, Entry) else f for f in frames]
    depth_size = size if options.depth is None else common_size(loaders.values())
    return make_sequence(
        place.drive if place.camera == _CAMERAS[0] else f"{place.drive}_{place.camera}",
        "kitti360",
        frames,
        K,
        image_size=size,
        depth_intrinsics=_depth_intrinsics(options, K, size, depth_size),
        depth_size=depth_size if loaders else None,
    )


def _place(path: Path) -> _Place | None:
    """The camera that a folder below ``data_2d_raw`` means."""
    path = Path(os.path.abspath(path))
    if path.name in ("data_rect", "data_rgb"):
        path = path.parent
    if path.parent.name == _RAW:
        have = [camera for camera in _CAMERAS if (path / camera / "data_rect").is_dir()]
        path = path / (have or sorted(p.name for p in path.glob("image_0?")) or _CAMERAS)[0]
    if _CAMERA.fullmatch(path.name) and path.parents[1].name == _RAW:
        return _Place(path.parents[2], path.parent.name, path.name)
    return None


def _drive(path: Path, drive: str | int | None) -> Path:
    """The folder of the drive that ``path`` and the option mean.

    Raises:
        ValueError: none or several fit.
    """
    if not (path / _RAW).is_dir():
        if drive is not None:
            raise ValueError(f"drive goes with the dataset's root, which holds {_RAW}; {path} does not")
        return path
    fitting = [d for d in drives(path) if drive is None or str(drive) == d.name or _same_number(str(drive), d.name)]
    if len(fitting) != 1:
        raise ValueError(
            f"{path}: drive must name one of {[d.name for d in drives(path)]}, by name or number: {drive!r}"
        )
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


def _poses(place: _Place, calibration: Calibration) -> dict[int, np.ndarray]:
    """T_world_cam of the rectified camera by frame number."""
    folder = place.root / "data_poses" / place.drive
    of_camera, of_car = folder / "cam0_to_world.txt", folder / "poses.txt"
    if not of_camera.is_file() and not of_car.is_file():
        raise FileNotFoundError(f"{folder} has neither {of_camera.name} nor {of_car.name}: pass trajectory")
    file = of_camera if of_camera.is_file() else of_car
    trajectory = read_trajectory(file)
    if trajectory.timestamps is None:
        raise ValueError(f"{file}: expected the frame's number before each pose")
    T = trajectory.T_world_cam if of_camera.is_file() else trajectory.T_world_cam @ calibration.T_car_rect0()
    return dict(zip(trajectory.timestamps.astype(int).tolist(), T @ calibration.T_rect0_rect(), strict=True))


def _entry(image: Path, number: int, poses: dict[int, np.ndarray], time: float | None) -> Entry | Skipped:
    if number not in poses:
        return Skipped(image.stem, "no pose for this frame number")
    return Entry(image.stem, poses[number], partial(read_color, image), None, time)


def _depth(
    place: _Place,
    calibration: Calibration,
    poses: dict[int, np.ndarray],
    names: list[str],
    options: Options,
    K: np.ndarray,
    size: Size,
) -> dict[str, Loader]:
    """What loads the depth of each frame that has any."""
    if options.depth is not None:
        if options.scans is not None:
            raise ValueError("scans goes with depth from the laser, not with a folder of depth maps")
        folder = resolve(place.folder, options.depth)
        pairs = pair_by_name(names, list_files(folder, DEPTH_SUFFIXES))
        if not pairs:
            raise ValueError(f"{folder}: no depth map is named like an image ({names[0]}, ...)")
        loaders = {name: depth_loader(file, options.depth_scale, _SCALE) for name, file in pairs.items()}
        return {name: load for name, load in loaders.items() if load is not None}
    if not place.scans.is_dir() or not calibration.has_laser():
        return {}
    T_cam_laser = calibration.T_rect_laser()
    scans = {int(file.stem): file for file in place.scans.glob("*.bin") if file.stem.isdecimal()}
    near = range(-(options.scans or 0), (options.scans or 0) + 1)
    result: dict[str, Loader] = {}
    for name in names:
        number = int(name)
        if number in scans and number in poses and np.isfinite(poses[number]).all():
            around = [
                n for n in (number + step for step in near) if n in scans and np.isfinite(poses.get(n, UNKNOWN)).all()
            ]
            result[name] = LaserDepth(tuple(_scan(scans[n], n, number, poses, T_cam_laser) for n in around), K, size)
    return result


def _scan(path: Path, of: int, at: int, poses: dict[int, np.ndarray], T_cam_laser: np.ndarray) -> Scan:
    """Scan number ``of`` in the camera of frame ``at``."""
    T = np.linalg.inv(poses[at]) @ poses[of]
    motion = next(
        (
            np.linalg.inv(poses[after]) @ poses[before]
            for before, after in ((of - 1, of), (of, of + 1))
            if np.isfinite(poses.get(before, UNKNOWN)).all() and np.isfinite(poses.get(after, UNKNOWN)).all()
        ),
        None,
    )
    turn = None if motion is None else np.linalg.inv(T_cam_laser) @ motion @ T_cam_laser
    return Scan(path, T @ T_cam_laser, turn)


def _depth_intrinsics(options: Options, K: np.ndarray, size: Size | None, depth_size: Size | None) -> np.ndarray | None:
    if options.depth_intrinsics is not None:
        return read_intrinsics(options.depth_intrinsics)
    if options.depth is None or size is None or depth_size is None or size == depth_size:
        return None
    return scale_intrinsics(K, size, depth_size)


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
    for number, line in numbered_lines(_existing(path)):
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
