"""Figures of a validation, and the baseline of a constant variance.

The baseline is the likelihood without a variance head: the same depth with one variance for all pixels, the mean
squared error. It is estimated on the training part ("nll_constant"), as in practice, and for comparison on the
validation part ("nll_constant_best"), the optimum of all constants.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ufmstar_torch.eval.metrics import NLL, DepthAccuracy
from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.train.losses import gaussian_nll

FIGURES = ("val_nll", "val_nll_constant", "val_nll_constant_best", "val_delta1", "val_rmse", "val_rel")
# [m^2] Smallest constant variance: (1 mm)^2, as for the heads.
VARIANCE_FLOOR = 1e-6


@dataclass(frozen=True, eq=False)
class Sums:
    """Sum of a value per pixel (for example of squared errors [m^2]), and the number of pixels, on their device."""

    values: Tensor | None = None  # [2] float64; None without pixels

    def plus(self, values: Tensor) -> Sums:
        """The sums with more pixels [2]; does not wait for the device."""
        return Sums(values if self.values is None else self.values + values)

    @property
    def pixels(self) -> float:
        """The number of pixels."""
        return 0.0 if self.values is None else float(self.values[1])

    def mean(self) -> float:
        """The mean over the pixels; NaN without pixels."""
        return math.nan if self.values is None or not self.pixels else float(self.values[0]) / self.pixels


class Validation:
    """The figures of one validation, over the valid pixels of all processes. NCCL requires the sums on the GPU."""

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self._accuracy = DepthAccuracy().to(device)
        self._nll = NLL().to(device)
        self._has_variance = False

    def update(self, prediction: DepthPrediction, depth: Tensor, valid: Tensor) -> None:
        """Add a batch: true depth [B, H, W] [m], ``valid`` [B, H, W] bool, True = use."""
        self._accuracy.update(prediction.depth, None, depth, valid)
        if prediction.variance is not None:
            self._has_variance = True
            self._nll.update(prediction.depth, prediction.variance.clamp(min=VARIANCE_FLOOR), depth, valid)

    def figures(self, training: Sums) -> dict[str, float]:
        """The figures by their names in metrics.csv: the NLL only if the network predicts a variance, no figures
        without a pixel. ``training``: squared errors of the training part [m^2]. All processes must call this."""
        accuracy = self._accuracy.compute()
        if not accuracy["pixels"]:
            return {}
        rmse = accuracy["rmse"]
        figures = {
            "val_delta1": accuracy["delta1_ratio"],
            "val_rmse": rmse,
            "val_rel": accuracy["abs_rel"],
            "val_nll_constant_best": constant_nll(rmse, rmse.square()),
        }
        if training.pixels:
            figures["val_nll_constant"] = constant_nll(rmse, rmse.new_tensor(training.mean()))
        if self._has_variance:
            figures["val_nll"] = self._nll.compute()["nll"]
        return {name: float(value) for name, value in figures.items()}


def constant_nll(rmse: Tensor, variance: Tensor) -> Tensor:
    """Mean Gaussian negative log likelihood [nat] of errors with that RMSE [m] under one variance [m^2] (at least
    :data:`VARIANCE_FLOOR`) for all pixels."""
    return gaussian_nll(torch.zeros_like(rmse), variance.clamp(min=VARIANCE_FLOOR).log(), rmse)
