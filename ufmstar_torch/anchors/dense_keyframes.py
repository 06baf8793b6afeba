"""Keyframes of a camera in a ring buffer: stored when the camera has moved, chosen by their baselines."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.kernels.dense import Views
from ufmstar_torch.anchors.kernels.keyframes import compare
from ufmstar_torch.anchors.landmarks import opencv
from ufmstar_torch.anchors.saved_state import SavedState
from ufmstar_torch.gaussians.camera import inverse_intrinsics

# A frame becomes a keyframe if the camera has moved by this share of the median depth, or turned by this angle [rad].
_MOVED, _TURNED = 0.015, math.radians(4.0)


class Keyframes(SavedState):
    """The last ``count`` keyframes: gray images, the same at half the size, and poses.

    The ring has one place more: a new keyframe leaves those before it unchanged, so that they can be restored.
    """

    HELD: ClassVar = {"_image": "images", "_pose": "pose", "_number": "number", "_added": "added"}

    def __init__(self, count: int) -> None:
        self._count = count
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._image = self._half = np.zeros((self._count + 1, 0, 0), np.uint8)
        self._pose = np.tile(np.eye(4), (self._count + 1, 1, 1))
        self._number = np.full(self._count + 1, -1)
        self._added = 0

    def add(
        self, image: NDArray[np.uint8], half: NDArray[np.uint8], T_world_cam: NDArray[np.float64], depth: float,
        number: int,
    ) -> None:  # fmt: skip
        """Store a frame if the camera has moved or turned since the last keyframe.

        Args:
            image, half: [H, W] and [H // 2, W // 2], the same sizes for all.
            T_world_cam: [4, 4] [m].
            depth: median of the scene [m].
            number: index of the image, for :meth:`correct`.
        """
        if self._image.shape[1:] != image.shape:
            self._image, self._half = (np.zeros((self._count + 1, *one.shape), np.uint8) for one in (image, half))
        if self._added:
            last = self._pose[(self._added - 1) % (self._count + 1)]
            moved = math.dist(last[:3, 3].tolist(), T_world_cam[:3, 3].tolist())
            cosine = (float((last[:3, :3] * T_world_cam[:3, :3]).sum()) - 1) / 2
            if moved < _MOVED * depth and math.acos(min(max(cosine, -1.0), 1.0)) < _TURNED:
                return
        slot = self._added % (self._count + 1)
        self._image[slot], self._half[slot], self._pose[slot], self._number[slot] = image, half, T_world_cam, number
        self._added += 1

    def correct(self, number: NDArray[np.int64], T_world_cam: NDArray[np.float64]) -> None:
        """Replace the poses of stored images, by their indices [V], with [V, 4, 4]; negative indices are ignored."""
        slot, view = np.nonzero((self._number[:, None] == number) & (number >= 0))
        self._pose[slot] = T_world_cam[view]

    def compared(
        self, T_world_cam: NDArray[np.float64], K: NDArray[np.float64], depth: float, baselines: NDArray[np.float64],
    ) -> tuple[Views, Views, float]:  # fmt: skip
        """Choose the keyframes to compare with a view, at most one for each baseline, the shortest first; noise 0.

        Args:
            T_world_cam: [4, 4] of the view [m].
            K: [3, 3] [px].
            depth: median of the scene [m].
            baselines: [B] requested, as shares of ``depth``.

        Returns:
            V <= B keyframes; the same at half the size; and their longest baseline [m].
        """
        b, ring = len(baselines), self._count + 1
        whole, half = (
            Views(
                images, np.zeros(b, np.int64), np.zeros(b, np.int64), np.zeros((b, 3, 3)), np.zeros((b, 3)), np.zeros(b)
            )
            for images in (self._image, self._half)
        )
        newest, number = (self._added - 1) % ring, min(self._added, self._count)
        camera = T_world_cam, K, inverse_intrinsics(K), self._image.shape[1:], depth
        n, longest = compare(self._pose, newest, number, *camera, baselines, whole, half)
        return whole.first(n), half.first(n), longest

    def state(self) -> dict[str, Tensor]:
        """The state, for :meth:`load_state`."""
        state = super().state()
        state["images"][self._added % (self._count + 1)] = 0  # the free place may hold a keyframe that was undone
        return state

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of :meth:`state`; ValueError: another number of keyframes."""
        super().load_state(state)
        count, height, width = self._image.shape
        self._half = np.zeros((count, height // 2, width // 2), np.uint8)
        for slot in range(min(self._added, count) if self._image.size else 0):
            self._half[slot] = halved(self._image[slot])


def halved(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Average blocks of two by two pixels; an odd last row or column is dropped."""
    cv2 = opencv()
    height, width = image.shape[0] // 2, image.shape[1] // 2
    if height == 0 or width == 0:
        return np.zeros((height, width), np.uint8)
    return np.asarray(cv2.resize(image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA))
