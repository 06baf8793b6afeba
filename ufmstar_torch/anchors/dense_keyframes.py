"""Keyframes of a camera in a ring buffer: stored when the camera has moved, chosen by their baselines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.landmarks import opencv
from ufmstar_torch.anchors.saved_state import SavedState, saved_image
from ufmstar_torch.gaussians.camera import inverse_intrinsics

# A frame becomes a keyframe if the camera has moved by this share of the median depth, or turned by this angle [rad].
_MOVED, _TURNED = 0.015, np.deg2rad(4.0)
# Largest factor between the baseline of a keyframe and the requested one.
_MAX_FACTOR = 2.5
# Least share of a grid of points, at the median depth in the present view, that a keyframe must show.
_OVERLAP = 0.5
# [3, 16] (u, v, 1) of a grid of points in an image of width and height 1.
_GRID = np.stack([*(np.indices((4, 4)).reshape(2, -1)[::-1] + 0.5) / 4, np.ones(16)])


class Keyframes(SavedState):
    """The last ``count`` keyframes: gray images and poses."""

    HELD: ClassVar = {"_pose": "pose", "_number": "number", "_added": "added"}

    def __init__(self, count: int) -> None:
        self._count = count
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._images([np.zeros((0, 0), np.uint8)] * self._count)
        self._pose = np.tile(np.eye(4), (self._count, 1, 1))
        self._number = np.full(self._count, -1)
        self._added = 0

    def _images(self, images: list[NDArray[np.uint8]]) -> None:
        """Store these images, which are never modified in place."""
        self._image = images
        self._half: dict[int, NDArray[np.uint8]] = {}  # of half the size, where they were needed
        self._saved = {f"image{i}": torch.from_numpy(image) for i, image in enumerate(images)}

    @property
    def number(self) -> int:
        """Number of stored frames."""
        return min(self._added, self._count)

    def add(self, image: NDArray[np.uint8], T_world_cam: NDArray[np.float64], depth: float, number: int) -> None:
        """Store a frame if the camera has moved or turned since the last keyframe.

        Args:
            image: [H, W], the same size for all.
            T_world_cam: [4, 4] [m].
            depth: median of the scene [m].
            number: index of the image, for :meth:`correct`.
        """
        if self._image[0].shape != image.shape:
            self._images([np.zeros(image.shape, np.uint8)] * self._count)
        if self._added:
            last = self._pose[(self._added - 1) % self._count]
            moved = np.linalg.norm(last[:3, 3] - T_world_cam[:3, 3])
            turned = np.arccos(np.clip((np.trace(last[:3, :3].T @ T_world_cam[:3, :3]) - 1) / 2, -1, 1))
            if moved < _MOVED * depth and turned < _TURNED:
                return
        slot = self._added % self._count
        self._image[slot] = image.copy()
        self._half.pop(slot, None)
        self._saved[f"image{slot}"] = torch.from_numpy(self._image[slot])
        self._pose[slot], self._number[slot] = T_world_cam, number
        self._added += 1

    def correct(self, number: NDArray[np.int64], T_world_cam: NDArray[np.float64]) -> None:
        """Replace the poses of stored images, by their indices [V], with [V, 4, 4]; negative indices are ignored."""
        slot, view = np.nonzero((self._number[:, None] == number) & (number >= 0))
        self._pose[slot] = T_world_cam[view]

    def choose(
        self, T_world_cam: NDArray[np.float64], K: NDArray[np.float64], depth: float, shares: tuple[float, ...]
    ) -> list[tuple[int, int]]:
        """Choose the keyframes to compare with a view, the shortest baseline first.

        Args:
            T_world_cam: [4, 4] of the view [m].
            K: [3, 3] [px].
            depth: median of the scene [m].
            shares: requested baselines as shares of ``depth``.

        Returns:
            Pairs (index of the share, keyframe), without repeated keyframes.
        """
        n = self.number
        if n == 0:
            return []
        pose = self._pose[:n]
        baseline = np.linalg.norm(pose[:, :3, 3] - T_world_cam[:3, 3], axis=1) / depth
        overlapping = self._overlap(pose, T_world_cam, K, depth) >= _OVERLAP
        age = (self._added - 1 - np.arange(n)) % self._count
        chosen: list[tuple[int, int]] = []
        for index, share in enumerate(shares):
            mismatch = np.abs(np.log(np.maximum(baseline, 1e-9) / share))
            mismatch = np.where(overlapping & (mismatch < np.log(_MAX_FACTOR)), mismatch + 0.002 * age, np.inf)
            mismatch[[keyframe for _, keyframe in chosen]] = np.inf
            best = int(mismatch.argmin())
            if np.isfinite(mismatch[best]):
                chosen.append((index, best))
        return sorted(chosen, key=lambda pair: baseline[pair[1]])

    def _overlap(
        self, pose: NDArray[np.float64], T: NDArray[np.float64], K: NDArray[np.float64], depth: float
    ) -> NDArray[np.float64]:
        """[n] share of a grid of points, at a depth in the camera T, that the views show."""
        height, width = self._image[0].shape
        rays = inverse_intrinsics(K) @ (_GRID * [[width], [height], [1]])
        K_R = K @ pose[:, :3, :3].transpose(0, 2, 1)
        moved = K_R @ (T[:3, 3] - pose[:, :3, 3])[..., None]
        point = K_R @ (depth * T[:3, :3] @ rays) + moved
        x, y, z = point[:, 0], point[:, 1], point[:, 2]
        inside = (z > 0.2 * depth) & (x > 0) & (y > 0) & (x < (width - 1) * z) & (y < (height - 1) * z)
        return np.asarray(inside.mean(1))

    def images(self, keyframes: NDArray[np.int64]) -> NDArray[np.uint8]:
        """[V, H, W] images of ``keyframes`` [V]."""
        return np.stack([self._image[keyframe] for keyframe in keyframes])

    def halves(self, keyframes: NDArray[np.int64]) -> NDArray[np.uint8]:
        """[V, H // 2, W // 2] images of ``keyframes`` [V] at half the size."""
        for keyframe in keyframes:
            if keyframe not in self._half:
                self._half[keyframe] = halved(self._image[keyframe])
        return np.stack([self._half[keyframe] for keyframe in keyframes])

    def poses(self, keyframes: NDArray[np.int64]) -> NDArray[np.float64]:
        """[V, 4, 4] camera-to-world poses of ``keyframes`` [V] [m]."""
        return self._pose[keyframes]

    def state(self) -> dict[str, Tensor]:
        """The state, for :meth:`load_state`. Images are shared and must not be written to."""
        return self._saved | super().state()

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of :meth:`state`; ValueError: another number of keyframes."""
        images = [saved_image(state, name) for name in self._saved]
        super().load_state(state)
        self._images(images)


def halved(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Average blocks of two by two pixels; an odd last row or column is dropped."""
    cv2 = opencv()
    height, width = image.shape[0] // 2, image.shape[1] // 2
    return np.asarray(cv2.resize(image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA))
