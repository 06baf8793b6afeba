"""Comparison of a video's first images with their poses and intrinsics (``pose_fit``), image by image.

Wrong axes, the inverse pose, a late trajectory and the intrinsics of another image make UfM*'s disagreement large
without an error. This comparison names them even where no anchors are used.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.landmarks import checked
from ufmstar_torch.anchors.pose_fit import UNCHANGED, Cameras, CornerTrack, FollowedCorners, pose_fit
from ufmstar_torch.anchors.streams import as_bytes
from ufmstar_torch.frames.warnings import LOGGER
from ufmstar_torch.kernels.cpu.check import camera_faults


class PoseCheck:
    """Compares the first images of a batch's first stream with their cameras, once after half of the images and once
    after all, and warns if another reading of the cameras (``pose_fit.Reading``) fits much better.

    Args:
        images: number of images to compare; 0 = none.
        rotation_tolerance: of the poses, as UfM*'s.

    Images with a faulty camera are left out; UfM* refuses or skips them, too. Images that are neither bytes nor floats
    in [0, 1] end the comparison, and so does OpenCV if it cannot be imported.
    """

    def __init__(self, images: int, rotation_tolerance: float) -> None:
        self._left, self._half, self._tolerance = images, images // 2, rotation_tolerance
        self.reset()

    def reset(self) -> None:
        """Drop the images so far, because another video begins. The number of images still to compare stays."""
        self._track: CornerTrack | None = None
        self._corners: list[FollowedCorners] = []
        self._cameras: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []

    def compare(self, image: Tensor, pose: Tensor, intrinsics: Tensor) -> None:
        """Add the next image [B, 3, H, W] with its pose [B, 4, 4] or [4, 4] and K [B, 3, 3] or [3, 3]."""
        if not self._left or image.is_meta:
            return
        T_first, K_first = (x.detach().reshape(-1, *x.shape[-2:])[:1].cpu().double() for x in (pose, intrinsics))
        if any(camera_faults(T_first.numpy(), K_first.numpy(), (torch.inf, torch.inf), self._tolerance)):
            return
        try:
            gray, T, K = checked(
                as_bytes(image[:1])[0].permute(1, 2, 0).cpu().numpy(), T_first[0].numpy(), K_first[0].numpy()
            )
        except (ImportError, ValueError):
            self._left = 0
            return
        self._cameras.append((T, K))
        index = len(self._cameras) - 1
        if self._track is None or not self._track.add(index, gray):
            self._end_track()
            self._track = CornerTrack(index, gray)
        self._left -= 1
        if self._left in (self._half, 0):
            self._judge(gray.shape[1])

    def _end_track(self) -> None:
        self._corners += [] if self._track is None else self._track.pairs

    def _judge(self, width: int) -> None:
        self._end_track()
        self._track = None
        T_world_cam, K = (np.stack(values) for values in zip(*self._cameras, strict=True))
        fit = pose_fit(Cameras(T_world_cam, K), width, self._corners)
        if fit is not None and fit.reading != UNCHANGED:
            LOGGER.warning("stream 0: %s", fit.problem)
            self._left = 0
        if not self._left:
            self.reset()
