"""Frames of a video file, decoded in order (OpenCV)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ufmstar_torch.eval.sequences.frame import FrameError, Size

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")


class Video:
    """A video file; frames are exact by index, and cheap when read in increasing order.

    Seeking in compressed video is inexact in most containers, so that an earlier frame is reached by
    decoding again from the start.

    Attributes:
        path: the file.
        fps: frames per second that the file names.
        size: (H, W).

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is no video, or one without a frame.
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

        self.fps = float(capture.get(cv2.CAP_PROP_FPS))
        height, width = capture.get(cv2.CAP_PROP_FRAME_HEIGHT), capture.get(cv2.CAP_PROP_FRAME_WIDTH)
        self.size: Size = int(height), int(width)
        named = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self._length = named if named > 0 else self._count()
        if self._length == 0 or 0 in self.size:
            raise ValueError(f"{self.path}: the video has no frame that can be decoded")

    def __len__(self) -> int:
        """Number of frames stated in the file; a truncated file ends earlier, with :class:`FrameError`."""
        return self._length

    def read(self, index: int) -> np.ndarray:
        """Frame ``index`` as [H, W, 3] uint8 RGB. Raises FrameError: the file ends, or cannot be decoded, before that
        frame."""
        if self._capture is None or index < self._next:
            self._capture = self._open()
            self._next = 0
        while self._next < index:
            self._advance(self._capture.grab(), index)
        ok, image = self._capture.read()
        self._advance(ok, index)
        return np.ascontiguousarray(image[..., ::-1])

    def _advance(self, found: bool, index: int) -> None:
        if not found:
            raise FrameError(self.path, f"frame {index} cannot be read, decoding stops at frame {self._next}")
        self._next += 1

    def _count(self) -> int:
        """Frames of a file that does not say how many it has (a browser's recording), by decoding it."""
        capture, count = self._open(), 0
        while capture.grab():
            count += 1
        return count

    def _open(self) -> Any:
        import cv2

        capture = cv2.VideoCapture(str(self.path))
        if not capture.isOpened():
            raise FrameError(self.path, "cannot be opened as a video: empty, truncated, or of an unknown format")
        return capture

    def __getstate__(self) -> dict[str, Any]:
        """A decoder cannot be pickled: a worker process opens its own."""
        return {**self.__dict__, "_capture": None, "_next": 0}
