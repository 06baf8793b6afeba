"""Images and poses as they come: a recording replayed at its pace, a camera, a folder and a trajectory that grow, and
lines of JSON.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.sequences.attach import stem_times
from ufmstar_torch.eval.sequences.frame import FrameError, FrameSequence
from ufmstar_torch.eval.sequences.images import IMAGE_SUFFIXES, read_color
from ufmstar_torch.eval.sequences.poses import CONVENTIONS, OURS, in_metres, parse_pose, poses_from_columns

_FPS = 30.0  # of a recording without timestamps
_POLL = 0.01  # [s] between two looks at a folder
_UNREADABLE = 1.0  # [s] an image that is still being written may take so long


@dataclass(frozen=True, eq=False)
class LiveEvent:
    """An image, a pose, or both, at a moment [s]."""

    stamp: float
    image: NDArray[np.uint8] | None = None  # [H, W, 3] RGB
    T_world_cam: NDArray[np.float64] | None = None  # [4, 4] camera-to-world [m]
    intrinsics: NDArray[np.float64] | None = None  # [3, 3] of the image [px]; None: as given elsewhere


class PoseFile:
    """A text file of poses (``poses.py`` has its formats, those with timestamps) to which lines are added; it need not
    exist yet. Its poses have a ``convention`` of ``CONVENTIONS``, and positions in units of ``scale`` metres."""

    def __init__(self, path: str | Path, convention: str = OURS, scale: float = 1.0) -> None:
        self.path, self._convert, self._scale = Path(path), CONVENTIONS[convention].convert, scale
        self._read, self._line = 0, 0

    def new(self) -> Iterator[LiveEvent]:
        """The poses of the lines that were completed since the last call. Raises ValueError: a line is no pose with a
        timestamp."""
        if not self.path.exists():
            return
        with self.path.open("rb") as file:
            file.seek(self._read)
            text = file.read()
        complete = text[: text.rfind(b"\n") + 1]
        self._read += len(complete)
        for line in complete.decode("utf-8", "replace").splitlines():
            self._line += 1
            if (found := parse_pose(line, f"{self.path}:{self._line}")) is not None:
                yield LiveEvent(found[0], T_world_cam=in_metres(self._convert(found[1]), self._scale))


def replay(sequence: FrameSequence, speed: float = 1.0) -> Iterator[LiveEvent]:
    """A recording's frames with their poses, each when its time has come, without timestamps 30 a second; ``speed`` 2
    is twice as fast, infinity without waiting. A frame that cannot be decoded is left out."""
    stamps = [entry.timestamp for entry in sequence.entries]
    known = [stamp for stamp in stamps if stamp is not None]
    timed = len(known) == len(stamps) and all(a < b for a, b in pairwise(known))
    times = np.array(known) if timed else np.arange(len(sequence)) / _FPS
    started = time.perf_counter()
    for n, stamp in enumerate(times.tolist()):
        try:
            frame = sequence[n]
        except FrameError:
            continue
        wait = (stamp - times[0]) / speed + started - time.perf_counter()
        if wait > 0:
            time.sleep(wait)
        yield LiveEvent(stamp, frame.image, frame.T_world_cam, frame.intrinsics)


def camera(index: int, poses: PoseFile) -> Iterator[LiveEvent]:
    """The images of a camera of this computer, stamped with the system's clock (``time.time()``), and the poses of a
    file that another program writes, with stamps of the same clock. Raises OSError: the camera cannot be opened, or
    stops."""
    import cv2

    capture = cv2.VideoCapture(index)
    try:
        while True:
            ok, image = capture.read() if capture.isOpened() else (False, None)
            stamp = time.time()
            if image is None or not ok:
                raise OSError(f"camera {index} yields no image: is it connected, and not in use by another program?")
            yield from poses.new()
            yield LiveEvent(stamp, np.ascontiguousarray(image[..., ::-1]))
    finally:
        capture.release()


def growing_folder(
    folder: str | Path, poses: PoseFile, idle: float = math.inf, clock: Callable[[], float] = time.monotonic
) -> Iterator[LiveEvent]:
    """The images that are added to a folder from now on, in the order of their names, and the poses of a file. A name
    that is a number is the time of the image ([s], or [ns], [us] as ``stem_times``); of others it is that of the file.
    Ends after ``idle`` seconds without a new image. Raises FileNotFoundError: no such folder."""
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"no such folder: {folder}")
    seen, last = {path.name for path in folder.iterdir()}, clock()
    while clock() - last <= idle:
        yield from poses.new()
        for path in sorted(folder.iterdir()):
            if path.name in seen or path.suffix.lower() not in IMAGE_SUFFIXES:
                continue
            try:
                written = path.stat().st_mtime
            except OSError:  # it was removed, or is a link to nothing
                continue
            try:
                image = read_color(path)
            except FrameError:
                if time.time() - written > _UNREADABLE:
                    seen.add(path.name)
                break  # it is still being written; those after it come later
            seen.add(path.name)
            last, times = clock(), stem_times([path.stem])
            yield LiveEvent(written if times is None else float(times[0]), image)
        time.sleep(_POLL)


def json_lines(
    lines: Iterable[str], folder: str | Path = ".", convention: str = OURS, scale: float = 1.0
) -> Iterator[LiveEvent]:
    """Events from lines such as ``{"stamp": 1.5, "pose": [x, y, z, qx, qy, qz, qw], "image": "a.jpg"}``.

    ``pose`` has 7 numbers, or the 12 or 16 of a matrix (nested or not); ``image`` is a file, or the content of one as
    ``"data:;base64,..."``; ``intrinsics`` are fx, fy, cx, cy. A line has a stamp and at least one of pose and image.
    Relative files lie in ``folder``; poses are as those of :class:`PoseFile`. Raises ValueError: a line is something
    else; names its number.
    """
    convert = CONVENTIONS[convention].convert
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            try:
                about = json.loads(line)
            except json.JSONDecodeError:
                raise ValueError(f"no JSON: {line.strip():.60}") from None
            if not isinstance(about, dict) or about.keys() - {"stamp", "pose", "image", "intrinsics"}:
                raise ValueError('expected {"stamp": s, "pose": [...], "image": "file", "intrinsics": [...]}')
            if "stamp" not in about or not about.keys() & {"pose", "image"}:
                raise ValueError("a stamp and a pose or an image are needed")
            if not isinstance(stamp := about["stamp"], int | float):
                raise ValueError(f"a stamp is a number [s], got {stamp!r:.40}")
            if not math.isfinite(stamp := float(stamp)):
                raise ValueError(f"stamp must be finite [s], got {stamp}")
            pose = _pose(about["pose"], convert, scale) if "pose" in about else None
            image = _image(about["image"], Path(folder)) if "image" in about else None
            K = None if "intrinsics" not in about else np.array(about["intrinsics"], dtype=np.float64)
        except (ValueError, TypeError, OverflowError, RecursionError, FrameError, binascii.Error) as error:
            raise ValueError(f"line {number}: {error}") from error
        yield LiveEvent(stamp, image, pose, K)


def _pose(values: Any, convert: Callable[[np.ndarray], np.ndarray], scale: float) -> NDArray[np.float64]:
    numbers = np.array(values, dtype=np.float64).ravel()
    if len(numbers) not in (7, 12, 16):
        raise ValueError(f"a pose has 7 (x y z qx qy qz qw) or 12 (3x4) or 16 (4x4) numbers, got {values}")
    return in_metres(convert(poses_from_columns(numbers[None], ["pose"])[0]), scale)


def _image(text: Any, folder: Path) -> NDArray[np.uint8]:
    if not isinstance(text, str):
        raise ValueError(f"an image is the name of a file, got {text!r:.40}")
    head, comma, body = text.partition(",")
    if head.startswith("data:") and comma:
        return read_color("image", base64.b64decode(body, validate=True))
    return read_color(folder / text)
