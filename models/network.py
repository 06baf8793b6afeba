"""What all depth networks here have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor, nn

from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.prediction import DepthPrediction


class DepthNetwork(nn.Module, ABC):
    """A monocular network that predicts metric depth.

    ``x, K = network.preprocess(image, intrinsics)`` turns a camera image into the network's input ``x``
    [B, 3, H, W] with its intrinsics K, and ``network(x)`` is a :class:`DepthPrediction` at that resolution.
    """

    preprocess: Preprocess

    @abstractmethod
    def forward(self, image: Tensor) -> DepthPrediction:
        """Depth [B, H, W] [m] of ``image`` [B, 3, H, W] as ``preprocess`` returns it."""


class Backbone(DepthNetwork):
    """An encoder and decoder that uncertainty heads can be put on.

    Depth is read from the decoder's last features, and so is everything that a head adds. The two steps are
    separate so that a head shares the features without computing them twice.
    """

    feature_channels: int

    @abstractmethod
    def features(self, image: Tensor) -> Tensor:
        """The decoder's last features [B, feature_channels, H, W] at the resolution of ``image`` [B, 3, H, W]."""

    @abstractmethod
    def depth(self, features: Tensor) -> Tensor:
        """Depth [B, H, W] [m] from :meth:`features`."""

    def forward(self, image: Tensor) -> DepthPrediction:
        """Depth [B, H, W] [m] of ``image`` [B, 3, H, W] as ``preprocess`` returns it; no variances."""
        return DepthPrediction(self.depth(self.features(image)))
