"""UfM, the pointwise predecessor of UfM*, as a baseline.

Sudhakar, Karaman, Sze, "Uncertainty from Motion for DNN Monocular Depth Estimation" (ICRA 2022). UfM* stores a few
hundred Gaussians; UfM stores every observed pixel as a point of 40 bytes (float32): 4.0 MB with the authors' limit of
100,000 points at 224 x 224. ``ufm_cloud`` has the equations and the deliberate differences.

The paper's modes differ only in the network's prediction. "Aleatoric": depth and A. "Ensemble" and "MC-dropout":
alternating members, or one stochastic pass. "Depth only": no variance, s^2 = 0. "Full": mean depth, A and E of several
inferences.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.methods.ufm_cloud import Cloud, View, take_in
from ufmstar_torch.frames.frame import check_frame, raise_faults
from ufmstar_torch.frames.output import EVERY_FRAME, FrameStatistics, UncertaintyOutput
from ufmstar_torch.gaussians.camera import relative_pose
from ufmstar_torch.runtime.stateful import undisturbed


def output_of(depth: Tensor, variance: Tensor | None, valid: Tensor, **maps: Tensor | None) -> UncertaintyOutput:
    """The output of a method other than UfM*, from maps [1, h, w]: NaN where not valid; all counts but that of the
    valid pixels are 0. ``variance``: None = the method states none."""
    variance = torch.full_like(depth, torch.nan) if variance is None else variance
    none = torch.zeros(len(depth), dtype=torch.int64)
    counts = dict.fromkeys(EVERY_FRAME, none)
    statistics = FrameStatistics({**counts, "valid_pixels": valid.sum((1, 2)).cpu()})
    named = {name: value for name, value in maps.items() if value is not None}
    return UncertaintyOutput(depth, torch.where(valid, variance, torch.nan), valid, named, statistics)


class UfM:
    """Uncertainty from Motion: a variance per pixel from one predicted depth map per image, for B streams at once.

    A frame that raises an error leaves the state unchanged. There are no gradients.

    Args:
        max_points: largest number of points of a stream; the paper's 100,000 at 224 x 224, 300,000 at 518 x 518. None =
            no limit. With fewer than an image has pixels, points are dropped before they are observed again.
        dtype: of the points and of the computation, torch.float32 or torch.float64.

    Attributes:
        clouds: the points of each stream, in the frame of its first camera; empty before the first frame.
        T_world_first: [B, 4, 4] float64 camera-to-world of the first camera [m].
    """

    def __init__(self, max_points: int | None = 100_000, *, dtype: torch.dtype = torch.float32) -> None:
        if max_points is not None and max_points < 1:
            raise ValueError(f"max_points must be None or at least 1, got {max_points}")
        self.max_points, self._dtype = max_points, dtype
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.clouds: tuple[Cloud, ...] = ()
        self.T_world_first = torch.zeros(0, 4, 4, dtype=torch.float64)

    def __call__(
        self,
        depth: Tensor,
        pose: Tensor,
        intrinsics: Tensor,
        aleatoric: Tensor | None = None,
        epistemic: Tensor | None = None,
        valid: Tensor | None = None,
    ) -> UncertaintyOutput:
        """Process one predicted depth map of each stream. The variance is S_zz of the newest point at a pixel; without
        a point it is s^2.

        Args:
            depth: [B, H, W] metric depth along the optical axis [m]. Pixels that are NaN, infinite, zero or negative
                are ignored.
            pose: [B, 4, 4] or [4, 4] camera-to-world (T_world_cam) [m].
            intrinsics: [B, 3, 3] or [3, 3] in pixels of this depth map, first pixel's centre at (0, 0).
            aleatoric: like ``depth``, the network's variance A [m^2]; pixels where it is not a finite number >= 0 are
                ignored.
            epistemic: likewise E [m^2].
            valid: like ``depth``, bool, True = use.

        Raises:
            TypeError: wrong kind of argument or dtype.
            ValueError: wrong shape, another number of streams than before, a pose that is not rigid, or bad intrinsics.
        """
        frame = check_frame(
            depth, pose, intrinsics, aleatoric, epistemic, valid,
            rotation_tolerance=UfMStarConfig.rotation_tolerance,
        )  # fmt: skip
        if self.clouds and len(frame.depth) != len(self.clouds):
            raise ValueError(f"depth must be of {len(self.clouds)} streams as before, got {tuple(depth.shape)}")
        raise_faults(frame)
        with undisturbed(frame.depth):
            first = self.T_world_first if self.clouds else frame.T_world_cam
            clouds = self.clouds or [Cloud.empty(self._dtype, frame.depth.device)] * len(frame.depth)
            stated = [value.detach() for value in (frame.aleatoric, frame.epistemic) if value is not None]
            s2 = sum(stated, start=torch.zeros_like(frame.depth))
            views = map(View, frame.depth, s2, frame.valid, frame.intrinsics, *relative_pose(frame.T_world_cam, first))
            steps = [take_in(cloud, view, self.max_points) for cloud, view in zip(clouds, views, strict=True)]
            variance = torch.stack([variance for _, variance in steps]).to(frame.depth.dtype)
        self.clouds, self.T_world_first = tuple(cloud for cloud, _ in steps), first
        return output_of(depth, variance, frame.valid, aleatoric=aleatoric, epistemic=epistemic)
