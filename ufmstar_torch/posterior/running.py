"""What the posterior learns of a stream: sums with a half-life, and the last frame's coefficients.

Everything here is learnt from anchors alone, in frames that have some: how far the network's error varies (amplitude),
how much anchors and network differ from one pixel to the next (roughness), by what factor the anchors' variances are
stated too small (noise), how fast the error grows with the distance from evidence (unseen), and how well held-out
anchors were predicted (calibration). Each is a ratio of two sums that fade towards a prior, so that a few anchors do
not decide.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ufmstar_torch.posterior.model import GLOBALS, MODEL

# (prior value, its weight in anchors, least, largest). Amplitude and noise are factors of the model's variances;
# roughness and unseen are variances of y, at a pixel and over a width of the image. Calibration is a mean z^2, of
# which nothing is known before.
RATIOS = {
    "amplitude": (1.0, 20.0, 0.1, 100.0),
    "roughness": (0.05**2, 60.0, 0.01**2, 0.2**2),
    "noise": (1.0, 60.0, 0.25, 16.0),
    "unseen": (0.05, 30.0, 0.0, 16.0),
    "calibration": (0.0, 0.0, 0.0, 1e6),
}
_MATRIX = GLOBALS * GLOBALS
SIZE = 2 + 2 * len(RATIOS) + GLOBALS + _MATRIX


@dataclass(frozen=True)
class Running:
    """Of B streams.

    Attributes:
        frames: [B] that had anchors.
        mean: [B] m_0 of the last of them.
        above, below: by name of ``RATIOS``, [B] sums whose quotient is the ratio.
        coefficients: [B, 4] of 1, log d - m_0, u, v in the last of them.
        covariance: [B, 4, 4] of these.
    """

    frames: Tensor
    mean: Tensor
    above: dict[str, Tensor]
    below: dict[str, Tensor]
    coefficients: Tensor
    covariance: Tensor

    @classmethod
    def of(cls, packed: Tensor) -> Running:
        """From a row of numbers [B, SIZE] a stream; zeros are the start."""
        packed = packed.double()
        frames, mean, sums, coefficients, covariance = packed.split([1, 1, 2 * len(RATIOS), GLOBALS, _MATRIX], 1)
        new = frames == 0
        start = sums.new_tensor([r[0] * r[1] for r in RATIOS.values()] + [r[1] for r in RATIOS.values()])
        above, below = torch.where(new, start, sums).split(len(RATIOS), 1)
        P = torch.diag(packed.new_tensor(MODEL.prior).square())
        return cls(
            frames[:, 0], mean[:, 0], dict(zip(RATIOS, above.unbind(1), strict=True)),
            dict(zip(RATIOS, below.unbind(1), strict=True)), coefficients,
            torch.where(new[..., None], P, covariance.reshape(-1, GLOBALS, GLOBALS)),
        )  # fmt: skip

    def packed(self) -> Tensor:
        """[B, SIZE], for :meth:`of`."""
        scalars = [self.frames, self.mean, *self.above.values(), *self.below.values()]
        return torch.cat([torch.stack(scalars, 1), self.coefficients, self.covariance.flatten(1)], 1)

    def ratio(self, name: str) -> Tensor:
        """[B] within its range; 0/0 is the prior's value."""
        value, _, least, largest = RATIOS[name]
        below = self.below[name]
        ratio = torch.where(below > 0, self.above[name] / below.clamp_min(1e-12), torch.full_like(below, value))
        return ratio.clamp(least, largest)

    def growth(self) -> Tensor:
        """[B] variance of y a width of the image from evidence."""
        return MODEL.growth + self.ratio("unseen")

    def added(self, name: str, above: Tensor, below: Tensor) -> tuple[Tensor, Tensor]:
        """The two sums of a ratio [B] after a frame with these [B]."""
        value, weight, least, largest = RATIOS[name]
        n = MODEL.memory * self.below[name] + (1 - MODEL.memory) * weight + below
        total = MODEL.memory * self.above[name] + (1 - MODEL.memory) * weight * value + above
        return torch.minimum(torch.maximum(total, least * n), largest * n), n

    def expected(self, mean: Tensor) -> tuple[Tensor, Tensor]:
        """Coefficients [B, 4] and their covariance [B, 4, 4] before a frame whose m_0 is ``mean`` [B]: a random walk
        from the last frame, whose variances do not grow beyond those of the start."""
        T = torch.eye(GLOBALS, dtype=mean.dtype, device=mean.device).repeat(len(mean), 1, 1)
        T[:, 0, 1] = torch.where(self.frames > 0, mean - self.mean, torch.zeros_like(mean))
        walked = T @ self.covariance @ T.mT
        prior, drift = (mean.new_tensor(x).square() for x in (MODEL.prior, MODEL.drift))
        grown = drift * (1 - walked.diagonal(dim1=1, dim2=2) / prior).clamp(0, 1)
        started = (self.frames > 0).to(mean)[:, None]
        return (T @ self.coefficients[..., None])[..., 0], walked + torch.diag_embed(grown * started)
