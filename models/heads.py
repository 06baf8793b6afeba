"""Uncertainty heads: an additional convolution on a network's features.

Aleatoric: Gaussian depth and log-variance (Kendall and Gal 2017). Evidential: the four parameters of a
Normal-Inverse-Gamma distribution (Amini et al. 2020). The backbone predicts depth with and without a head, so that
pretrained weights can be used.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ufmstar_torch.frames.arguments import require_whole
from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.models.distribution import DepthDistribution, EvidentialDepth, GaussianDepth, PointDepth, images_of
from ufmstar_torch.models.network import Backbone, DepthNetwork
from ufmstar_torch.runtime.kinds import check_kinds

# [log m^2] Standard deviations from 1 mm to 1 km, which covers all plausible ones. Within them, exp(s) and exp(-s)
# times a squared depth stay in the range of float32.
LOG_VARIANCE_RANGE = (math.log(1e-6), math.log(1e6))
# [1] Smallest nu and alpha - 1, so that both evidential variances are finite: in float32, softplus is 0 below -104.
EVIDENCE_FLOOR = 1e-4
# [m^2] Smallest beta: (1 mm)^2, as for the Gaussian head.
BETA_FLOOR = 1e-6
# [1] Factor of PyTorch's initial weights. Without it, the log-variance of a trained FastDepth in training mode (on
# frames unlike NYU's) starts as low as -8 at some pixels: 2 cm, where the error is a metre and more. The mean loss of
# such a batch was up to 136 nat instead of 2, and Adam averages a gradient over a thousand steps.
HEAD_SCALE = 0.1


class UncertaintyHead(nn.Module, ABC):
    """A 3x3 convolution on a feature map of any network, for custom models; ``train.loss_of`` is its loss.

    Args:
        channels: C of the feature map.
    """

    method = ""  # of a ``NetworkSpec`` with such a head
    outputs = 0  # channels of the convolution

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.convolution = _convolution(channels, self.outputs)

    def forward(self, features: Tensor, depth: Tensor) -> DepthDistribution:
        """The distribution [B, H, W] of ``depth`` [B, H, W] [m], at least in float32, from ``features`` [B, C, h, w] of
        any resolution."""
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
    """A learned data and model variance from one inference (Amini et al. 2020)."""

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
        backbone: provides features, depth and ``preprocess``.
        kind: of the head; None: depth without a variance.
        scales: number of heads, at full resolution, 1/2, 1/4, ...: 4 in Poggi et al. (2020). Only the first is used for
            inference; in training mode, the coarser heads train the decoder's inner layers.

    Raises:
        ValueError: more scales than the backbone has.
    """

    @check_kinds
    def __init__(self, backbone: Backbone, kind: type[UncertaintyHead] | None, scales: int = 1) -> None:
        super().__init__()
        channels = backbone.pyramid_channels
        if not 1 <= scales <= len(channels):
            raise ValueError(f"scales must be from 1 to {len(channels)} of this backbone, got {scales}")
        self.backbone, self.kind = backbone, kind
        self.preprocess = backbone.preprocess
        if kind is not None:
            # Only the convolutions, under the keys of stored weights.
            self.head = _convolution(channels[0], kind.outputs)
            if scales > 1:
                coarse = (_convolution(channels[s], kind.outputs) for s in range(1, scales))
                self.coarse = nn.ModuleList(coarse)

    @property
    def wrapped(self) -> tuple[nn.Module]:
        """The backbone."""
        return (self.backbone,)

    def distribution(self, image: Tensor) -> DepthDistribution:
        """The parameters for the losses, each [B, H, W], of ``image`` [B, 3, H, W]; in training mode with S scales
        [S B, H, W], full resolution first, all with the same depth."""
        if self.kind is None:
            return PointDepth(_single(self.backbone.depth(self.backbone.features(image))))
        coarse = self.coarse if self.training and hasattr(self, "coarse") else ()
        maps = self.backbone.pyramid(image) if coarse else [self.backbone.features(image)]
        raws = [_single(head(x)) for head, x in zip((self.head, *coarse), maps, strict=False)]
        size = (raws[0].shape[-2], raws[0].shape[-1])
        depth = _single(self.backbone.depth(maps[0])).repeat(len(raws), 1, 1)
        return self.kind.distribution(depth, torch.cat([resized(raw, size) for raw in raws]))

    def forward(self, image: Tensor) -> DepthPrediction:
        """Depth [B, H, W] [m] and the head's variances [m^2] of the output ``image`` of ``preprocess``."""
        distribution = self.distribution(image)
        return (images_of(distribution, slice(len(image))) if self.training else distribution).prediction()


def with_head(backbone: Backbone, method: str, scales: int = 1) -> UncertaintyNetwork:
    """A backbone with the head of a method: "depth" (none), "aleatoric" or "evidential"; ``scales`` as in
    :class:`UncertaintyNetwork`. Raises TypeError: ``backbone`` is no :class:`Backbone`; ValueError: another method, or
    more scales than the backbone has."""
    if not isinstance(backbone, Backbone):
        remedy = "train_module(NETWORK, ...) of ufmstar_torch.train puts a head on any network"
        raise TypeError(f"backbone must be a Backbone such as FastDepth, got {type(backbone).__name__}: {remedy}")
    require_whole("scales", scales, 1)
    if not isinstance(method, str) or method not in HEADS:
        raise ValueError(f"method must be one of {list(HEADS)}, got {method!r}")
    return UncertaintyNetwork(backbone, HEADS[method], scales)


def soft_range(x: Tensor, low: float, high: float) -> Tensor:
    """A smooth, increasing clamp of x to [low, high], equal to x well inside.

    low + softplus(x - low) at the lower end, mirrored at the upper. Unlike a clamp, it has a gradient outside, which
    decays as exp(-distance): in float32 it is 0 only from a distance of about 100 on.
    """
    x = low + F.softplus(x - low)
    return high - F.softplus(high - x)


def resized(x: Tensor, size: tuple[int, int]) -> Tensor:
    """x [B, C, h, w] resized bilinearly, with aligned borders (``align_corners=False``)."""
    return x if x.shape[-2:] == size else F.interpolate(x, size, mode="bilinear", align_corners=False)


def _convolution(inputs: int, outputs: int) -> nn.Conv2d:
    """A 3x3 convolution with outputs initially near 0 for any features; members of an ensemble still differ."""
    head = nn.Conv2d(inputs, outputs, 3, padding=1)
    assert head.bias is not None
    with torch.no_grad():
        head.weight.mul_(HEAD_SCALE)
        head.bias.zero_()
    return head


def _single(x: Tensor) -> Tensor:
    """x in at least float32: in float16 1 + EVIDENCE_FLOOR is 1 and exp(LOG_VARIANCE_RANGE[1]) infinite, and bfloat16
    resolves depths from 2 m on to more than a centimetre."""
    return x.float() if x.dtype in (torch.float16, torch.bfloat16) else x
