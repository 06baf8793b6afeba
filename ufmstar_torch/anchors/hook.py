"""The one place where anchors meet the algorithm: two ends around step 5's single regression.

Before it, a frame's anchors become evidence, and the evidence of each component is appended to the
mixture's features; after it, those features are taken off the regressed ones again. The rest of the package uses
anchors through this file only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from ufmstar_torch.anchors.evidence import SUMS as EVIDENCE_SUMS
from ufmstar_torch.anchors.evidence import Evidence, inliers, means, observe
from ufmstar_torch.anchors.given import AnchorInput, Anchors, check_anchors
from ufmstar_torch.camera import unproject_at
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.regress import Regression

__all__ = [
    "EVIDENCE_SUMS",
    "AnchorInput",
    "Anchors",
    "Evidence",
    "Learnt",
    "TermKernel",
    "after_regression",
    "anchored_term",
    "before_regression",
    "check_anchors",
    "learn",
]

# (mixture in the camera frame, points [B, N, 3], values [B, N, C], config) -> sums by component [B, K, C]
Distribute = Callable[[GaussianMixture, Tensor, Tensor, UfMStarConfig], Tensor]


@dataclass(frozen=True)
class Learnt:
    """What is known after a frame's anchors.

    Attributes:
        evidence: this frame's included.
        used: [B] how many anchors were used.
        beyond: [B, K, 2] mean r and e of the components less the stream's (``evidence.means``).
        stream: [B, 2] the stream's.
    """

    evidence: Evidence
    used: Tensor
    beyond: Tensor
    stream: Tensor


class LearnKernel(Protocol):
    """Evidence with room for the mixture, M_i in the camera frame, a frame and its anchors (:func:`learn`)."""

    def __call__(
        self,
        evidence: Evidence,
        mixture_cam: GaussianMixture,
        frame: FrameInput,
        anchors: AnchorInput | None,
        config: UfMStarConfig,
        /,
    ) -> Learnt: ...


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
        evidence: up to the frame before.
        mixture_cam: M_i in the camera frame, [B, K].
        frame: the same B streams.
        anchors: of this frame, or None.
        config: of UfM*.
        distribute: sums values at points by component (:func:`ufmstar_torch.regress.distribute`).
        supported: which anchors their neighbours support (``evidence.inliers``).
    """
    assert config.anchors is not None
    used = torch.zeros_like(frame.fault)
    if anchors is not None:
        points = unproject_at(anchors.predicted, anchors.index, frame.size[1], frame.intrinsics)

        def by_component(rows: Tensor) -> Tensor:
            return distribute(mixture_cam, points, rows, config)

        memory = 0.5 ** (1 / config.anchors.half_life)
        # A faulty frame's anchors are not valid.
        evidence, each = observe(evidence, anchors, by_component, memory, supported)
        used = each.sum(1)
    return Learnt(evidence, used, *means(evidence, config.anchors.shrinkage))


def before_regression(
    evidence: Evidence,
    mixture_cam: GaussianMixture,
    frame: FrameInput,
    anchors: AnchorInput | None,
    config: UfMStarConfig,
    kernel: LearnKernel,
) -> tuple[Evidence, Tensor, GaussianMixture, Tensor | None]:
    """Add a frame's anchors to the evidence, and make the mixture ready to regress it.

    Args:
        evidence, mixture_cam, frame, anchors: as :func:`learn`.
        config: ``anchors`` None = everything is returned as it is.
        kernel: an implementation of :func:`learn`.

    Returns:
        The evidence, this frame's included; how many anchors were used [B]; the mixture with two more features, the
        components' mean r and e less the stream's; the stream's means [B, 2], for :func:`after_regression`.
    """
    if config.anchors is None:
        return evidence, torch.zeros_like(frame.fault), mixture_cam, None
    learnt = kernel(evidence.padded(mixture_cam.capacity), mixture_cam, frame, anchors, config)
    features = torch.cat([mixture_cam.features, learnt.beyond], dim=-1)
    return learnt.evidence, learnt.used, mixture_cam.replace(features=features), learnt.stream


def after_regression(result: Regression, stream: Tensor | None) -> tuple[Regression, Tensor | None]:
    """Separate the evidence from the regressed features.

    Args:
        result: of the mixture of :func:`before_regression`, at every pixel or at some.
        stream: from there.

    Returns:
        The regression without the evidence; the residual [..., 2] to expect at each pixel, mean r and mean e
        (``evidence``). The result as it is and None where ``stream`` is None.
    """
    if stream is None:
        return result, None
    residual = result.features[..., -2:]
    residual = residual + stream.to(residual.dtype).view(-1, *[1] * (residual.dim() - 2), 2)
    return replace(result, features=result.features[..., :-2]), residual


class TermKernel(Protocol):
    """B and M + B; see :func:`anchored_term`."""

    def __call__(self, depth: Tensor, excess: Tensor, disagreement: Tensor, /) -> tuple[Tensor, Tensor]: ...


def anchored_term(depth: Tensor, excess: Tensor, disagreement: Tensor) -> tuple[Tensor, Tensor]:
    """B = max(0, d^2 e - M) [m^2], the mean square error that anchors show beyond M, and M + B; NaN where M is.

    Args:
        depth: d, any shape [m].
        excess: e, likewise, the relative mean square error that the network does not state (``evidence``).
        disagreement: M, likewise [m^2].
    """
    term = depth.square().mul_(excess).sub_(disagreement).clamp_min_(0)
    return term, disagreement + term
