"""The posterior as a mixture: with probability 1 - p a pixel is on its evidence's surface, else on another one."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import torch
from torch import Tensor

from ufmstar_torch.eval.metrics.base import COUNT, SUM, Pixels, Selection, SumMetric, share
from ufmstar_torch.eval.metrics.calibration import quantile_levels

_BINS, _DELTA = 10, 0.25
# Mass of a normal distribution within three standard deviations.
_THREE_SIGMA = 0.9973002039367398


class Mixture(SumMetric):
    """NLL, calibration and coverage of (1 - p) N(d, v_1) + p N(d, v_2), whose variance is v.

    v_2 = (v - (1 - p) v_1)/p, at least v_1. The pixels are those with ground truth, a finite depth, v_1 > 0 and p.
    ``compute()``: ``mixture_nll`` [nats], ``mixture_ece_delta`` and ``mixture_ece_q`` with the bins of ``ECEDelta`` and
    ``ECEQuantile``, ``mixture_coverage``: share of ground truths in the central interval of three sigma's mass, .9973.
    Curves [10] over bins of p, of the share of pixels beyond three sigma of the inliers (NaN in an empty bin):
    ``outlier_stated`` by the mixture, ``outlier_found``; and ``outlier_pixels``. {} without a pixel: only a posterior
    has a mixture.
    """

    OF_VARIANCE = "the mixture"
    NEEDS = "inlier"
    STATES = (
        *(("total", SUM), ("confidence", SUM, _BINS), ("stated", SUM, _BINS), ("covered", COUNT)),
        *((name, COUNT, _BINS) for name in ("accurate", "pixels", "at_or_below", "beyond", "with_outlier")),
    )

    CONSTANTS = MappingProxyType({"levels": quantile_levels(_BINS)})

    def sums(self, pixels: Pixels) -> Mapping[str, Tensor]:
        maps = pixels.depth, pixels.variance, pixels.target, pixels.inlier, pixels.outlier
        v1, p = pixels.inlier, pixels.outlier
        used = (v1 > 0) & v1.isfinite() & (p >= 0) & (p <= 1)
        d, v, g, v1, p = chosen = Selection(maps, used & pixels.with_truth & pixels.predicted)
        parts = torch.stack([v1, torch.maximum((v - (1 - p) * v1) / p.clamp_min(1e-12), v1)])
        weight, sigma, error = torch.stack([1 - p, p]), parts.sqrt(), g - d
        log_density = -(error.square() / parts + (2 * torch.pi * parts).log()) / 2
        confidence = (weight * torch.erf(_DELTA * d.abs() / (2**0.5 * sigma))).sum(0)
        below = (weight * (1 + torch.erf(error / (2**0.5 * sigma)))).sum(0) / 2
        beyond = (weight * torch.erfc(3 * v1.sqrt() / (2**0.5 * sigma))).sum(0)
        bins, by_outlier = ((x * _BINS).long().clamp_max(_BINS - 1) for x in (confidence, p))
        accurate = error.abs() <= _DELTA * d.abs()
        first = chosen.histogram((below * _BINS - 0.5).ceil().long(), _BINS + 1)  # number of levels below
        return {
            "total": -chosen.total(torch.logaddexp(*(weight.log() + log_density))),
            "confidence": chosen.histogram(bins, _BINS, confidence),
            "pixels": chosen.histogram(bins, _BINS),
            "accurate": chosen.histogram(bins, _BINS, accurate),
            "at_or_below": first.cumsum(0)[:-1],
            "stated": chosen.histogram(by_outlier, _BINS, beyond),
            "beyond": chosen.histogram(by_outlier, _BINS, error.square() > 9 * v1),
            "with_outlier": chosen.histogram(by_outlier, _BINS),
            "covered": chosen.number((below - 0.5).abs() <= _THREE_SIGMA / 2),
        }

    def compute(self) -> dict[str, Tensor]:
        count = self.pixels.sum()
        if not int(count):
            return {}
        gap = (self.confidence - self.accurate.double()).abs().sum()
        observed = share(self.at_or_below, count)
        return {
            "mixture_nll": share(self.total, count),
            "mixture_ece_delta": share(gap, count),
            "mixture_ece_q": (observed - self.levels).abs().mean(),
            "mixture_coverage": share(self.covered, count),
            "outlier_stated": share(self.stated, self.with_outlier),
            "outlier_found": share(self.beyond, self.with_outlier),
            "outlier_pixels": self.with_outlier.double(),
        }
