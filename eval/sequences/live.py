"""Live sources of images and poses: a recording replayed at its pace, a camera, a growing folder and trajectory, and
lines of JSON.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from queue import Empty, Queue
from threading import Thread
from typing import Any, BinaryIO, TextIO

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.sequences.attach import stem_times
from ufmstar_torch.eval.sequences.frame import FrameError, FrameSequence, check_intrinsics
from ufmstar_torch.eval.sequences.images import read_color
from ufmstar_torch.eval.sequences.intrinsics import pinhole
from ufmstar_torch.eval.sequences.paths import IMAGE_SUFFIXES, is_hidden, listed_path, on_disk
from ufmstar_torch.eval.sequences.poses import PoseColumns, in_metres, numbers, parse_pose, poses_from_columns
from ufmstar_torch.frames.warnings import LOGGER
from ufmstar_torch.gaussians.conventions import CONVENTIONS, OURS

_FPS = 30.0  # of a recording without timestamps
_MOST_FRAMES = 10**6  # smaller whole numbers are numbers of images, not times
_POLL = 0.01  # [s] interval of polling a folder
_KEPT = 256  # [bytes] of each end of a file of poses, by which a file that was written anew is recognised
LONGEST_LINE = 2**28  # characters of JSON; an image of 12 megapixels has 2**26 at most
_UNREADABLE = 1.0  # [s] largest time to write an image


@dataclass(frozen=True, eq=False)
class LiveEvent:
    """An image, a pose, or both, at a moment [s]."""

    stamp: float
    image: NDArray[np.uint8] | None = None  # [H, W, 3] RGB
    T_world_cam: NDArray[np.float64] | None = None  # [4, 4] camera-to-world [m]
    intrinsics: NDArray[np.float64] | None = None  # [3, 3] of the image [px]; None = those of the stream


class PoseFile:
    """A growing text file of poses in a format with timestamps of ``poses.py``; it may not exist yet. A file that was
    written anew, as by a program that starts again, is read from its start. Its poses have a ``convention`` of
    ``CONVENTIONS``, and positions in units of ``scale`` metres."""

    def __init__(self, path: str | Path, convention: str = OURS, scale: float = 1.0) -> None:
        self.path, self._convert, self._scale = Path(path), CONVENTIONS[convention].convert, scale
        self._read, self._line = 0, 0
        self._head, self._tail = b"", b""  # first and last bytes of what was read
        self._digest = hashlib.sha256()  # of all that was read
        self._columns = PoseColumns()
        self._file: tuple[int, int] | None = None  # device and inode

    def new(self) -> Iterator[LiveEvent]:
        """The poses of lines that were completed since the last call. Raises ValueError: a line is no pose with a
        timestamp."""
        try:
            file = self.path.open("rb")
        except FileNotFoundError:  # not yet written, or about to be replaced
            return
        with file:
            if not self._continues(file):
                LOGGER.warning("%s was written anew: its poses are read from the start", self.path)
                self._read, self._line, self._head, self._tail, self._digest = 0, 0, b"", b"", hashlib.sha256()
                self._columns = PoseColumns()
            file.seek(self._read)
            text = file.read()
        complete = text[: text.rfind(b"\n") + 1]
        self._head, self._tail = (self._head + complete)[:_KEPT], (self._tail + complete)[-_KEPT:]
        self._read += len(complete)
        self._digest.update(complete)
        for line in complete.decode("utf-8", "replace").splitlines():
            self._line += 1
            if (pose := parse_pose(line, f"{self.path}:{self._line}", self._columns)) is not None:
                yield LiveEvent(pose[0], T_world_cam=in_metres(self._convert(pose[1]), self._scale))

    def _continues(self, file: BinaryIO) -> bool:
        """True if the open file begins with what was read. A file with the same inode is compared at both ends, another
        one completely."""
        status = os.fstat(file.fileno())
        same, self._file = (status.st_dev, status.st_ino) == self._file, (status.st_dev, status.st_ino)
        if status.st_size < self._read:
            return False
        if not same:
            return hashlib.sha256(file.read(self._read)).digest() == self._digest.digest()
        head = file.read(len(self._head))
        file.seek(self._read - len(self._tail))
        return head == self._head and file.read(len(self._tail)) == self._tail


def replay(sequence: FrameSequence, speed: float = 1.0) -> Iterator[LiveEvent]:
    """Yield a recording's frames with their poses at their times, or at 30 frames/s without timestamps. ``speed`` 2 is
    twice as fast, infinity does not wait. A frame that cannot be decoded is omitted. The clock starts when the caller
    asks for the second frame."""
    stamps = [entry.timestamp for entry in sequence.entries]
    timed_stamps = [stamp for stamp in stamps if stamp is not None]
    timed = len(timed_stamps) == len(stamps) and all(a < b for a, b in pairwise(timed_stamps))
    times = np.array(timed_stamps) if timed else np.arange(len(sequence)) / _FPS
    if timed and (times % 1 == 0).all() and times.max() < _MOST_FRAMES:  # numbers of frames, as of names 3, 4, 5, ...
        times = times / _FPS
    started: float | None = None
    first = 0.0
    for n, stamp in enumerate(times.tolist()):
        try:
            frame = sequence[n]
        except FrameError:
            continue
        if started is not None and (wait := (stamp - first) / speed + started - time.perf_counter()) > 0:
            time.sleep(wait)
        yield LiveEvent(stamp, frame.image, frame.T_world_cam, frame.intrinsics)
        if started is None:
            started, first = time.perf_counter(), stamp


def camera(index: int, poses: PoseFile) -> Iterator[LiveEvent]:
    """Yield the images of this computer's camera, stamped by the system's clock (``time.time()``), and the poses of a
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
) -> Iterator[LiveEvent | None]:
    """Yield new images of a folder, also those that replace earlier ones, in the order of their names, and the poses of
    a file. The time of an image is its name if that is a number ([s], or [ns], [us] as ``stem_times``), else that of
    the file; None after every look. Ends after ``idle`` seconds without a new image. Raises FileNotFoundError: no such
    folder."""
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"no such folder: {folder}")
    seen, last = {path.name: _changed(path) for path in folder.iterdir()}, clock()
    while clock() - last <= idle:
        yield from poses.new()
        for path in sorted(folder.iterdir()):
            if path.suffix.lower() not in IMAGE_SUFFIXES or is_hidden(path):
                continue
            changed = _changed(path)
            if seen.get(path.name) == changed:
                continue
            try:
                written = path.stat().st_mtime
            except OSError:  # it was removed, or is a link to nothing
                continue
            try:
                image = read_color(path)
            except FrameError:
                if time.time() - written > _UNREADABLE:
                    seen[path.name] = changed
                break  # it is still being written; keep the order of images
            seen[path.name] = changed
            last, times = clock(), stem_times([path.stem])
            yield LiveEvent(written if times is None else float(times[0]), image)
        yield None
        time.sleep(_POLL)


