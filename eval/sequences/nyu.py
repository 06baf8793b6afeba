"""NYU Depth V2 in FastDepth's layout as an evaluation set: ``train|val/<scene>/*.h5`` with ``rgb`` and ``depth``.

``rgb`` is uint8 [3, H, W], ``depth`` floating-point [H, W] in metres along the optical axis, registered to ``rgb``;
0 or not finite = none. The images are single images without poses: the sequence has ``posed`` False.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.assemble import assemble
from ufmstar_torch.eval.sequences.frame import Entry, FrameError, FrameSequence
from ufmstar_torch.eval.sequences.images import first_depth_size, positive
from ufmstar_torch.eval.sequences.lens import Lens
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.eval.sequences.paths import is_hidden, natural_key
from ufmstar_torch.files.limits import require_bytes

LOOKED_FOR = "val/SCENE/*.h5 or train/SCENE/*.h5 (the root, meaning val, the part's folder or the scene's)"
PARTS = ("train", "val")
# The colour camera's calibration in the dataset's toolbox [px], for images of 640 x 480.
INTRINSICS = (518.857901, 519.469611, 325.582449, 253.736166)
NATIVE_SIZE = (480, 640)
# Errors of h5py for damaged files and missing datasets.
_BROKEN = (OSError, KeyError, RuntimeError, ValueError)


def detect(path: Path) -> bool:
    """True if the path is the root, a part or a scene."""
    return bool(part_files(path / "val")) or bool(_files(path))


def parts(path: Path) -> list[Path]:
    """The evaluation part of a root; for a part or scene the path itself."""
    return [path / "val"] if part_files(path / "val") else [path]


def part_files(folder: Path) -> list[Path]:
    """The h5 files of a part, in the order of scenes and numbers."""
    files = (path for path in folder.glob("*/*.h5") if not is_hidden(path))
    return sorted(files, key=lambda path: (path.parent.name, natural_key(path)))


def read(path: Path, options: Options) -> FrameSequence:
    """Open a part, or a scene of it, as a sequence without poses; names are ``SCENE__NUMBER``. Raises ValueError: the
    images were cropped and ``intrinsics`` is None, or no file can be read."""
    folder = parts(path)[0]
    files = _files(folder)
    scale = 1.0 if options.truth_scale is None else options.truth_scale
    entries = [
        Entry(f"{file.parent.name}__{file.stem}", np.eye(4), partial(_image, file), partial(_depth, file, scale))
        for file in files
    ]
    name = "_".join(["nyu", *folder.resolve().parts[-1 if folder.name in PARTS else -2 :]])
    size = first_depth_size(entries)
    if size is None:
        raise ValueError(f"{folder} holds no h5 file that can be read")
    return assemble("nyu", folder, entries, Lens(INTRINSICS, NATIVE_SIZE), options, name=name, size=size, posed=False)


def _files(path: Path) -> list[Path]:
    """The files of a part or of a scene; [] for other paths."""
    if path.resolve().name in PARTS:
        return part_files(path)
    if path.is_dir() and path.resolve().parent.name in PARTS:
        return sorted((file for file in path.resolve().glob("*.h5") if not is_hidden(file)), key=natural_key)
    return []


def _image(path: Path) -> np.ndarray:
    rgb = _dataset(path, "rgb")
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[0] != 3 or 0 in rgb.shape:
        raise FrameError(path, f"rgb must be uint8 [3, H, W], got {rgb.dtype} {list(rgb.shape)}")
    return np.ascontiguousarray(rgb.transpose(1, 2, 0))


def _depth(path: Path, scale: float) -> np.ndarray:
    depth = _dataset(path, "depth")
    if not np.issubdtype(depth.dtype, np.floating) or depth.ndim != 2 or 0 in depth.shape:
        raise FrameError(path, f"depth must be floating-point [H, W], got {depth.dtype} {list(depth.shape)}")
    return positive((depth * np.float64(scale)).astype(np.float32))


def _dataset(path: Path, name: str) -> np.ndarray:
    """Read a dataset of an HDF5 file, and close the file, because processes must not share an open file.

    Raises FrameError: the dataset is missing or unreadable.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            if name not in file:
                raise KeyError(f"no dataset {name!r}, only {sorted(file)}")
            require_bytes(f"dataset {name!r}", file[name].size * file[name].dtype.itemsize)
            return np.asarray(file[name])
    except _BROKEN as error:
        raise FrameError(path, f"cannot be read: {error}") from error
