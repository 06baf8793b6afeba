"""Cameras whose lens distorts: images and depth maps without the distortion, by OpenCV's maps, computed once a camera.

Radial-tangential (Brown-Conrady, ``plumb_bob``, ``rational_polynomial``) and fisheye (Kannala-Brandt, ``equidistant``)
lenses, with OpenCV's coefficients: k1 k2 p1 p2 [k3 [k4 k5 k6]], or k1 k2 k3 k4.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.attach import attach_given
from ufmstar_torch.eval.sequences.frame import Entry, FrameSequence, Loader, Size, Skipped, make_sequence
from ufmstar_torch.eval.sequences.images import depth_size
from ufmstar_torch.eval.sequences.intrinsics import (
    depth_camera_matrix,
    pinhole,
    pinhole_values,
    read_intrinsics,
    scale_intrinsics,
)
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.trajectory import Trajectory

FISHEYE, NONE = "fisheye", "none"
# The undistorted camera's focal lengths over the lens's: a fisheye of over 120 degrees is cut, so that its middle keeps
# its resolution; beyond the upper end the coefficients are not those of a lens.
_ZOOM = (0.5, 2.0)
_BORDER_POINTS = 33  # on every side of an image
_MOST_APART = 2.0  # [px] of a border point and the image of its ray; more where coefficients fold the image


@dataclass(frozen=True)
class Lens:
    """A camera with the images that its lens made. Raises ValueError: a wrong number of coefficients, or some that are
    not finite."""

    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy [px]; the centre of the first pixel is (0, 0)
    size: Size  # (H, W) of its images
    coefficients: tuple[float, ...] = ()  # of the distortion; () = none
    fisheye: bool = False  # whether they are a fisheye's

    def __post_init__(self) -> None:
        allowed = (0, 4) if self.fisheye else (0, 4, 5, 8)
        if len(self.coefficients) not in allowed or not np.isfinite(self.coefficients).all():
            counts = " or ".join(map(str, allowed[1:]))
            kind = "a fisheye" if self.fisheye else "a radial-tangential"
            raise ValueError(f"distortion: {kind} lens has {counts} finite coefficients, got {self.coefficients}")

    @property
    def K(self) -> np.ndarray:
        """[3, 3] of the undistorted images [px]: the lens's centre, and its focal lengths times the least factor with
        which every pixel of the result lies in the image. Raises ValueError: no lens has these coefficients."""
        K = pinhole(*self.intrinsics)
        K[:2, :2] *= _zoom(self) if any(self.coefficients) else 1.0
        return K

    def see(self, entry: Entry, depth_size: Size | None = None) -> Entry:
        """The entry of an image of this camera, undistorted, with its intrinsics. A depth map of ``depth_size`` (H, W)
        shows the same view, and each pixel of the result is one of its pixels, never a mean."""
        image, depth = entry.load_image, entry.load_depth
        if any(self.coefficients):
            image = image and partial(_undistorted, image, self, self.size, False)
            depth = depth and partial(_undistorted, depth, self, depth_size or self.size, True)
        return replace(
            entry,
            load_image=image,
            load_depth=depth,
            intrinsics=self.K,
            depth_intrinsics=depth_camera_matrix(None, self.K, self.size, depth_size),
            image_size=self.size,
        )


def parse_distortion(words: str | Sequence[str | float]) -> tuple[tuple[float, ...], bool]:
    """Coefficients and whether they are a fisheye's, of ``none``, of numbers, or of ``fisheye`` and numbers. Raises
    ValueError: another form."""
    listed = [words] if isinstance(words, str) else list(words)
    if listed == [NONE]:
        return (), False
    fisheye = listed[:1] == [FISHEYE]
    try:
        return tuple(float(word) for word in listed[fisheye:]), fisheye
    except ValueError:
        raise ValueError(
            f"distortion must be k1 k2 p1 p2 [k3 [k4 k5 k6]], fisheye k1 k2 k3 k4, or none, got {words!r}"
        ) from None


def undistort(
    sequence: FrameSequence, coefficients: tuple[float, ...], fisheye: bool, *, depth_too: bool
) -> FrameSequence:
    """The sequence with undistorted images, and depth maps where those are distorted alike (``depth_too``). Raises
    ValueError: the images' size is not known, or no lens has these coefficients."""
    if sequence.image_size is None:
        raise ValueError(f"distortion: sequence {sequence.name!r} has no image whose size is known")
    entries = []
    for entry in sequence.entries:
        K, size = sequence.intrinsics_of(entry), entry.image_size or sequence.image_size
        lens = Lens(pinhole_values(K), size, coefficients, fisheye)
        seen = lens.see(entry, sequence.depth_size)
        entries.append(seen if depth_too else replace(seen, load_depth=entry.load_depth, depth_intrinsics=None))
    K_depth = entries[0].depth_intrinsics if depth_too else sequence.depth_intrinsics
    assert entries[0].intrinsics is not None
    return replace(sequence, entries=tuple(entries), intrinsics=entries[0].intrinsics, depth_intrinsics=K_depth)


