"""A mixture of normal distributions of the depth at every pixel: CDF, quantiles, central intervals.

A depth is positive, so the CDF is that of the mixture on condition of a positive depth:

    F(x) = (S(x) - S(0)) / (1 - S(0)),      S(x) = sum over c of w_c Phi((x - mean_c) / sigma_c).

z(x) = Phi^-1(F(x)) is standard normal where the mixture is right. ``conformal`` learns from held-out anchors how large
|z| is at the levels 50, 90 and 99 %; a depth of that |z| gets the |z| of the normal distribution.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.special import ndtr, ndtri

from ufmstar_torch.posterior.conformal import corrected, uncorrected

# [m^2] of a component: a variance of 0 has no density.
LEAST_VARIANCE = 1e-12
# Least distance of F from 0 and 1 [1]: z stays finite in float64.
TAIL = 1e-15
# Steps of the bisection: a bracket of 20 m shrinks to a micrometre.
_BISECTIONS = 24


@dataclass(frozen=True)
class DepthDistribution:
    """Distribution of the depth at every pixel.

    Attributes:
        weight: [C, B, ...] of the components; their sum is 1. NaN where there is no depth.
        mean: [C, B, ...] [m].
        variance: [C, B, ...] [m^2], positive.
        quantiles: [B, 3] |z| at the levels of ``conformal.LEVELS``, increasing; NaN = no evidence.
    """

    weight: Tensor
    mean: Tensor
    variance: Tensor
    quantiles: Tensor

    def standard(self, depth: Tensor) -> Tensor:
        """z [B, ...] of a depth [B, ...] [m], float64, before the correction."""
        return ndtri(_conditional(self, depth.double()).clamp(TAIL, 1 - TAIL))

    def below(self, depth: Tensor) -> Tensor:
        """Probability [B, ...] of a depth below ``depth`` [B, ...] [m], float64."""
        z = self.standard(depth)
        probability = ndtr(z.sign() * corrected(z.abs(), self._quantiles_at(z)))
        return torch.where(depth > 0, probability, probability * 0)

    def central_level(self, depth: Tensor) -> Tensor:
        """Level [B, ...] of the smallest central interval with ``depth`` [B, ...] [m] in it, float64."""
        return 2 * ndtr(corrected(self.standard(depth).abs(), self._quantiles_at(depth))) - 1

    def interval(self, level: float) -> tuple[Tensor, Tensor]:
        """Lower and upper end [B, ...] of the central interval of probability ``level`` [m], float64."""
        wanted = ndtri(torch.tensor((1 + level) / 2, dtype=torch.float64))
        z = uncorrected(wanted.to(self.quantiles.device).expand_as(self.mean[0]), self._quantiles_at(self.mean[0]))
        return self._quantile(ndtr(-z)), self._quantile(ndtr(z))

    def _quantile(self, probability: Tensor) -> Tensor:
        """x [B, ...] with F(x) = ``probability``, by bisection."""
        low = torch.zeros_like(probability)
        zero = self._sum(low)
        target = (zero + probability * (1 - zero)).clamp(TAIL, 1 - TAIL)
        # The mixture's quantile is at most the largest of the components' quantiles.
        high = (self.mean + ndtri(target) * self.variance.double().sqrt()).amax(0).clamp_min(0)
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            below = self._sum(middle) < target
            low, high = torch.where(below, middle, low), torch.where(below, high, middle)
        return torch.where(self.weight.isnan().any(0) | probability.isnan(), torch.nan, (low + high) / 2)

    def _sum(self, depth: Tensor) -> Tensor:
        """S [B, ...]."""
        z = (depth - self.mean.double()) / self.variance.double().sqrt()
        return (self.weight.double() * ndtr(z)).sum(0)

    def _quantiles_at(self, like: Tensor) -> Tensor:
        """[3, B, 1, ...] to broadcast over the pixels of ``like`` [B, ...]."""
        return self.quantiles.double().T.reshape(3, -1, *[1] * (like.dim() - 1))


def _conditional(distribution: DepthDistribution, depth: Tensor) -> Tensor:
    """F [B, ...]."""
    at_zero = distribution._sum(torch.zeros_like(depth))
    return (distribution._sum(depth) - at_zero) / (1 - at_zero)
