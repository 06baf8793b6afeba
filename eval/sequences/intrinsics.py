"""Intrinsics from files and numbers, and their scaling to another image size."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ufmstar_torch.eval.sequences.frame import Size
from ufmstar_torch.eval.sequences.paths import on_disk

# A file's path, a matrix [3, 3] (or ScanNet's [4, 4]), or the numbers fx, fy, cx, cy [px].
IntrinsicsLike = str | Path | np.ndarray | Sequence[Any]

# Names of files with the camera of the images, and of the depth maps.
FILES = (
    *("K.txt", "intrinsics.txt", "intrinsic.txt", "camera.txt", "intrinsics.K.txt"),
    *("camera-intrinsics.txt", "camera_intrinsics.txt", "calibration.txt"),  # the last: ETH3D
)
DEPTH_FILES = ("K_depth.txt", "depth_K.txt", "intrinsics_depth.txt", "depth_intrinsics.txt", "depth.intrinsics.K.txt")

# Sizes whose aspect ratios differ by more than this were cropped, not resized.
_ASPECT_TOLERANCE = 0.02
_PROJECTION = re.compile(r"P(?:_rect_0)?(\d)\s*:(.*)")


def read_intrinsics(source: IntrinsicsLike) -> np.ndarray:
    """[3, 3] float64 [px] from a text file or numbers: 3x3, 4x4, 3x4, or ``fx fy cx cy``; or from KITTI's calib.txt or
    calib_cam_to_cam.txt. Raises ValueError: the file or array has another shape, or KITTI's cameras differ."""
    from ufmstar_torch.eval.sequences.poses import read_matrix

    if isinstance(source, str | Path):
        kitti = [P[:, :3] for P in projections(Path(source)).values()]
        if any(not np.array_equal(K, kitti[0]) for K in kitti):
            raise ValueError(f"{source}: the intrinsics of its cameras differ: pass intrinsics as fx fy cx cy")
        values, source_name = kitti[0] if kitti else read_matrix(source), f"intrinsics file {source}"
    else:
        values, source_name = np.array(source, dtype=np.float64), "intrinsics"
    if values.shape in ((4,), (1, 4), (4, 1)):
        return pinhole(*values.ravel())
    if values.size == 9:
        values = values.reshape(3, 3)
    if values.shape not in ((3, 3), (3, 4), (4, 4)):
        raise ValueError(f"{source_name}: expected a 3x3 matrix or fx fy cx cy, got shape {list(values.shape)}")
    return np.ascontiguousarray(values[:3, :3])


def projections(path: Path) -> dict[int, np.ndarray]:
    """[3, 4] by number, of the projections ``P0:`` (or ``P_rect_00:``) ... of KITTI's rectified cameras; {} if the file
    has no such line. Raises ValueError: a line has no 12 numbers."""
    from ufmstar_torch.eval.sequences.poses import numbered_lines

    found = {}
    for number, text in numbered_lines(path):
        if line := _PROJECTION.fullmatch(text.strip()):
            try:
                found[int(line[1])] = np.array(line[2].split(), dtype=np.float64).reshape(3, 4)
            except ValueError:
                raise ValueError(f"{path}:{number}: expected 12 numbers after ':', got {text.strip()[:60]!r}") from None
    return found


def camera_file(folder: Path, names: Sequence[str]) -> Path | None:
    """The first file of these names in a folder."""
    return next((file for name in names if (file := on_disk(folder / name)).is_file()), None)


def parse_intrinsics(words: Sequence[str], option: str) -> str | list[float] | None:
    """Words of a command line as the argument of :func:`read_intrinsics`: a file, or fx, fy, cx, cy [px]; None for no
    words. Raises ValueError: another form, or no such file; the message names ``option``."""
    if len(words) == 1 and not Path(words[0]).is_file():
        raise ValueError(f"{option}: no such file: {words[0]}")
    if len(words) <= 1:
        return words[0] if words else None
    try:
        fx, fy, cx, cy = map(float, words)
    except ValueError:
        raise ValueError(f"{option} must be a file, or the four numbers fx fy cx cy, got {' '.join(words)!r}") from None
    return [fx, fy, cx, cy]


def pinhole(fx: float, fy: float, cx: float, cy: float, skew: float = 0.0) -> np.ndarray:
    """The matrix [3, 3] of a pinhole camera [px]."""
    return np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def pinhole_values(K: np.ndarray) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy [px] of a matrix [3, 3]."""
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def camera_matrix(
    override: IntrinsicsLike | None, native: np.ndarray, native_size: Size, size: Size | None
) -> np.ndarray:
    """K [3, 3] of images of ``size``: the ``override``, or the layout's ``native`` one of ``native_size``, scaled."""
    return scale_intrinsics(native, native_size, size) if override is None else read_intrinsics(override)


def scale_intrinsics(K: np.ndarray, old: Size | None, new: Size | None) -> np.ndarray:
    """K [3, 3] of images (H, W) ``old`` after a resize to ``new``; unchanged if a size is unknown. Raises ValueError:
    the aspect ratios differ, so the images were not only resized."""
    import torch

    from ufmstar_torch.gaussians.camera import resize_intrinsics

    if old is None or new is None or old == new:
        return K.copy()
    if abs((new[1] / new[0]) / (old[1] / old[0]) - 1) > _ASPECT_TOLERANCE:
        sizes = f"{old[1]}x{old[0]} images, these are {new[1]}x{new[0]}"
        raise ValueError(f"intrinsics are known for {sizes}, which is not only a resize: pass intrinsics")
    return resize_intrinsics(torch.from_numpy(K), old, new).numpy()
