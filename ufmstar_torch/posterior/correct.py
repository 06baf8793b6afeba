"""The posterior of a frame, with the errors that anchors share, and its place in the state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.kernels.cpu.calls import array, each
from ufmstar_torch.posterior import conformal
from ufmstar_torch.posterior.running import restarted

if TYPE_CHECKING:
    from ufmstar_torch.posterior.update import Posterior


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
    learnt, posterior = update(packed, frame, anchors, claimed, config.posterior)
    posterior = widened(posterior, anchors, config.posterior.prior_sigma**2, config.variance_floor)
    intervals = conformal.after_frame(tensors["intervals"], posterior.scores)
    maps = {
        "depth": posterior.depth, "variance": posterior.variance,
        "posterior_outlier": posterior.outlier, "posterior_inlier_variance": posterior.inlier,
        "quantiles": conformal.quantiles(intervals),
    }  # fmt: skip
    counts = {"calibration": posterior.calibration, "unseen": posterior.unseen}
    return {"posterior": learnt, "intervals": intervals}, maps, counts


def widened(posterior: Posterior, anchors: Anchors | None, limit: float, floor: float) -> Posterior:
    """The posterior with variances of at least ``floor`` and the errors that all anchors of the frame share:
    :func:`common_error`, and where most anchors are off by a factor over 100, their mean squared error."""
    if posterior.depth.is_cpu:
        from ufmstar_torch.posterior.cells import widen

        columns: list[NDArray[Any]] = [np.zeros(len(posterior.depth))] * 3
        if anchors is not None:
            parts = (anchors.shared, anchors.scale, anchors.contradiction)
            columns = [none if x is None else array(x) for none, x in zip(columns, parts, strict=True)]
        maps = [array(x) for x in (posterior.depth, posterior.variance, posterior.inlier)]
        each(widen, [(*(x[b] for x in (*maps, *columns)), limit, floor) for b in range(len(maps[0]))])
        return posterior
    added = torch.zeros_like(posterior.variance)
    if anchors is not None:
        added = common_error(anchors, posterior.depth, limit)
        added = added + posterior.depth.square() * anchors.contradiction[:, None, None].to(added.dtype)
    variance, inlier = (v.clamp_min(floor) + added for v in (posterior.variance, posterior.inlier))
    return replace(posterior, variance=variance, inlier=inlier)


def common_error(anchors: Anchors, depth: Tensor, limit: float) -> Tensor:
    """Variance of the depth [B, H, W] from errors common to all anchors of the frame [m^2], which residuals do not
    show; at most ``limit`` times the squared depth."""
    zero = torch.zeros((), dtype=depth.dtype, device=depth.device)
    shared, scale = (zero if x is None else x[:, None, None].to(depth) for x in (anchors.shared, anchors.scale))
    return depth.square() * (depth.square() * shared + scale).clamp(0, limit)
