"""Images of a live stream, each of which waits for the pose at its stamp."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from ufmstar_torch.frames.arguments import ImageLike
from ufmstar_torch.frames.clock import PoseBuffer, StreamClock, Verdict
from ufmstar_torch.frames.warnings import LOGGER
from ufmstar_torch.gaussians.trajectory import SAME_TIME

# Reasons for which an image is dropped (NEWER, CLOSED) or skipped (the others).
NEWER, CLOSED = "a newer image was ready", "closed"
BACKWARDS, LATE, GAP = "its stamp is not after the image before", "no pose in time", "poses too far apart around it"
LOST = "a pose around it is not finite"
DOUBTFUL = "its stamp is far from those before it"
_WAITING = 16  # most images that wait for their poses: half a second at 30 frames/s


@dataclass(frozen=True, eq=False)
class QueuedImage:
    """An image that waits for its pose."""

    stamp: float  # [s]
    image: ImageLike
    intrinsics: Tensor
    received: float  # by ``time.perf_counter`` [s]


class ImageQueue:
    """The waiting images, and the poses. It is used by one thread at a time.

    Args:
        max_wait: longest wait for a pose after an image [s].
        max_gap: longest interval between the poses around an image, beyond which it is skipped [s].

    Attributes:
        dropped, skipped: numbers of usable and of unusable images that were left out, by reason.
    """

    def __init__(self, max_wait: float, max_gap: float) -> None:
        self._max_wait, self._max_gap = max_wait, max_gap
        self.dropped, self.skipped = Counter[str](), Counter[str]()
        self._waiting: list[QueuedImage] = []  # the oldest first
        self.restart()

    def __len__(self) -> int:
        return len(self._waiting)

    def restart(self) -> None:
        """Drop the waiting images, and forget all poses and stamps."""
        self.drop(NEWER)
        self._poses, self._clock, self._last = PoseBuffer(), StreamClock(), -math.inf

    def add(self, image: QueuedImage) -> bool:
        """Add the newest image. Returns False if its stamp is not usable, which is counted."""
        verdict = self._clock.judge(image.stamp, image.received)
        if verdict == Verdict.WAIT:
            self.skip(DOUBTFUL, image.stamp)
            return False
        if verdict == Verdict.USE and image.stamp <= self._last:
            self.skip(BACKWARDS, image.stamp)
            return False
        if verdict == Verdict.JUMPED:
            LOGGER.warning("the images' clock jumped from %.3f s to %.3f s", self._last, image.stamp)
            self.drop(NEWER)
        self._last = image.stamp
        if len(self._waiting) == _WAITING:  # drop the newest: older images get their poses first
            self._waiting.pop()
            self.dropped[NEWER] += 1
        self._waiting.append(image)
        return True

    def add_pose(self, stamp: float, pose: np.ndarray, now: float) -> int:
        """Add a pose [4, 4], as :meth:`PoseBuffer.add`; returns the number of poses that were dropped."""
        return self._poses.add(stamp, pose, now, self._clock.newest)

    def take(self, now: float) -> tuple[QueuedImage, np.ndarray] | None:
        """Remove the newest image that needs no further wait, and drop older ones; returns it and its pose [4, 4]."""
        for n in reversed(range(len(self._waiting))):
            image = self._waiting[n]
            late = self._poses.latest < image.stamp - SAME_TIME
            if late and now - image.received < self._max_wait:
                continue
            del self._waiting[n]
            T = self._poses.at(image.stamp, self._max_gap)
            if T is not None and np.isfinite(T).all():
                self.drop(NEWER, n)
                return image, T
            self.skip(LOST if T is not None else LATE if late else GAP, image.stamp)
        return None

    @property
    def due(self) -> float:
        """When the oldest image needs no further wait [s]; infinity without images."""
        return self._waiting[0].received + self._max_wait if self._waiting else math.inf

    def skip(self, reason: str, stamp: float) -> None:
        """Count an unusable image; logs the first one for each reason with the time range of the poses."""
        self.skipped[reason] += 1
        if self.skipped[reason] == 1:
            LOGGER.warning("image at %.3f s skipped: %s (poses: %s; logged once)", stamp, reason, self._poses.span)

    def drop(self, reason: str, count: int | None = None) -> None:
        """Drop the ``count`` oldest images, or all."""
        dropped = self._waiting[:count]
        del self._waiting[:count]
        if dropped:
            self.dropped[reason] += len(dropped)
