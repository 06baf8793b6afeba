"""nerfstudio and instant-ngp: ``transforms.json``, also that of ``ns-process-data`` for Polycam and Record3D.

Poses are camera-to-world with OpenGL axes; the first pixel's centre is (0.5, 0.5). Each frame may have its camera. A
folder may instead have ``transforms_train.json``, as NeRF's scenes; the files of the other parts are named.

The file does not state the unit of the poses. They count as metric only if there is depth, with which ``ufmstar data
check`` compares them; not if marks of structure from motion are in the file or folder, as from COLMAP and instant-ngp.
A translation of the world in ``applied_transform``, as of ``ufmstar export`` far from the origin, is undone.
https://docs.nerf.studio/quickstart/data_conventions.html
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ufmstar_torch.eval.sequences.assemble import assemble
from ufmstar_torch.eval.sequences.attach import UNKNOWN
from ufmstar_torch.eval.sequences.frame import Entry, FrameError, FrameSequence, Size, Skipped
from ufmstar_torch.eval.sequences.images import depth_loader, image_size, read_color
from ufmstar_torch.eval.sequences.lens import Lens
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.eval.sequences.paths import IMAGE_SUFFIXES, is_hidden, listed_file, listed_path, on_disk
from ufmstar_torch.files.limits import read_json
from ufmstar_torch.frames.warnings import LOGGER
from ufmstar_torch.gaussians.conventions import CONVENTIONS

FILE, TRAIN = "transforms.json", "transforms_train.json"
LOOKED_FOR = f"{FILE} or {TRAIN}, or the path of another file *.json"
# Keys of a file or frame made by structure from motion, and the factor by which a program has scaled the poses.
_NOT_METRIC = ("aabb_scale", "colmap_im_id", "applied_scale")
# Names in the folder of transforms.json that show that structure from motion computed the poses.
_FROM_COLMAP = ("sparse_pc.ply", "colmap")
_SIGMA = "sigma_file_path"  # of a frame of `ufmstar export`
_FISHEYES = ("OPENCV_FISHEYE", "FISHEYE")
_MODELS = (*_FISHEYES, "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "")


def detect(path: Path) -> bool:
    """True if the path is a file of this layout, or a folder with one."""
    return _file(path).is_file() and _file(path).suffix.lower() == ".json" and not is_hidden(path)


def _file(path: Path) -> Path:
    """The file of a folder; another path itself."""
    if not path.is_dir():
        return path
    return next((path / name for name in (FILE, TRAIN) if (path / name).is_file()), path / FILE)


def read(path: Path, options: Options) -> FrameSequence:
    """Open the frames in the file's order. Raises ValueError: no JSON of this layout (the message names the entry), an
    unknown camera model, or no usable frame."""
    file = _file(path)
    try:
        content = read_json(file)
        frames = [dict(frame) for frame in content["frames"]]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{file}: expected JSON with a list 'frames' of objects: {error}") from error
    others = sorted(other.name for other in file.parent.glob("transforms_*.json") if other != file)
    if path.is_dir() and file.name == TRAIN and others:
        LOGGER.warning("%s: %s is read, not %s: pass the path of another file", path, TRAIN, ", ".join(others))
    scale = options.truth_scale or _unit(content, file)
    offset = _offset(content, file)
    entries: list[Entry | Skipped] = []
    lenses = {}
    paths = [_path(frame, file) for frame in frames]
    short = len({image.stem for image in paths}) == len(paths)
    for frame, image in zip(frames, paths, strict=True):
        name = image.stem if short else str(image.with_suffix("")).strip("/").replace("/", "__")
        whole = listed_file(file.parent, image)  # may lack the suffix, as in NeRF's synthetic scenes
        candidates = (whole, *(on_disk(whole.with_name(whole.name + suffix)) for suffix in IMAGE_SUFFIXES))
        image_file = next((path for path in candidates if path.is_file()), None)
        if image_file is None:
            entries.append(Skipped(name, "missing image file", whole))
            continue
        try:
            lenses[name] = _lens({**content, **frame}, image_size(image_file), file)
        except FrameError:
            entries.append(Skipped(name, "the image's header cannot be read"))
            continue
        depth = None if _SIGMA in frame else frame.get("depth_file_path")
        load_depth = depth_loader(listed_file(file.parent, depth), scale) if isinstance(depth, str) else None
        entries.append(Entry(name, _pose(frame, offset, file), partial(read_color, image_file), load_depth))
    if any(_SIGMA in frame for frame in frames):
        LOGGER.warning("%s: no ground truth: its depth is a prediction, with a sigma beside it", file)
    marked = any(key in part for part in (content, *frames) for key in _NOT_METRIC)
    marked |= any((file.parent / name).exists() for name in _FROM_COLMAP)
    metric = not marked and any("depth_file_path" in frame for frame in frames)
    name = file.parent.resolve().name if file == _file(file.parent) else file.stem
    return assemble("transforms", path, entries, lenses, options, name=name, metric=metric)


def _path(frame: Mapping[str, Any], file: Path) -> Path:
    value = frame.get("file_path")
    if not isinstance(value, str) or not value or "\0" in value:
        raise ValueError(f"{file}: a frame's file_path must be text, got {str(value)[:60]}")
    return listed_path(value)


def _unit(content: Mapping[str, Any], file: Path) -> float:
    """Metres per unit of the depth maps. Raises ValueError: not positive."""
    unit = _number(content, "depth_unit_scale_factor", file, 0.001)
    if not 0 < unit <= 1:
        expected = "metres per unit of the depth maps, above 0 and at most 1 (0.001: millimetres)"
        raise ValueError(f"{file}: depth_unit_scale_factor must be {expected}, got {unit}; --truth-scale replaces it")
    return unit


def _offset(content: Mapping[str, Any], file: Path) -> np.ndarray:
    """[3] the translation that ``applied_transform`` added to the poses; 0 if it also changed the axes, which are then
    those of the world. Raises ValueError: no matrix."""
    try:
        T = np.array(content.get("applied_transform", np.eye(4)), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        T = np.zeros(0)
    if T.shape not in ((4, 4), (3, 4)) or not np.isfinite(T).all():
        raise ValueError(f"{file}: applied_transform must be 3x4 finite numbers")
    return T[:3, 3] if (T[:3, :3] == np.eye(3)).all() else np.zeros(3)


def _pose(frame: Mapping[str, Any], offset: np.ndarray, file: Path) -> np.ndarray:
    """[4, 4] camera-to-world with our axes, without the world's ``offset`` [3]; NaN if it is not finite."""
    try:
        T = np.array(frame["transform_matrix"], dtype=np.float64)
        if T.shape not in ((4, 4), (3, 4)):
            raise ValueError(f"shape {list(T.shape)}")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{file}: {frame['file_path']}: transform_matrix must be 4x4 numbers: {error}") from error
    T = np.vstack([T[:3], [0.0, 0.0, 0.0, 1.0]])
    if not np.isfinite(T).all():
        return UNKNOWN
    T[:3, 3] -= offset
    return CONVENTIONS["opengl"].convert(T)


