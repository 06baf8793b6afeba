"""The posterior as an extension of UfM* (``ufmstar_torch.frames.extension``). It runs after the anchors' extension."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from ufmstar_torch.anchors.anchors import AnchorInput
from ufmstar_torch.anchors.extension import AnchorFrame
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.extension import Extension, FrameExtension, Tensors, Total
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.frames.output import StepOutput
from ufmstar_torch.gaussians.state import UfMStarState
from ufmstar_torch.posterior import conformal
from ufmstar_torch.posterior.running import SIZE, require, restarted

if TYPE_CHECKING:
    from ufmstar_torch.posterior.update import Posterior


class PosteriorFrame(FrameExtension):
    """The posterior of one frame.

    Args:
        anchor_frame: the anchors' extension in the same frame.
        config: with ``posterior``.
    """

    def __init__(self, anchor_frame: AnchorFrame, config: UfMStarConfig) -> None:
        self._anchors, self._config = anchor_frame, config
        self._posterior: Posterior | None = None
        self._intervals = torch.zeros(0, conformal.SIZE)

    def after_frame(self, state: UfMStarState, out: StepOutput, total: Total) -> tuple[UfMStarState, StepOutput]:
        """Learn from the frame's anchors, and correct the depth (on the CPU, :mod:`ufmstar_torch.posterior.update`)."""
        from ufmstar_torch.posterior.update import update  # kernels compile when they are first needed

        assert self._config.posterior is not None
        claimed = total(out.disagreement).detach()
        frame, anchors, packed = self._anchors.frame, self._anchors.anchors, state.by_stream["posterior"]
        if anchors is not None and anchors.shared is not None:  # wrong poses, for an unknown time
            start = restarted(packed, self._config.posterior)
            packed = torch.where(anchors.shared.isinf()[:, None], start, packed)
        learnt, posterior = update(packed, frame, anchors, claimed, self._config.posterior)
        added = torch.zeros_like(posterior.variance)
        if anchors is not None and anchors.contradiction is not None:  # most anchors are off by a factor over 100
            added = posterior.depth.square() * anchors.contradiction[:, None, None].to(added.dtype)
        if anchors is not None:
            added = added + common_error(anchors, posterior.depth, self._config.posterior.prior_sigma**2)
        floor = self._config.variance_floor
        variance, inlier = (v.clamp_min(floor) + added for v in (posterior.variance, posterior.inlier))
        self._posterior = replace(posterior, variance=variance, inlier=inlier)
        self._intervals = conformal.after_frame(state.by_stream["intervals"], posterior.scores)
        statistics = replace(out.statistics, calibration=posterior.calibration, unseen=posterior.unseen)
        tensors = {"posterior": learnt, "intervals": self._intervals}
        return state.with_tensors(tensors), replace(out, statistics=statistics)

    def outputs(self) -> dict[str, Tensor]:
        """Corrected depth, its variance, the probability of another surface, the variance without that case, and the
        quantiles of intervals [B, 3]."""
        assert self._posterior is not None
        p = self._posterior
        return {
            "posterior_depth": p.depth, "posterior_variance": p.variance,
            "posterior_outlier": p.outlier, "posterior_inlier_variance": p.inlier,
            "quantiles": conformal.quantiles(self._intervals),
        }  # fmt: skip


def common_error(anchors: AnchorInput, depth: Tensor, limit: float) -> Tensor:
    """Variance of the depth [B, H, W] from errors common to all anchors of the frame [m^2], which residuals do not
    show; at most ``limit`` times the squared depth."""
    zero = torch.zeros((), dtype=depth.dtype, device=depth.device)
    shared, scale = (zero if x is None else x[:, None, None].to(depth) for x in (anchors.shared, anchors.scale))
    return depth.square() * (depth.square() * shared + scale).clamp(0, limit)


class PosteriorExtension(Extension):
    """p(depth | network, UfM*, anchors).

    Args:
        config: with ``posterior`` and ``anchors``.
    """

    always_float64: ClassVar[tuple[str, ...]] = ("posterior", "intervals")

    def __init__(self, config: UfMStarConfig) -> None:
        self._config = config

    def by_stream(self, streams: int, dtype: torch.dtype, device: torch.device | str) -> dict[str, Tensor]:
        """float64: ``posterior`` [B, S], the memory of each stream (``posterior.running``), and ``intervals`` [B, 4]
        (``posterior.conformal``)."""
        sizes = {"posterior": SIZE, "intervals": conformal.SIZE}
        return {n: torch.zeros(streams, size, dtype=torch.float64, device=device) for n, size in sizes.items()}

    def require_state(self, state: Tensors) -> None:
        """See :meth:`Extension.require_state`."""
        require(state["posterior"])
        conformal.require(state["intervals"])

    def of_frame(
        self,
        frame: FrameInput,
        network_variances: Sequence[Tensor],
        argument: Any,
        before: Sequence[FrameExtension],
        *,
        dense: bool,
    ) -> FrameExtension:
        """The posterior needs dense maps and anchors; the frame extension has no effect without them."""
        anchor_frames = [extension for extension in before if isinstance(extension, AnchorFrame)]
        if not dense or not anchor_frames:
            return FrameExtension()
        return PosteriorFrame(anchor_frames[0], self._config)
