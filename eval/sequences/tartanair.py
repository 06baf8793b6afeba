"""TartanAir: ``image_left/*.png depth_left/*_depth.npy pose_left.txt``, float32 depth [m].

Poses are ``tx ty tz qx qy qz qw`` of a camera frame with NED axes (x forward, y right, z down); they are
converted to ours (x right, y down, z forward). https://tartanair.org
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.attach import attach_given
from ufmstar_torch.eval.sequences.frame import Entry, FrameSequence, Skipped, make_sequence
from ufmstar_torch.eval.sequences.images import depth_loader, depth_size, first_image_size, list_images, read_color
from ufmstar_torch.eval.sequences.intrinsics import camera_matrix, pinhole
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.eval.sequences.poses import CONVENTIONS, read_trajectory

LOOKED_FOR = "pose_left.txt and image_left/ (also in a single sub-folder P000)"
_NATIVE_SIZE = (480, 640)
_K = (320.0, 320.0, 320.0, 240.0)


def detect(path: Path) -> bool:
    """True if the folder has this layout, itself or in trajectory folders below it."""
    return bool(trajectory_folders(path))


def read(path: Path, options: Options) -> FrameSequence:
    """Opens a TartanAir trajectory (left camera). A given ``trajectory`` has our axes already. Raises ValueError: no
    usable frame; several trajectories below ``path``; another number of poses than of images; a malformed pose line."""
    folders = trajectory_folders(path)
    if len(folders) > 1:
        raise ValueError(f"{path} holds the trajectories {[folder.name for folder in folders]}: open one of them")
    folder = folders[0]
    trajectory = read_trajectory(folder / "pose_left.txt")
    if trajectory.timestamps is not None:
        raise ValueError(f"{folder / 'pose_left.txt'}: expected 7 numbers in a line, tx ty tz qx qy qz qw")
    images = list_images(folder / "image_left")
    frames = _frames(folder, images, CONVENTIONS["ned"].convert(trajectory.T_world_cam), options.depth_scale)
    frames = attach_given(frames, folder, options)
    size = first_image_size(images) or _NATIVE_SIZE
    K = camera_matrix(options.intrinsics, pinhole(*_K), _NATIVE_SIZE, size)
    name = path.resolve().name if folder == path else f"{path.resolve().name}_{folder.name}"
    return make_sequence(name, "tartanair", frames, K, image_size=size, depth_size=depth_size(frames))


def trajectory_folders(path: Path) -> list[Path]:
    """The folders with a trajectory: ``path``, or those called PNNN in it."""
    folders = [path, *sorted(path.glob("P[0-9]*"))] if path.is_dir() else []
    return [f for f in folders if (f / "pose_left.txt").is_file() and (f / "image_left").is_dir()]


def _frames(
    folder: Path, images: list[Path], T_world_cam: np.ndarray, depth_scale: float | None
) -> list[Entry | Skipped]:
    """One frame per pose: row i belongs to the image numbered i, so that a missing image shifts nothing."""
    by_number: dict[int, Path] = {}
    for image in images:
        digits = image.stem.split("_")[0]
        if not digits.isdigit() or int(digits) >= len(T_world_cam):
            raise ValueError(f"{image}: expected a name NNNNNN_left below the {len(T_world_cam)} poses")
        by_number[int(digits)] = image
    frames: list[Entry | Skipped] = []
    for number, T in enumerate(T_world_cam):
        if number not in by_number:
            frames.append(Skipped(f"{number:06d}_left", "missing image file"))
            continue
        image = by_number[number]
        depth = folder / "depth_left" / f"{image.stem}_depth.npy"
        load_depth = depth_loader(depth if depth.is_file() else None, depth_scale)
        frames.append(Entry(image.stem, T, partial(read_color, image), load_depth))
    return frames
