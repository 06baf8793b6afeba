"""The posterior of a frame, with the errors that anchors share, and its place in the state."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.frame import FrameInput
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
    wrong = None if anchors is None or anchors.shared is None else anchors.shared.isinf()
    if wrong is not None and not (wrong.is_cpu and not wrong.any()):  # wrong poses, for an unknown time
        packed = torch.where(wrong[:, None], restarted(packed, config.posterior), packed)
    learnt, posterior = update(packed, frame, anchors, claimed, config.posterior, config.variance_floor)
    intervals = conformal.after_frame(tensors["intervals"], posterior.scores)
    maps = {
        "depth": posterior.depth, "variance": posterior.variance,
        "posterior_outlier": posterior.outlier, "posterior_inlier_variance": posterior.inlier,
        "quantiles": conformal.quantiles(intervals),
    }  # fmt: skip
    counts = {"calibration": posterior.calibration, "unseen": posterior.unseen}
    return {"posterior": learnt, "intervals": intervals}, maps, counts
