"""UfM*'s variance as what a variance head learns: computed in the loop, from the network's own depth on short clips.

A head that is trained on ground truth states how far the network errs on the training data. One that is trained on
UfM* states how far the network's predictions disagree between views: it needs no ground truth for the variance, and one
image at the end. UfM* gets the depth alone, without the head's own variance, and no gradient goes through it.
"""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.models.distribution import GaussianDepth
from ufmstar_torch.train.losses import depth_l1
from ufmstar_torch.ufmstar import UfMStar

# Share of M that rests on surfaces seen from two views or more, from which on a pixel is learnt from; as
# ``config.unmeasured`` has it.
_MEASURED = 0.5
# [m^2] Least variance that is learnt, (1 mm)^2: where views agree exactly, V is 0, which has no logarithm.
_LEAST = 1e-6


class Teacher:
    """UfM* on the clips of ``clip`` frames of a batch; each step begins without a memory. ``max_depth`` [m]: the
    largest depth that the network can predict; None = not known."""

    def __init__(self, clip: int, max_depth: float | None = None) -> None:
        self._clip = clip
        self._ufm = UfMStar(UfMStarConfig(on_bad_frame="skip", unmeasured="paper").within(max_depth))

    def __call__(self, depth: Tensor, T_world_cam: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
        """V of every frame, from it and the frames of its clip before it.

        Args:
            depth: [N, H, W] of N / clip clips, one behind the other [m].
            T_world_cam: [N, 4, 4] float64 [m]; a frame whose pose is NaN is left out.
            intrinsics: [N, 3, 3] float64 of the depth map [px].

        Returns:
            V [N, H, W] [m^2], at least (1 mm)^2, and where it may be learnt from [N, H, W] bool: not in the first
            frame of a clip, whose views have nothing to compare with.
        """
        maps, poses, K = (x.detach().unflatten(0, (-1, self._clip)) for x in (depth.float(), T_world_cam, intrinsics))
        if self._ufm.mean.device != depth.device:
            self._ufm.to(depth.device)
        self._ufm.reset()
        with warnings.catch_warnings():
            # A network that has just begun to learn may predict nothing that has a segment.
            warnings.filterwarnings("ignore", message="stream .* a frame has no segment")
            out = [self._ufm(maps[:, t], poses[:, t], K[:, t]) for t in range(self._clip)]
        variance = torch.stack([one.variance for one in out], 1).flatten(0, 1)
        measured = torch.stack([one.measured for one in out], 1).flatten(0, 1)
        return variance.clamp_min(_LEAST), (measured >= _MEASURED) & variance.isfinite()


def distillation_sums(
    distribution: GaussianDepth, target: Tensor, valid: Tensor, variance: Tensor, measured: Tensor
) -> tuple[Tensor, Tensor]:
    """The sum of the loss over pixels and their number (int64), as ``losses.loss_sums``.

    Each pixel counts |error| [m] of the depth where there is ground truth, and (s - log V)^2 / 2 where UfM* has
    measured V.
    The likelihood of an error of variance V would be the alternative; V spans many orders of magnitude, and a few large
    values would decide its mean.

    Args:
        distribution: of the network, [N, H, W].
        target: [N, H, W] ground truth [m].
        valid: [N, H, W] bool, where there is some.
        variance: [N, H, W] V [m^2].
        measured: [N, H, W] bool, where it may be learnt from.
    """
    with_truth = valid & target.isfinite() & (target > 0)
    depth = torch.where(with_truth, distribution.depth.float(), 1.0)
    s = torch.where(measured, distribution.log_variance.float(), 0.0)
    off = torch.where(with_truth, depth_l1(depth, torch.where(with_truth, target, 1.0)), 0.0)
    spread = 0.5 * (s - torch.where(measured, variance, 1.0).log()).square()
    return (off + torch.where(measured, spread, 0.0)).sum(), (with_truth | measured).sum()
