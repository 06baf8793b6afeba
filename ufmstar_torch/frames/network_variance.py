"""V = M + A + E (section "Uncertainty Regression"), with the network's A and E that the config adds."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.extension import Chosen
from ufmstar_torch.frames.frame import FrameInput


@dataclass(frozen=True)
class NetworkVariance:
    """A and E at some pixels, of equal shape [m^2]; None = not predicted, or not added."""

    aleatoric: Tensor | None
    epistemic: Tensor | None

    @classmethod
    def of(cls, frame: FrameInput, config: UfMStarConfig) -> NetworkVariance:
        """A and E of a frame [B, H, W]."""
        return cls(frame.aleatoric if config.add_aleatoric else None, frame.epistemic if config.add_epistemic else None)

    def maps(self) -> list[Tensor]:
        """A and E, without those that are None."""
        return [value for value in (self.aleatoric, self.epistemic) if value is not None]

    def at(self, chosen: Chosen, features: Tensor, config: UfMStarConfig) -> NetworkVariance:
        """A and E at the regressed pixels, whose features are [..., F]. With ``config.variances_in_h`` the last three
        features are the mixture's A, E and weight share s; each of A and E is then its mean over the mixture plus
        (1 - s) times the pixel's own."""
        of_pixel = [None if value is None else chosen(value) for value in (self.aleatoric, self.epistemic)]
        if config.variances_in_h:
            *means, explained = features[..., -3:].unbind(-1)
            pairs = zip(of_pixel, means, strict=True)
            of_pixel = [None if value is None else mean + (1 - explained) * value for value, mean in pairs]
        return replace(self, aleatoric=of_pixel[0], epistemic=of_pixel[1])

    def total(self, disagreement: Tensor, floor: float) -> Tensor:
        """V of M [m^2], at least ``floor``; NaN stays NaN."""
        variance = disagreement
        for value in self.maps():
            variance = variance + value
        return variance.clamp_min(floor) if floor else variance
