"""Posed frames and the sequence of them that every dataset reader returns.

Poses are camera-to-world (``T_world_cam``), camera axes x right, y down, z forward [m]; intrinsics are
in pixels with the centre of the first pixel at (0, 0).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from ufmstar_torch.files.limits import require_pixels

Loader = Callable[[], np.ndarray]
Size = tuple[int, int]


def parse_size(text: str | None, option: str = "--size") -> Size | None:
    """HxW as (H, W), None for None. Raises ValueError: another form, or more pixels than an image can have."""
    if text is None:
        return None
    height, _, width = text.lower().partition("x")
    if not (height.isdecimal() and width.isdecimal() and int(height) and int(width)):
        raise ValueError(f"{option} must be HxW in pixels, 240x320 say, got {text!r}")
    require_pixels(option, (int(height), int(width)))
    return int(height), int(width)


class FrameError(Exception):
    """A file (or frame) ``path`` is missing, truncated, corrupt, or not of the sequence's size: ``reason``. Callers may
    count such frames and continue (as :meth:`FrameSequence.readable`)."""

    def __init__(self, path: str | Path, reason: str) -> None:
        super().__init__(str(path), reason)  # both in args, so that a worker can pickle it
        self.path = Path(path)
        self.reason = reason

    def __str__(self) -> str:
        return f"{self.path}: {self.reason}"


@dataclass(frozen=True, eq=False)
class Frame:
    """One posed frame."""

    index: int  # position in the sequence, 0-based
    name: str  # on disk, without suffix; unique in its sequence
    image: np.ndarray | None  # [H, W, 3] uint8 RGB
    depth: np.ndarray | None  # [Hd, Wd] float32 along z [m], 0 = invalid
    T_world_cam: np.ndarray  # [4, 4] float64 camera-to-world [m]
    intrinsics: np.ndarray  # [3, 3] float64 of the image [px]
    depth_intrinsics: np.ndarray | None = None  # [3, 3] of the depth map [px]; None = those of the image
    timestamp: float | None = None  # [s]
    moving: np.ndarray | None = None  # [Hd, Wd] bool, True where the depth map shows a thing that moves; None = unknown


@dataclass(frozen=True)
class Skipped:
    """A frame on disk that the sequence excludes, and the reason, known at opening."""

    name: str
    reason: str
    path: Path | None = None  # of the file that is missing or unusable, if that is the reason


@dataclass(frozen=True, eq=False)
class Entry:
    """A frame before decoding: ``load_image``, ``load_depth`` and ``load_moving`` return the arrays of :class:`Frame`.
    A frame whose pose is not finite is skipped and counted."""

    name: str
    T_world_cam: np.ndarray
    load_image: Loader | None
    load_depth: Loader | None = None
    timestamp: float | None = None
    # The frame's camera if a sequence has several cameras or zooms; None = the sequence's.
    intrinsics: np.ndarray | None = None
    depth_intrinsics: np.ndarray | None = None
    image_size: Size | None = None
    load_moving: Loader | None = None


@dataclass(frozen=True, eq=False)
class FrameSequence:
    """Posed frames, decoded lazily. Build one with :func:`make_sequence`."""

    name: str
    layout: str  # name of its reader
    entries: tuple[Entry, ...]  # the frames with a usable pose, in order
    intrinsics: np.ndarray  # [3, 3] of the images [px]
    image_size: Size | None = None  # (H, W) of the images; an image of another size raises FrameError
    depth_intrinsics: np.ndarray | None = None  # [3, 3] of the depth maps [px], if they differ from ``intrinsics``
    depth_size: Size | None = None  # (H, W) of the depth maps, None = no depth maps
    skipped: tuple[Skipped, ...] = ()  # the excluded frames
    names_on_disk: tuple[str, ...] = ()  # every frame's name in order, skipped ones included
    # True if poses are known. Otherwise all are the identity: single images, on which networks can be evaluated, but no
    # method that compares views.
    posed: bool = True
    folder: Path | None = None  # of the recording; None for other sources
    metric: bool = True  # False if the unit of the poses is unknown, as with structure from motion
    pose_scale: float = 1.0  # factor of the recording's positions [m per unit]

    @property
    def names(self) -> tuple[str, ...]:
        """The frames' names, in order."""
        return tuple(entry.name for entry in self.entries)

    @property
    def without_depth(self) -> tuple[str, ...]:
        """Names of the frames with a pose but without a depth map."""
        return tuple(entry.name for entry in self.entries if entry.load_depth is None)

    def changed(self, change: Callable[[Entry], Entry]) -> FrameSequence:
        """The sequence with changed entries."""
        return replace(self, entries=tuple(map(change, self.entries)))

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, index: int) -> Frame:
        """Decode one frame (negative indices count from the end). Raises FrameError: a file is missing, cannot be
        decoded, or does not have the sequence's size."""
        entry = self.entries[index]
        K_depth = self.depth_intrinsics if entry.depth_intrinsics is None else entry.depth_intrinsics
        return Frame(
            index=index % len(self.entries),
            name=entry.name,
            image=_load(entry.name, "image", entry.load_image, entry.image_size or self.image_size),
            depth=_load(entry.name, "depth map", entry.load_depth, self.depth_size),
            T_world_cam=entry.T_world_cam.copy(),
            intrinsics=self.intrinsics_of(entry).copy(),
            depth_intrinsics=None if K_depth is None else K_depth.copy(),
            timestamp=entry.timestamp,
            moving=_load(entry.name, "mask of moving pixels", entry.load_moving, self.depth_size),
        )

    def intrinsics_of(self, entry: Entry) -> np.ndarray:
        """[3, 3] intrinsics of an entry's image [px]: the entry's, or the sequence's."""
        return self.intrinsics if entry.intrinsics is None else entry.intrinsics

    def __iter__(self) -> Iterator[Frame]:
        """All frames in order. Raises FrameError: a frame cannot be decoded."""
        return (self[index] for index in range(len(self)))

    def readable(self, on_error: Callable[[FrameError], None], indices: Iterable[int] | None = None) -> Iterator[Frame]:
        """The frames at ``indices`` (None = all) that can be decoded, in order; ``on_error`` gets the errors of the
        others."""
        for index in range(len(self)) if indices is None else indices:
            try:
                frame = self[index]
            except FrameError as error:
                on_error(error)
            else:
                yield frame


