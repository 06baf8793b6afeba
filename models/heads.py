"""Uncertainty heads: one more convolution on a network's features.

Aleatoric: Gaussian depth and log-variance (Kendall and Gal 2017). Evidential: the four parameters of a
Normal-Inverse-Gamma distribution (Amini et al. 2020). Depth stays the backbone's own, so that pretrained
weights keep their meaning when a head is added.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ufmstar_torch.models.distribution import DepthDistribution, EvidentialDepth, GaussianDepth, PointDepth, images_of
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


class UncertaintyHead(nn.Module, ABC):
    """A 3x3 convolution on a feature map of any network, for a model of one's own; ``train.loss_of`` is its loss.

    Args:
        channels: C of the feature map.
    """

    method = ""  # of a ``NetworkSpec`` with such a head
    outputs = 0  # channels of the convolution

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.convolution = _convolution(channels, self.outputs)

    def forward(self, features: Tensor, depth: Tensor) -> DepthDistribution:
        """The distribution [B, H, W] of ``depth`` [B, H, W] [m], at least in single precision, from ``features``
        [B, C, h, w] of any resolution."""
        raw = _single(self.convolution(features))
        return self.distribution(_single(depth), resized(raw, (depth.shape[-2], depth.shape[-1])))

    @staticmethod
    @abstractmethod
    def distribution(depth: Tensor, raw: Tensor) -> DepthDistribution:
        """The parameters of depth [B, H, W] [m] from the convolution's outputs [B, outputs, H, W]."""


class AleatoricHead(UncertaintyHead):
    """A learned data variance (Kendall and Gal 2017)."""

    method, outputs = "aleatoric", 1

    @staticmethod
    def distribution(depth: Tensor, raw: Tensor) -> GaussianDepth:
        """Depth and log-variance within :data:`LOG_VARIANCE_RANGE`."""
        return GaussianDepth(depth, soft_range(raw[:, 0], *LOG_VARIANCE_RANGE))


class EvidentialHead(UncertaintyHead):
    """Learned data and model variance from one inference (Amini et al. 2020)."""

    method, outputs = "evidential", 3

    @staticmethod
    def distribution(depth: Tensor, raw: Tensor) -> EvidentialDepth:
        """gamma is the depth; nu, alpha - 1 and beta are softplus of the three channels."""
        nu, alpha, beta = F.softplus(raw).unbind(1)
        return EvidentialDepth(depth, nu + EVIDENCE_FLOOR, alpha + (1 + EVIDENCE_FLOOR), beta + BETA_FLOOR)


HEADS: dict[str, type[UncertaintyHead] | None] = {
    "depth": None,
    "aleatoric": AleatoricHead,
    "evidential": EvidentialHead,
}


class UncertaintyNetwork(DepthNetwork):
    """A backbone with a head; made by :func:`with_head`.

    Args:
        backbone: whose features and depth are used; its ``preprocess`` is this network's.
        kind: of the head; None: depth without a variance.
        scales: heads, at full resolution, 1/2, 1/4, ...: as many as 4 in Poggi et al. (2020). Only the first predicts;
            the coarser ones are there in training mode, where they teach the decoder's inner layers.

    Raises:
        ValueError: more scales than the backbone has.
    """

    def __init__(self, backbone: Backbone, kind: type[UncertaintyHead] | None, scales: int = 1) -> None:
        super().__init__()
        channels = backbone.pyramid_channels
        if not 1 <= scales <= len(channels):
            raise ValueError(f"scales must be from 1 to {len(channels)} of this backbone, got {scales}")
        self.backbone, self.kind = backbone, kind
        self.preprocess = backbone.preprocess
        if kind is not None:
            # The convolutions alone, under the names that stored weights have.
            self.head = _convolution(channels[0], kind.outputs)
            if scales > 1:
                coarse = (_convolution(channels[s], kind.outputs) for s in range(1, scales))
                self.coarse = nn.ModuleList(coarse)

    @property
    def wrapped(self) -> tuple[nn.Module]:
        """The backbone."""
        return (self.backbone,)

    def distribution(self, image: Tensor) -> DepthDistribution:
        """The parameters that the losses need, each [B, H, W], of ``image`` [B, 3, H, W]; in training mode with S
        scales [S B, H, W], full resolution first, each with the same depth."""
        if self.kind is None:
            return PointDepth(_single(self.backbone.depth(self.backbone.features(image))))
        coarse = self.coarse if self.training and hasattr(self, "coarse") else ()
        maps = self.backbone.pyramid(image) if coarse else [self.backbone.features(image)]
        raws = [_single(head(x)) for head, x in zip((self.head, *coarse), maps, strict=False)]
        size = (raws[0].shape[-2], raws[0].shape[-1])
        depth = _single(self.backbone.depth(maps[0])).repeat(len(raws), 1, 1)
        return self.kind.distribution(depth, torch.cat([resized(raw, size) for raw in raws]))

    def forward(self, image: Tensor) -> DepthPrediction:
        """Depth [B, H, W] [m] and the head's variances [m^2] of ``image`` as ``preprocess`` returns it."""
        distribution = self.distribution(image)
        return (images_of(distribution, slice(len(image))) if self.training else distribution).prediction()


def with_head(backbone: Backbone, method: str, scales: int = 1) -> UncertaintyNetwork:
    """A backbone with the head of a method: "depth" (none), "aleatoric" or "evidential"; ``scales`` as in
    :class:`UncertaintyNetwork`. Raises ValueError: another method, or more scales than the backbone has."""
    if method not in HEADS:
        raise ValueError(f"method must be one of {list(HEADS)}, got {method!r}")
    return UncertaintyNetwork(backbone, HEADS[method], scales)


def soft_range(x: Tensor, low: float, high: float) -> Tensor:
    """x, bent smoothly into [low, high]: equal to x well inside, never decreasing.

    low + softplus(x - low) from below, and the same mirrored from above. Unlike a clamp it keeps a gradient
    outside, which falls as exp(-distance): in single precision it is 0 only some 100 beyond an end.
    """
    x = low + F.softplus(x - low)
    return high - F.softplus(high - x)


def resized(x: Tensor, size: tuple[int, int]) -> Tensor:
    """x [B, C, h, w] at another size, linearly between the centres of pixels."""
    return x if x.shape[-2:] == size else F.interpolate(x, size, mode="bilinear", align_corners=False)


def _convolution(inputs: int, outputs: int) -> nn.Conv2d:
    """A 3x3 convolution that starts near 0, whatever features a trained backbone has; members still differ."""
    head = nn.Conv2d(inputs, outputs, 3, padding=1)
    assert head.bias is not None
    with torch.no_grad():
        head.weight.mul_(HEAD_SCALE)
        head.bias.zero_()
    return head


def _single(x: Tensor) -> Tensor:
    """At least single precision: in half precision 1 + EVIDENCE_FLOOR is 1 and exp(LOG_VARIANCE_RANGE[1])
    infinite, and a depth in bfloat16 has steps of more than a centimetre from 2 m on."""
    return x.float() if x.dtype in (torch.float16, torch.bfloat16) else x
