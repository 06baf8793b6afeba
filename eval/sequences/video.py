"""Frames of a video file, decoded in order (OpenCV)."""

from __future__ import annotations

import re
import subprocess
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ufmstar_torch.eval.sequences.frame import FrameError, Size
from ufmstar_torch.limits import require_pixels

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")


class Video:
    """A video file with images of ``size`` (H, W). Frames are exact by index, and fast in increasing order: seeking is
    inexact in most containers, so an earlier frame is decoded again from the start. Raises FileNotFoundError: no such
    file; ValueError: it is no video, or has no frame."""

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
        named = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self._length = named if named > 0 else len(self._decoded_times())
        if self._length == 0 or 0 in self.size:
            raise ValueError(f"{self.path}: the video has no frame that can be decoded")

    def __len__(self) -> int:
        """Number of frames stated in the file; a truncated file raises :class:`FrameError` earlier."""
        return self._length

    def times(self) -> np.ndarray:
        """[N] times of the frames [s], from 0 on, by the timestamps in the container, or by decoding if their number is
        not that of the frames (an edited video). Raises FrameError: the file ends before its last frame."""
        stamps = _container_times(self.path)
        if len(stamps) != self._length:
            stamps = self._decoded_times()
        if len(stamps) < self._length:
            raise FrameError(self.path, f"it states {self._length} frames, of which {len(stamps)} can be decoded")
        return stamps[: self._length] - stamps[0]

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
        """[N] timestamps [s] of all frames, by decoding the file, if it does not state their number (a browser's
        recording) or times."""
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
