"""Structure from motion of keyframes: SIFT on the CPU, matching, COLMAP's global mapper; models, landmarks and gaps.

```
DIR/images/NAME.jpg     keyframes; DIR/rgb.txt has their times [s], if known
DIR/sparse/0, 1, ...    COLMAP models, the largest first; only model 0 can be metric, if a scale is known
DIR/landmarks.npz       points [P, 3] and sigma [P] [m] of model 0, for --anchors
DIR/poses.json          the result, and the origin of the scale
```
The incremental mapper is not used: its error on a walk with a HoloLens was 148 cm.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from ufmstar_torch.eval.reconstruct.keyframes import is_keyframe
from ufmstar_torch.eval.run.folder import FolderKind
from ufmstar_torch.eval.sequences.attach import attach
from ufmstar_torch.eval.sequences.colmap import SCALE_FILE
from ufmstar_torch.eval.sequences.frame import Entry
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.gaussians.trajectory import Trajectory
from ufmstar_torch.runtime.optional import optional

# Largest number of keyframes for which all pairs are matched; with more, each is matched with the next ten and those
# 16, 32, ... 512 later.
_ALL_PAIRS = 60
_FEATURES, _LARGEST_IMAGE = 4096, 1600  # largest number of features of an image, and its largest side [px]
# A landmark: smallest number of images, smallest angle between their rays [rad], largest error [px], and lower limit of
# the error [px], SIFT's accuracy.
_VIEWS, _ANGLE, _MOST_ERROR, _LEAST_ERROR = 3, np.radians(1.5), 2.0, 0.5


_KEYFRAMES = "images/*.jpg"
_MADE = (_KEYFRAMES, "sparse/[0-9]*/*.bin", "sparse/unsorted/[0-9]*/*.bin", "rgb.txt", "landmarks.npz", "database.db")
POSES = FolderKind(
    "ufmstar poses",
    "reconstruction",
    SCALE_FILE,
    _MADE,
    recognise={_KEYFRAMES: is_keyframe},
    temporary=(".*.tmp", "images/.*.tmp"),
)


def require_pycolmap() -> Any:
    """The package. Raises ModuleNotFoundError: it is missing; the message names the extra to install."""
    return optional("pycolmap", "`ufmstar poses` needs pycolmap", "'ufmstar-torch[recordings]'")


def reconstruct(
    out: Path,
    names: Sequence[str],
    K: np.ndarray | None,
    *,
    threads: int,
    say: Callable[[str], object] = lambda _: None,
) -> list[Any]:
    """The models (``pycolmap.Reconstruction``) of ``out/images/NAME.jpg`` for ``names`` in the order of the video, the
    largest first. K [3, 3] of all images [px] is not refined; None = estimate one focal length and one distortion
    coefficient. ``say`` gets a line at the start of each stage. Raises ValueError: the images fit no model."""
    if len(names) < _VIEWS:
        raise ValueError(f"{len(names)} keyframes, of which {_VIEWS} are needed: too few images, or blank or alike")
    pycolmap = require_pycolmap()
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    pycolmap.set_random_seed(0)
    camera = {"camera_model": "SIMPLE_RADIAL"}
    if K is not None:  # COLMAP's first pixel has its centre at (0.5, 0.5)
        values = (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5)
        camera = {"camera_model": "PINHOLE", "camera_params": ",".join(f"{value:.17g}" for value in values)}
    database, cpu = out / "database.db", pycolmap.Device.cpu
    features, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    features.num_threads = matching.num_threads = threads
    features.sift.max_num_features, features.max_image_size = _FEATURES, _LARGEST_IMAGE
    say(f"features of {len(names)} keyframes")
    pycolmap.extract_features(
        database,
        out / "images",
        image_names=[f"{name}.jpg" for name in names],
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=pycolmap.ImageReaderOptions(**camera),
        extraction_options=features,
        device=cpu,
    )
    say("matches between keyframes")
    match = pycolmap.match_exhaustive if len(names) <= _ALL_PAIRS else pycolmap.match_sequential
    match(database, matching_options=matching, device=cpu)
    say("poses")
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = threads, 0
    adjustment = options.mapper.bundle_adjustment
    adjustment.refine_focal_length = adjustment.refine_extra_params = K is None
    (out / "sparse").mkdir(exist_ok=True)
    scratch = out / "sparse" / "unsorted"
    scratch.mkdir(exist_ok=True)
    found = pycolmap.global_mapping(database, out / "images", scratch, options).values()
    shutil.rmtree(scratch)
    database.unlink()
    models = sorted((model for model in found if model.num_reg_images()), key=lambda m: -m.num_reg_images())
    if not models:
        raise ValueError("no model: the images are blank, or the camera only turns; give another part of the video")
    return models


def scale_model(
    model: Any,
    images: Sequence[Entry],
    *,
    length: tuple[str, str, float] | None = None,
    trajectory: Trajectory | None = None,
    options: Options | None = None,
) -> dict[str, Any]:
    """Convert a model to metres, in place, and with a trajectory also to its axes.

    Args:
        model: ``pycolmap.Reconstruction``.
        images: all of the video, in order, with their times.
        length: two places in the form of ``endpoint``, and their distance [m].
        trajectory: positions of the camera in metres.
        options: of the association of the trajectory's times with the images'.

    Returns:
        ``scale_from``, None without length and trajectory; ``metres_per_unit``; with a trajectory ``residual`` [m].

    Raises:
        ValueError: the two places are equal, or see ``endpoint``, ``attach`` and ``similarity``.
    """
    pycolmap = require_pycolmap()
    if length is not None:
        first, second = (endpoint(model, word) for word in length[:2])
        distance = float(np.linalg.norm(second - first))
        if not distance > 0:
            raise ValueError(f"--length: {length[0]} and {length[1]} are the same place")
        metres = length[2] / distance
        model.transform(pycolmap.Sim3d(metres, pycolmap.Rotation3d(), np.zeros(3)))
        return {"scale_from": "length", "metres_per_unit": metres}
    if trajectory is None:
        return {"scale_from": None}
    posed = (f for f in attach(images, trajectory, options or Options()) if isinstance(f, Entry))
    position = {frame.name: frame.T_world_cam[:3, 3] for frame in posed if np.isfinite(frame.T_world_cam).all()}
    centres = {Path(i.name).stem: i.projection_center() for i in model.images.values()}
    common = sorted(position.keys() & centres.keys())
    pairs = (np.array([values[name] for name in common]).reshape(-1, 3) for values in (centres, position))
    metres, R, t, residual = similarity(*pairs)
    model.transform(pycolmap.Sim3d(metres, pycolmap.Rotation3d(R), t))
    return {"scale_from": "trajectory", "metres_per_unit": metres, "residual": residual}


def landmarks(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """Points [P, 3] of a model that are seen from several directions, and the standard deviations [P] of their depths:
    sqrt(2) e z / (f sin(angle)), with the error e of their pixels [px], their depth z and the largest angle between two
    of their rays."""
    centres = {key: image.projection_center() for key, image in model.images.items()}
    focal = {key: model.cameras[image.camera_id].mean_focal_length() for key, image in model.images.items()}
    points, sigma = [], []
    for point in model.points3D.values():
        seen = sorted({element.image_id for element in point.track.elements})
        if len(seen) < _VIEWS or not point.error <= _MOST_ERROR:
            continue
        rays = point.xyz - np.array([centres[key] for key in seen])
        distance = np.linalg.norm(rays, axis=1)
        rays = rays / distance[:, None]
        angle = float(np.arccos(np.clip(rays @ rays.T, -1, 1).min()))
        if angle < _ANGLE:
            continue
        pixel = max(point.error, _LEAST_ERROR) / np.mean([focal[key] for key in seen])
        points.append(point.xyz)
        sigma.append(np.sqrt(2) * pixel * distance.mean() / np.sin(min(angle, np.pi / 2)))
    return np.array(points).reshape(-1, 3), np.array(sigma)


def gaps(keyframes: Sequence[str], model: Any) -> list[tuple[str, str]]:
    """The first and last name of each run of keyframes without a pose in a model."""
    posed = {Path(image.name).stem for image in model.images.values()}
    runs = [list(run) for has_pose, run in groupby(keyframes, posed.__contains__) if not has_pose]
    return [(run[0], run[-1]) for run in runs]


# Largest distance of a landmark from the pixel of an endpoint, as a share of the image's width.
_NEAR = 0.02
# Positions farther from the first fit than this multiple of the median distance are excluded from the second one.
_OUTLIER = 3.0


def endpoint(model: Any, word: str) -> np.ndarray:
    """[3] a point of a model (``pycolmap.Reconstruction``): "NAME" is the camera's position at an image, "NAME:U,V" the
    landmark nearest to its pixel. Raises ValueError: no such image in the model, or no landmark near the pixel."""
    name, _, pixel = word.partition(":")
    number = int(name) if name.isdecimal() else None  # images may be named by their number
    stems = [(Path(i.name).stem, i) for i in model.images.values()]
    same = (i for stem, i in stems if stem == name or (stem.isdecimal() and int(stem) == number))
    image = next(same, None)
    if image is None:
        names = sorted(stem for stem, _ in stems)
        listed = f"{', '.join(names[:3])}, ... {names[-1]}" if len(names) > 4 else ", ".join(names)
        raise ValueError(f"--length: image {name!r} has no pose; choose one of the {len(names)} that have: {listed}")
    if not pixel:
        return np.array(image.projection_center())
    try:
        u, v = (float(number) for number in pixel.split(","))
    except ValueError:
        raise ValueError(f"--length: {word!r} must be NAME, or NAME:U,V with a pixel [px]") from None
    seen = [point for point in image.points2D if point.has_point3D()]
    # COLMAP's first pixel has its centre at (0.5, 0.5)
    distances = np.array([np.hypot(point.xy[0] - 0.5 - u, point.xy[1] - 0.5 - v) for point in seen])
    reach = _NEAR * model.cameras[image.camera_id].width
    if not len(distances) or distances.min() > reach:
        nearest = f"the nearest is {distances.min():.0f} px away" if len(distances) else "it has none"
        raise ValueError(f"--length: no landmark within {reach:.0f} px of {word}: {nearest}; choose a corner")
    return np.array(model.points3D[seen[int(distances.argmin())].point3D_id].xyz)


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Scale s, rotation R [3, 3], translation t [3] that minimise sum |s R x + t - y|^2 over pairs of points x, y [N,
    3] (Umeyama 1991), fitted again without outliers; and the root mean square distance of the inliers. Raises
    ValueError: fewer than three points, or all points are equal."""
    inliers = np.ones(len(source), bool)
    for _ in range(2):
        x, y = source[inliers], target[inliers]
        if len(x) < 3:
            raise ValueError(f"--trajectory: {len(x)} keyframes have a pose there and in the model, 3 are needed")
        dx, dy = x - x.mean(0), y - y.mean(0)
        variance = float(np.square(dx).sum())
        if variance <= 0 or not np.square(dy).sum() > 0:
            raise ValueError("--trajectory: the camera stays at one place, which shows no scale")
        U, singular, Vt = np.linalg.svd(dy.T @ dx)
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
        R = (U * sign) @ Vt
        s = float((singular * sign).sum() / variance)
        t = y.mean(0) - s * R @ x.mean(0)
        distance = np.linalg.norm(s * source @ R.T + t - target, axis=1)
        inliers = distance <= max(_OUTLIER * float(np.median(distance)), 1e-9)
    return s, R, t, float(np.sqrt(np.square(distance[inliers]).mean()))