def _lens(values: Mapping[str, Any], size: Size, file: Path) -> Lens:
    """The camera of an image of ``size`` (H, W), which may be smaller than the w x h of the file's parameters."""
    model = str(values.get("camera_model", "")).upper()
    if model not in _MODELS:
        raise ValueError(f"{file}: camera_model must be one of {', '.join(_MODELS[:-1])}, got {model[:60]!r}")
    height, width = (_number(values, key, file, side) for key, side in (("h", size[0]), ("w", size[1])))
    if height < 1 or width < 1 or abs(size[1] * height / (size[0] * width) - 1) > 0.02:
        raise ValueError(f"{file}: the camera has {width:g}x{height:g} pixels, an image {size[1]}x{size[0]}")
    angle = _number(values, "camera_angle_x", file, np.nan)
    fx = _number(values, "fl_x", file, 0.5 * width / np.tan(0.5 * angle))
    fy = _number(values, "fl_y", file, fx)
    if not (np.isfinite([fx, fy]).all() and min(fx, fy) > 0):
        raise ValueError(f"{file}: expected fl_x [px] or camera_angle_x, got {fx} and {fy}")
    cx, cy = _number(values, "cx", file, width / 2), _number(values, "cy", file, height / 2)
    sx, sy = size[1] / width, size[0] / height
    fisheye = model in _FISHEYES or values.get("is_fisheye") is True
    k1, k2, p1, p2, k3, k4 = (_number(values, key, file, 0.0) for key in ("k1", "k2", "p1", "p2", "k3", "k4"))
    coefficients = [k1, k2, k3, k4] if fisheye else [k1, k2, p1, p2, k3] + [k4, 0.0, 0.0] * bool(k4)
    return Lens((fx * sx, fy * sy, cx * sx - 0.5, cy * sy - 0.5), size, tuple(coefficients), fisheye)


def _number(values: Mapping[str, Any], key: str, file: Path, default: float) -> float:
    if key not in values:
        return default
    value = values[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1e12:
        raise ValueError(f"{file}: {key} must be a number, got {str(value)[:60]}")
    return float(value)
