"""The posterior's memory of a stream: sums with a half-life, and the last frame's coefficients.

Frames with anchors update these ratios:

- amplitude: scale of the variance of the network's error
- roughness: variance of y between neighbouring pixels
- noise: factor by which the anchors' stated variances are too small
- unseen: increase of the error's variance with the distance from evidence
- wrong: probability that the local correction does not hold
- inlier: factor by which the variance is too small where the correction holds
- calibration: mean z^2 of held-out anchors

Each ratio is the quotient of two sums that fade towards a prior, so that few anchors change it little.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from ufmstar_torch.posterior.config import PosteriorConfig

FEATURES = 4  # 1, log d - m_0, u and v from -1 to 1
_MATRIX = FEATURES * FEATURES
# Limits of stored values, beyond what any run reaches: of m_0, the log of the largest accepted depth
# (``frame.DEPTH_RANGE``); of all values, which count anchors and frames or are squares of logs.
LARGEST_LOG, LARGEST = 14.0, 1e9


class Ratio(NamedTuple):
    """The prior of a ratio: its value, its weight in anchors, and the limits of the ratio."""

    value: float
    weight: float
    least: float
    largest: float


def ratios(config: PosteriorConfig) -> dict[str, Ratio]:
    """The priors of the ratios by name. The calibration has none."""
    weight = config.prior_weight
    return {
        "amplitude": Ratio(1.0, weight, 0.1, 100.0),
        "roughness": Ratio(config.roughness**2, weight, 0.01**2, 0.2**2),
        "noise": Ratio(1.0, weight, 0.25, 16.0),
        "unseen": Ratio(config.unseen, weight, 0.0, 16.0),
        "wrong": Ratio(config.wrong, weight, config.wrong / 10, 10 * config.wrong),
        "inlier": Ratio(1.0, weight, 0.05, 4.0),
        "calibration": Ratio(0.0, 0.0, 0.0, 1e6),
    }


RATIOS = len(ratios(PosteriorConfig()))
SIZE = 2 + 2 * RATIOS + FEATURES + _MATRIX


def restarted(packed: Tensor, config: PosteriorConfig) -> Tensor:
    """Memory [B, SIZE] with the initial coefficients: wrong poses can have corrupted them. The ratios depend on network
    and scene and remain. Zeros before the first anchor."""
    P = torch.diag(packed.new_tensor(config.prior_variance)).flatten()
    start = torch.cat([packed.new_zeros(FEATURES), P]) * (packed[:, :1] > 0)
    return torch.cat([packed[:, : -FEATURES - _MATRIX], start], 1)


@dataclass(frozen=True)
class Running:
    """The posterior's memory of B streams.

    Attributes:
        config: of the posterior.
        frames: [B] number of frames with anchors.
        mean: [B] m_0 of the last frame.
        above, below: [B] numerators and denominators of :func:`ratios`, by name.
        coefficients: [B, 4] of the features in the last frame.
        covariance: [B, 4, 4] of the coefficients.
    """

    config: PosteriorConfig
    frames: Tensor
    mean: Tensor
    above: dict[str, Tensor]
    below: dict[str, Tensor]
    coefficients: Tensor
    covariance: Tensor

    @classmethod
    def of(cls, packed: Tensor, config: PosteriorConfig) -> Running:
        """Unpack [B, SIZE]; a row of zeros is the start."""
        packed, priors = packed.double(), ratios(config)
        frames, mean, sums, coefficients, covariance = packed.split([1, 1, 2 * RATIOS, FEATURES, _MATRIX], 1)
        new = frames == 0
        start = [r.value * r.weight for r in priors.values()] + [r.weight for r in priors.values()]
        above, below = torch.where(new, sums.new_tensor(start), sums).split(RATIOS, 1)
        P = torch.diag(packed.new_tensor(config.prior_variance))
        return cls(
            config, frames[:, 0], mean[:, 0], dict(zip(priors, above.unbind(1), strict=True)),
            dict(zip(priors, below.unbind(1), strict=True)), coefficients,
            torch.where(new[..., None], P, covariance.reshape(-1, FEATURES, FEATURES)),
        )  # fmt: skip

    def packed(self) -> Tensor:
        """Pack into [B, SIZE]; inverse of :meth:`of`."""
        scalars = [self.frames, self.mean, *self.above.values(), *self.below.values()]
        return torch.cat([torch.stack(scalars, 1), self.coefficients, self.covariance.flatten(1)], 1)

    def drifted(self, mean: Tensor) -> Tensor:
        """[B, SIZE] after a frame without anchors whose m_0 is ``mean`` [B]; zeros before the first anchor."""
        coefficients, covariance = self.expected(mean)
        packed = replace(self, mean=mean, coefficients=coefficients, covariance=covariance).packed()
        return torch.where(self.frames[:, None] > 0, packed, torch.zeros_like(packed))

    def require(self) -> None:
        """Raise a ValueError if no anchors can have led to these values."""
        sums = torch.stack([*self.above.values(), *self.below.values(), self.frames])
        scale = self.covariance.abs().amax((1, 2)).clamp(1e-300, 1e300)
        low = torch.linalg.eigvalsh(self.covariance / scale[:, None, None])[:, 0]
        faults = {
            f"values beyond {LARGEST:g}": self.packed().abs() > LARGEST,
            "negative sums": sums < 0,
            "a mean log depth out of range": self.mean.abs() > LARGEST_LOG,
            "a covariance with negative eigenvalues": low < -1e-6,
        }
        if names := [name for name, bad in faults.items() if bool(bad.any())]:
            raise ValueError(f"posterior holds impossible values: {', '.join(names)}")

    def ratio(self, name: str) -> Tensor:
        """[B] a ratio within its limits; the prior's value where the denominator is 0."""
        prior, below = ratios(self.config)[name], self.below[name]
        ratio = torch.where(below > 0, self.above[name] / below.clamp_min(1e-12), torch.full_like(below, prior.value))
        return ratio.clamp(prior.least, prior.largest)

    def added(self, name: str, above: Tensor, below: Tensor) -> tuple[Tensor, Tensor]:
        """Numerator and denominator [B] of a ratio after a frame with the sums ``above`` and ``below`` [B]."""
        prior, fade = ratios(self.config)[name], 0.5 ** (1 / self.config.half_life)
        n = fade * self.below[name] + (1 - fade) * prior.weight + below
        total = fade * self.above[name] + (1 - fade) * prior.weight * prior.value + above
        return torch.minimum(torch.maximum(total, prior.least * n), prior.largest * n), n

    def expected(self, mean: Tensor) -> tuple[Tensor, Tensor]:
        """Predict coefficients [B, 4] and covariance [B, 4, 4] for a frame whose m_0 is ``mean`` [B]: a random walk
        from the last frame. The walk stops adding variance at the prior's."""
        T = torch.eye(FEATURES, dtype=mean.dtype, device=mean.device).repeat(len(mean), 1, 1)
        T[:, 0, 1] = torch.where(self.frames > 0, mean - self.mean, torch.zeros_like(mean))
        transformed = T @ self.covariance @ T.mT
        prior = mean.new_tensor(self.config.prior_variance)
        remaining = (1 - transformed.diagonal(dim1=1, dim2=2) / prior).clamp(0, 1)
        started = (self.frames > 0).to(mean)[:, None]
        grown = torch.diag_embed(self.config.drift**2 * remaining * started)
        return (T @ self.coefficients[..., None])[..., 0], transformed + grown
