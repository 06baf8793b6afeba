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

from ufmstar_torch.models.distribution import DepthDistribution, EvidentialDepth, GaussianDepth, PointDepth, split_batch
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
        scales: heads, at full resolution, 1/2, 1/4, ...: as many as 4 in Poggi et al. (2020). Only the first predicts;
            the coarser ones are there in training mode, where they teach the decoder's inner layers.

    Raises:
        ValueError: more scales than the backbone has.
    """

    outputs = 0  # channels of a head

    def __init__(self, backbone: Backbone, scales: int = 1) -> None:
        super().__init__()
        channels = backbone.pyramid_channels
        if not 1 <= scales <= len(channels):
            raise ValueError(f"scales must be from 1 to {len(channels)} of this backbone, got {scales}")
        self.backbone = backbone
        self.preprocess = backbone.preprocess
        if self.outputs:
            self.head = _head(channels[0], self.outputs)
            if scales > 1:
                self.coarse = nn.ModuleList(_head(channels[s], self.outputs) for s in range(1, scales))

    @abstractmethod
    def distribution(self, image: Tensor) -> DepthDistribution:
        """The parameters that the losses need, each [B, H, W], of ``image`` [B, 3, H, W]; in training mode with S
        scales [S B, H, W], full resolution first, each with the same depth."""

    def forward(self, image: Tensor) -> DepthPrediction:
        """Depth [B, H, W] [m] and the head's variances [m^2] of ``image`` as ``preprocess`` returns it."""
        prediction = self.distribution(image).prediction()
        scales = len(prediction.depth) // max(len(image), 1)
        return prediction if scales <= 1 else split_batch(prediction, scales)[0]

    def _raw(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Depth [S B, H, W] [m] and the heads' outputs [S B, outputs, H, W], at least in single precision."""
        coarse = self.coarse if self.training and hasattr(self, "coarse") else ()
        if not coarse:
            features = self.backbone.features(image)
            raw = _single(self.head(features))
            return _single(self.backbone.depth(features)), raw
        maps = self.backbone.pyramid(image)
        raws = [_single(head(x)) for head, x in zip((self.head, *coarse), maps, strict=False)]
        size = raws[0].shape[-2:]
        raws = [raws[0], *(F.interpolate(x, size, mode="bilinear", align_corners=False) for x in raws[1:])]
        return _single(self.backbone.depth(maps[0])).repeat(len(raws), 1, 1), torch.cat(raws)


class DepthOnlyNetwork(UncertaintyNetwork):
    """No head: depth without a variance ("DepthOnly")."""

    def distribution(self, image: Tensor) -> PointDepth:
        """The backbone's depth."""
        return PointDepth(_single(self.backbone.depth(self.backbone.features(image))))


class AleatoricNetwork(UncertaintyNetwork):
    """Depth and a learned data variance ("Aleatoric")."""

    outputs = 1

    def distribution(self, image: Tensor) -> GaussianDepth:
        """Depth and log-variance within :data:`LOG_VARIANCE_RANGE`."""
        depth, raw = self._raw(image)
        return GaussianDepth(depth, soft_range(raw[:, 0], *LOG_VARIANCE_RANGE))


class EvidentialNetwork(UncertaintyNetwork):
    """Depth with learned data and model variance from one inference ("Evidential")."""

    outputs = 3

    def distribution(self, image: Tensor) -> EvidentialDepth:
        """gamma is the backbone's depth; nu, alpha - 1 and beta are softplus of the head's channels."""
        depth, raw = self._raw(image)
        nu, alpha, beta = F.softplus(raw).unbind(1)
        return EvidentialDepth(depth, nu + EVIDENCE_FLOOR, alpha + (1 + EVIDENCE_FLOOR), beta + BETA_FLOOR)


HEADS: dict[str, type[UncertaintyNetwork]] = {
    "depth": DepthOnlyNetwork,
    "aleatoric": AleatoricNetwork,
    "evidential": EvidentialNetwork,
}


def with_head(backbone: Backbone, method: str, scales: int = 1) -> UncertaintyNetwork:
    """A backbone with the head of a method: "depth" (none), "aleatoric" or "evidential"; ``scales`` as in
    :class:`UncertaintyNetwork`. Raises ValueError: another method, or more scales than the backbone has."""
    if method not in HEADS:
        raise ValueError(f"method must be one of {list(HEADS)}, got {method!r}")
    return HEADS[method](backbone, scales)


def soft_range(x: Tensor, low: float, high: float) -> Tensor:
    """x, bent smoothly into [low, high]: equal to x well inside, never decreasing.

    low + softplus(x - low) from below, and the same mirrored from above. Unlike a clamp it keeps a gradient
    outside, which falls as exp(-distance): in single precision it is 0 only some 100 beyond an end.
    """
    x = low + F.softplus(x - low)
    return high - F.softplus(high - x)


def _head(inputs: int, outputs: int) -> nn.Conv2d:
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
