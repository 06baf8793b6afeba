"""COLMAP: ``sparse/0/{cameras,images,points3D}.{bin,txt}`` next to ``images/``, of any number of cameras.

If images were divided into several models, ``sparse/0``, ``sparse/1``, ..., the one with most images is read, and the
others are named; each has its own world and unit. Poses are world-to-camera in an arbitrary unit; they are in metres
only if ``poses.json`` of ``ufmstar poses`` has a scale, or with ``pose_scale``. COLMAP's first pixel has its centre at
(0.5, 0.5). Depth maps may be in ``depth/``. This module reads the files, because pycolmap accepts truncated cameras and
does not return from truncated images. https://colmap.github.io/format.html
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ufmstar_torch.eval.sequences.assemble import assemble
from ufmstar_torch.eval.sequences.attach import frame_of_image, pair_depth
from ufmstar_torch.eval.sequences.frame import FrameSequence
from ufmstar_torch.eval.sequences.generic import depth_folder, listed_times
from ufmstar_torch.eval.sequences.images import depth_loader
from ufmstar_torch.eval.sequences.lens import Lens
from ufmstar_torch.eval.sequences.options import Options, resolve
from ufmstar_torch.eval.sequences.paths import listed_file, listed_path, natural_key
from ufmstar_torch.eval.sequences.poses import numbered_lines, poses_from_columns
from ufmstar_torch.files.limits import read_json
from ufmstar_torch.frames.warnings import LOGGER

LOOKED_FOR = "cameras and images (.bin or .txt) in sparse/0/ (or another number), sparse/ or the folder itself"
SCALE_FILE, MODELS = "poses.json", "sparse"
# By COLMAP's number: name, number of focal lengths, and number of distortion coefficients (None = no model of OpenCV);
# the other parameters are the principal point.
_MODELS: tuple[tuple[str, int, int | None], ...] = (
    *(("SIMPLE_PINHOLE", 1, 0), ("PINHOLE", 2, 0), ("SIMPLE_RADIAL", 1, 1), ("RADIAL", 1, 2), ("OPENCV", 2, 4)),
    *(("OPENCV_FISHEYE", 2, 4), ("FULL_OPENCV", 2, 8), ("FOV", 2, None), ("SIMPLE_RADIAL_FISHEYE", 1, 1)),
    *(("RADIAL_FISHEYE", 1, 2), ("THIN_PRISM_FISHEYE", 2, None)),
)
_NO_POINT = 2**64 - 1


class _View(NamedTuple):
    """An image of a model: its name, camera, pose as qw qx qy qz tx ty tz (world-to-camera), and its points' ids."""

    name: str
    camera: int
    pose: tuple[float, ...]
    points: np.ndarray


def detect(path: Path) -> bool:
    """True if the folder contains a model."""
    return bool(_model_folders(path))


def read(path: Path, options: Options) -> FrameSequence:
    """Open a model's images in the order of their names. ``images`` and ``truth`` name other folders than ``images/``
    and ``depth/``; times come from ``rgb.txt`` next to the images; ``model_index`` chooses among several models. Raises
    ValueError: a file is truncated or malformed (named), a camera model that is not OpenCV's, no model of that index,
    or no usable frame."""
    model = _chosen_model(path, options.model_index)
    root = next((f for f in (path, *model.parents[:2]) if (f / "images").is_dir()), path)
    folder = resolve(path, options.images) if options.images is not None else root / "images"
    cameras = _cameras(_file(model, "cameras"))
    views = sorted(_views(_file(model, "images")), key=lambda view: natural_key(Path(_frame_name(view))))
    if not views:
        raise ValueError(f"{_file(model, 'images')} holds no image")
    names = [_frame_name(view) for view in views]
    depths = depth_folder(path, root, options)
    depth_of = {} if depths is None else pair_depth(names, depths)
    times = listed_times(folder, [Path(view.name) for view in views])
    frames, lenses = [], {}
    for number, (view, name) in enumerate(zip(views, names, strict=True)):
        if view.camera not in cameras:
            raise ValueError(f"{_file(model, 'images')}: image {view.name!r} has the camera {view.camera}, not listed")
        lenses[name] = cameras[view.camera]
        load_depth = depth_loader(depth_of.get(name), options.truth_scale)
        time = None if times is None else float(times[number])
        frames.append(frame_of_image(name, listed_file(folder, view.name), load_depth, _pose(view, model), time))
    metric = _metric(root) and model == root / MODELS / "0"
    return assemble("colmap", path, frames, lenses, options, metric=metric)


