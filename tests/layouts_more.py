"""Writes tiny sequences as KITTI-360 with laser scans, ScanNet's .sens, and NYU's h5 files."""

from __future__ import annotations

import io
import struct
import zlib

import h5py
import layouts
import numpy as np
from changed_poses import rigid
from PIL import Image
from scipy.spatial.transform import Rotation

DRIVE = "2013_05_28_drive_0007_sync"
CAR_SIZE = (47, 176)  # an eighth of 376 x 1408
_P_RECT = (552.554261, 552.554261, 682.049453, 238.769549)
# Camera axes (right, down, forward) in the car's and in the laser's.
_CAR_FROM_CAMERA = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
_LASER_FROM_CAMERA = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def turn(*degrees):
    return Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()


R_RECT = {"00": turn(0.4, -0.3, 0.2), "01": turn(-0.2, 0.5, 0.1)}
T_CAR_MOUNTED = {
    "00": rigid(_CAR_FROM_CAMERA @ turn(1, 2, 0.5), (1.57, 0.04, -1.2)),
    "01": rigid(_CAR_FROM_CAMERA @ turn(0.7, 2.1, 0.6), (1.58, 0.63, -1.21)),
}
T_LASER_MOUNTED = rigid(_LASER_FROM_CAMERA @ turn(0.2, 0.1, -0.4), (0.77, 0.29, -0.08))


def T_car_rect(camera):
    return T_CAR_MOUNTED[camera] @ rigid(R_RECT[camera].T, (0, 0, 0))


def large_walk(frames):
    """The walk through the room, ten times as large: a drive of 1.1 m per frame."""
    return [rigid(T[:3, :3], 10 * T[:3, 3]) for T in layouts.walk(frames)]


def large_truth(poses):
    K = layouts.resized(*_P_RECT, (376, 1408), CAR_SIZE)
    small = layouts.truth(K, size=CAR_SIZE, poses=[rigid(T[:3, :3], T[:3, 3] / 10) for T in poses])
    return layouts.Truth(poses, K, [10 * depth for depth in small.depths], small.images)


