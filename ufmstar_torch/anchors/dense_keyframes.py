"""Keyframes of a camera, a ring of fixed size: kept where the camera has moved, chosen by their baselines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.saved_state import SavedState, saved_image

# A frame becomes a keyframe where the camera has moved by this share of the median depth, or turned so far [rad].
_MOVED, _TURNED = 0.015, np.deg2rad(4.0)
# A baseline may be off from the one that is asked for by a factor of at most _OFF.
_OFF = 2.5
# A view must show at least this share of a grid of points that the present view has at the median depth.
_OVERLAP = 0.5


class Keyframes(SavedState):
    """The last ``count`` keyframes: images in gray, and poses."""

    HELD: ClassVar = {"_pose": "pose", "_number": "number", "_added": "added"}

    def __init__(self, count: int) -> None:
        self._count = count
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._image = [np.zeros((0, 0), np.uint8)] * self._count  # none is ever written to
        self._pose = np.tile(np.eye(4), (self._count, 1, 1))
        self._number = np.full(self._count, -1)
        self._added = 0

    @property
    def number(self) -> int:
        """Number of stored frames."""
        return min(self._added, self._count)

    def add(self, image: NDArray[np.uint8], T_world_cam: NDArray[np.float64], depth: float, number: int) -> None:
        """Keep a frame if the camera has moved or turned since the last one that was kept.

        Args:
            image: [H, W], of one size for all.
            T_world_cam: [4, 4] [m].
            depth: median of the scene [m].
            number: of the image, for :meth:`correct`.
        """
        if self._image[0].shape != image.shape:
            self._image = [np.zeros(image.shape, np.uint8)] * self._count
        if self._added:
            last = self._pose[(self._added - 1) % self._count]
            moved = np.linalg.norm(last[:3, 3] - T_world_cam[:3, 3])
            turned = np.arccos(np.clip((np.trace(last[:3, :3].T @ T_world_cam[:3, :3]) - 1) / 2, -1, 1))
            if moved < _MOVED * depth and turned < _TURNED:
                return
        slot = self._added % self._count
        self._image[slot], self._pose[slot], self._number[slot] = image.copy(), T_world_cam, number
        self._added += 1

    def correct(self, number: NDArray[np.int64], T_world_cam: NDArray[np.float64]) -> None:
        """Replace the poses of some images [V] by [V, 4, 4] where they are kept; negative numbers are none."""
        slot, which = np.nonzero((self._number[:, None] == number) & (number >= 0))
        self._pose[slot] = T_world_cam[which]

    def choose(
        self, T_world_cam: NDArray[np.float64], K: NDArray[np.float64], depth: float, shares: tuple[float, ...]
    ) -> list[tuple[int, int]]:
        """The keyframes to compare a view with, the shortest baseline first.

        Args:
            T_world_cam: [4, 4] of the view [m].
            K: [3, 3] [px].
            depth: median of the scene [m].
            shares: baselines that are wanted, as shares of ``depth``.

        Returns:
            (index of the share, keyframe), none twice.
        """
        n = self.number
        if n == 0:
            return []
        pose = self._pose[:n]
        baseline = np.linalg.norm(pose[:, :3, 3] - T_world_cam[:3, 3], axis=1) / depth
        seen = self._overlap(pose, T_world_cam, K, depth) >= _OVERLAP
        age = (self._added - 1 - np.arange(n)) % self._count
        chosen: list[tuple[int, int]] = []
        for index, share in enumerate(shares):
            off = np.abs(np.log(np.maximum(baseline, 1e-9) / share))
            off = np.where(seen & (off < np.log(_OFF)), off + 0.002 * age, np.inf)
            off[[keyframe for _, keyframe in chosen]] = np.inf
            best = int(off.argmin())
            if np.isfinite(off[best]):
                chosen.append((index, best))
        return sorted(chosen, key=lambda pair: baseline[pair[1]])

    def _overlap(
        self, pose: NDArray[np.float64], T: NDArray[np.float64], K: NDArray[np.float64], depth: float
    ) -> NDArray[np.float64]:
        """[n] share of a grid of points at a depth before the camera T that the views show."""
        height, width = self._image[0].shape
        v, u = (np.indices((4, 4)).reshape(2, -1) + 0.5) / 4
        rays = np.linalg.inv(K) @ np.stack([u * width, v * height, np.ones(16)])
        into = K @ pose[:, :3, :3].transpose(0, 2, 1)
        moved = into @ (T[:3, 3] - pose[:, :3, 3])[..., None]
        x, y, z = np.moveaxis(into @ (depth * T[:3, :3] @ rays) + moved, 1, 0)
        inside = (z > 0.2 * depth) & (x > 0) & (y > 0) & (x < (width - 1) * z) & (y < (height - 1) * z)
        return np.asarray(inside.mean(1))

    def images(self, keyframes: NDArray[np.int64]) -> NDArray[np.uint8]:
        """[V, H, W] of some."""
        return np.stack([self._image[keyframe] for keyframe in keyframes])

    def poses(self, keyframes: NDArray[np.int64]) -> NDArray[np.float64]:
        """[V, 4, 4] camera-to-world of some [m]."""
        return self._pose[keyframes]

    def state(self) -> dict[str, Tensor]:
        """All that is remembered, for :meth:`load_state`; the images are shared and must not be written to."""
        images = {f"image{i}": torch.from_numpy(image) for i, image in enumerate(self._image)}
        return images | super().state()

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue where :meth:`state` was taken; ValueError: another number of keyframes."""
        images = [saved_image(state, f"image{i}") for i in range(self._count)]
        super().load_state(state)
        self._image = images
