"""Anchors as an extension of UfM* (``ufmstar_torch.frames.extension``): columns of step 5's regression, and the term B.

Before the regression, a frame's anchors are added to the evidence. The regression of H also regresses the mean r and e
of the components less the stream's. The stream's means are added at every pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.anchors.anchors import AnchorInput, check_anchors
from ufmstar_torch.anchors.doubts import AnchorDoubts
from ufmstar_torch.anchors.evidence import SUMS, Evidence, inliers, means, observe
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.extension import Columns, Distribute, Extension, FrameExtension, Tensors, Total
from ufmstar_torch.frames.frame import LARGEST, FrameInput
from ufmstar_torch.frames.output import StepOutput
from ufmstar_torch.gaussians.camera import unproject_at
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.gaussians.state import UfMStarState


@dataclass(frozen=True)
class Learnt:
    """The evidence after a frame's anchors.

    Attributes:
        evidence: including this frame.
        used: [B] number of used anchors.
        beyond: [B, K, 2] mean r and e of the components less the stream's (``evidence.means``).
        stream: [B, 2] the stream's.
    """

    evidence: Evidence
    used: Tensor
    beyond: Tensor
    stream: Tensor


def learn(
    evidence: Evidence,
    mixture_cam: GaussianMixture,
    frame: FrameInput,
    anchors: AnchorInput | None,
    config: UfMStarConfig,
    distribute: Distribute,
    supported: Callable[[AnchorInput], Tensor] = inliers,
) -> Learnt:
    """Add a frame's anchors to the evidence.

    Args:
        evidence: of the frames before.
        mixture_cam: M_i in the camera frame, [B, K].
        frame: of the same B streams.
        anchors: of this frame, or None.
        config: of UfM*.
        distribute: sums values at points by component (:func:`ufmstar_torch.steps.regress.distribute`).
        supported: masks the anchors that their neighbours support (``evidence.inliers``).
    """
    assert config.anchors is not None
    used = torch.zeros_like(frame.fault)
    if anchors is not None:
        points = unproject_at(anchors.predicted, anchors.index, frame.size[1], frame.intrinsics)

        def by_component(rows: Tensor) -> Tensor:
            return distribute(mixture_cam, points, rows, config)

        memory = 0.5 ** (1 / config.anchors.half_life)
        # A faulty frame's anchors are not valid.
        evidence, mask = observe(evidence, anchors, by_component, memory, supported)
        used = mask.sum(1)
    return Learnt(evidence, used, *means(evidence, config.anchors.shrinkage))


def anchored_term(depth: Tensor, excess: Tensor, disagreement: Tensor) -> tuple[Tensor, Tensor]:
    """B = max(0, d^2 e - M) [m^2], the mean square error that anchors show beyond M, and M + B; NaN where M is NaN.

    Args:
        depth: d, any shape [m].
        excess: e, same shape, the relative mean square error that the network does not predict (``evidence``).
        disagreement: M, same shape [m^2].
    """
    term = depth.square().mul_(excess).sub_(disagreement).clamp_min_(0)
    return term, disagreement + term


@dataclass(frozen=True)
class AnchorKernels:
    """The implementations of the replaceable parts.

    Attributes:
        supported: see ``evidence.inliers``.
        learn_in_view: :func:`learn` with the compiled step's components in view, to which it adds the columns
            (``anchors.kernels.learn.learn_in_view``); None = use :func:`learn`.
    """

    supported: Callable[[AnchorInput], Tensor]
    learn_in_view: Callable[..., Learnt] | None


REFERENCE = AnchorKernels(inliers, None)


class AnchorFrame(FrameExtension):
    """The anchors of one frame.

    Args:
        frame: of B streams.
        anchors: of the frame, checked, or None.
        config: with ``anchors``.
        kernels: implementation of each part.
        warn: called after a frame with anchors.

    Attributes:
        frame, anchors: as above.
    """

    columns = 2  # mean r and mean e

    def __init__(
        self, frame: FrameInput, anchors: AnchorInput | None, config: UfMStarConfig, kernels: AnchorKernels,
        warn: Callable[[], object] = lambda: None,
    ) -> None:  # fmt: skip
        self.frame, self.anchors, self._warn = frame, anchors, warn
        self._config, self._kernels = config, kernels
        self._used = self._residual = self._term = torch.empty(0)

    def before_regression(self, tensors: Tensors, mixture_cam: GaussianMixture, distribute: Distribute) -> Columns:
        """Add the frame's anchors to the evidence."""
        evidence = _evidence(tensors).padded(mixture_cam.capacity)
        arguments = evidence, mixture_cam, self.frame, self.anchors, self._config
        return self._columns(learn(*arguments, distribute, self._kernels.supported))

    def in_view(self, tensors: Tensors, capacity: int, seen: Any, views: Any) -> Columns | None:
        """Add the frame's anchors to the evidence, in the compiled step."""
        if self._kernels.learn_in_view is None:
            return None
        arguments = _evidence(tensors), capacity, seen, views, self.frame, self.anchors, self._config
        return self._columns(self._kernels.learn_in_view(*arguments))

    def _columns(self, learnt: Learnt) -> Columns:
        self._used = learnt.used
        tensors = {"evidence": learnt.evidence.component, "overall_evidence": learnt.evidence.overall}
        return Columns(learnt.beyond, learnt.stream, tensors)

    def after_regression(self, values: Tensor) -> None:
        """Store the expected residual [..., 2] of each pixel, mean r and mean e."""
        self._residual = values

    def after_frame(self, state: UfMStarState, out: StepOutput, total: Total) -> tuple[UfMStarState, StepOutput]:
        """Count the anchors, those that were used and those that were rejected."""
        none, anchors = torch.zeros_like(self._used), self.anchors
        count, rejected = (none, none) if anchors is None else (anchors.valid.sum(1), anchors.rejected)
        moving = none if anchors is None or anchors.moving is None else anchors.moving
        measured = out.statistics.pose_error
        if anchors is not None:
            self._warn()
            measured = anchors.pose_error
        counts = replace(
            out.statistics, anchors=count, anchors_used=self._used, anchors_rejected=rejected, anchors_moving=moving,
            pose_error=measured,
        )  # fmt: skip
        return state, replace(out, statistics=counts)

    def disagreement(self, disagreement: Tensor, depth: Tensor) -> Tensor:
        """M + B [m^2]; where most anchors were rejected, B is at least d^2 times the mean of their r^2."""
        self._term, both = anchored_term(depth, self._residual[..., 1], disagreement)
        if self.anchors is None or self.anchors.contradiction is None:
            return both
        least = self.anchors.contradiction.view(-1, *[1] * (depth.dim() - 1)).to(depth.dtype) * depth.square()
        self._term = torch.maximum(self._term, least)
        return torch.maximum(both, disagreement + least)

    def outputs(self) -> dict[str, Tensor]:
        """B and r."""
        return {"anchored": self._term, "bias": self._residual[..., 0]}


