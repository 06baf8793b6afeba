"""What every depth network returns."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class DepthPrediction:
    """One prediction of a monocular depth network (section "Single DNN inference").

    Attributes:
        depth: [B, H, W] metric depth D along the optical axis [m].
        aleatoric_variance: [B, H, W] learned data variance A [m^2], or None.
        epistemic_variance: [B, H, W] learned model variance E [m^2], or None.

    Raises:
        ValueError: the shapes disagree or depth is not [B, H, W].
    """

    depth: Tensor
    aleatoric_variance: Tensor | None = None
    epistemic_variance: Tensor | None = None

    def __post_init__(self) -> None:
        if self.depth.dim() != 3 or not torch.is_floating_point(self.depth):
            raise ValueError(
                f"depth must be a floating-point tensor [B, H, W], got {self.depth.dtype} {tuple(self.depth.shape)}"
            )
        for name in ("aleatoric_variance", "epistemic_variance"):
            value = getattr(self, name)
            if value is not None and value.shape != self.depth.shape:
                raise ValueError(
                    f"{name} must have the depth's shape {tuple(self.depth.shape)}, got {tuple(value.shape)}"
                )

    @property
    def variance(self) -> Tensor | None:
        """[B, H, W] the network's own total variance A + E [m^2], None if it predicts neither."""
        a, e = self.aleatoric_variance, self.epistemic_variance
        if a is None or e is None:
            return e if a is None else a
        return a + e
