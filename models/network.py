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