def lines_of(file: TextIO) -> Iterator[str | None]:
    """The lines of a stream such as the standard input, and None while none comes. Raises the errors of the stream."""
    lines: Queue[str | Exception] = Queue(1)

    def read() -> None:
        try:
            while line := file.readline(LONGEST_LINE):
                lines.put(line)
            lines.put("")
        except (OSError, ValueError) as error:
            lines.put(error)

    Thread(target=read, daemon=True).start()
    while True:
        try:
            line = lines.get(timeout=_POLL)
        except Empty:
            yield None
            continue
        if isinstance(line, Exception):
            raise line
        if not line:
            return
        yield line


def _changed(path: Path) -> int | None:
    """The time of the last change of a file [ns]; None if it was removed."""
    try:
        return path.lstat().st_mtime_ns
    except OSError:
        return None


def json_lines(
    lines: Iterable[str | None],
    folder: str | Path = ".",
    convention: str = OURS,
    scale: float = 1.0,
    intrinsics: NDArray[np.float64] | None = None,
) -> Iterator[LiveEvent | None]:
    """Events from lines such as ``{"stamp": 1.5, "pose": [x, y, z, qx, qy, qz, qw], "image": "a.jpg"}``.

    ``pose`` has 7 numbers, or the 12 or 16 of a matrix (nested or not). ``image`` is a file, or its content as
    ``"data:;base64,..."``. ``intrinsics`` are fx, fy, cx, cy; they hold for later lines too, and may stand alone in a
    line. Another line has a stamp and at least one of pose and image. Relative files are in ``folder``; poses are as in
    :class:`PoseFile`. An image that cannot be read is left out; the first one and their number are logged, and so is a
    last line that ends in its middle, as of a program that was killed. Raises ValueError: a line has another form or
    ``LONGEST_LINE`` characters, or an image is without intrinsics; the message has the line's number. For a line None
    there is None, so that a caller can stop while none comes.
    """
    convert, unreadable, number, K = CONVENTIONS[convention].convert, 0, 0, intrinsics
    for line in lines:
        if line is None:
            yield None
            continue
        number += 1
        if not line.strip():
            continue
        try:
            if len(line) >= LONGEST_LINE:
                raise ValueError(f"it is longer than {LONGEST_LINE:,} characters")
            if (event := _fields(line)) is None:
                LOGGER.warning("line %d is unfinished and left out", number)
                break
            K = _intrinsics(event["intrinsics"]) if "intrinsics" in event else K
            if event.keys() == {"intrinsics"}:
                continue
            pose = _pose(event["pose"], convert, scale) if "pose" in event else None
            if "image" in event and K is None:
                raise ValueError("an image needs intrinsics, in its line, an earlier one or --intrinsics fx fy cx cy")
            try:
                image = _image(event["image"], Path(folder)) if "image" in event else None
            except FrameError as error:
                image, unreadable = None, unreadable + 1
                if unreadable == 1:
                    LOGGER.warning("line %d: the image is left out: %s (logged once)", number, error)
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
            raise ValueError(f"line {number}: {error}") from error
        if image is not None or pose is not None:
            yield LiveEvent(float(event["stamp"]), image, pose, K)
    if unreadable:
        LOGGER.warning("%d images could not be read", unreadable)


