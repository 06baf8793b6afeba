"""A relative network with a fixed alignment: metric depth for UfM*."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ufmstar_torch.models.alignment import Alignment
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.outputs import as_map
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.prediction import DepthPrediction, infer


class AlignedNetwork(DepthNetwork):
    """Metric depth from a network that predicts it up to scale (and shift).

    Args:
        network: image [B, 3, H, W] -> relative depth [B, H, W] or [B, 1, H, W].
        alignment: the same for every frame, fitted once; see :mod:`ufmstar_torch.models.alignment` for why.
        preprocess: what the network's input needs; None: images in [0, 1] at their own size.
    """

    def __init__(self, network: nn.Module, alignment: Alignment, preprocess: Preprocess | None = None) -> None:
        super().__init__()
        self.network = network
        self.alignment = alignment
        self.preprocess = preprocess or Preprocess()

    @property
    def wrapped(self) -> tuple[nn.Module]:
        """The relative network."""
        return (self.network,)

    @property
    def max_depth(self) -> float | None:
        """[m] Of the alignment: what is farther is no prediction."""
        return self.alignment.max_depth

    def forward(self, image: Tensor, intrinsics: Tensor | None = None) -> DepthPrediction:
        """Depth [B, H, W] [m] of ``image`` [B, 3, H, W] with ``intrinsics`` [B, 3, 3] [px]; 0 (no prediction) where the
        alignment is not possible. Raises ValueError: the network returns another shape."""
        relative = as_map(infer(self.network, image, intrinsics), "the network's relative depth")
        if relative.shape[-2:] != image.shape[-2:]:
            raise ValueError(f"network must return {tuple(image.shape[-2:])} px, got {tuple(relative.shape)}")
        if relative.dtype in (torch.float16, torch.bfloat16):
            relative = relative.float()  # a scale of 1e-3 and less is no number in half precision
        return DepthPrediction(self.alignment.depth(relative))
