"""ROS messages as arrays: images, depth maps, cameras, poses, and the tree of frames (tf); of a bag or a node.

REP 103: an image's ``header.frame_id`` names the optical frame, x right, y down, z forward. REP 118: depth is 16UC1
[mm] or 32FC1 [m]. The encoding of a message decides whether it is depth; of a CompressedImage it stands first in
``format`` ("16UC1; png compressed"). https://ros.org/reps/rep-0103.html
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from functools import partial
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from PIL import Image

from ufmstar_torch.eval.sequences.frame import FrameError
from ufmstar_torch.eval.sequences.images import full_scale, grey_bytes, positive, read_color
from ufmstar_torch.eval.sequences.lens import Lens
from ufmstar_torch.eval.sequences.poses import trajectory_of
from ufmstar_torch.files.limits import require_pixels
from ufmstar_torch.gaussians.trajectory import Trajectory, interpolate_pose
from ufmstar_torch.runtime.optional import optional

_DEPTHS = ("16UC1", "32FC1", "64FC1")
# Encodings by OpenCV's names of types, which state no colour order; drivers mean these.
_COLOURS = {"8UC1": "mono8", "8UC3": "bgr8", "8UC4": "bgra8", "16UC3": "bgr16", "16UC4": "bgra16"}
_PLANES = ("nv12", "nv21")  # encodings with half as many further rows for the colours of 2 x 2 pixels
_ROS_IMAGES = partial(optional, "rosbags.image.image", "ROS images need rosbags-image", "'ufmstar-torch[recordings]'")
_RADIAL, _FISHEYES = ("plumb_bob", "rational_polynomial", ""), ("equidistant", "fisheye")
_COUNTS = (4, 5, 8)  # of OpenCV's coefficients
_STILL = 1e-9  # [m], [1] largest difference between samples of a static transform
_NORM_TOLERANCE = 0.02  # of a quaternion


def colour(message: Any, full: int | None, path: Path) -> np.ndarray:
    """[H, W, 3] uint8 RGB of an Image or CompressedImage.

    Args:
        message: of ``rosbags`` or ``rclpy``.
        full: the value of white in images of more than 8 bits; None = by this image (:func:`full_scale_of`).
        path: of the bag, or a topic's name, for messages.

    Raises:
        FrameError: it cannot be decoded.
    """
    if not hasattr(message, "encoding"):
        data = bytes(message.data)
        grey = _grey16(data)
        if grey is None:
            return read_color(path, data)
        return np.repeat(grey_bytes(grey, full or full_scale(grey))[..., None], 3, axis=2)
    encoding = _encoding(message)
    pixels = _pixels(message, encoding, path)
    if encoding.endswith("16"):
        pixels, encoding = grey_bytes(pixels, full or full_scale(pixels)), f"{encoding[:-2]}8"
    rosbags_image = _ROS_IMAGES()
    try:
        return np.ascontiguousarray(rosbags_image.convert_color(pixels, encoding, "rgb8"))
    except rosbags_image.ImageError as error:
        raise FrameError(path, f"an image's encoding must have colours or grey, got {encoding!r}") from error


def full_scale_of(message: Any, path: Path) -> int | None:
    """The range of an image of more than 8 bits by its largest value (``images.full_scale``); None for 8 bits. Raises
    FrameError: it cannot be decoded."""
    if not hasattr(message, "encoding"):
        grey = _grey16(bytes(message.data))
        return None if grey is None else full_scale(grey)
    encoding = _encoding(message)
    return full_scale(_pixels(message, encoding, path)) if encoding.endswith("16") else None


def is_depth(message: Any) -> bool:
    """True for an Image or CompressedImage that is a depth map."""
    if hasattr(message, "encoding"):
        return message.encoding in _DEPTHS
    form = str(message.format)
    return _form_encoding(form) in _DEPTHS or "compressedDepth" in form


def depth(message: Any, scale: float | None, path: Path) -> np.ndarray:
    """[H, W] float32 [m], 0 = invalid, of an Image, or a CompressedImage of ``compressed_image_transport`` or
    ``compressed_depth_image_transport``; ``scale`` [m per unit] replaces REP 118's. Raises FrameError: it cannot be
    decoded, or is no depth map."""
    if hasattr(message, "encoding"):
        if message.encoding not in _DEPTHS:
            raise FrameError(path, f"depth must be one of {', '.join(_DEPTHS)}, got {message.encoding!r}")
        values = _pixels(message, message.encoding, path)
    else:
        values = _compressed_depth(bytes(message.data), str(message.format), path)
    scale = scale or (1e-3 if values.dtype.kind == "u" else 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        return positive((values * np.float64(scale)).astype(np.float32))


def _form_encoding(form: str) -> str:
    """The encoding before compression in a CompressedImage's format; "" if it has only the compression's name."""
    first, separator, _ = form.partition(";")
    return first.strip() if separator else ""


def _grey16(data: bytes) -> np.ndarray | None:
    """[H, W] of a PNG of 16-bit grey; None for other files, or damaged ones."""
    try:
        with Image.open(BytesIO(data)) as image:
            require_pixels("the image", (image.height, image.width))
            values = np.array(image) if image.mode.startswith("I;16") else None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return None
    return values


def _compressed_depth(data: bytes, form: str, path: Path) -> np.ndarray:
    """A 16-bit PNG or TIFF, with ``compressedDepth`` after 12 bytes: i32 format, f32 a, f32 b; for 32FC1 its values are
    a / depth + b, 0 = invalid."""
    quantised, a, b = "compressedDepth" in form, 0.0, 0.0
    try:
        if quantised:
            _, a, b = struct.unpack_from("<iff", data)
        with Image.open(BytesIO(data[12:] if quantised else data)) as image:
            require_pixels("the map", (image.height, image.width))
            values, mode = np.array(image), image.mode
    except (struct.error, OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise FrameError(path, f"compressed depth ({form[:40]!r}) must be PNG: {error}") from error
    if not mode.startswith(("I", "F")) or (quantised and mode == "F"):
        raise FrameError(path, f"compressed depth must have one channel of 16 bits, got {mode!r}")
    if mode == "F":
        return values
    if not (quantised and form.startswith("32FC1")):
        return values.astype(np.uint16)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(values > 0, a / (values - np.float32(b)), 0).astype(np.float32)


def _encoding(message: Any) -> str:
    """The encoding with colours, as rosbags-image names it."""
    return _COLOURS.get(message.encoding, str(message.encoding))


def _pixels(message: Any, encoding: str, path: Path) -> np.ndarray:
    """[H, W] or [H, W, C] values of an Image in the machine's byte order; rows may be padded. Raises FrameError: an
    unknown encoding, or data of another size than stated."""
    rosbags_image = _ROS_IMAGES()
    try:
        _, _, kind, channels = rosbags_image.to_cvtype(encoding)
    except rosbags_image.ImageError as error:
        raise FrameError(
            path, f"an image's encoding must be one of ROS's, got {str(message.encoding)[:40]!r}"
        ) from error
    height, width, step = int(message.height), int(message.width), int(message.step)
    rows = height + height // 2 if encoding in _PLANES else height
    used, data = width * channels * np.dtype(kind).itemsize, np.frombuffer(message.data, np.uint8)
    if not (0 < used <= step and height > 0 and data.size == step * rows):
        raise FrameError(path, f"an image of {width}x{height} {message.encoding} has {data.size} bytes, {step} a row")
    if encoding in _PLANES and height % 2:
        raise FrameError(path, f"an image in {message.encoding} must have an even height, got {height}")
    if channels == 2 and width % 2:  # two pixels share their colour
        raise FrameError(path, f"an image in {message.encoding} must have an even width, got {width}")
    tight = SimpleNamespace(
        encoding=encoding,
        height=rows,
        width=width,
        is_bigendian=getattr(message, "is_bigendian", 0),
        data=data.reshape(rows, step)[:, :used].copy(),  # rosbags-image expects rows without padding
    )
    return np.asarray(rosbags_image.image_to_cvimage(tight))


def lens(info: Any, rectified: bool, where: str) -> Lens:
    """A CameraInfo's camera; for ``rectified`` images P without distortion. Raises ValueError: the camera is not
    calibrated, its model is not OpenCV's, or its images are cropped or binned."""

    def field(name: str) -> np.ndarray:  # ROS 1 has capitals
        return np.asarray(getattr(info, name, None) if hasattr(info, name) else getattr(info, name.upper()), np.float64)

    roi, model = info.roi, str(info.distortion_model)
    cropped = (roi.width, roi.height) not in ((0, 0), (info.width, info.height))
    if cropped or max(info.binning_x, info.binning_y) > 1:
        raise ValueError(f"{where}: the images are cropped or binned: pass intrinsics")
    if model not in (*_RADIAL, *_FISHEYES):
        raise ValueError(f"{where}: distortion_model {model[:40]!r} is none of {', '.join((*_RADIAL[:2], *_FISHEYES))}")
    size = (int(info.height), int(info.width))
    K = field("p").reshape(3, 4) if rectified else field("k").reshape(3, 3)
    if min(size) < 1 or not np.isfinite(K).all() or min(K[0, 0], K[1, 1]) <= 0:
        raise ValueError(f"{where}: the camera is not calibrated, its focal lengths are {K[0, 0]}, {K[1, 1]}")
    coefficients = () if rectified else tuple(float(x) for x in field("d"))
    while len(coefficients) > 4 and coefficients[-1] == 0 and len(coefficients) not in _COUNTS:
        coefficients = coefficients[:-1]  # of 12 or 14, drop zero thin-prism and tilt coefficients
    fisheye = model in _FISHEYES and any(coefficients)
    return Lens((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), size, coefficients if any(coefficients) else (), fisheye)


