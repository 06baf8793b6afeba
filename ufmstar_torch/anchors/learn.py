"""Update of the evidence by a frame's anchors, the columns of step 5's regression, and the term B.

Before the regression, a frame's anchors are added to the evidence. The regression of H also regresses the mean r and e
of the components less the stream's. The stream's means are added at every pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.anchors.evidence import Evidence, inliers, means, observe
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.gaussians.camera import unproject_at
from ufmstar_torch.gaussians.mixture import GaussianMixture

COLUMNS = 2  # of the regression: mean r and mean e
# (mixture in the camera frame, points [B, N, 3], values [B, N, C], config) -> sums by component [B, K, C]
Distribute = Callable[[GaussianMixture, Tensor, Tensor, UfMStarConfig], Tensor]


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

    def tensors(self) -> dict[str, Tensor]:
        """The evidence by its names in the state."""
        return {"evidence": self.evidence.component, "overall_evidence": self.evidence.overall}

    def residual(self, columns: Tensor) -> Tensor:
        """The expected r and e [..., 2] at pixels, from the regressed columns [B, ..., 2]."""
        shift = self.stream.to(columns.dtype)
        return columns + shift.view(len(shift), *[1] * (columns.dim() - 2), COLUMNS)


def learn(
    tensors: Mapping[str, Tensor], mixture_cam: GaussianMixture, frame: FrameInput, config: UfMStarConfig,
    distribute: Distribute, supported: Callable[[Anchors], Tensor] = inliers,
) -> Learnt:  # fmt: skip
    """Add a frame's anchors to the evidence.

    Args:
        tensors: of the state, with the evidence of the frames before.
        mixture_cam: M_i in the camera frame, [B, K].
        frame: of the same B streams, with anchors or None.
        config: of UfM*, with ``anchors``.
        distribute: sums values at points by component (:func:`ufmstar_torch.steps.regress.distribute`).
        supported: masks the anchors that their neighbours support (``evidence.inliers``).
    """
    assert config.anchors is not None
    evidence = Evidence(tensors["evidence"], tensors["overall_evidence"]).padded(mixture_cam.capacity)
    anchors, used = frame.anchors, torch.zeros_like(frame.fault)
    if anchors is not None:
        points = unproject_at(anchors.predicted, anchors.index, frame.size[1], frame.intrinsics)

        def by_component(rows: Tensor) -> Tensor:
            return distribute(mixture_cam, points, rows, config)

        memory = 0.5 ** (1 / config.anchors.half_life)
        # A faulty frame's anchors are not valid.
        evidence, mask = observe(evidence, anchors, by_component, memory, supported)
        used = mask.sum(1)
    return Learnt(evidence, used, *means(evidence, config.anchors.shrinkage))


def counts(anchors: Anchors | None, used: Tensor) -> dict[str, Tensor]:
    """The statistics of a frame's anchors, of which ``used`` [B] were used."""
    none = torch.zeros_like(used)
    if anchors is None:
        return {"anchors": none, "anchors_used": used, "anchors_rejected": none, "anchors_moving": none}
    measured = {} if anchors.pose_error is None else {"pose_error": anchors.pose_error}
    return {
        "anchors": anchors.mask.sum(1),
        "anchors_used": used,
        "anchors_rejected": anchors.rejected,
        "anchors_moving": none if anchors.moving is None else anchors.moving,
        **measured,
    }


def anchored_term(
    depth: Tensor, excess: Tensor, disagreement: Tensor, contradiction: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """B = max(0, d^2 e - M) [m^2], the mean square error that anchors show beyond M, and M + B; NaN where M is NaN.

    Args:
        depth: d, [B, ...] [m].
        excess: e, same shape, the relative mean square error that the network does not predict (``evidence``).
        disagreement: M, same shape [m^2].
        contradiction: [B] mean r^2 of rejected anchors that outnumber the others (``Anchors``), a lower bound of
            B/d^2; None = 0.
    """
    square = depth.square()
    term = (square * excess).sub_(disagreement).clamp_min_(0)
    both = disagreement + term
    if contradiction is None or (contradiction.is_cpu and not contradiction.any()):  # no bound
        return term, both
    least = contradiction.view(-1, *[1] * (depth.dim() - 1)).to(depth.dtype) * square
    return torch.maximum(term, least), torch.maximum(both, disagreement + least)