def read_landmarks(path: Path, model_index: int | None = None) -> dict[str, np.ndarray]:
    """By frame name, the triangulated points [N, 3] that the frame sees, in the axes and unit of the poses of the model
    that :func:`read` reads. Raises ValueError: the folder has no such model, or a file is truncated or malformed."""
    model = _chosen_model(path, model_index)
    points = _points(_file(model, "points3D"))
    return {
        _frame_name(view): np.array([points[key] for key in view.points.tolist() if key in points]).reshape(-1, 3)
        for view in _views(_file(model, "images"))
    }


def _model_folders(path: Path) -> list[Path]:
    """The folders with a model: the numbered ones in ``sparse/`` in the order of their numbers, or else ``sparse/``, or
    else the path itself, or else ETH3D's folder."""
    below, eth3d = path / MODELS, path / "dslr_calibration_undistorted"
    numbered = sorted((f for f in below.glob("*") if f.name.isdecimal()), key=natural_key) if below.is_dir() else []
    return next(
        (
            found
            for found in (list(filter(_is_model, group)) for group in (numbered, [below], [path], [eth3d]))
            if found
        ),
        [],
    )


def _is_model(folder: Path) -> bool:
    files = ([folder / f"{part}{end}" for end in (".bin", ".txt")] for part in ("cameras", "images"))
    return all(any(file.is_file() for file in pair) for pair in files)


def _chosen_model(path: Path, index: int | None) -> Path:
    """The folder of the model ``index``, or of the model with most images (the first of equal ones), which is logged if
    there are several. Raises ValueError: there is no model, or none with that index."""
    models = _model_folders(path)
    if index is not None:
        chosen = next((model for model in models if model.name == str(index)), None)
        if chosen is None:
            listed = ", ".join(model.name for model in models if model.name.isdecimal()) or "one model without a number"
            raise ValueError(f"model_index must be one of the models of {path} ({listed}), got {index}")
        return chosen
    if not models:
        raise ValueError(f"{path} holds no COLMAP model: looked for {LOOKED_FOR}")
    if len(models) == 1:
        return models[0]
    counts = {model: _image_count(_file(model, "images")) for model in models}
    largest = max(models, key=lambda model: counts[model])
    others = ", ".join(f"{model.name} with {counts[model]}" for model in models if model != largest)
    LOGGER.warning(
        "%s: the model %s with %d images is read, not %s; --reader model_index chooses another one",
        path, largest.name, counts[largest], others,
    )  # fmt: skip
    return largest


def _image_count(file: Path) -> int:
    """Number of images that a model's file states."""
    if file.suffix == ".bin":
        with file.open("rb") as opened:
            return int.from_bytes(opened.read(8), "little")
    return (sum(1 for _ in _lines(file)) + 1) // 2  # two lines an image; the last one's line of points may be missing


def _file(model: Path, part: str) -> Path:
    return next((f for f in (model / f"{part}.bin", model / f"{part}.txt") if f.is_file()), model / f"{part}.bin")


def _frame_name(view: _View) -> str:
    """The image's name without suffix; "/" becomes "__"."""
    return str(Path(view.name).with_suffix("")).strip("/").replace("/", "__")


def _metric(root: Path) -> bool:
    with suppress(OSError, ValueError, KeyError, TypeError):
        return read_json(root / SCALE_FILE)["scale_from"] is not None
    return False


def _pose(view: _View, model: Path) -> np.ndarray:
    """[4, 4] camera-to-world, NaN if it is not finite."""
    qw, *quaternion = view.pose[:4]
    values = np.array([[*view.pose[4:], *quaternion, qw]])
    return np.asarray(np.linalg.inv(poses_from_columns(values, [f"{model}: image {view.name!r}"])[0]))


def _lens(file: Path, model: str, size: tuple[int, int], values: tuple[float, ...]) -> Lens:
    """A camera of (W, H) ``size``. Raises ValueError: a model that OpenCV does not have, or wrong parameters."""
    focal, count = next(((f, c) for name, f, c in _MODELS if name == model), (0, None))
    if count is None:
        supported = ", ".join(name for name, _, c in _MODELS if c is not None)
        raise ValueError(f"{file}: camera model {model[:60]!r} is none of {supported}: let COLMAP undistort the images")
    if len(values) != focal + 2 + count or not np.isfinite(values).all() or min(size) < 1:
        raise ValueError(f"{file}: a camera {model} has {focal + 2 + count} finite parameters and a size, got {values}")
    (fx, fy), (cx, cy) = (values[0], values[focal - 1]), values[focal : focal + 2]
    coefficients = values[focal + 2 :]
    if 0 < count < 4:
        coefficients = (*coefficients, *[0.0] * (4 - count))
    return Lens((fx, fy, cx - 0.5, cy - 0.5), (size[1], size[0]), coefficients, "FISHEYE" in model)


