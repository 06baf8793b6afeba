"""The scale of a reconstruction: a known length, or a trajectory in metres."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

# A known point is the nearest landmark in its image, at most this share of the image's width away.
_NEAR = 0.02
# Positions that lie farther from the fit than so many times the median are left out of a second one.
_OUTLIER = 3.0


def endpoint(model: Any, word: str) -> np.ndarray:
    """[3] a point of a model (``pycolmap.Reconstruction``): the camera's place in an image, "NAME", or the landmark
    next to a pixel of it, "NAME:U,V". Raises ValueError: no such image in the model, or no landmark near the pixel."""
    name, _, pixel = word.partition(":")
    image = next((i for i in model.images.values() if _is(i.name, name)), None)
    if image is None:
        names = sorted(Path(i.name).stem for i in model.images.values())
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
    apart = np.array([np.hypot(point.xy[0] - 0.5 - u, point.xy[1] - 0.5 - v) for point in seen])
    reach = _NEAR * model.cameras[image.camera_id].width
    if not len(apart) or apart.min() > reach:
        nearest = f"the nearest is {apart.min():.0f} px away" if len(apart) else "it has none"
        raise ValueError(f"--length: no landmark within {reach:.0f} px of {word}: {nearest}; choose a corner")
    return np.array(model.points3D[seen[int(apart.argmin())].point3D_id].xyz)


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Scale s, rotation R [3, 3], translation t [3] that minimise sum |s R x + t - y|^2 over pairs of points x, y
    [N, 3] (Umeyama 1991), fitted again without those far off; and the root mean square of the rest's distances.

    Raises:
        ValueError: fewer than three points, or all at one place.
    """
    kept = np.ones(len(source), bool)
    for _ in range(2):
        x, y = source[kept], target[kept]
        if len(x) < 3:
            raise ValueError(
                f"--trajectory: {len(x)} keyframes have a pose in it and in the model, at least 3 are needed"
            )
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
        kept = distance <= max(_OUTLIER * float(np.median(distance)), 1e-9)
    return s, R, t, float(np.sqrt(np.square(distance[kept]).mean()))


def _is(file: str, name: str) -> bool:
    """Return whether an image's file has this name, or both are the same number."""
    stem = file.rpartition(".")[0]
    return stem == name or (stem.isdecimal() and name.isdecimal() and int(stem) == int(name))
