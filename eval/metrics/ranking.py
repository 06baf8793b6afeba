"""Metrics of the order of variances and errors: AUSE, AURG, Spearman, and the NLL by size of the error.

Ranks need all pixels at once; a stream has none of the earlier ones. So the pixels go into bins of equal
width in the logarithm of the variance and of the error, finer than anyone reads a variance, and pixels
of one bin count as ties. Each class states a bound on the error that this makes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.eval.metrics.base import COUNT, SUM, Array, Pixels, SumMetric
from ufmstar_torch.eval.metrics.likelihood import gaussian_nll

# In the logarithm of the variance or of the error; of both together: 5.5 % in variance, 2 MB of counts.
BINS, JOINT_BINS = 4096, 512
# Variances and squared errors [m^2] between (0.1 mm)^2 and (100 m)^2 are distinguished; 0 and what is
# smaller share the bin below, what is larger the bin above. Relative errors use the same bins.
LOW, HIGH = 1e-8, 1e4


def log_bin(value: Array, bins: int) -> NDArray[np.intp]:
    """Bins in [0, bins + 1] of values >= 0: 0 below ``LOW``, bins + 1 from ``HIGH`` on."""
    at = np.log(np.maximum(value, LOW) / LOW) * (bins / math.log(HIGH / LOW))
    return np.where(value < LOW, 0, np.minimum(at, bins).astype(np.intp) + 1)


def mean_of_share(count: Tensor, total: Tensor, shares: Tensor) -> Tensor:
    """[F] mean over the ``shares`` (0, 1] of the pixels in the first bins.

    Within a bin the order is random: the expectation over all orders is linear in the pixels taken.
    """
    pixels, sums = count.double().cumsum(0), total.cumsum(0)
    wanted = shares * pixels[-1]
    bin_ = torch.searchsorted(pixels, wanted).clamp(max=count.numel() - 1)
    before, sum_before = pixels[bin_] - count[bin_], sums[bin_] - total[bin_]
    part = (wanted - before) / count[bin_].clamp(min=1)
    return (sum_before + part * total[bin_]) / wanted


class Sparsification(SumMetric):
    """AUSE and AURG for RMSE and AbsRel, from sparsification curves with ties broken at random.

    The curve at f is the error of the pixels left after the share f with the largest variance is gone,
    f = 0, .02, ..., .98; its area is the trapezoid rule, the last value held up to 1. The oracle removes
    by the error itself; random removal leaves the error as it is. Nothing is normalised, so the RMSE
    figures are in metres.
    ``compute()``: ``ause_rmse`` = area - oracle's area (0 is best), ``aurg_rmse`` = overall error -
    area (positive: better than random), ``ause_abs_rel``, ``aurg_abs_rel``, curves [50]
    ``sparsification_rmse``, ``sparsification_oracle_rmse`` and the same for abs_rel.

    Ties: pixels whose variance agrees within a bin (4096 bins: .7 %, .35 % of sigma) count as equal, so
    the curve is exactly that of variances rounded so far.
    """

    OF_VARIANCE = "AUSE"
    STATES = (
        *((name, COUNT, BINS + 2) for name in ("count", "count_squared", "count_relative")),
        *((name, SUM, BINS + 2) for name in ("squared", "relative", "sum_squared", "sum_relative")),
    )

    def sums(self, pixels: Pixels) -> Mapping[str, Any]:
        d, v, g = pixels.judged
        squared, relative = np.square(d - g), np.abs(d - g) / g
        b, of_squared, of_relative = (log_bin(value, BINS) for value in (v, squared, relative))
        return {
            "count": np.bincount(b, minlength=BINS + 2),
            "squared": np.bincount(b, squared, BINS + 2),
            "relative": np.bincount(b, relative, BINS + 2),
            "count_squared": np.bincount(of_squared, minlength=BINS + 2),
            "sum_squared": np.bincount(of_squared, squared, BINS + 2),
            "count_relative": np.bincount(of_relative, minlength=BINS + 2),
            "sum_relative": np.bincount(of_relative, relative, BINS + 2),
        }

    def compute(self) -> dict[str, Tensor]:
        kept = 1 - torch.arange(50, dtype=torch.float64, device=self.count.device) / 50
        curves = {
            "rmse": mean_of_share(self.count, self.squared, kept).sqrt(),
            "oracle_rmse": mean_of_share(self.count_squared, self.sum_squared, kept).sqrt(),
            "abs_rel": mean_of_share(self.count, self.relative, kept),
            "oracle_abs_rel": mean_of_share(self.count_relative, self.sum_relative, kept),
        }
        results = {f"sparsification_{name}": curve for name, curve in curves.items()}
        for error in ("rmse", "abs_rel"):
            area = _area(curves[error])
            results[f"ause_{error}"] = area - _area(curves[f"oracle_{error}"])
            results[f"aurg_{error}"] = curves[error][0] - area
        return results


def _area(curve: Tensor) -> Tensor:
    """[] trapezoid rule over f = 0, .02, ..., .98, the last value held up to 1."""
    return torch.trapezoid(curve, dx=1 / 50) + curve[-1] / 50


class SpearmanCorrelation(SumMetric):
    """Spearman's rank correlation of variance and squared error, ties at their mean rank.

    ``compute()``: ``spearman``, NaN where all variances or all errors are alike. Pixels of a bin count as ties:
    on drawn maps the figure is within .002 of that of the single pixels.
    """

    OF_VARIANCE = "Spearman's correlation"
    STATES = (("joint", COUNT, JOINT_BINS + 2, JOINT_BINS + 2),)

    def sums(self, pixels: Pixels) -> Mapping[str, Any]:
        d, v, g = pixels.judged
        size = JOINT_BINS + 2
        both = log_bin(v, JOINT_BINS) * size + log_bin(np.square(d - g), JOINT_BINS)
        return {"joint": np.bincount(both, minlength=size * size).reshape(size, size)}

    def compute(self) -> dict[str, Tensor]:
        joint = self.joint.double()
        x, y = _centred_ranks(joint.sum(1)), _centred_ranks(joint.sum(0))
        var_x, var_y = (joint.sum(1) * x.square()).sum(), (joint.sum(0) * y.square()).sum()
        return {"spearman": (x @ joint @ y) / (var_x * var_y).sqrt()}


def _centred_ranks(count: Tensor) -> Tensor:
    """[bins] mean rank of each bin less the overall mean."""
    return count.cumsum(0) - count / 2 - count.sum() / 2  # the mean of n_b successive ranks, less 1/2


class NLLByError(SumMetric):
    """Mean NLL by percentile of the error (the paper's figure of binned error against NLL).

    The paper looks at pixels where another method is confident: pass these as ``valid``, and the same
    ones for every method that is compared.
    ``compute()``: curve [10] ``nll_by_error``, mean NLL over v > 0 of the pixels between one decile and the next, NaN
    without a pixel. Errors that agree within a bin count as equal: 4096 bins of squared error, .35 % of the error.
    """

    OF_VARIANCE = "NLL by error"
    STATES = (("count", COUNT, BINS + 2), ("nll", SUM, BINS + 2))

    def sums(self, pixels: Pixels) -> Mapping[str, Any]:
        d, v, g = (value[pixels.judged[1] > 0] for value in pixels.judged)
        b = log_bin(np.square(d - g), BINS)
        return {"count": np.bincount(b, minlength=BINS + 2), "nll": np.bincount(b, gaussian_nll(d, v, g), BINS + 2)}

    def compute(self) -> dict[str, Tensor]:
        kept = torch.arange(1, 11, dtype=torch.float64, device=self.count.device) / 10
        mean = mean_of_share(self.count, self.nll, kept) * kept
        return {"nll_by_error": torch.diff(mean, prepend=mean.new_zeros(1)) * 10}