def _fields(line: str) -> dict[str, Any] | None:
    """The fields of a line of JSON: intrinsics alone, or a stamp with a pose, an image or both; None for an unfinished
    line. Raises ValueError: another form."""
    try:
        event = json.loads(line.lstrip("\ufeff"))  # the mark that Windows adds
    except json.JSONDecodeError:
        if line.startswith("{") and not line.endswith("\n"):
            return None
        raise ValueError(f"no JSON: {line.strip():.60}") from None
    if not isinstance(event, dict) or event.keys() - {"stamp", "pose", "image", "intrinsics"}:
        raise ValueError('expected {"stamp": s, "pose": [...], "image": "file", "intrinsics": [...]}')
    if event.keys() == {"intrinsics"}:
        return event
    if "stamp" not in event or not event.keys() & {"pose", "image"}:
        raise ValueError("a stamp and a pose or an image are needed")
    if not (isinstance(event["stamp"], int | float) and math.isfinite(event["stamp"])):
        raise ValueError(f"a stamp is a finite number [s], got {event['stamp']!r:.40}")
    return event


def _intrinsics(values: Any) -> NDArray[np.float64]:
    error = f"intrinsics are fx, fy, cx, cy [px], got {values!r:.60}"
    of_matrix = isinstance(values, list) and len(values) == 3
    K = numbers(values, (3, 3), error) if of_matrix else pinhole(*numbers(values, (4,), error))
    check_intrinsics("intrinsics", K, None)
    return K


def _pose(values: Any, convert: Callable[[np.ndarray], np.ndarray], scale: float) -> NDArray[np.float64]:
    row = np.zeros(0)
    with suppress(TypeError, ValueError, OverflowError):
        row = np.array(values, dtype=np.float64).ravel()
    if len(row) not in (7, 12, 16):
        raise ValueError(f"a pose has 7 (x y z qx qy qz qw) or 12 (3x4) or 16 (4x4) numbers, got {values!r:.60}")
    return in_metres(convert(poses_from_columns(row[None], ["pose"])[0]), scale)


def _image(text: Any, folder: Path) -> NDArray[np.uint8]:
    if not isinstance(text, str):
        raise ValueError(f"an image is the name of a file, got {text!r:.40}")
    head, comma, body = text.partition(",")
    if head.startswith("data:") and comma:
        try:
            return read_color("image", base64.b64decode(body, validate=True))
        except ValueError as error:
            raise FrameError("image", f"no base64: {error}") from error
    return read_color(on_disk(folder / listed_path(text)))