def sequence_of_lenses(
    name: str,
    layout: str,
    frames: Sequence[Entry | Skipped],
    lenses: Lens | Mapping[str, Lens],
    root: Path,
    options: Options,
    *,
    own: Callable[[], Trajectory] | None = None,
    metric: bool = True,
) -> FrameSequence:
    """A sequence of cameras that a recording calibrates, its images undistorted; ``frames`` are all on disk, in order.
    The ``lenses`` are one, or by frame name; ``options.intrinsics`` replaces them by a pinhole camera. ``own`` is the
    recording's trajectory, see ``attach_given``; ``metric``: whether its poses are in metres."""
    if isinstance(lenses, Lens):
        lenses = dict.fromkeys((frame.name for frame in frames), lenses)
    if options.intrinsics is not None:
        values = pinhole_values(read_intrinsics(options.intrinsics))
        lenses = {key: Lens(values, lens.size) for key, lens in lenses.items()}
    attached = attach_given(frames, root, options, own)
    size = depth_size(attached)
    seen = [lenses[frame.name].see(frame, size) if isinstance(frame, Entry) else frame for frame in attached]
    first = next((frame for frame in seen if isinstance(frame, Entry)), Entry(name, np.eye(4), None))
    return make_sequence(
        name,
        layout,
        seen,
        pinhole(1, 1, 0, 0) if first.intrinsics is None else first.intrinsics,
        image_size=first.image_size,
        depth_intrinsics=first.depth_intrinsics,
        depth_size=size,
        metric=metric or options.trajectory is not None,
    )


def _undistorted(load: Loader, lens: Lens, size: Size, nearest: bool) -> np.ndarray:
    import cv2

    array = load()
    if array.shape[:2] != size:
        return array  # the sequence names the frame and both sizes
    how = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    return np.asarray(cv2.remap(array, *_maps(lens, size), how))


@lru_cache(maxsize=8)
def _maps(lens: Lens, size: Size) -> tuple[np.ndarray, np.ndarray]:
    """For every pixel of the undistorted image its column and row in the lens's, [H, W] float32 each."""
    import cv2

    K, K_new = (scale_intrinsics(matrix, lens.size, size) for matrix in (pinhole(*lens.intrinsics), lens.K))
    compute = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    columns, rows = compute(K, np.array(lens.coefficients), np.eye(3), K_new, size[::-1], cv2.CV_32FC1)
    return columns, rows


@lru_cache(maxsize=8)
def _zoom(lens: Lens) -> float:
    """The undistorted focal lengths over the lens's: the least with which the sides of the result lie within the image,
    but within ``_ZOOM``. Raises ValueError: the distortion cannot be inverted at the image's sides."""
    import cv2

    (height, width), (fx, fy, cx, cy) = lens.size, lens.intrinsics
    along, one = np.linspace(0, 1, _BORDER_POINTS), np.ones(_BORDER_POINTS)
    across, down = along * (width - 1), along * (height - 1)
    sides = ((0 * one, down), (one * (width - 1), down), (across, 0 * one), (across, one * (height - 1)))
    pixels = np.stack([np.concatenate(axis) for axis in zip(*sides, strict=True)], axis=-1)[:, None]
    K, coefficients, still = pinhole(*lens.intrinsics), np.array(lens.coefficients), np.zeros(3)
    until = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-9)
    if lens.fisheye:
        rays = cv2.fisheye.undistortPoints(pixels, K, coefficients, criteria=until)
        again, _ = cv2.fisheye.projectPoints(cv2.convertPointsToHomogeneous(rays), still, still, K, coefficients)
    else:
        rays = cv2.undistortPoints(pixels, K, coefficients, criteria=until)
        again, _ = cv2.projectPoints(cv2.convertPointsToHomogeneous(rays), still, still, K, coefficients)
    apart = np.abs(again.reshape(-1, 2) - pixels.reshape(-1, 2)).max()
    rays = rays.reshape(4, _BORDER_POINTS, 2)
    left, right, top, bottom = -rays[0, :, 0], rays[1, :, 0], -rays[2, :, 1], rays[3, :, 1]
    reach = ((cx, fx, left), (width - 1 - cx, fx, right), (cy, fy, top), (height - 1 - cy, fy, bottom))
    inner = [(extent / focal, float(ray.min())) for extent, focal, ray in reach]
    if not (apart < _MOST_APART and all(np.isfinite(ray) and ray > 0 for _, ray in inner)):
        raise ValueError(f"distortion: no lens has the coefficients {lens.coefficients}: they fold the image's border")
    zoom = max(extent / ray for extent, ray in inner)
    if zoom > _ZOOM[1]:
        raise ValueError(f"distortion: the coefficients {lens.coefficients} shrink the image {zoom:.3g} times")
    return max(zoom, _ZOOM[0])
