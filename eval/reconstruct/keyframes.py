"""Keyframes: images of a video that are far enough apart to triangulate, by the motion of corners."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.engine.files import write_bytes_atomic
from ufmstar_torch.eval.sequences.frame import Entry, FrameError

# An image is a keyframe if the median corner has moved by this share of the image's width since the last keyframe, or
# if fewer than this share of its corners remain.
_MOTION, _LEFT = 0.03, 0.5
_WIDTH = 320  # [px] to which images are reduced for tracking
_CORNERS, _FEWEST = 300, 20  # largest number of corners in an image, and smallest number in a keyframe
_JPEG_QUALITY = 95
_TEXT = b"ufmstar poses"
_COMMENT = b"\xff\xfe" + (2 + len(_TEXT)).to_bytes(2) + _TEXT  # a JPEG's comment, the first segment


def write_keyframes(
    images: Sequence[Entry],
    folder: Path,
    *,
    always: Collection[str] = (),
    progress: Callable[[int], object] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[list[int], int]:
    """Decode a video's images once, in order, and write its keyframes as ``folder/NAME.jpg``. Returns their indices in
    ``images``, and the number of images that cannot be decoded. Images named in ``always`` are always keyframes.
    ``progress`` gets the number of decoded images; ``stop`` is called before every image, and True ends the loop."""
    import cv2

    chosen, broken, motion = [], 0, _Motion()
    for index, entry in enumerate(images):
        if stop():
            break
        assert entry.load_image is not None
        try:
            image = entry.load_image()
        except FrameError:
            broken += 1
            continue
        if motion.is_keyframe(image, required=entry.name in always):
            jpeg = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
            write_bytes_atomic(folder / f"{entry.name}.jpg", jpeg[:2] + _COMMENT + jpeg[2:])
            chosen.append(index)
        progress(index + 1)
    return chosen, broken


def is_keyframe(path: Path) -> bool:
    """True if a file is an image of :func:`write_keyframes`, by its comment."""
    with path.open("rb") as file:
        return file.read(2 + len(_COMMENT))[2:] == _COMMENT


class _Motion:
    """Corners tracked from image to image since the last keyframe."""

    def __init__(self) -> None:
        self._last: np.ndarray | None = None
        self._start: np.ndarray = np.zeros((0, 1, 2), np.float32)  # of the corners in the last keyframe
        self._now = self._start
        self._count = 0

    def is_keyframe(self, image: np.ndarray, required: bool) -> bool:
        """True if the next image [H, W, 3] is a keyframe: ``required``, or far enough from the last one."""
        import cv2

        scale = min(1.0, _WIDTH / image.shape[1])
        grey = cv2.resize(
            cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA
        )
        if self._last is not None and self._last.shape == grey.shape and len(self._now):
            moved, found, _ = cv2.calcOpticalFlowPyrLK(self._last, grey, self._now, np.zeros_like(self._now))
            tracked = found.ravel() == 1
            self._start, self._now = self._start[tracked], np.asarray(moved, np.float32)[tracked]
        self._last = np.asarray(grey)
        enough = len(self._now) >= max(_LEFT * self._count, 1)
        distance = np.linalg.norm(self._now - self._start, axis=-1)
        if enough and not required and np.median(distance) < _MOTION * grey.shape[1]:
            return False
        corners = cv2.goodFeaturesToTrack(grey, _CORNERS, 0.01, 5)
        if (corners is None or len(corners) < _FEWEST) and not required:
            return False
        self._start = self._now = np.asarray([] if corners is None else corners, np.float32).reshape(-1, 1, 2)
        self._count = len(self._start)
        return True
