"""Writes rendered sequences in every dataset layout, tiny and with known content."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from scipy.spatial.transform import Rotation

from scenes import FURNITURE, camera_pose, render

SIZE = (48, 64)  # (H, W)
NED_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True, eq=False)
class Truth:
    """The scene that a layout's files were rendered from."""

    T_world_cam: list[np.ndarray]
    K: np.ndarray
    depths: list[np.ndarray]
    images: list[np.ndarray]


def resized(fx, fy, cx, cy, old, new=SIZE):
    """K after a resize from ``old`` (H, W) that maps the image borders (at -1/2) to the image borders."""
    sy, sx = new[0] / old[0], new[1] / old[1]
    return np.array([[fx * sx, 0, (cx + 0.5) * sx - 0.5], [0, fy * sy, (cy + 0.5) * sy - 0.5], [0, 0, 1]])


def walk(frames):
    """A walk through the room with turns: neighbouring frames are 11 cm and 2 degrees apart."""
    steps = np.arange(frames)
    return [camera_pose((-0.5 + 0.1 * i, -0.2 + 0.02 * i, -0.9 + 0.03 * i), 0.035 * i - 0.2, 0.05) for i in steps]


def paint(depth, T_world_cam, K):
    """[H, W, 3] uint8: a colour for each piece of furniture, darker with distance."""
    colour = np.full((*depth.shape, 3), [210.0, 200, 180])
    for number, box in enumerate(FURNITURE):
        alone = render(T_world_cam, K, *depth.shape, boxes=(box,))
        room = render(T_world_cam, K, *depth.shape, boxes=())
        colour[(alone == depth) & (alone < room)] = [40 + 30 * number, 90 - 20 * number, 60 * number]
    return (colour / (0.6 + 0.2 * depth[..., None])).clip(0, 255).astype(np.uint8)


def truth(K, frames=6, size=SIZE, poses=None):
    """Rendered frames of the walk (or of ``poses``)."""
    poses = walk(frames) if poses is None else poses
    depths = [render(T, K, *size) for T in poses]
    images = [paint(depth, T, K) for depth, T in zip(depths, poses, strict=True)]
    return Truth(poses, K, depths, images)


def write_image(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def write_depth_png(path, depth, units_per_metre, scale_text=None):
    """16-bit PNG; ``scale_text`` goes into its text as ``depth_scale``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    info = PngInfo()
    if scale_text is not None:
        info.add_text("depth_scale", scale_text)
    Image.fromarray(np.rint(depth * units_per_metre).astype(np.uint16)).save(path, pnginfo=info)


def truncate(path: Path, share=0.5):
    """Truncate a file, as a full disk does."""
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def quaternion_line(T):
    """``tx ty tz qx qy qz qw``."""
    return " ".join(f"{x:.12g}" for x in [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()])


def write_tum(root, frames=6, folder="rgbd_dataset_freiburg2_desk"):
    """Colour and a pose at 10 + i/30 s, depth 5 ms later."""
    path = root / folder
    scene = truth(resized(520.9, 521.0, 325.1, 249.7, (480, 640)), frames)
    rgb, depth, poses = ["# color images"], ["# depth maps"], ["# timestamp tx ty tz qx qy qz qw"]
    for i in range(frames):
        time = 10 + i / 30
        rgb.append(f"{time:.6f} rgb/{time:.6f}.png")
        depth.append(f"{time + 0.005:.6f} depth/{time + 0.005:.6f}.png")
        poses.append(f"{time:.6f} {quaternion_line(scene.T_world_cam[i])}")
        write_image(path / "rgb" / f"{time:.6f}.png", scene.images[i])
        write_depth_png(path / "depth" / f"{time + 0.005:.6f}.png", scene.depths[i], 5000)
    for name, lines in (("rgb.txt", rgb), ("depth.txt", depth), ("groundtruth.txt", poses)):
        (path / name).write_text("\n".join(lines) + "\n")
    return path, scene


def write_seven_scenes(root, frames=6):
    """Depth and poses of the depth camera; the colour camera is 2.5 cm to its right."""
    path = root / "seq-01"
    T_depth_color = np.eye(4)
    T_depth_color[0, 3] = 0.025
    K_color = resized(525, 525, 320, 240, (480, 640))
    K_depth = resized(585, 585, 320, 240, (480, 640))
    of_depth = truth(K_depth, frames)
    of_color = truth(K_color, frames, poses=[T @ T_depth_color for T in of_depth.T_world_cam])
    for i in range(frames):
        write_image(path / f"frame-{i:06d}.color.png", of_color.images[i])
        write_depth_png(path / f"frame-{i:06d}.depth.png", of_depth.depths[i], 1000)
        np.savetxt(path / f"frame-{i:06d}.pose.txt", of_depth.T_world_cam[i])
    return path, of_color, of_depth


def write_scannet(root, frames=6):
    """Colour 162x121 (an eighth of ScanNet's), depth 64x48, each with its own 4x4 intrinsics."""
    path = root / "scene0000_00"
    color_size = (121, 162)
    K_color = resized(1170, 1171, 648, 484, (968, 1296), color_size)
    K_depth = resized(578, 578, 320, 240, (480, 640))
    of_color, of_depth = truth(K_color, frames, color_size), truth(K_depth, frames)
    for i in range(frames):
        write_image(path / "color" / f"{i}.jpg", of_color.images[i])
        write_depth_png(path / "depth" / f"{i}.png", of_depth.depths[i], 1000)
        (path / "pose").mkdir(exist_ok=True)
        np.savetxt(path / "pose" / f"{i}.txt", of_depth.T_world_cam[i])
    (path / "intrinsic").mkdir()
    for name, K in (("color", K_color), ("depth", K_depth)):
        matrix = np.eye(4)
        matrix[:3, :3] = K
        np.savetxt(path / "intrinsic" / f"intrinsic_{name}.txt", matrix)
    return path, of_color, of_depth


def write_tartanair(root, frames=6):
    """Poses of a camera frame with NED axes: x forward, y right, z down."""
    path = root / "office" / "P000"
    scene = truth(resized(320, 320, 320, 240, (480, 640)), frames)
    (path / "depth_left").mkdir(parents=True)
    for i in range(frames):
        write_image(path / "image_left" / f"{i:06d}_left.png", scene.images[i])
        np.save(path / "depth_left" / f"{i:06d}_left_depth.npy", scene.depths[i].astype(np.float32))
    ned = [T @ np.linalg.inv(NED_FROM_CAMERA) for T in scene.T_world_cam]
    (path / "pose_left.txt").write_text("\n".join(quaternion_line(T) for T in ned) + "\n")
    return path, scene


def write_generic(root, frames=6, folder="walk", size=SIZE):
    """``images/N.png depth/N.png K.txt poses.txt``: numbers without leading zeros, one 4x4 pose in a line."""
    path = root / folder
    scene = truth(resized(500, 510, 310, 245, (480, 640), size), frames, size)
    for i in range(frames):
        write_image(path / "images" / f"{i + 7}.png", scene.images[i])
        write_depth_png(path / "depth" / f"{i + 7}.png", scene.depths[i], 1000)
    np.savetxt(path / "K.txt", scene.K)
    np.savetxt(path / "poses.txt", [T.ravel() for T in scene.T_world_cam])
    return path, scene


def write_video(path, images, fps=10):
    """A lossless video (FFV1 in Matroska)."""
    import cv2

    height, width = images[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), fps, (width, height))
    assert writer.isOpened()
    for image in images:
        writer.write(np.ascontiguousarray(image[..., ::-1]))
    writer.release()
