"""The posterior as a mixture: with probability 1 - p a pixel is on its evidence's surface, else on another one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

import torch
from torch import Tensor

from ufmstar_torch.eval.metrics.base import COUNT, SUM, TOLERANCE, Pixels, SumMetric, share
from ufmstar_torch.eval.metrics.calibration import quantile_levels

_BINS = 10
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
        v1, p = (pixels.judged.map(name) for name in ("inlier", "outlier"))
        chosen = pixels.judged.where((v1 > 0) & (v1 < torch.inf) & (p >= 0) & (p <= 1))
        d, v, g = chosen
        v1, p = chosen.map("inlier"), chosen.map("outlier")
        v2 = torch.maximum((v - (1 - p) * v1) / p.clamp_min(1e-12), v1)
        error, tolerance, squared = g - d, TOLERANCE * d.abs(), chosen.squared
        inner, outer = ((2 * part).sqrt() for part in (v1, v2))
        # ln (w N) of both parts, without the constant
        densities = [((w.square() / part).log() - squared / part) / 2 for w, part in ((1 - p, v1), (p, v2))]
        confidence = torch.lerp(torch.erf(tolerance / inner), torch.erf(tolerance / outer), p)
        below = (1 + torch.lerp(torch.erf(error / inner), torch.erf(error / outer), p)) / 2
        beyond = torch.lerp(torch.full_like(p, 1 - _THREE_SIGMA), torch.erfc(3 * inner / (2**0.5 * outer)), p)
        bins, by_outlier = ((x * _BINS).long().clamp_max(_BINS - 1) for x in (confidence, p))
        counts, accurate = chosen.parted(bins, _BINS, chosen.error <= tolerance)
        with_outlier, beyond_three = chosen.parted(by_outlier, _BINS, squared > 9 * v1)
        first = chosen.histogram((below * _BINS - 0.5).ceil().long(), _BINS + 1)  # number of levels below
        return {
            "total": chosen.total(math.log(2 * math.pi) / 2 - torch.logaddexp(*densities)),
            "confidence": chosen.histogram(bins, _BINS, confidence),
            "pixels": counts,
            "accurate": accurate,
            "at_or_below": first.cumsum(0)[:-1],
            "stated": chosen.histogram(by_outlier, _BINS, beyond),
            "beyond": beyond_three,
            "with_outlier": with_outlier,
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
