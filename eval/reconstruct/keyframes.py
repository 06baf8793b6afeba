"""Keyframes: the images of a video that lie far enough apart to triangulate, by how far its corners move."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.frame import Entry, FrameError

# A new keyframe where the median corner has moved by this share of the image's width since the last one, or where fewer
# than half of its corners are left.
_MOTION, _LEFT = 0.03, 0.5
_WIDTH = 320  # [px] to which images are reduced for tracking
_CORNERS, _FEWEST = 300, 20  # in an image; one with fewer corners is no keyframe
_JPEG_QUALITY = 95


def write_keyframes(
    images: Sequence[Entry],
    folder: Path,
    *,
    always: Collection[str] = (),
    progress: Callable[[int], object] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[list[int], int]:
    """Decode a video's images once, in order, and write its keyframes as ``folder/NAME.jpg``; their positions in
    ``images``, and how many images cannot be decoded. Images named in ``always`` are keyframes wherever they lie.
    ``progress`` gets the number of decoded images; ``stop`` is called before every image, and True ends the video."""
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
            how = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
            if not cv2.imwrite(str(folder / f"{entry.name}.jpg"), image[..., ::-1], how):
                raise OSError(f"{folder / entry.name}.jpg cannot be written")
            chosen.append(index)
        progress(index + 1)
    return chosen, broken


class _Motion:
    """Corners followed from image to image since the last keyframe."""

    def __init__(self) -> None:
        self._last: np.ndarray | None = None
        self._start: np.ndarray = np.zeros((0, 1, 2), np.float32)  # of the corners in the last keyframe
        self._now = self._start
        self._count = 0

    def is_keyframe(self, image: np.ndarray, required: bool) -> bool:
        """Return whether the next image [H, W, 3] is a keyframe: ``required``, or far enough from the last one."""
        import cv2

        scale = min(1.0, _WIDTH / image.shape[1])
        grey = cv2.resize(
            cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA
        )
        if self._last is not None and self._last.shape == grey.shape and len(self._now):
            moved, found, _ = cv2.calcOpticalFlowPyrLK(self._last, grey, self._now, np.zeros_like(self._now))
            kept = found.ravel() == 1
            self._start, self._now = self._start[kept], np.asarray(moved, np.float32)[kept]
        self._last = np.asarray(grey)
        left = len(self._now) >= max(_LEFT * self._count, 1)
        distance = np.linalg.norm(self._now - self._start, axis=-1)
        if left and not required and np.median(distance) < _MOTION * grey.shape[1]:
            return False
        corners = cv2.goodFeaturesToTrack(grey, _CORNERS, 0.01, 5)
        if (corners is None or len(corners) < _FEWEST) and not required:
            return False
        self._start = self._now = np.asarray([] if corners is None else corners, np.float32).reshape(-1, 1, 2)
        self._count = len(self._start)
        return True
