"""TUM RGB-D: ``rgb/ depth/ rgb.txt depth.txt groundtruth.txt``, 16-bit depth in 1/5000 m.

Depth is registered to colour. Colour and depth have different timestamps and are paired one-to-one; the pose is
interpolated at the colour image's time. https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.assemble import assemble
from ufmstar_torch.eval.sequences.attach import frame_of_image
from ufmstar_torch.eval.sequences.frame import FrameSequence
from ufmstar_torch.eval.sequences.images import depth_loader, first_image_size
from ufmstar_torch.eval.sequences.lens import Lens
from ufmstar_torch.eval.sequences.options import Options, with_camera_files
from ufmstar_torch.eval.sequences.paths import listed_file, listed_path
from ufmstar_torch.eval.sequences.poses import associate, numbered_lines, read_trajectory

LOOKED_FOR = "rgb.txt and groundtruth.txt"
SCALE = 1 / 5000
_NATIVE_SIZE = (480, 640)
# The colour cameras' published calibration, by robot. Depth is registered to the distorted image (k1 k2 p1 p2 k3).
_LENSES = {
    "1": Lens((517.3, 516.5, 318.6, 255.3), _NATIVE_SIZE, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": Lens((520.9, 521.0, 325.1, 249.7), _NATIVE_SIZE, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": Lens((535.4, 539.2, 320.1, 247.6), _NATIVE_SIZE),
}


def detect(path: Path) -> bool:
    """True if the folder has this layout."""
    return (path / "rgb.txt").is_file() and (path / "groundtruth.txt").is_file()


def read(path: Path, options: Options) -> FrameSequence:
    """Open a TUM RGB-D sequence. An image without a depth map within ``max_time_difference`` stays, with ``depth``
    None. Images and depth are undistorted with the lens's published coefficients, unless ``distortion`` or
    ``intrinsics`` is set or the folder has a file of intrinsics. Raises ValueError: no usable frame; neither the folder
    nor the files name the camera (``freiburgN``) and there are no intrinsics; a malformed line."""
    options = with_camera_files(options, path)
    times, files = read_file_list(path / "rgb.txt")
    depth_files = _paired_depth(path, times, options.max_time_difference)
    loaders = [depth_loader(depth_files.get(i), options.truth_scale, SCALE) for i in range(len(files))]
    frames = [
        frame_of_image(Path(file).stem, listed_file(path, file), load_depth, timestamp=float(time))
        for file, load_depth, time in zip(files, loaders, times, strict=True)
    ]
    lens = _LENSES[_robot(path)] if options.intrinsics is None else None
    size = first_image_size(listed_file(path, file) for file in files) or _NATIVE_SIZE
    read_poses = partial(read_trajectory, path / "groundtruth.txt")
    return assemble("tum", path, frames, lens, options, size=size, read_poses=read_poses)


def read_file_list(path: Path) -> tuple[np.ndarray, list[str]]:
    """Timestamps [N] [s] and file names of lines ``timestamp filename``, with spaces or a comma between them; ``#``
    starts a comment line, and the first line may name the columns. Raises
    ValueError: a line (named by file and number) has another form."""
    times: list[float] = []
    files: list[str] = []
    for number, text in numbered_lines(path):
        words = re.split(r"[\s,;]+", text.strip(), maxsplit=1)
        if not words[0] or words[0].startswith("#") or (not times and words[0].lower().startswith("time")):
            continue
        try:
            times.append(float(words[0]))
            files.append(listed_path(words[1].strip()).as_posix())
        except (ValueError, IndexError):
            raise ValueError(f"{path}:{number}: expected 'timestamp filename', got {text!r}") from None
    return np.array(times, dtype=np.float64), files


def _paired_depth(path: Path, color_times: np.ndarray, max_difference: float) -> dict[int, Path]:
    """The existing depth files by index of the colour image."""
    if not (path / "depth.txt").is_file():
        return {}
    depth_times, depth_files = read_file_list(path / "depth.txt")
    pairs = associate(color_times, depth_times, max_difference)
    found = {i: listed_file(path, depth_files[j]) for i, j in pairs.items()}
    return {i: file for i, file in found.items() if file.is_file()}


def _robot(path: Path) -> str:
    """1, 2 or 3, from ``freiburgN`` in the folder's name or in the header of rgb.txt."""
    header = "\n".join(text for _, text in numbered_lines(path / "rgb.txt"))[:500]
    for text in (path.resolve().name, header):
        if found := re.search(r"freiburg([123])", text):
            return found[1]
    remedy = "names the camera (freiburg1, 2 or 3); pass intrinsics as fx fy cx cy"
    raise ValueError(f"intrinsics: neither the folder name {path.resolve().name!r} nor rgb.txt {remedy}")
