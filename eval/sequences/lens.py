"""Undistortion of images and depth maps by OpenCV's maps, which are computed once per camera.

Radial-tangential (Brown-Conrady, ``plumb_bob``, ``rational_polynomial``) and fisheye (Kannala-Brandt, ``equidistant``)
lenses, with OpenCV's coefficients: k1 k2 p1 p2 [k3 [k4 k5 k6]], or k1 k2 k3 k4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from ufmstar_torch.eval.sequences.frame import Entry, Loader, Size, check_intrinsics
from ufmstar_torch.eval.sequences.intrinsics import pinhole, scale_intrinsics

FISHEYE, NONE = "fisheye", "none"
# Limits of the undistorted focal lengths over the lens's. The lower one crops a fisheye of over 120 degrees, so that
# its middle keeps its resolution; beyond the upper one the coefficients are not those of a lens.
_ZOOM = (0.5, 2.0)
_BORDER_POINTS = 33  # on every side of an image
_MOST_APART = 2.0  # [px] largest reprojection error of a border point; coefficients with more fold the image


@dataclass(frozen=True)
class Lens:
    """A camera with its distortion. Raises ValueError: a wrong number of coefficients, or some are not finite."""

    # fx, fy, cx, cy [px], the first pixel's centre at (0, 0), and the skew [px], which is used without distortion only.
    intrinsics: tuple[float, ...]
    size: Size  # (H, W) of its images
    coefficients: tuple[float, ...] = ()  # of the distortion; () = none
    fisheye: bool = False  # True for a fisheye's coefficients

    def __post_init__(self) -> None:
        allowed = (0, 4) if self.fisheye else (0, 4, 5, 8)
        if len(self.coefficients) not in allowed or not np.isfinite(self.coefficients).all():
            counts = " or ".join(map(str, allowed[1:]))
            kind = "a fisheye" if self.fisheye else "a radial-tangential"
            raise ValueError(f"distortion: {kind} lens has {counts} finite coefficients, got {self.coefficients}")

    @classmethod
    def of(cls, K: np.ndarray, size: Size, coefficients: tuple[float, ...] = (), fisheye: bool = False) -> Lens:
        """The camera of a matrix [3, 3] [px] and its distortion. Raises ValueError: the matrix is malformed, or of
        another image size."""
        check_intrinsics("intrinsics", K, size)
        return cls((*K[[0, 1, 0, 1, 0], [0, 1, 2, 2, 1]].tolist(),), size, coefficients, fisheye)

    @property
    def K(self) -> np.ndarray:
        """[3, 3] of the undistorted images [px]: the lens's centre, and its focal lengths times the smallest factor for
        which every pixel of the result is in the image. Raises ValueError: no lens has these coefficients."""
        if not any(self.coefficients):
            return pinhole(*self.intrinsics)
        K = pinhole(*self.intrinsics[:4])
        K[:2, :2] *= _zoom(self)
        return K

    def resized(self, size: Size) -> Lens:
        """The camera of images that were resized to (H, W). Raises ValueError: they were not only resized."""
        K = scale_intrinsics(pinhole(*self.intrinsics), self.size, size)
        return Lens.of(K, size, self.coefficients, self.fisheye)

    def see(self, entry: Entry, depth_size: Size | None = None) -> Entry:
        """The entry of an image of this camera, undistorted. A depth map of ``depth_size`` (H, W) is undistorted by
        nearest neighbour; None = the depth is not of this camera."""
        image, depth = entry.load_image, entry.load_depth
        if any(self.coefficients):
            image = image and partial(_undistorted, image, self, self.size, False)
            depth = partial(_undistorted, depth, self, depth_size, True) if depth and depth_size else depth
        return replace(entry, load_image=image, load_depth=depth)

    def undistorted(self, image: np.ndarray) -> np.ndarray:
        """An image [H, W, C] of this camera without distortion, of intrinsics ``K``. Raises ValueError: another size,
        or no lens has these coefficients."""
        if image.shape[:2] != self.size:
            raise ValueError(f"image must have the camera's size {self.size}, got {image.shape[:2]}")
        return _undistorted(lambda: image, self, self.size, False) if any(self.coefficients) else image


def parse_distortion(words: str | Sequence[str | float]) -> tuple[tuple[float, ...], bool]:
    """Coefficients and True for a fisheye, from ``none``, numbers, or ``fisheye`` and numbers. Raises ValueError:
    another form."""
    listed = [words] if isinstance(words, str) else list(words)
    if listed == [NONE]:
        return (), False
    fisheye = listed[:1] == [FISHEYE]
    try:
        return tuple(float(word) for word in listed[fisheye:]), fisheye
    except ValueError:
        forms = "k1 k2 p1 p2 [k3 [k4 k5 k6]], fisheye k1 k2 k3 k4, or none"
        raise ValueError(f"distortion must be {forms}, got {words!r}") from None


def _undistorted(load: Loader, lens: Lens, size: Size, nearest: bool) -> np.ndarray:
    import cv2

    array = load()
    if array.shape[:2] != size:
        return array  # the sequence raises an error with the frame and both sizes
    interpolation = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    return np.asarray(cv2.remap(array, *_maps(lens, size), interpolation))


@lru_cache(maxsize=8)
def _maps(lens: Lens, size: Size) -> tuple[np.ndarray, np.ndarray]:
    """For every pixel of the undistorted image its column and row in the distorted one, [H, W] float32 each."""
    import cv2

    K, K_new = (scale_intrinsics(matrix, lens.size, size) for matrix in (pinhole(*lens.intrinsics[:4]), lens.K))
    compute = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    columns, rows = compute(K, np.array(lens.coefficients), np.eye(3), K_new, size[::-1], cv2.CV_32FC1)
    return columns, rows


@lru_cache(maxsize=8)
def _zoom(lens: Lens) -> float:
    """The undistorted focal lengths over the lens's: the smallest factor for which the sides of the result are within
    the image, at least ``_ZOOM[0]``. Raises ValueError: the distortion cannot be inverted at the image's sides."""
    import cv2

    (height, width), (fx, fy, cx, cy) = lens.size, lens.intrinsics[:4]
    along, ones = np.linspace(0, 1, _BORDER_POINTS), np.ones(_BORDER_POINTS)
    across, down = along * (width - 1), along * (height - 1)
    sides = ((0 * ones, down), (ones * (width - 1), down), (across, 0 * ones), (across, ones * (height - 1)))
    pixels = np.stack([np.concatenate(axis) for axis in zip(*sides, strict=True)], axis=-1)[:, None]
    K, coefficients, identity = pinhole(fx, fy, cx, cy), np.array(lens.coefficients), np.zeros(3)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-9)
    model: Any = cv2.fisheye if lens.fisheye else cv2
    rays = model.undistortPoints(pixels, K, coefficients, criteria=criteria)
    reprojected, _ = model.projectPoints(cv2.convertPointsToHomogeneous(rays), identity, identity, K, coefficients)
    deviation = np.abs(reprojected.reshape(-1, 2) - pixels.reshape(-1, 2)).max()
    rays = rays.reshape(4, _BORDER_POINTS, 2)
    left, right, top, bottom = -rays[0, :, 0], rays[1, :, 0], -rays[2, :, 1], rays[3, :, 1]
    reach = ((cx, fx, left), (width - 1 - cx, fx, right), (cy, fy, top), (height - 1 - cy, fy, bottom))
    inner = [(extent / focal, float(ray.min())) for extent, focal, ray in reach]
    if not (deviation < _MOST_APART and all(np.isfinite(ray) and ray > 0 for _, ray in inner)):
        raise ValueError(f"distortion: no lens has the coefficients {lens.coefficients}: they fold the image's border")
    zoom = max(extent / ray for extent, ray in inner)
    if zoom > _ZOOM[1]:
        raise ValueError(f"distortion: the coefficients {lens.coefficients} shrink the image {zoom:.3g} times")
    return max(zoom, _ZOOM[0])
