"""TartanAir: ``image_left/*.png depth_left/*_depth.npy pose_left.txt``, float32 depth [m].

Poses are ``tx ty tz qx qy qz qw`` of a camera frame with NED axes (x forward, y right, z down); they are
converted to ours (x right, y down, z forward). https://tartanair.org
"""

from __future__ import annotations

from pathlib import Path

from ufmstar_torch.eval.sequences.assemble import assemble
from ufmstar_torch.eval.sequences.attach import frame_of_image
from ufmstar_torch.eval.sequences.frame import FrameSequence
from ufmstar_torch.eval.sequences.images import depth_loader, first_image_size
from ufmstar_torch.eval.sequences.lens import Lens
from ufmstar_torch.eval.sequences.options import Options, with_camera_files
from ufmstar_torch.eval.sequences.paths import list_files, on_disk
from ufmstar_torch.eval.sequences.poses import read_trajectory
from ufmstar_torch.gaussians.conventions import CONVENTIONS

LOOKED_FOR = "pose_left.txt and image_left/ (also in a single sub-folder P000)"
_LENS = Lens((320.0, 320.0, 320.0, 240.0), (480, 640))


def detect(path: Path) -> bool:
    """True if the folder, or a trajectory folder in it, has this layout."""
    return bool(parts(path))


def read(path: Path, options: Options) -> FrameSequence:
    """Open a TartanAir trajectory (left camera); row i of the poses belongs to the image numbered i. ``trajectory``
    must have our axes. Raises ValueError: no usable frame; several trajectories below ``path``; an image without a
    pose; a malformed pose line."""
    folders = parts(path)
    if len(folders) > 1:
        raise ValueError(f"{path} holds the trajectories {[folder.name for folder in folders]}: open one of them")
    folder = folders[0]
    options = with_camera_files(options, folder)
    trajectory = read_trajectory(folder / "pose_left.txt")
    if trajectory.timestamps is not None:
        raise ValueError(f"{folder / 'pose_left.txt'}: expected 7 numbers in a line, tx ty tz qx qy qz qw")
    images = list_files(folder / "image_left")
    by_number: dict[int, Path] = {}
    for image in images:
        digits = image.stem.split("_")[0]
        if not digits.isdigit() or int(digits) >= len(trajectory):
            raise ValueError(f"{image}: expected a name NNNNNN_left below the {len(trajectory)} poses")
        by_number[int(digits)] = image
    frames = []
    for number, T in enumerate(CONVENTIONS["ned"].convert(trajectory.T_world_cam)):
        image = by_number.get(number, folder / "image_left" / f"{number:06d}_left.png")
        depth = on_disk(folder / "depth_left" / f"{image.stem}_depth.npy")
        load_depth = depth_loader(depth if depth.is_file() else None, options.truth_scale)
        frames.append(frame_of_image(image.stem, image, load_depth, T))
    name = path.resolve().name if folder == path else f"{path.resolve().name}_{folder.name}"
    size = first_image_size(images) or _LENS.size
    return assemble("tartanair", folder, frames, _LENS, options, name=name, size=size)


def parts(path: Path) -> list[Path]:
    """The folders with a trajectory: ``path``, or folders PNNN in it."""
    folders = [path, *sorted(path.glob("P[0-9]*"))] if path.is_dir() else []
    return [f for f in folders if (f / "pose_left.txt").is_file() and (f / "image_left").is_dir()]
