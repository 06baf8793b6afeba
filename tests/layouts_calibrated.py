"""Writes tiny sequences in the layouts that store their calibration: COLMAP, transforms.json, EuRoC, ARKit."""

from __future__ import annotations

import json
import struct

import layouts
import numpy as np
from layouts_more import rigid, turn
from scipy.spatial.transform import Rotation

K = layouts.resized(500, 510, 310, 245, (480, 640))
H, W = layouts.SIZE
MODELS = {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5, "SIMPLE_RADIAL": 2}
T_BODY_CAMERA = rigid(turn(10, 20, -90), (0.1, -0.2, 0.3))


def focal_and_centre(shift=0.5):
    """fx fy cx cy, with the first pixel's centre at (shift, shift)."""
    return [float(x) for x in (K[0, 0], K[1, 1], K[0, 2] + shift, K[1, 2] + shift)]


def world_to_camera(T):
    """qw qx qy qz tx ty tz."""
    inverse = np.linalg.inv(T)
    return [*np.roll(Rotation.from_matrix(inverse[:3, :3]).as_quat(), 1), *inverse[:3, 3]]


SEEN = 12  # points of an image


def surface_points(scene):
    """[12 N, 3] surface points at 12 pixels of each of N frames [m]."""
    rng, points = np.random.default_rng(0), []
    for T, depth in zip(scene.T_world_cam, scene.depths, strict=True):
        u, v = rng.integers(0, W, SEEN), rng.integers(0, H, SEEN)
        rays = np.linalg.inv(scene.K) @ np.stack([u, v, np.ones(SEEN)])
        points.append((T[:3, :3] @ (rays * depth[v, u]) + T[:3, 3:]).T)
    return np.concatenate(points)


def write_colmap(root, frames=6, *, text=False, model="PINHOLE", coefficients=(), unit=1.0):
    """``sparse/0`` with two alternating cameras, in a ``unit`` of [m], ``images/`` and ``depth/``. Each image observes
    12 surface points that no other image observes."""
    path, scene = root / "walk", layouts.truth(K, frames)
    folder = path / "sparse" / "0"
    folder.mkdir(parents=True)
    values = [*focal_and_centre()[model.startswith("SIMPLE") :], *coefficients]
    points = surface_points(scene) / unit
    views = []
    for i in reversed(range(frames)):
        layouts.write_image(path / "images" / f"{i}.png", scene.images[i])
        layouts.write_depth_png(path / "depth" / f"{i}.png", scene.depths[i], 1000)
        T = scene.T_world_cam[i].copy()
        T[:3, 3] /= unit
        views.append((i + 1, world_to_camera(T), 1 + i % 2, f"{i}.png", [*range(SEEN * i, SEEN * (i + 1)), -1]))
    if text:
        numbers = " ".join(f"{x:.17g}" for x in values)
        lines = ["# cameras", *(f"{camera} {model} {W} {H} {numbers}" for camera in (1, 2))]
        (folder / "cameras.txt").write_text("\n".join(lines))
        lines = ["# images"]
        for key, pose, camera, name, seen in views:
            lines += [f"{key} {' '.join(f'{x:.17g}' for x in pose)} {camera} {name}"]
            lines += [" ".join(f"1.5 2.5 {point}" for point in seen)]
        (folder / "images.txt").write_text("\n".join(lines) + "\n")
        rows = [f"{i} {p[0]:.17g} {p[1]:.17g} {p[2]:.17g} 1 2 3 .5 1 0" for i, p in enumerate(points)]
        (folder / "points3D.txt").write_text("\n".join(rows))
        return path, scene, points
    cameras = b"".join(struct.pack(f"<IiQQ{len(values)}d", c, MODELS[model], W, H, *values) for c in (1, 2))
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", 2) + cameras)
    stored = b"".join(
        struct.pack("<I7dI", key, *pose, camera) + name.encode() + b"\0" + struct.pack("<Q", len(seen))
        + b"".join(struct.pack("<ddQ", 1.5, 2.5, point % 2**64) for point in seen)
        for key, pose, camera, name, seen in views
    )  # fmt: skip
    (folder / "images.bin").write_bytes(struct.pack("<Q", frames) + stored)
    rows = [struct.pack("<Q3d3BdQII", i, *p, 1, 2, 3, 0.5, 1, 1, 0) for i, p in enumerate(points)]
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))
    return path, scene, points