def frame_name(text: str) -> str:
    """A frame's id without the leading slash of ROS 1."""
    return text.lstrip("/")


Sample = tuple[float, ...]  # stamp [s], x y z [m], qx qy qz qw


def sample(stamp: float, position: Any, rotation: Any) -> Sample:
    """A pose at ``stamp`` [s] from a message's position and quaternion."""
    p, q = position, rotation
    return (stamp, p.x, p.y, p.z, q.x, q.y, q.z, q.w)


def trajectory(samples: Sequence[Sample]) -> Trajectory:
    """Poses of one frame in another in the order of time, one per time; NaN if a quaternion is not normalised."""
    values = np.array(samples, dtype=np.float64)
    values[np.abs(np.linalg.norm(values[:, 4:], axis=1) - 1) >= _NORM_TOLERANCE, 1:] = np.nan
    return trajectory_of(values[:, 0], values[:, 1:4], values[:, 4:], "tf")


class FrameTree:
    """The frames of tf: each has one parent."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}
        self._samples: dict[str, list[Sample]] = {}
        self._edges: dict[str, Trajectory] = {}

    def add(self, stamp: float, transform: Any) -> None:
        """Add a TransformStamped at ``stamp`` [s]. Raises ValueError: the frame has another parent."""
        parent, child = frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)
        if self._parents.setdefault(child, parent) != parent:
            raise ValueError(f"tf: frame {child!r} has the parents {self._parents[child]!r} and {parent!r}")
        motion = transform.transform
        self._samples.setdefault(child, []).append(sample(stamp, motion.translation, motion.rotation))

    def chain(self, frame: str) -> list[str]:
        """The frame, its parent, ... up to the root. Raises ValueError: a loop."""
        listed = [frame]
        while listed[-1] in self._parents:
            listed.append(self._parents[listed[-1]])
            if listed[-1] in listed[:-1]:
                raise ValueError(f"tf: the frames {', '.join(listed)} are a loop")
        return listed

    def moves(self, frames: Iterable[str]) -> bool:
        """True if any of these frames moves in its parent."""
        return any(len(self._edge(frame)) > 1 for frame in frames)

    def between(self, frame: str, other: str, time: float, max_gap: float) -> np.ndarray | None:
        """[4, 4] the pose of ``frame`` in a connected frame ``other`` at ``time`` [s]; None if a sample is missing
        (``interpolate_pose``)."""
        above = self.chain(other)
        common = next(name for name in self.chain(frame) if name in above)
        poses = []
        for start in (frame, other):
            T, listed = np.eye(4), self.chain(start)
            for edge in map(self._edge, listed[: listed.index(common)]):
                step = edge.T_world_cam[0] if len(edge) == 1 else interpolate_pose(edge, time, max_gap)
                if step is None:
                    return None
                T = step @ T
            poses.append(T)
        return np.asarray(np.linalg.inv(poses[1]) @ poses[0])

    def _edge(self, child: str) -> Trajectory:
        """A frame's poses in its parent; a single pose if it does not move."""
        if child not in self._edges:
            edge = trajectory(self._samples[child]) if child in self._samples else Trajectory(None, np.eye(4)[None])
            if not (np.abs(edge.T_world_cam - edge.T_world_cam[0]) > _STILL).any():
                edge = Trajectory(None, edge.T_world_cam[:1])
            self._edges[child] = edge
        return self._edges[child]
