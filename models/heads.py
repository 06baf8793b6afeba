"""Uncertainty heads: one more convolution on a backbone's last features.

Aleatoric: Gaussian depth and log-variance (Kendall and Gal 2017). Evidential: the four parameters of a
Normal-Inverse-Gamma distribution (Amini et al. 2020). Depth stays the backbone's own, so that pretrained
weights keep their meaning when a head is added.
"""

from __future__ import annotations

import math
from abc import abstractmethod

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ufmstar_torch.models.distribution import DepthDistribution, EvidentialDepth, GaussianDepth, PointDepth
from ufmstar_torch.models.network import Backbone, DepthNetwork
from ufmstar_torch.prediction import DepthPrediction

# [log m^2] Standard deviations from 1 mm to 1 km: none that a depth network could mean lies outside, and
# within them neither exp(s) nor exp(-s) times a squared depth leaves single precision.
LOG_VARIANCE_RANGE = (math.log(1e-6), math.log(1e6))
# [1] Smallest nu and alpha - 1, so that both evidential variances stay finite: softplus reaches 0 in
# single precision from about -104 on.
EVIDENCE_FLOOR = 1e-4
# [m^2] Smallest beta: (1 mm)^2, as for the Gaussian head.
BETA_FLOOR = 1e-6
# [1] Share of PyTorch's initial weights. With all of them, the log-variance of a trained FastDepth in training mode (on
# frames unlike NYU's) starts as low as -8 at some pixels: 2 cm, where it errs by a metre and more. The mean loss of
# such a batch was up to 136 nat instead of 2, and Adam remembers a gradient for a thousand steps.
HEAD_SCALE = 0.1


class UncertaintyNetwork(DepthNetwork):
    """A backbone with a head.

    Args:
        backbone: whose features and depth are used; its ``preprocess`` is this network's.
    """

    def __init__(self, backbone: Backbone) -> None:
        super().__init__()
        self.backbone = backbone
        self.preprocess = backbone.preprocess

    @abstractmethod
    def distribution(self, image: Tensor) -> DepthDistribution:
        """The parameters that the losses need, each [B, H, W], of ``image`` [B, 3, H, W]."""

    def forward(self, image: Tensor) -> DepthPrediction:
        """Depth [B, H, W] [m] and the head's variances [m^2] of ``image`` as ``preprocess`` returns it."""
        return self.distribution(image).prediction()


class DepthOnlyNetwork(UncertaintyNetwork):
    """No head: depth without a variance ("DepthOnly")."""

    def distribution(self, image: Tensor) -> PointDepth:
        """The backbone's depth."""
        return PointDepth(_single(self.backbone.depth(self.backbone.features(image))))


class AleatoricNetwork(UncertaintyNetwork):
    """Depth and a learned data variance ("Aleatoric")."""

    def __init__(self, backbone: Backbone) -> None:
        super().__init__(backbone)
        self.head = _head(backbone, 1)

    def distribution(self, image: Tensor) -> GaussianDepth:
        """Depth and log-variance within :data:`LOG_VARIANCE_RANGE`."""
        features = self.backbone.features(image)
        log_variance = soft_range(_single(self.head(features)[:, 0]), *LOG_VARIANCE_RANGE)
        return GaussianDepth(_single(self.backbone.depth(features)), log_variance)


class EvidentialNetwork(UncertaintyNetwork):
    """Depth with learned data and model variance from one inference ("Evidential")."""

    def __init__(self, backbone: Backbone) -> None:
        super().__init__(backbone)
        self.head = _head(backbone, 3)

    def distribution(self, image: Tensor) -> EvidentialDepth:
        """gamma is the backbone's depth; nu, alpha - 1 and beta are softplus of the head's channels."""
        features = self.backbone.features(image)
        nu, alpha, beta = F.softplus(_single(self.head(features))).unbind(1)
        depth = _single(self.backbone.depth(features))
        return EvidentialDepth(depth, nu + EVIDENCE_FLOOR, alpha + (1 + EVIDENCE_FLOOR), beta + BETA_FLOOR)


HEADS: dict[str, type[UncertaintyNetwork]] = {
    "depth": DepthOnlyNetwork,
    "aleatoric": AleatoricNetwork,
    "evidential": EvidentialNetwork,
}


def with_head(backbone: Backbone, method: str) -> UncertaintyNetwork:
    """A backbone with the head of a method: "depth" (none), "aleatoric" or "evidential".

    Raises:
        ValueError: another method.
    """
    if method not in HEADS:
        raise ValueError(f"method must be one of {list(HEADS)}, got {method!r}")
    return HEADS[method](backbone)


def soft_range(x: Tensor, low: float, high: float) -> Tensor:
    """x, bent smoothly into [low, high]: equal to x well inside, never decreasing.

    low + softplus(x - low) from below, and the same mirrored from above. Unlike a clamp it keeps a gradient
    outside, which falls as exp(-distance): in single precision it is 0 only some 100 beyond an end.
    """
    x = low + F.softplus(x - low)
    return high - F.softplus(high - x)


def _head(backbone: Backbone, outputs: int) -> nn.Conv2d:
    """A 3x3 convolution that starts near 0, whatever features a trained backbone has; members still differ."""
    head = nn.Conv2d(backbone.feature_channels, outputs, 3, padding=1)
    assert head.bias is not None
    with torch.no_grad():
        head.weight.mul_(HEAD_SCALE)
        head.bias.zero_()
    return head


def _single(x: Tensor) -> Tensor:
    """At least single precision: in half precision 1 + EVIDENCE_FLOOR is 1 and exp(LOG_VARIANCE_RANGE[1])
    infinite, and a depth in bfloat16 has steps of more than a centimetre from 2 m on."""
    return x.float() if x.dtype in (torch.float16, torch.bfloat16) else x
