"""Calibration of N(d, v): ECE_delta and ECE_q with their curves (section "Metrics for Uncertainty")."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.eval.metrics.base import COUNT, SUM, Pixels, SumMetric, share
from ufmstar_torch.runtime.kinds import check_kinds


class ECEDelta(SumMetric):
    """ECE_delta = sum_b |b|/S |acc(b) - conf(b)| and the delta calibration curve.

    Confidence: mass of N(d, v) on [(1 - delta) d, (1 + delta) d]; accuracy: 1 if the ground truth lies
    in that interval; B equal-width bins on [0, 1], with three sums each.
    ``compute()``: ``ece_delta``, NaN without a pixel; curve [B] ``ece_delta_confidence``,
    ``ece_delta_accuracy`` (NaN in empty bins) and ``ece_delta_pixels``; ``overconfidence`` = mean
    confidence - mean accuracy, positive if the variance is too small.

    A variant in circulation (the helper of the older MIT code) bins between the smallest and largest
    confidence, uses bin centres for conf(b), and tests the accuracy around the ground truth. Its
    figures differ, so do not compare them with these.

    Args:
        delta: half-width of the interval relative to the depth; the paper's .25.
        bins: B; the paper names none, the default is 10, the authors use 100.
    """

    OF_VARIANCE = "ECE_delta"

    @check_kinds
    def __init__(self, delta: float = 0.25, bins: int = 10, **kwargs: Any) -> None:
        if not 0 < delta < 1 or bins < 1:
            raise ValueError(f"delta must lie in (0, 1) and bins be >= 1, got delta={delta}, bins={bins}")
        self.settings = {"delta": delta, "bins": bins}
        self.STATES = (("confidence", SUM, bins), ("accurate", COUNT, bins), ("pixels", COUNT, bins))
        super().__init__(**kwargs)

    def sums(self, pixels: Pixels) -> Mapping[str, Tensor]:
        chosen = pixels.judged
        delta, bins = self.settings["delta"], self.settings["bins"]
        tolerance = delta * chosen.map("depth").abs()
        # Bin b is [b/B, (b+1)/B); a confidence of exactly 1, as of v = 0, belongs to the last.
        confidence = torch.erf(tolerance / (math.sqrt(2.0) * chosen.sigma)).nan_to_num(1.0)
        b = (confidence * bins).long().clamp_max(bins - 1)
        count, accurate = chosen.parted(b, bins, chosen.error <= tolerance)
        return {"confidence": chosen.histogram(b, bins, confidence), "accurate": accurate, "pixels": count}

    def compute(self) -> dict[str, Tensor]:
        total = self.pixels.sum()
        gap = self.confidence - self.accurate.double()
        return {
            "ece_delta": share(gap.abs().sum(), total),
            "overconfidence": share(gap.sum(), total),
            "ece_delta_confidence": share(self.confidence, self.pixels),
            "ece_delta_accuracy": share(self.accurate, self.pixels),
            "ece_delta_pixels": self.pixels.double(),
        }


def quantile_levels(bins: int) -> Tensor:
    """[B] q_b = (b - 1/2) / B, b = 1..B; the levels 0 and 1, which are always right, are excluded."""
    return (torch.arange(bins, dtype=torch.float64) + 0.5) / bins


class ECEQuantile(SumMetric):
    """ECE_q = 1/B sum_b |obs(q_b) - q_b| and the quantile calibration curve.

    The predicted quantile is the inverse CDF of N(d, v) at q_b, d itself where v = 0; obs(q_b) is the
    share of pixels whose ground truth lies at or below it.
    ``compute()``: ``ece_q``, NaN without a pixel; curve [B] ``ece_q_levels``, ``ece_q_observed``.

    Args:
        levels: q_b, rising, within [0, 1]; None = .05, .15, ..., .95 (the paper names no B). The authors use
            0, .01, ..., 1, whose ends are right by definition.
    """

    OF_VARIANCE = "ECE_q"

    @check_kinds
    def __init__(self, levels: Sequence[float] | None = None, **kwargs: Any) -> None:
        q = quantile_levels(10) if levels is None else torch.tensor(list(levels), dtype=torch.float64)
        if q.numel() == 0 or not bool(((q >= 0) & (q <= 1)).all() and (q.diff() > 0).all()):
            raise ValueError(f"levels must rise within [0, 1], got {levels}")
        self.settings = {"levels": q.tolist()}
        self.CONSTANTS = {"levels": q, "quantiles": torch.special.ndtri(q)}
        self.STATES = (("at_or_below", COUNT, len(q)), ("pixels", COUNT))
        super().__init__(**kwargs)

    def sums(self, pixels: Pixels) -> Mapping[str, Tensor]:
        chosen = pixels.judged
        d, _, g = chosen
        z = ((g - d) / chosen.sigma).nan_to_num(-torch.inf, torch.inf, -torch.inf)
        # For ten levels ``searchsorted`` takes twice as long.
        at_or_below = torch.stack([chosen.number(z <= quantile) for quantile in self.quantiles])
        return {"at_or_below": at_or_below, "pixels": chosen.number()}

    def compute(self) -> dict[str, Tensor]:
        observed = share(self.at_or_below, self.pixels)
        return {"ece_q": (observed - self.levels).abs().mean(), "ece_q_levels": self.levels, "ece_q_observed": observed}
