"""The posterior of a frame, with the errors that anchors share, and its place in the state."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.frame import AnchorInput, FrameInput
from ufmstar_torch.posterior import conformal
from ufmstar_torch.posterior.running import restarted


def correct(
    tensors: Mapping[str, Tensor], frame: FrameInput, claimed: Tensor, config: UfMStarConfig
) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Tensor]]:
    """Learn from a frame's anchors, and correct the depth (on the CPU, :mod:`ufmstar_torch.posterior.update`).

    Args:
        tensors: of the state, with the posterior's memory of the frames before.
        frame: with anchors or None.
        claimed: [B, H, W] V of UfM* without B [m^2], NaN where not valid.
        config: with ``posterior``.

    Returns:
        The memory after the frame by its names in the state; the maps [B, H, W] by name (``output.MAPS``)
        and the "quantiles" [B, 3]; and the counts.
    """
    from ufmstar_torch.posterior.update import update  # kernels compile when they are first needed

    assert config.posterior is not None
    anchors, packed = frame.anchors, tensors["posterior"]
    if anchors is not None and anchors.shared is not None:  # wrong poses, for an unknown time
        start = restarted(packed, config.posterior)
        packed = torch.where(anchors.shared.isinf()[:, None], start, packed)
    learnt, posterior = update(packed, frame, anchors, claimed, config.posterior)
    added = torch.zeros_like(posterior.variance)
    if anchors is not None and anchors.contradiction is not None:  # most anchors are off by a factor over 100
        added = posterior.depth.square() * anchors.contradiction[:, None, None].to(added.dtype)
    if anchors is not None:
        added = added + common_error(anchors, posterior.depth, config.posterior.prior_sigma**2)
    variance, inlier = (v.clamp_min(config.variance_floor) + added for v in (posterior.variance, posterior.inlier))
    intervals = conformal.after_frame(tensors["intervals"], posterior.scores)
    maps = {
        "depth": posterior.depth, "variance": variance,
        "posterior_outlier": posterior.outlier, "posterior_inlier_variance": inlier,
        "quantiles": conformal.quantiles(intervals),
    }  # fmt: skip
    counts = {"calibration": posterior.calibration, "unseen": posterior.unseen}
    return {"posterior": learnt, "intervals": intervals}, maps, counts


def common_error(anchors: AnchorInput, depth: Tensor, limit: float) -> Tensor:
    """Variance of the depth [B, H, W] from errors common to all anchors of the frame [m^2], which residuals do not
    show; at most ``limit`` times the squared depth."""
    zero = torch.zeros((), dtype=depth.dtype, device=depth.device)
    shared, scale = (zero if x is None else x[:, None, None].to(depth) for x in (anchors.shared, anchors.scale))
    return depth.square() * (depth.square() * shared + scale).clamp(0, limit)
