"""SensReader exports of ScanNet: ``color/N.jpg depth/N.png pose/N.txt intrinsic/intrinsic_*.txt``.

Depth is 16-bit in mm with another size and other intrinsics than colour (640x480, 1296x968); missing poses are -inf.
https://github.com/ScanNet/ScanNet/tree/master/SensReader
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.assemble import assemble
from ufmstar_torch.eval.sequences.attach import frame_of_files
from ufmstar_torch.eval.sequences.frame import Entry, FrameSequence, Size, Skipped, fits
from ufmstar_torch.eval.sequences.images import depth_loader, first_depth_size, first_image_size
from ufmstar_torch.eval.sequences.intrinsics import IntrinsicsLike, read_intrinsics, scale_intrinsics
from ufmstar_torch.eval.sequences.lens import Lens
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.eval.sequences.paths import list_files, on_disk

LOOKED_FOR = "color/, pose/ and intrinsic/ folders"
_NATIVE_COLOR, _NATIVE_DEPTH = (968, 1296), (480, 640)


def detect(path: Path) -> bool:
    """True if the folder has this layout."""
    return all((path / folder).is_dir() for folder in ("color", "pose", "intrinsic"))


def read(path: Path, options: Options) -> FrameSequence:
    """Open a SensReader export. Depth maps keep their camera, ``depth_intrinsics``. Exports with resized images have
    the original ``intrinsic_color.txt``: intrinsics that fit 1296x968 (depth: 640x480) but not the files' size are
    scaled. Raises ValueError: no usable frame, intrinsics that fit neither size, a malformed pose file."""
    images = list_files(path / "color")
    frames = [_frame(path, image, options) for image in images]
    if not images:
        raise ValueError(f"scannet sequence {path.name!r}: the folder color/ holds no image")
    color_size = first_image_size(images) or _NATIVE_COLOR
    size = first_depth_size(frames)
    K = _intrinsics(options.intrinsics, path / "intrinsic" / "intrinsic_color.txt", _NATIVE_COLOR, color_size)
    file = path / "intrinsic" / "intrinsic_depth.txt"
    K_depth = None if size is None else _intrinsics(options.depth_intrinsics, file, _NATIVE_DEPTH, size)
    return assemble("scannet", path, frames, Lens.of(K, color_size), options, K_depth=K_depth, depth_size=size)


def _frame(path: Path, image: Path, options: Options) -> Entry | Skipped:
    pose, depth = (on_disk(path / kind / f"{image.stem}{end}") for kind, end in (("pose", ".txt"), ("depth", ".png")))
    load_depth = depth_loader(depth if depth.is_file() else None, options.truth_scale)
    return frame_of_files(image.stem, image, pose if pose.is_file() else None, load_depth, options)


def _intrinsics(override: IntrinsicsLike | None, file: Path, native: Size, size: Size) -> np.ndarray:
    if override is not None:
        return read_intrinsics(override)
    K = read_intrinsics(file)
    return scale_intrinsics(K, native, size) if not fits(K, size) and fits(K, native) else K