def make_sequence(
    name: str,
    layout: str,
    frames: Iterable[Entry | Skipped],
    intrinsics: np.ndarray,
    *,
    image_size: Size | None,
    depth_intrinsics: np.ndarray | None = None,
    depth_size: Size | None = None,
    posed: bool = True,
    metric: bool = True,
) -> FrameSequence:
    """Divide frames into usable and skipped ones, and check that the intrinsics fit the sizes (H, W). ``posed`` and
    ``metric``: see :class:`FrameSequence`. Raises ValueError: no frame is usable (the message counts the reasons); two
    frames share a name; the intrinsics are malformed or belong to another image size."""
    from ufmstar_torch.config import UfMStarConfig  # here, since these files import torch
    from ufmstar_torch.frames.frame import FARTHEST

    names, entries, skipped = list[str](), list[Entry](), list[Skipped]()
    for frame in frames:
        names.append(frame.name)
        if isinstance(frame, Skipped):
            skipped.append(frame)
        elif not np.isfinite(frame.T_world_cam).all():
            skipped.append(Skipped(frame.name, "non-finite pose"))
        elif np.abs(frame.T_world_cam).max() > FARTHEST:
            skipped.append(Skipped(frame.name, f"pose farther than {FARTHEST:g} m from the origin"))
        elif not is_rotation(frame.T_world_cam[:3, :3], UfMStarConfig.rotation_tolerance):
            skipped.append(Skipped(frame.name, "pose that is no rotation, but has a scale, shear or reflection"))
        else:
            entries.append(frame)
    if not entries:
        reasons = Counter(frame.reason for frame in skipped).most_common(3)
        summary = "; ".join(f"{count} x {reason}" for reason, count in reasons) or "no frame was found"
        if (path := next((frame.path for frame in skipped if frame.path is not None), None)) is not None:
            summary += f"; first {path}"
        raise ValueError(f"{layout} sequence {name!r} has no usable frame: {summary}")
    if repeated := [frame_name for frame_name, count in Counter(names).items() if count > 1]:
        raise ValueError(f"{layout} sequence {name!r}: frame names must be unique, {repeated[:3]} occur twice")
    check_intrinsics("intrinsics", intrinsics, image_size)
    if depth_intrinsics is not None:
        check_intrinsics("depth_intrinsics", depth_intrinsics, depth_size)
    for entry in entries:
        if entry.intrinsics is not None:
            check_intrinsics(f"intrinsics of {entry.name}", entry.intrinsics, entry.image_size or image_size)
    cameras = (intrinsics, image_size, depth_intrinsics, depth_size)
    return FrameSequence(name, layout, tuple(entries), *cameras, tuple(skipped), tuple(names), posed, metric=metric)


