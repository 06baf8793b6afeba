"""The posterior's memory of a stream: sums with a half-life, and the last frame's coefficients.

Everything here is learnt from anchors alone, in frames that have some: how far the network's error varies (amplitude),
how much anchors and network differ from one pixel to the next (roughness), by what factor the anchors' variances are
stated too small (noise), how fast the error grows with the distance from evidence (unseen), how often the local
correction does not hold (wrong), by what factor the variance is stated too small where it does (inlier), and how well
held-out anchors were predicted (calibration). Each is a ratio of two sums that fade towards a prior, so that a few
anchors do not decide.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from ufmstar_torch.posterior.config import PosteriorConfig

FEATURES = 4  # 1, log d - m_0, u and v from -1 to 1
_MATRIX = FEATURES * FEATURES
# Beyond what any run reaches: of m_0, the log of the largest depth that is accepted (``frame.DEPTH_RANGE``); of the
# others, which count anchors and frames or are squares of logs.
LARGEST_LOG, LARGEST = 14.0, 1e9


class Ratio(NamedTuple):
    """The prior of a ratio: its value, its weight in anchors, and the range that the ratio keeps."""

    value: float
    weight: float
    least: float
    largest: float


def ratios(config: PosteriorConfig) -> dict[str, Ratio]:
    """The ratios by name. Nothing is known of the calibration, a mean z^2, before the first frame."""
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
    """Memory [B, SIZE] with the coefficients of the start: where poses were wrong, the coefficients may be. The ratios
    remain: they depend on network and scene. Zeros before the first anchor."""
    P = torch.diag(packed.new_tensor(config.prior_variance)).flatten()
    start = torch.cat([packed.new_zeros(FEATURES), P]) * (packed[:, :1] > 0)
    return torch.cat([packed[:, : -FEATURES - _MATRIX], start], 1)


@dataclass(frozen=True)
class Running:
    """The posterior's memory of B streams.

    Attributes:
        config: of the posterior.
        frames: [B] that had anchors.
        mean: [B] m_0 of the last frame.
        above, below: by name of :func:`ratios`, [B] sums whose quotient is the ratio.
        coefficients: [B, 4] of the features in the last frame.
        covariance: [B, 4, 4] of these.
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
        """From a row of numbers [B, SIZE] a stream; zeros are the start."""
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
        """[B, SIZE], for :meth:`of`."""
        scalars = [self.frames, self.mean, *self.above.values(), *self.below.values()]
        return torch.cat([torch.stack(scalars, 1), self.coefficients, self.covariance.flatten(1)], 1)

    def drifted(self, mean: Tensor) -> Tensor:
        """[B, SIZE] after a frame without anchors whose m_0 is ``mean`` [B]; zeros before the first anchor."""
        coefficients, covariance = self.expected(mean)
        packed = replace(self, mean=mean, coefficients=coefficients, covariance=covariance).packed()
        return torch.where(self.frames[:, None] > 0, packed, torch.zeros_like(packed))

    def require(self) -> None:
        """Raise a ValueError unless anchors can have taught these numbers."""
        sums = torch.stack([*self.above.values(), *self.below.values(), self.frames])
        scale = self.covariance.abs().amax((1, 2)).clamp(1e-300, 1e300)
        low = torch.linalg.eigvalsh(self.covariance / scale[:, None, None])[:, 0]
        wrong = {
            f"values beyond {LARGEST:g}": self.packed().abs() > LARGEST,
            "negative sums": sums < 0,
            "a mean of logs that no depth has": self.mean.abs() > LARGEST_LOG,
            "a covariance that is none": low < -1e-6,
        }
        if names := [name for name, bad in wrong.items() if bool(bad.any())]:
            raise ValueError(f"posterior holds impossible values: {', '.join(names)}")

    def ratio(self, name: str) -> Tensor:
        """[B] within its range; 0/0 is the prior's value."""
        prior, below = ratios(self.config)[name], self.below[name]
        ratio = torch.where(below > 0, self.above[name] / below.clamp_min(1e-12), torch.full_like(below, prior.value))
        return ratio.clamp(prior.least, prior.largest)

    def added(self, name: str, above: Tensor, below: Tensor) -> tuple[Tensor, Tensor]:
        """The two sums of a ratio [B] after a frame with these [B]."""
        prior, memory = ratios(self.config)[name], 0.5 ** (1 / self.config.half_life)
        n = memory * self.below[name] + (1 - memory) * prior.weight + below
        total = memory * self.above[name] + (1 - memory) * prior.weight * prior.value + above
        return torch.minimum(torch.maximum(total, prior.least * n), prior.largest * n), n

    def expected(self, mean: Tensor) -> tuple[Tensor, Tensor]:
        """Coefficients [B, 4] and their covariance [B, 4, 4] before a frame whose m_0 is ``mean`` [B]: a random walk
        from the last frame, whose variances do not grow beyond those of the start."""
        T = torch.eye(FEATURES, dtype=mean.dtype, device=mean.device).repeat(len(mean), 1, 1)
        T[:, 0, 1] = torch.where(self.frames > 0, mean - self.mean, torch.zeros_like(mean))
        walked = T @ self.covariance @ T.mT
        prior = mean.new_tensor(self.config.prior_variance)
        left = (1 - walked.diagonal(dim1=1, dim2=2) / prior).clamp(0, 1)
        started = (self.frames > 0).to(mean)[:, None]
        grown = torch.diag_embed(self.config.drift**2 * left * started)
        return (T @ self.coefficients[..., None])[..., 0], walked + grown
