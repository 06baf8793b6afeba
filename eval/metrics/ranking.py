"""Metrics of the order of variances and errors: AUSE, AURG, Spearman, and the NLL by size of the error.

Ranks need all pixels at once, which a stream does not store. The pixels are therefore counted in bins of equal width in
the logarithm of the variance and of the error; pixels of one bin are ties. Each class states a bound on the error of
this approximation.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ufmstar_torch.eval.metrics.base import BINS, COUNT, SUM, Pixels, SumMetric, log_bin
from ufmstar_torch.eval.metrics.likelihood import gaussian_nll

JOINT_BINS = 512  # of variance and error in their joint histogram (5.5 % in variance, 2 MB)
_SHIFT = (BINS // JOINT_BINS).bit_length() - 1


def mean_of_share(count: Tensor, total: Tensor, shares: Tensor) -> Tensor:
    """[F] mean over the ``shares`` (0, 1] of the pixels in the first bins.

    The order within a bin is random; the expectation over all orders is linear in the number of its pixels.
    """
    pixels, sums = count.double().cumsum(0), total.cumsum(0)
    pixels_taken = shares * pixels[-1]
    bin_ = torch.searchsorted(pixels, pixels_taken).clamp(max=count.numel() - 1)
    before, sum_before = pixels[bin_] - count[bin_], sums[bin_] - total[bin_]
    part = (pixels_taken - before) / count[bin_].clamp(min=1)
    return (sum_before + part * total[bin_]) / pixels_taken


class Sparsification(SumMetric):
    """AUSE and AURG for RMSE and AbsRel, from sparsification curves with ties broken at random.

    The curve at f is the error of the pixels without the share f with the largest variance,
    f = 0, .02, ..., .98; its area is by the trapezoid rule, with the last value extended to 1. The oracle removes the
    largest errors; random removal does not change the error. Nothing is normalised, so the RMSE figures are in metres.
    ``compute()``: ``ause_rmse`` = area - oracle's area (0 is best), ``aurg_rmse`` = overall error -
    area (positive: better than random), ``ause_abs_rel``, ``aurg_abs_rel``, curves [50]
    ``sparsification_rmse``, ``sparsification_oracle_rmse`` and the same for abs_rel.

    Ties: pixels whose variance is in the same bin (4096 bins: .7 %, .35 % of sigma) are equal, so the curve is exactly
    that of variances rounded to bins.
    """

    OF_VARIANCE = "AUSE"
    STATES = (
        *((name, COUNT, BINS + 2) for name in ("count", "count_squared", "count_relative")),
        *((name, SUM, BINS + 2) for name in ("squared", "relative", "sum_squared", "sum_relative")),
    )

    def sums(self, pixels: Pixels) -> Mapping[str, Tensor]:
        judged, binned = pixels.judged, pixels.judged.histogram
        squared, relative, b, of_squared = judged.squared, judged.relative, judged.variance_bins, judged.squared_bins
        of_relative = log_bin(relative.log())
        return {
            "count": binned(b, BINS + 2),
            "squared": binned(b, BINS + 2, squared),
            "relative": binned(b, BINS + 2, relative),
            "count_squared": binned(of_squared, BINS + 2),
            "sum_squared": binned(of_squared, BINS + 2, squared),
            "count_relative": binned(of_relative, BINS + 2),
            "sum_relative": binned(of_relative, BINS + 2, relative),
        }

    def compute(self) -> dict[str, Tensor]:
        shares = 1 - torch.arange(50, dtype=torch.float64, device=self.count.device) / 50
        curves = {
            "rmse": mean_of_share(self.count, self.squared, shares).sqrt(),
            "oracle_rmse": mean_of_share(self.count_squared, self.sum_squared, shares).sqrt(),
            "abs_rel": mean_of_share(self.count, self.relative, shares),
            "oracle_abs_rel": mean_of_share(self.count_relative, self.sum_relative, shares),
        }
        results = {f"sparsification_{name}": curve for name, curve in curves.items()}
        for error in ("rmse", "abs_rel"):
            area = _area(curves[error])
            results[f"ause_{error}"] = area - _area(curves[f"oracle_{error}"])
            results[f"aurg_{error}"] = curves[error][0] - area
        return results


def _area(curve: Tensor) -> Tensor:
    """[] trapezoid rule over f = 0, .02, ..., .98, with the last value extended to 1."""
    return torch.trapezoid(curve, dx=1 / 50) + curve[-1] / 50


class SpearmanCorrelation(SumMetric):
    """Spearman's rank correlation of variance and squared error, ties at their mean rank.

    ``compute()``: ``spearman``, NaN if all variances or all errors are equal. Pixels of a bin are ties: on random maps
    the figure is within .002 of the exact one.
    """

    OF_VARIANCE = "Spearman's correlation"
    STATES = (("joint", COUNT, JOINT_BINS + 2, JOINT_BINS + 2),)

    def sums(self, pixels: Pixels) -> Mapping[str, Tensor]:
        size, judged = JOINT_BINS + 2, pixels.judged
        # Eight of the finer bins make one; a shift takes an eighth of a division's time.
        v, e = ((bins + (1 << _SHIFT) - 1) >> _SHIFT for bins in (judged.variance_bins, judged.squared_bins))
        both = v * size + e
        return {"joint": pixels.judged.histogram(both, size * size).reshape(size, size)}

    def compute(self) -> dict[str, Tensor]:
        joint = self.joint.double()
        x, y = _centred_ranks(joint.sum(1)), _centred_ranks(joint.sum(0))
        var_x, var_y = (joint.sum(1) * x.square()).sum(), (joint.sum(0) * y.square()).sum()
        return {"spearman": (x @ joint @ y) / (var_x * var_y).sqrt()}


def _centred_ranks(count: Tensor) -> Tensor:
    """[bins] mean rank of each bin minus the overall mean."""
    return count.cumsum(0) - count / 2 - count.sum() / 2  # the mean of n_b successive ranks, less 1/2


class NLLByError(SumMetric):
    """Mean NLL by percentile of the error (the paper's figure of binned error against NLL).

    The paper uses the pixels where another method is confident: pass them as ``valid``, the same for every compared
    method.
    ``compute()``: curve [10] ``nll_by_error``, mean NLL over v > 0 of the pixels between two deciles of the error, NaN
    without a pixel. Errors in the same bin are equal: 4096 bins of squared error, .35 % of the error.
    """

    OF_VARIANCE = "NLL by error"
    STATES = (("count", COUNT, BINS + 2), ("nll", SUM, BINS + 2))

    def sums(self, pixels: Pixels) -> Mapping[str, Tensor]:
        chosen = pixels.judged.certain
        b = chosen.squared_bins
        return {"count": chosen.histogram(b, BINS + 2), "nll": chosen.histogram(b, BINS + 2, gaussian_nll(chosen))}

    def compute(self) -> dict[str, Tensor]:
        shares = torch.arange(1, 11, dtype=torch.float64, device=self.count.device) / 10
        mean = mean_of_share(self.count, self.nll, shares) * shares
        return {"nll_by_error": torch.diff(mean, prepend=mean.new_zeros(1)) * 10}