def is_rotation(R: np.ndarray, tolerance: float) -> bool:
    """True if max |R R^T - I| of R [3, 3] is at most the tolerance, and R is no reflection."""
    return bool(np.abs(R @ R.T - np.eye(3)).max() <= tolerance and np.linalg.det(R) > 0)


def in_memory(sequence: FrameSequence, progress: Callable[[int], object] = lambda _: None) -> FrameSequence:
    """The sequence with all frames decoded and in memory; ``progress`` gets the number of decoded frames. Raises
    FrameError: a frame cannot be decoded."""
    entries = []
    for frame, entry in zip(sequence, sequence.entries, strict=True):
        load_image = entry.load_image and partial(np.asarray, frame.image)
        load_depth = entry.load_depth and partial(np.asarray, frame.depth)
        load_moving = entry.load_moving and partial(np.asarray, frame.moving)
        entries.append(replace(entry, load_image=load_image, load_depth=load_depth, load_moving=load_moving))
        progress(len(entries))
    return replace(sequence, entries=tuple(entries))


def parse_slice(text: str | None) -> slice:
    """START:STOP:STEP as a slice of frames; each part is optional. Raises ValueError: another form, or a step below
    1."""
    parts = (text or ":").split(":")
    try:
        numbers = [int(part) if part.strip() else None for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or (len(numbers) == 3 and numbers[2] is not None and numbers[2] < 1):
        raise ValueError(f"--frames must be START:STOP or START:STOP:STEP with STEP at least 1, got {text!r}")
    return slice(*numbers)


def check_intrinsics(argument: str, K: np.ndarray, size: Size | None) -> None:
    """Raises ValueError unless K [3, 3] is a pinhole matrix whose centre is well inside ``size`` (H, W)."""
    from ufmstar_torch.frames.frame import FOCAL_RANGE

    if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise ValueError(f"{argument} must be a finite 3x3 matrix with positive focal lengths, got {K.tolist()}")
    if np.abs(K).max() > FOCAL_RANGE[1]:
        raise ValueError(f"{argument} must have values within {FOCAL_RANGE[1]:g} px, got {K.tolist()}")
    if np.abs(K[2] - [0, 0, 1]).max() > 1e-9 or abs(K[1, 0]) > 1e-9:
        raise ValueError(f"{argument} must have rows (fx s cx), (0 fy cy), (0 0 1), got {K.tolist()}")
    if size is not None and not fits(K, size):
        fitting = f"principal point ({K[0, 2]:g}, {K[1, 2]:g}) px do not fit images of {size[1]}x{size[0]}"
        raise ValueError(f"{argument} with {fitting}: were they given for another image size?")


def fits(K: np.ndarray, size: Size) -> bool:
    """True if K's principal point is plausible for images of ``size`` (H, W)."""
    from ufmstar_torch.frames.warnings import CENTRE_RANGE

    low, high = CENTRE_RANGE
    return bool(low < K[0, 2] / size[1] < high and low < K[1, 2] / size[0] < high)


def _load(name: str, what: str, load: Loader | None, size: Size | None) -> np.ndarray | None:
    array = None if load is None else load()
    if array is not None and size is not None and array.shape[:2] != size:
        sizes = f"the {what} is {array.shape[1]}x{array.shape[0]}, the sequence's are {size[1]}x{size[0]}"
        raise FrameError(name, f"{sizes} (its intrinsics hold for that size only)")
    return array