def _values_of(file: Path) -> Callable[[str], tuple[Any, ...]]:
    """A function that reads the next values of a binary file by a format of ``struct``. It raises ValueError: the file
    ends before them."""
    stored = BytesIO(file.read_bytes())

    def take(form: str) -> tuple[Any, ...]:
        try:
            return struct.unpack(f"<{form}", stored.read(struct.calcsize(f"<{form}")))
        except struct.error:
            raise ValueError(f"{file} is truncated or damaged at byte {stored.tell():,}") from None

    return take


def _cameras(file: Path) -> dict[int, Lens]:
    if file.suffix == ".txt":
        cameras = {}
        for number, words in _lines(file):
            if words:
                key, width, height, *values = _numbers([words[0], *words[2:]], file, number, whole=3)
                cameras[int(key)] = _lens(file, words[1], (int(width), int(height)), tuple(values))
        return cameras
    take, cameras = _values_of(file), {}
    for _ in range(take("Q")[0]):
        key, model, width, height = take("IiQQ")
        if not 0 <= model < len(_MODELS):
            raise ValueError(f"{file}: unknown camera model {model}")
        name, focal, count = _MODELS[model]
        cameras[key] = _lens(file, name, (width, height), take(f"{focal + 2 + (count or 0)}d"))
    return cameras


def _views(file: Path) -> Iterator[_View]:
    if file.suffix == ".txt":
        yield from _views_of_text(file)
        return
    take = _values_of(file)
    for _ in range(take("Q")[0]):
        _, *pose, camera = take("I7dI")
        name = listed_path(b"".join(iter(lambda: take("c")[0], b"\0")).decode()).as_posix()
        stored = take(f"{24 * take('Q')[0]}s")[0]
        points = np.frombuffer(stored, "<u8")[2::3]  # x, y and the point's id
        yield _View(name, camera, tuple(pose), points[points != _NO_POINT].astype(np.int64))


def _views_of_text(file: Path) -> Iterator[_View]:
    lines = list(_lines(file))
    lines += [(0, [])] * (len(lines) % 2)  # an empty line of points for the last image
    for (number, words), (below, points) in zip(lines[::2], lines[1::2], strict=True):
        if not words and not points:
            continue
        if len(words) < 10:
            text = " ".join(words)[:60]
            raise ValueError(f"{file}:{number}: expected 'ID QW QX QY QZ TX TY TZ CAMERA NAME', got {text!r}")
        camera, *pose = _numbers([words[8], *words[1:8]], file, number, whole=1)
        if len(points) % 3:
            raise ValueError(f"{file}:{below}: expected 'X Y POINT' for every point, got {len(points)} numbers")
        keys = np.array(_numbers(points[2::3], file, below, whole=len(points) // 3))
        name = listed_path(" ".join(words[9:])).as_posix()
        yield _View(name, int(camera), tuple(pose), keys[keys >= 0].astype(np.int64))


def _points(file: Path) -> dict[int, np.ndarray]:
    if not file.is_file():
        raise ValueError(f"{file}: no such file, the model has no points")
    points = {}
    if file.suffix == ".txt":
        for number, words in _lines(file):
            if words:
                key, *position = _numbers(words[:4], file, number, whole=1)
                points[int(key)] = np.array([*position, np.nan, np.nan, np.nan])[:3]
        return points
    take = _values_of(file)
    for _ in range(take("Q")[0]):
        key, x, y, z, *_, length = take("Q3d3BdQ")
        take(f"{8 * length}s")
        points[key] = np.array([x, y, z])
    return points


def _lines(file: Path) -> Iterator[tuple[int, list[str]]]:
    """Numbers (from 1) and words of the lines without comments, empty lines included."""
    return ((number, text.split()) for number, text in numbered_lines(file) if not text.startswith("#"))


def _numbers(words: list[str], file: Path, line: int, whole: int) -> list[float]:
    """Words as numbers. Raises ValueError: a word is no number, or the first ``whole`` ones are missing or >= 2^53."""
    try:
        values = [float(word) for word in words]
        if len(values) < whole or not all(abs(value) < 2**53 for value in values[:whole]):
            raise ValueError
    except ValueError:
        text = " ".join(words)[:60]
        raise ValueError(f"{file}:{line}: expected numbers, {whole} of them whole, got {text!r}") from None
    return values