class AnchorExtension(Extension):
    """Measures the network's error at anchors.

    Args:
        config: with ``anchors``.
        kernels: returns the kernels for a backend and a device type.
    """

    argument = "anchors"

    def __init__(self, config: UfMStarConfig, kernels: Callable[[str, str], AnchorKernels]) -> None:
        self._config, self._kernels = config, kernels
        self._doubts = AnchorDoubts()

    def by_component(
        self, streams: int, slots: int, dtype: torch.dtype, device: torch.device | str
    ) -> dict[str, Tensor]:
        """``evidence`` [B, K, 3], sums over anchors."""
        return {"evidence": torch.zeros(streams, slots, SUMS, dtype=dtype, device=device)}

    def by_stream(self, streams: int, dtype: torch.dtype, device: torch.device | str) -> dict[str, Tensor]:
        """``overall_evidence`` [B, 3], sums over anchors of the stream."""
        return {"overall_evidence": torch.zeros(streams, SUMS, dtype=dtype, device=device)}

    def require_state(self, state: Tensors) -> None:
        """See :meth:`Extension.require_state`."""
        for name in ("evidence", "overall_evidence"):
            if bool((state[name][..., 0] < 0).any()) or bool((state[name].abs() > LARGEST).any()):
                raise ValueError(f"{name} holds negative weights or values beyond {LARGEST:g}")

    def of_frame(
        self,
        frame: FrameInput,
        network_variances: Sequence[Tensor],
        argument: Any,
        before: Sequence[FrameExtension],
        *,
        dense: bool,
    ) -> AnchorFrame:
        """Check the frame's anchors.

        Raises:
            TypeError, ValueError: as :func:`check_anchors`.
        """
        kernels = self._kernels(self._config.backend, frame.depth.device.type)
        if argument is None:
            return AnchorFrame(frame, None, self._config, kernels)
        anchors = check_anchors(argument, frame, network_variances)
        return AnchorFrame(
            frame, anchors, self._config, kernels, partial(self._doubts.judge, argument, anchors, frame.size)
        )


def _evidence(tensors: Tensors) -> Evidence:
    return Evidence(tensors["evidence"], tensors["overall_evidence"])