def write_transforms(root, frames=6, *, per_frame=False, **more):
    """``transforms.json`` with depth maps, the camera once or in each frame."""
    path, scene = root / "walk", layouts.truth(K, frames)
    camera = dict(zip(("fl_x", "fl_y", "cx", "cy"), focal_and_centre(), strict=True)) | {"w": W, "h": H, **more}
    listed = []
    for i in range(frames):
        layouts.write_image(path / "images" / f"{i}.png", scene.images[i])
        layouts.write_depth_png(path / "depth" / f"{i}.png", scene.depths[i], 1000)
        matrix = (scene.T_world_cam[i] @ np.diag([1.0, -1, -1, 1])).tolist()
        listed.append(
            {"file_path": f"./images/{i}.png", "transform_matrix": matrix, "depth_file_path": f"depth/{i}.png"}
        )
    content = {"frames": [frame | camera for frame in listed]} if per_frame else {**camera, "frames": listed}
    (path / "transforms.json").write_text(json.dumps(content))
    return path, scene


def write_euroc(root, frames=6, coefficients=(0.0, 0.0, 0.0, 0.0), model="radial-tangential"):
    """``mav0``: images at 20 Hz, poses of the body at 20 Hz; ground truth has no depth."""
    path, scene = root / "V1_01_easy", layouts.truth(K, frames)
    start, step = 1403715273262142976, 50_000_000
    camera, truth = path / "mav0" / "cam0", path / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir(parents=True)
    rows, poses = ["#timestamp [ns],filename"], ["#timestamp, p_x [m], p_y, p_z, q_w, q_x, q_y, q_z, v_x"]
    for i in range(frames):
        time = start + i * step
        layouts.write_image(camera / "data" / f"{time}.png", scene.images[i])
        rows.append(f"{time},{time}.png")
        T = scene.T_world_cam[i] @ np.linalg.inv(T_BODY_CAMERA)
        quaternion = np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1)
        poses.append(",".join([str(time), *(f"{x:.15g}" for x in (*T[:3, 3], *quaternion, 0.0))]))
    (camera / "data.csv").write_text("\r\n".join(rows))
    (truth / "data.csv").write_text("\n".join(poses))
    data = ", ".join(f"{x:.17g}" for x in T_BODY_CAMERA.ravel())
    (camera / "sensor.yaml").write_text(
        f"#Default\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{data}]\nrate_hz: 20\n"
        f"resolution: [{W}, {H}]\ncamera_model: pinhole\nintrinsics: {focal_and_centre(0)}\n"
        f"distortion_model: {model}\ndistortion_coefficients: {list(coefficients)}\n"
    )
    return path, scene


def write_stray(root, frames=6, *, per_frame=False):
    """A phone's folder: a (here lossless) video, and depth of half its size, with confidence 0 in row 0."""
    path, scene = root / "4f3a2b", layouts.truth(K, frames)
    path.mkdir(parents=True)
    layouts.write_video(path / "rgb.mkv", scene.images)
    (path / "rgb.mkv").rename(path / "rgb.mp4")
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw" + ", fx, fy, cx, cy" * per_frame]
    for i, T in enumerate(scene.T_world_cam):
        camera = f" {' '.join(map(str, focal_and_centre(0)))}" * per_frame
        values = f"{100 + i / 60} {i:06d} {layouts.quaternion_line(T)}{camera}"
        rows.append(", ".join(values.split()))
        layouts.write_depth_png(path / "depth" / f"{i:06d}.png", scene.depths[i][::2, ::2], 1000)
        confidence = np.full((H // 2, W // 2), 2, np.uint8)
        confidence[0] = 0
        layouts.write_image(path / "confidence" / f"{i:06d}.png", confidence)
    (path / "odometry.csv").write_text("\n".join(rows))
    matrix = np.eye(3) if per_frame else scene.K
    (path / "camera_matrix.csv").write_text("\n".join(", ".join(f"{x:.17g}" for x in row) for row in matrix))
    return path, scene


def write_arkitscenes(root, frames=6):
    """Images at 10 Hz; the trajectory's times have more digits than the files' names."""
    path, scene = root / "41048190", layouts.truth(K, frames)
    inside, lines = path / "41048190_frames", []
    for name in ("lowres_wide", "lowres_depth", "lowres_wide_intrinsics"):
        (inside / name).mkdir(parents=True)
    for i, T in enumerate(scene.T_world_cam):
        stem = f"41048190_{3377.181 + i / 10:.3f}"
        layouts.write_image(inside / "lowres_wide" / f"{stem}.png", scene.images[i])
        layouts.write_depth_png(inside / "lowres_depth" / f"{stem}.png", scene.depths[i], 1000)
        values = [W, H, *focal_and_centre(0)]
        (inside / "lowres_wide_intrinsics" / f"{stem}.pincam").write_text(" ".join(f"{x:.17g}" for x in values))
        inverse = np.linalg.inv(T)
        rotation = Rotation.from_matrix(inverse[:3, :3]).as_rotvec()
        lines.append(" ".join(f"{x:.12g}" for x in (3377.18127 + i / 10, *rotation, *inverse[:3, 3])))
    (inside / "lowres_wide.traj").write_text("\n".join(lines))
    return path, scene
