"""Backbones of a few weights whose output is a known function of their input."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ufmstar_torch.models.dropout import DecoderDropout
from ufmstar_torch.models.network import Backbone
from ufmstar_torch.models.preprocess import Preprocess


class Linear(Backbone):
    """Two feature channels, the image's first two (optionally with dropout); depth is ``offset`` plus their weighted
    sum."""

    feature_channels = 2

    def __init__(self, weights: tuple[float, float] = (0.5, -0.25), offset: float = 3.0, dropout: float = 0.0) -> None:
        super().__init__()
        self.preprocess = Preprocess(size=(4, 6))
        self.weights = nn.Parameter(torch.tensor(weights))
        self.offset = offset
        self.dropout = DecoderDropout(dropout)

    def features(self, image: Tensor) -> Tensor:
        return self.dropout(image[:, :2])

    def depth(self, features: Tensor) -> Tensor:
        return self.offset + torch.einsum("c,bchw->bhw", self.weights.to(features.dtype), features)


def constant_head(head: nn.Module, values: tuple[float, ...]) -> None:
    """Make a head's raw output ``values``, whatever the features, in place."""
    assert isinstance(head, nn.Conv2d)
    assert head.bias is not None
    with torch.no_grad():
        head.weight.zero_()
        head.bias.copy_(torch.tensor(values))