def write_kitti360(root, numbers=(3, 4, 6, 7, 8), standing=(5,), camera="00"):
    """A drive. The frames ``standing`` have no pose; the truth has the frames ``numbers``, in that order.

    Every scan samples the camera's depth at every third column and second row, distorted as by a turning laser.
    """
    every = sorted({*numbers, *standing})
    rect0 = dict(zip(every, large_walk(len(every)), strict=True))
    to_camera = np.linalg.inv(T_car_rect("00")) @ T_car_rect(camera)
    truth = large_truth([rect0[n] @ to_camera for n in every])
    T_by_number = {n: T for n, T in rect0.items() if n not in standing}
    _write_calibration(root / "calibration")
    folder = root / "data_poses" / DRIVE
    folder.mkdir(parents=True)
    inverse = np.linalg.inv(T_car_rect("00"))
    np.savetxt(folder / "cam0_to_world.txt", [[n, *T.ravel()] for n, T in T_by_number.items()])
    np.savetxt(folder / "poses.txt", [[n, *(T @ inverse)[:3].ravel()] for n, T in T_by_number.items()])
    images = root / "data_2d_raw" / DRIVE / f"image_{camera}"
    scans = root / "data_3d_raw" / DRIVE / "velodyne_points" / "data"
    scans.mkdir(parents=True)
    for i, number in enumerate(every):
        layouts.write_image(images / "data_rect" / f"{number:010d}.png", truth.images[i])
        if number in T_by_number:
            _write_scan(scans / f"{number:010d}.bin", truth.depths[i], truth.K, to_camera, T_by_number, number)
    stamps = [f"2013-05-28 08:46:{2 + n / 10:012.9f}" for n in range(max(every) + 1)]
    (images / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    keep = [every.index(n) for n in numbers]
    return images.parent, layouts.Truth(*([values[i] for i in keep] if isinstance(values, list) else values
        for values in (truth.T_world_cam, truth.K, truth.depths, truth.images)))  # fmt: skip


def _write_calibration(folder):
    folder.mkdir(parents=True)
    fx, fy, cx, cy = _P_RECT
    lines = ["calib_time: 01-Jan-2013 00:00:00", "corner_dist: 9.950000e-02"]
    for camera, R in R_RECT.items():
        baseline = 0.0 if camera == "00" else -328.318735
        P = [fx, 0, cx, baseline, 0, fy, cy, 0, 0, 0, 1, 0]
        lines += [f"S_{camera}: 1392 512", f"R_rect_{camera}: {' '.join(f'{x:.12g}' for x in R.ravel())}"]
        lines += [f"S_rect_{camera}: 1408.000000 376.000000", f"P_rect_{camera}: {' '.join(f'{x:.12g}' for x in P)}"]
    (folder / "perspective.txt").write_text("\n".join(lines) + "\n")
    cameras = [f"image_{c}: {' '.join(f'{x:.12g}' for x in T[:3].ravel())}" for c, T in T_CAR_MOUNTED.items()]
    (folder / "calib_cam_to_pose.txt").write_text("\n".join(cameras) + "\n")
    np.savetxt(folder / "calib_cam_to_velo.txt", T_LASER_MOUNTED[:3].reshape(1, 12))


def _write_scan(path, depth, K, to_camera, T_by_number, number):
    v, u = np.mgrid[0 : depth.shape[0] : 2, 0 : depth.shape[1] : 3]
    z = depth[v, u].ravel()
    in_camera = np.stack([(u.ravel() - K[0, 2]) / K[0, 0] * z, (v.ravel() - K[1, 2]) / K[1, 1] * z, z, np.ones_like(z)])
    T_laser_rect0 = T_LASER_MOUNTED @ rigid(R_RECT["00"].T, (0, 0, 0))
    points = (T_laser_rect0 @ to_camera @ in_camera)[:3]
    before, after = (number - 1, number) if number - 1 in T_by_number else (number, number + 1)
    if before in T_by_number and after in T_by_number:
        motion = np.linalg.inv(T_by_number[after]) @ T_by_number[before]
        points = roll(points, T_laser_rect0 @ motion @ np.linalg.inv(T_laser_rect0))
    path.write_bytes(np.concatenate([points, np.full((1, len(z)), 0.5)]).T.astype("<f4").tobytes())


def roll(points, T_laser_before):
    """[3, N] points as measured by a laser head that turns clockwise; the arguments are points at the time it looks
    forward."""
    rotation = Rotation.from_matrix(T_laser_before[:3, :3]).as_rotvec()
    measured = points
    for _ in range(20):  # the azimuth determines the time of measurement, which changes the azimuth: iterate
        share = np.arctan2(measured[1], measured[0]) / (2 * np.pi)
        shifted = (points - share * T_laser_before[:3, 3:]).T
        measured = Rotation.from_rotvec(-share[:, None] * rotation).apply(shifted).T
    return measured


def write_sens(path, frames=6, *, lost=(), color=2, depth=1, version=4, timestamps=True, name=b"StructureSensor"):
    """Colour 162x121, depth 64x48 in mm at 10 + i/30 s; ``lost`` frames have a pose of -inf."""
    size = (121, 162)
    K_color = layouts.resized(1170, 1171, 648, 484, (968, 1296), size)
    K_depth = layouts.resized(578, 578, 320, 240, (480, 640))
    of_color, of_depth = layouts.truth(K_color, frames, size), layouts.truth(K_depth, frames)
    matrices = [np.eye(4) for _ in range(4)]
    matrices[0][:3, :3], matrices[2][:3, :3] = K_color, K_depth
    out = [struct.pack("<IQ", version, len(name)), name, np.array(matrices, "<f4").tobytes()]
    out.append(struct.pack("<2i4IfQ", color, depth, size[1], size[0], 64, 48, 1000.0, frames))
    for i in range(frames):
        buffer = io.BytesIO()
        Image.fromarray(of_color.images[i]).save(buffer, "JPEG", quality=95)
        packed = zlib.compress(np.rint(of_depth.depths[i] * 1000).astype("<u2").tobytes())
        pose = np.full((4, 4), -np.inf) if i in lost else of_depth.T_world_cam[i]
        time = int(1e6 * (10 + i / 30)) if timestamps else 0
        out.append(pose.astype("<f4").tobytes())
        out.append(struct.pack("<4Q", time, time, len(buffer.getvalue()), len(packed)))
        out += [buffer.getvalue(), packed]
    out.append(struct.pack("<Q", 0))  # no IMU frames
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(out))
    return path, of_color, of_depth


def write_h5(path, rgb, depth):
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for key, value in (("rgb", rgb), ("depth", depth)):
            if value is not None:
                file[key] = value


def write_nyu(root, scenes=("kitchen_1", "office_2"), frames=2, size=(48, 64)):
    """``val/SCENE/NNNNN.h5`` and one training file; the truth is of val."""
    K = layouts.resized(518.857901, 519.469611, 325.582449, 253.736166, (480, 640), size)
    truth = layouts.truth(K, len(scenes) * frames, size)
    for i in range(len(scenes) * frames):
        path = root / "val" / scenes[i // frames] / f"{i + 9}.h5"  # 9, 10, ...: text order would differ
        write_h5(path, truth.images[i].transpose(2, 0, 1), truth.depths[i].astype(np.float32))
    write_h5(root / "train" / "den" / "1.h5", truth.images[0].transpose(2, 0, 1), truth.depths[0].astype(np.float32))
    return root, truth
