"""The posterior as an extension of UfM* (``ufmstar_torch.extension``), which follows the one of anchors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from ufmstar_torch.anchors.anchors import AnchorInput
from ufmstar_torch.anchors.extension import AnchorFrame
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.extension import Extension, FrameExtension, Tensors, Total
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.output import StepOutput
from ufmstar_torch.posterior.running import SIZE, Running, restarted
from ufmstar_torch.posterior.update import Posterior, PosteriorUpdate
from ufmstar_torch.state import UfMStarState


class PosteriorFrame(FrameExtension):
    """The posterior of one frame.

    Args:
        of_anchors: the anchors during the same frame.
        config: with ``posterior``.
        update: an implementation of :func:`ufmstar_torch.posterior.update.update`.
    """

    def __init__(self, of_anchors: AnchorFrame, config: UfMStarConfig, update: PosteriorUpdate) -> None:
        self._anchors, self._config, self._update = of_anchors, config, update
        self._posterior: Posterior | None = None

    def after_frame(self, state: UfMStarState, out: StepOutput, total: Total) -> tuple[UfMStarState, StepOutput]:
        """Learn from the frame's anchors, and correct the depth."""
        assert self._config.posterior is not None
        claimed = total(out.disagreement).detach()
        frame, anchors, packed = self._anchors.frame, self._anchors.anchors, state.by_stream["posterior"]
        if anchors is not None and anchors.shared is not None:  # the poses contradict the images, for an unknown time
            start = restarted(packed, self._config.posterior)
            packed = torch.where(anchors.shared.isinf()[:, None], start, packed)
        learnt, posterior = self._update(packed, frame, anchors, claimed, self._config.posterior)
        more = torch.zeros_like(posterior.variance)
        if anchors is not None and anchors.contradiction is not None:  # most are off by more than a factor of 100
            more = posterior.depth.square() * anchors.contradiction[:, None, None].to(more.dtype)
        if anchors is not None:
            more = more + common_error(anchors, posterior.depth, self._config.posterior.prior_sigma**2)
        floor = self._config.variance_floor
        variance, inlier = (v.clamp_min(floor) + more for v in (posterior.variance, posterior.inlier))
        self._posterior = replace(posterior, variance=variance, inlier=inlier)
        statistics = replace(out.statistics, calibration=posterior.calibration, unseen=posterior.unseen)
        return state.with_tensors({"posterior": learnt}), replace(out, statistics=statistics)

    def outputs(self) -> dict[str, Tensor]:
        """The corrected depth, its variance, the probability of another surface, and the variance on its own."""
        assert self._posterior is not None
        p = self._posterior
        return {
            "posterior_depth": p.depth, "posterior_variance": p.variance,
            "posterior_outlier": p.outlier, "posterior_inlier_variance": p.inlier,
        }  # fmt: skip


def common_error(anchors: AnchorInput, depth: Tensor, most: float) -> Tensor:
    """Variance of the depth [B, H, W] by the errors that all anchors of the frame have in common [m^2], which no anchor
    shows beside the others; at most ``most`` of the squared depth."""
    none = torch.zeros((), dtype=depth.dtype, device=depth.device)
    shared, scale = (none if x is None else x[:, None, None].to(depth) for x in (anchors.shared, anchors.scale))
    return depth.square() * (depth.square() * shared + scale).clamp(0, most)


class PosteriorExtension(Extension):
    """p(depth | network, UfM*, anchors).

    Args:
        config: with ``posterior`` and ``anchors``.
        update: makes the implementation for a backend and a device's type.
    """

    always_float64: ClassVar[tuple[str, ...]] = ("posterior",)

    def __init__(self, config: UfMStarConfig, update: Callable[[str, str], PosteriorUpdate]) -> None:
        self._config, self._update = config, update

    def by_stream(self, streams: int, dtype: torch.dtype, device: torch.device | str) -> dict[str, Tensor]:
        """``posterior`` [B, S] float64, what was learnt of the stream (``posterior.running``)."""
        return {"posterior": torch.zeros(streams, SIZE, dtype=torch.float64, device=device)}

    def require_state(self, state: Tensors) -> None:
        """See :meth:`Extension.require_state`."""
        assert self._config.posterior is not None
        packed = state["posterior"]
        started = torch.cat([packed[:, :1].clamp_min(1), packed[:, 1:]], 1)  # what is stored, not the start
        Running.of(torch.where(packed.any(1, keepdim=True), started, packed), self._config.posterior).require()

    def of_frame(
        self,
        frame: FrameInput,
        network_variances: Sequence[Tensor],
        argument: Any,
        before: Sequence[FrameExtension],
        *,
        dense: bool,
    ) -> FrameExtension:
        """It needs whole maps: with a subset of pixels it does nothing."""
        of_anchors = [one for one in before if isinstance(one, AnchorFrame)]
        if not dense or not of_anchors:
            return FrameExtension()
        update = self._update(self._config.backend, frame.depth.device.type)
        return PosteriorFrame(of_anchors[0], self._config, update)
