"""nerfstudio and instant-ngp: ``transforms.json``, also that of ``ns-process-data`` for Polycam and Record3D.

Poses are camera-to-world with OpenGL axes; the first pixel's centre is (0.5, 0.5). Each frame may have its camera.
Files from COLMAP have no metric scale (instant-ngp also scales all others).
https://docs.nerf.studio/quickstart/data_conventions.html
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ufmstar_torch.conventions import CONVENTIONS
from ufmstar_torch.eval.sequences.assemble import assemble
from ufmstar_torch.eval.sequences.attach import UNKNOWN
from ufmstar_torch.eval.sequences.frame import Entry, FrameError, FrameSequence, Size, Skipped
from ufmstar_torch.eval.sequences.images import IMAGE_SUFFIXES, depth_loader, image_size, read_color
from ufmstar_torch.eval.sequences.lens import Lens
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.stream_warnings import LOGGER

FILE = "transforms.json"
LOOKED_FOR = f"{FILE}, also in one of its own name *.json"
# Keys of a file or frame made by structure from motion.
_NOT_METRIC = ("aabb_scale", "colmap_im_id")
_SIGMA = "sigma_file_path"  # of a frame of `ufmstar export`
_FISHEYES = ("OPENCV_FISHEYE", "FISHEYE")
_MODELS = (*_FISHEYES, "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "")


def detect(path: Path) -> bool:
    """True if the path is a file of this layout, or a folder with one."""
    return (path / FILE).is_file() or (path.is_file() and path.suffix == ".json")


def read(path: Path, options: Options) -> FrameSequence:
    """Open the frames in the file's order. Raises ValueError: no JSON of this layout (the message names the entry), an
    unknown camera model, or no usable frame."""
    file = path if path.is_file() else path / FILE
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        frames = [dict(frame) for frame in content["frames"]]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{file}: expected JSON with a list 'frames' of objects: {error}") from error
    scale = options.truth_scale or _number(content, "depth_unit_scale_factor", file, 0.001)
    entries: list[Entry | Skipped] = []
    lenses = {}
    paths = [_path(frame, file) for frame in frames]
    short = len({image.stem for image in paths}) == len(paths)
    for frame, image in zip(frames, paths, strict=True):
        name = image.stem if short else str(image.with_suffix("")).strip("/").replace("/", "__")
        whole = file.parent / image  # may lack the suffix, as in NeRF's synthetic scenes
        candidates = (whole, *(whole.with_name(whole.name + suffix) for suffix in IMAGE_SUFFIXES))
        image_file = next((path for path in candidates if path.is_file()), None)
        if image_file is None:
            entries.append(Skipped(name, "missing image file"))
            continue
        try:
            lenses[name] = _lens({**content, **frame}, image_size(image_file), file)
        except FrameError:
            entries.append(Skipped(name, "the image's header cannot be read"))
            continue
        depth = None if _SIGMA in frame else frame.get("depth_file_path")
        load_depth = depth_loader(file.parent / depth, scale, scale) if isinstance(depth, str) else None
        entries.append(Entry(name, _pose(frame, file), partial(read_color, image_file), load_depth))
    if any(_SIGMA in frame for frame in frames):
        LOGGER.warning("%s: no ground truth: its depth is a prediction, with a sigma beside it", file)
    metric = not any(key in part for part in (content, *frames) for key in _NOT_METRIC)
    name = file.parent.resolve().name if file.name == FILE else file.stem
    return assemble("transforms", path, entries, lenses, options, name=name, metric=metric)


def _path(frame: Mapping[str, Any], file: Path) -> Path:
    value = frame.get("file_path")
    if not isinstance(value, str) or not value or "\0" in value:
        raise ValueError(f"{file}: a frame's file_path must be text, got {str(value)[:60]}")
    return Path(value)


def _pose(frame: Mapping[str, Any], file: Path) -> np.ndarray:
    """[4, 4] camera-to-world with our axes, NaN if it is not finite."""
    try:
        T = np.array(frame["transform_matrix"], dtype=np.float64)
        if T.shape not in ((4, 4), (3, 4)):
            raise ValueError(f"shape {list(T.shape)}")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{file}: {frame['file_path']}: transform_matrix must be 4x4 numbers: {error}") from error
    T = np.vstack([T[:3], [0.0, 0.0, 0.0, 1.0]])
    if not np.isfinite(T).all():
        return UNKNOWN
    if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-3:
        raise ValueError(f"{file}: {frame['file_path']}: transform_matrix must be a rotation and a position, got {T}")
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
    value = values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e12:
        raise ValueError(f"{file}: {key} must be a number, got {str(value)[:60]}")
    return float(value)
