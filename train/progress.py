"""How good a network is while it is trained: sums over pixels, and what a variance head has gained.

The yardstick is the best that one can say without a head: the same depth with one variance for all pixels. Its
likelihood depends on the squared errors only. The variance is taken from the training part ("nll_constant"), as
anyone would have to, and for comparison from the validation itself ("nll_constant_best"), which no constant beats.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import astuple, dataclass

import torch
from torch import Tensor

from ufmstar_torch.prediction import DepthPrediction

# [m^2] Smallest variance of a constant: (1 mm)^2, as the heads have it.
VARIANCE_FLOOR = 1e-6
DELTA = 1.25


@dataclass(frozen=True)
class Sums:
    """Of a value per pixel (a squared error [m^2], say), and the number of pixels."""

    total: float = 0.0
    pixels: float = 0.0

    def plus(self, total: float, pixels: float) -> Sums:
        """With more pixels."""
        return Sums(self.total + total, self.pixels + pixels)

    def to_list(self) -> list[float]:
        """As it is stored."""
        return [self.total, self.pixels]

    def mean(self) -> float:
        """NaN without pixels."""
        return self.total / self.pixels if self.pixels else math.nan

    def variance(self) -> float:
        """Of squared errors: their mean [m^2], at least :data:`VARIANCE_FLOOR`; NaN without pixels."""
        return max(self.mean(), VARIANCE_FLOOR) if self.pixels else math.nan


@dataclass(frozen=True)
class ValidationSums:
    """Over the valid pixels of a validation.

    Attributes:
        pixels: their number.
        squared: of (depth - truth)^2 [m^2].
        relative: of |depth - truth| / truth.
        within: pixels with max(depth / truth, truth / depth) < 1.25.
        nll: of the Gaussian negative log likelihood [nat], and how many pixels have a variance.
    """

    pixels: float = 0.0
    squared: float = 0.0
    relative: float = 0.0
    within: float = 0.0
    nll: float = 0.0
    with_variance: float = 0.0

    def plus(self, prediction: DepthPrediction, depth: Tensor, valid: Tensor) -> ValidationSums:
        """With a batch.

        Args:
            prediction: maps [B, H, W].
            depth: [B, H, W] truth [m].
            valid: [B, H, W] bool, True = use.
        """
        use = valid & depth.isfinite() & (depth > 0)
        truth, predicted = depth[use].double(), prediction.depth[use].double()
        error = predicted - truth
        within = torch.maximum(predicted, truth) < DELTA * torch.minimum(predicted, truth)
        nll, counted = error.new_zeros(()), 0
        parts = [v for v in (prediction.aleatoric_variance, prediction.epistemic_variance) if v is not None]
        if parts:
            variance = torch.stack([part[use].double() for part in parts]).sum(0).clamp(min=VARIANCE_FLOOR)
            nll, counted = constant_nll_sum(error.square() / variance, variance), len(truth)
        more = torch.stack([error.square().sum(), (error.abs() / truth).sum(), within.sum().double(), nll]).tolist()
        added = (len(truth), *more, counted)
        return ValidationSums(*(a + b for a, b in zip(astuple(self), added, strict=True)))

    def over(self, reduce: Callable[[Tensor], Tensor]) -> ValidationSums:
        """The sums of all processes together; ``reduce`` adds a vector up over them."""
        return ValidationSums(*reduce(torch.tensor(astuple(self), dtype=torch.float64)).tolist())

    def figures(self, training: Sums) -> dict[str, float]:
        """Names as in metrics.csv -> values; the NLL only where the network says a variance.

        Args:
            training: squared errors of the training part.
        """
        mean = self.squared / self.pixels
        figures = {
            "val_delta1": self.within / self.pixels,
            "val_rmse": math.sqrt(mean),
            "val_rel": self.relative / self.pixels,
            "val_nll_constant_best": constant_nll(mean, max(mean, VARIANCE_FLOOR)),
        }
        if training.pixels:
            figures["val_nll_constant"] = constant_nll(mean, training.variance())
        if self.with_variance:
            figures["val_nll"] = self.nll / self.with_variance
        return figures


def constant_nll(mean_squared: float, variance: float) -> float:
    """Mean Gaussian negative log likelihood [nat] of errors with that mean square, under one variance [m^2]."""
    return 0.5 * (math.log(2 * math.pi * variance) + mean_squared / variance)


def constant_nll_sum(normalised: Tensor, variance: Tensor) -> Tensor:
    """Sum of the negative log likelihood [nat] of error^2 / variance under each pixel's own variance [m^2]."""
    return 0.5 * (normalised + (2 * math.pi * variance).log()).sum()
