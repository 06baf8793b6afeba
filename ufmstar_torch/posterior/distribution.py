"""A mixture of normal distributions of the depth at every pixel: CDF, quantiles, central intervals.

A depth is positive, so the CDF is that of the mixture on condition of a positive depth:

    F(x) = (S(x) - S(0)) / (1 - S(0)),      S(x) = sum over c of w_c Phi((x - mean_c) / sigma_c).

z(x) = Phi^-1(F(x)) is standard normal where the mixture is right. ``conformal`` learns from held-out anchors how large
|z| is at the levels 50, 90 and 99 %; a depth of that |z| gets the |z| of the normal distribution.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor
from torch.special import ndtr, ndtri

LEVELS: Final = (0.5, 0.9, 0.99)
# |z| of the normal distribution at the levels.
NORMAL: Final = (0.6744897501960817, 1.6448536269514722, 2.5758293035489004)
LEAST_VARIANCE = 1e-12  # [m^2] of a component: a variance of 0 has no density
TAIL = 1e-15  # least distance of F from 0 and 1 [1]: z stays finite in float64
_BISECTIONS = 24  # a bracket of 20 m shrinks to a micrometre


@dataclass(frozen=True)
class DepthDistribution:
    """Distribution of the depth at every pixel.

    Attributes:
        weight: [C, B, ...] of the components; their sum is 1. NaN where there is no depth.
        mean: [C, B, ...] [m].
        variance: [C, B, ...] [m^2], positive.
        quantiles: [B, 3] |z| at the ``LEVELS``, increasing; NaN = no evidence.
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
        total = torch.zeros_like(depth)
        for weight, mean, variance in zip(self.weight, self.mean, self.variance, strict=True):
            total = total + weight * ndtr((depth - mean) / variance.double().sqrt())
        return total

    def _quantiles_at(self, like: Tensor) -> Tensor:
        """[3, B, 1, ...] to broadcast over the pixels of ``like`` [B, ...]."""
        return self.quantiles.double().T.reshape(3, -1, *[1] * (like.dim() - 1))


def _conditional(distribution: DepthDistribution, depth: Tensor) -> Tensor:
    """F [B, ...]."""
    at_zero = distribution._sum(torch.zeros_like(depth))
    return (distribution._sum(depth) - at_zero) / (1 - at_zero)


def normal_where_missing(quantiles: Tensor | None, variance: Tensor) -> Tensor:
    """[B, 3] the quantiles, the normal distribution's where they are NaN or None; ``variance``: [B, ...]."""
    if quantiles is None:
        return variance.new_tensor(NORMAL).expand(len(variance), len(NORMAL))
    return torch.where(quantiles.isnan(), quantiles.new_tensor(NORMAL), quantiles)


def corrected(size: Tensor, quantiles: Tensor) -> Tensor:
    """|z| of the normal distribution for |z| = ``size`` [B, ...]: linear between 0 and the ``quantiles`` [3, B, ...],
    proportional beyond the last."""
    return _linear(size, quantiles, _normal(quantiles))


def uncorrected(size: Tensor, quantiles: Tensor) -> Tensor:
    """Inverse of :func:`corrected`."""
    return _linear(size, _normal(quantiles), quantiles)


def _normal(quantiles: Tensor) -> Tensor:
    """``NORMAL`` in the shape of ``quantiles`` [3, B, ...]."""
    return quantiles.new_tensor(NORMAL).view(-1, *[1] * (quantiles.dim() - 1)).expand_as(quantiles)


def _linear(x: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """The increasing function with the value 0 at 0 and ``end`` at ``start`` [3, B, ...]: linear between, proportional
    beyond. NaN where ``end`` or ``start`` is."""
    result, left, bottom = x * (end[-1] / start[-1]), torch.zeros_like(start[0]), torch.zeros_like(end[0])
    for right, top in zip(start, end, strict=True):
        share = (x - left) / (right - left).clamp_min(1e-12)  # two quantiles may be equal
        result = torch.where((x >= left) & (x <= right), bottom + share * (top - bottom), result)
        left, bottom = right, top
    return result + 0 * (start + end).sum(0)
