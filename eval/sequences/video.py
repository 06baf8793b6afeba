"""Frames of a video file, decoded in order (OpenCV)."""

from __future__ import annotations

import re
import subprocess
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ufmstar_torch.eval.sequences.frame import FrameError, Size
from ufmstar_torch.files.limits import require_pixels
from ufmstar_torch.frames.warnings import LOGGER

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")


class Video:
    """A video file with images of ``size`` (H, W). Frames are exact by index, and fast in increasing order: seeking is
    inexact in most containers, so an earlier frame is decoded again from the start. Raises FileNotFoundError: no such
    file; ValueError: it is no video, or has no frame.

    The whole file is decoded once at opening, because the number of frames that containers state is an estimate (of
    Matroska: the duration times a guessed rate) or wrong (truncated files).
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise FileNotFoundError(f"no such video: {self.path}")
        try:
            capture = self._open()
        except FrameError as error:
            raise ValueError(error) from error
        self._capture: Any = capture
        self._next = 0
        import cv2

        height, width = capture.get(cv2.CAP_PROP_FRAME_HEIGHT), capture.get(cv2.CAP_PROP_FRAME_WIDTH)
        self.size: Size = int(height), int(width)
        require_pixels(f"{self.path}: a frame", self.size)
        if turned := round(capture.get(cv2.CAP_PROP_ORIENTATION_META)):
            LOGGER.warning("%s: its frames are turned by %d degrees, as it states: K is of turned ones", path, turned)
        self._times = self._decoded_times()
        if self._times.size == 0 or 0 in self.size:
            raise ValueError(f"{self.path}: the video has no frame that can be decoded")

    def __len__(self) -> int:
        """Number of frames that can be decoded."""
        return self._times.size

    def times(self) -> np.ndarray:
        """[N] times of the frames [s], from 0 on, by the timestamps in the container, or by the decoder if their number
        is not that of the frames (an edited or truncated video)."""
        stamps = _container_times(self.path)
        if len(stamps) != len(self):
            stamps = self._times
        return stamps - stamps[0]

    def read(self, index: int) -> np.ndarray:
        """Frame ``index`` as [H, W, 3] uint8 RGB. Raises FrameError: the file ends or cannot be decoded before it."""
        if self._capture is None or index < self._next:
            self._capture, self._next = self._open(), 0
        while self._next <= index:
            if not self._capture.grab():
                raise FrameError(self.path, f"frame {index} cannot be read, decoding stops at frame {self._next}")
            self._next += 1
        _, image = self._capture.retrieve()
        return np.ascontiguousarray(image[..., ::-1])

    def _decoded_times(self) -> np.ndarray:
        """[N] timestamps [s] of all frames, by decoding the file."""
        import cv2

        capture, times = self._open(), []
        while capture.grab():
            times.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
        return np.array(times)

    def _open(self) -> Any:
        import cv2

        capture = cv2.VideoCapture(str(self.path))
        if not capture.isOpened():
            raise FrameError(self.path, "cannot be opened as a video: empty, truncated, or of an unknown format")
        return capture

    def __getstate__(self) -> dict[str, Any]:
        """Pickle without the decoder; a worker process opens the file again."""
        return {**self.__dict__, "_capture": None, "_next": 0}


def _container_times(path: Path) -> np.ndarray:
    """[N] sorted timestamps [s] of the packets of a file's first video stream, without decoding; empty if ffmpeg cannot
    read it."""
    from imageio_ffmpeg import get_ffmpeg_exe

    command = [get_ffmpeg_exe(), "-v", "error", "-nostdin", "-i", str(path.resolve())]
    command += ["-map", "0:v:0", "-c", "copy", "-copyts", "-f", "framecrc", "-"]
    listed = subprocess.run(command, capture_output=True, check=False).stdout.decode(errors="replace")
    unit = re.search(r"^#tb 0: (\d+)/(\d+)$", listed, re.MULTILINE)
    stamps = [int(line.split(",")[2]) for line in listed.splitlines() if re.match(r"0,\s*-?\d+,\s*-?\d+,", line)]
    if unit is None or int(unit[2]) == 0:
        return np.zeros(0)
    return np.sort(np.array(stamps, dtype=np.float64)) * float(Fraction(int(unit[1]), int(unit[2])))
