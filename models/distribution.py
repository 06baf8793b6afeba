"""Parameters of the distributions that uncertainty heads predict per pixel.

The losses need the parameters, UfM* the moments (``DepthPrediction``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.runtime.kinds import check_fields


class _Maps:
    """Checks that all fields are maps of one shape."""

    def __post_init__(self) -> None:
        check_fields(self)
        shapes = [()] if torch.jit.is_tracing() else [tuple(value.shape) for value in vars(self).values()]
        if any(shape != shapes[0] for shape in shapes):
            raise ValueError(f"{type(self).__name__} must hold maps of one shape, got {shapes}")


@dataclass(frozen=True)
class PointDepth(_Maps):
    """Depth without a variance."""

    depth: Tensor  # [B, H, W] [m]

    def prediction(self) -> DepthPrediction:
        """No variances."""
        return DepthPrediction(self.depth)


@dataclass(frozen=True)
class GaussianDepth(_Maps):
    """N(depth, exp(log_variance)) (Kendall and Gal 2017)."""

    depth: Tensor  # [B, H, W] mean [m]
    # [B, H, W] natural logarithm of the variance [m^2]: the loss is stable in it, and every real number is valid
    log_variance: Tensor

    def prediction(self) -> DepthPrediction:
        """A = exp(log_variance)."""
        return DepthPrediction(self.depth, aleatoric_variance=self.log_variance.exp())


@dataclass(frozen=True)
class EvidentialDepth(_Maps):
    """Normal-Inverse-Gamma evidence (Amini et al. 2020, Eq. 4 and 5).

    Mean and variance of the depth are random: variance ~ Inverse-Gamma(alpha, beta) and
    mean | variance ~ N(depth, variance / nu).
    """

    depth: Tensor  # [B, H, W] gamma [m]
    nu: Tensor  # [B, H, W] > 0, virtual observations of the mean
    alpha: Tensor  # [B, H, W] > 1, half the virtual observations of the variance
    beta: Tensor  # [B, H, W] > 0 [m^2]

    def prediction(self) -> DepthPrediction:
        """A = E[variance] = beta / (alpha - 1) and E = Var[mean] = beta / (nu (alpha - 1))."""
        aleatoric = self.beta / (self.alpha - 1)
        return DepthPrediction(self.depth, aleatoric, aleatoric / self.nu)


DepthDistribution = PointDepth | GaussianDepth | EvidentialDepth


def images_of(distribution: DepthDistribution, images: slice) -> DepthDistribution:
    """The distribution of some images of a batch."""
    return replace(distribution, **{name: value[images] for name, value in vars(distribution).items()})
