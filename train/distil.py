"""Distillation of UfM*'s variance, computed during training from the network's depth on short clips, into a head.

A head trained on ground truth predicts the network's error on the training data. A head trained on UfM* predicts the
disagreement of the network's predictions between views: it needs no ground truth for the variance, and one image at
inference. UfM* receives the depth without the head's variance, and without gradients.
"""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.models.distribution import GaussianDepth
from ufmstar_torch.train.losses import depth_l1
from ufmstar_torch.ufmstar import UfMStar

# Least share of M on surfaces seen from two or more views for which V of a pixel is a target (``unmeasured.HALF``).
_MEASURED = 0.5
# [m^2] Least target variance, (1 mm)^2: where views agree exactly, V is 0, which has no logarithm.
_LEAST = 1e-6


class Teacher:
    """UfM* on the clips of ``clip`` frames of a batch, reset at each step. ``max_depth`` [m]: the largest depth that
    the network can predict; None = unknown."""

    def __init__(self, clip: int, max_depth: float | None = None) -> None:
        self._clip = clip
        self._ufm = UfMStar(UfMStarConfig(on_bad_frame="skip", unmeasured="paper").within(max_depth))

    def __call__(self, depth: Tensor, T_world_cam: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
        """V of every frame, from it and the previous frames of its clip.

        Args:
            depth: [N, H, W] of N / clip clips, one after the other [m].
            T_world_cam: [N, 4, 4] float64 [m]; a frame whose pose is NaN is skipped.
            intrinsics: [N, 3, 3] float64 of the depth map [px].

        Returns:
            V [N, H, W] [m^2], at least (1 mm)^2, and [N, H, W] bool, True where it is a target: never in the first
            frame of a clip, which is not compared with another.
        """
        maps, poses, K = (x.detach().unflatten(0, (-1, self._clip)) for x in (depth.float(), T_world_cam, intrinsics))
        if self._ufm.mean.device != depth.device:
            self._ufm.to(depth.device)
        self._ufm.reset()
        with warnings.catch_warnings():
            # The depth of an untrained network may have no segment.
            warnings.filterwarnings("ignore", message="stream .* a frame has no segment")
            out = [self._ufm(maps[:, t], poses[:, t], K[:, t]) for t in range(self._clip)]
        variance = torch.stack([one.variance for one in out], 1).flatten(0, 1)
        measured = torch.stack([one.measured for one in out], 1).flatten(0, 1)
        return variance.clamp_min(_LEAST), (measured >= _MEASURED) & variance.isfinite()


def distillation_sums(
    distribution: GaussianDepth, target: Tensor, valid: Tensor, variance: Tensor, measured: Tensor
) -> tuple[Tensor, Tensor]:
    """The sum of the loss over pixels and their number (int64), as ``losses.loss_sums``.

    The loss of a pixel is |error| [m] of the depth where there is ground truth, plus (s - log V)^2 / 2 where UfM* has
    measured V. The likelihood of an error of variance V is not used: V spans many orders of magnitude, and a few large
    values would dominate its mean.

    Args:
        distribution: of the network, [N, H, W].
        target: [N, H, W] ground truth [m].
        valid: [N, H, W] bool, True = has ground truth.
        variance: [N, H, W] V [m^2].
        measured: [N, H, W] bool, True where V is a target.
    """
    with_truth = valid & target.isfinite() & (target > 0)
    depth = torch.where(with_truth, distribution.depth.float(), 1.0)
    s = torch.where(measured, distribution.log_variance.float(), 0.0)
    error = torch.where(with_truth, depth_l1(depth, torch.where(with_truth, target, 1.0)), 0.0)
    spread = 0.5 * (s - torch.where(measured, variance, 1.0).log()).square()
    return (error + torch.where(measured, spread, 0.0)).sum(), (with_truth | measured).sum()
