"""Do central intervals hold as much ground truth as they state, and what does a gate on sigma keep?"""

from __future__ import annotations

from collections.abc import Mapping
from statistics import NormalDist
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.eval.metrics.base import COUNT, SUM, Pixels, Selection, SumMetric, share
from ufmstar_torch.runtime.kinds import check_kinds

LEVELS = (0.5, 0.9, 0.99)
_PERCENT = 100  # classes of levels
# Thresholds of sigma / d, and bounds of the classes of the relative error, 8 % and 17 % apart.
_GATES = np.geomspace(0.01, 10.0, 91)
_ERRORS = np.geomspace(0.001, 10.0, 61)
_MIDDLE = LEVELS.index(0.9)


class IntervalCoverage(SumMetric):
    """Coverage of the central intervals of a :class:`~ufmstar_torch.posterior.distribution.DepthDistribution`.

    The pixels are those with ground truth and a level: the level of the smallest interval that holds the ground truth.
    ``compute()``: ``coverage_50``, ``coverage_90``, ``coverage_99``, the shares of the pixels whose interval of 50, 90
    and 99 % holds the ground truth; curves [100] ``coverage_levels`` and ``coverage_found``. {} without a pixel: only a
    distribution with evidence has intervals.
    """

    OF_VARIANCE = "the coverage of intervals"
    NEEDS = "level"
    STATES = (("levels", COUNT, _PERCENT),)

    def sums(self, pixels: Pixels) -> Mapping[str, Tensor]:
        chosen = Selection(pixels, pixels.with_truth & pixels.level.isfinite())
        kind = (chosen.map("level") * _PERCENT - 1e-9).ceil().long() - 1
        return {"levels": chosen.histogram(kind.clamp(0, _PERCENT - 1), _PERCENT)}

    def compute(self) -> dict[str, Tensor]:
        count = self.levels.sum()
        if not int(count):
            return {}
        found = share(self.levels.cumsum(0), count)
        named = {f"coverage_{level:.0%}".rstrip("%"): found[round(level * _PERCENT) - 1] for level in LEVELS}
        levels = torch.arange(1, _PERCENT + 1, dtype=torch.float64, device=found.device) / _PERCENT
        return {**named, "coverage_levels": levels, "coverage_found": found}


class Coverage(SumMetric):
    """Coverage and mean width of the central interval of N(d, v) of a level, over the pixels with ground truth.

    ``compute()``: ``coverage``, the share of the pixels whose ground truth lies in the interval, which equals ``level``
    for a calibrated variance; ``interval_width`` [m]. NaN without a pixel. Of two variances with the right coverage,
    the one with the narrower intervals says more.

    Args:
        level: probability of the interval, in (0, 1).
    """

    OF_VARIANCE = "the coverage"
    STATES = (("covered", COUNT), ("width", SUM), ("pixels", COUNT))

    @check_kinds
    def __init__(self, level: float = 0.9, **kwargs: Any) -> None:
        if not 0 < level < 1:
            raise ValueError(f"level must lie in (0, 1), got {level}")
        self.half_width, self.settings = NormalDist().inv_cdf(0.5 + level / 2), {"level": level}
        super().__init__(**kwargs)

    def sums(self, pixels: Pixels) -> Mapping[str, Tensor]:
        chosen = pixels.judged
        covered = chosen.number(chosen.squared <= self.half_width**2 * chosen.map("variance"))
        width = chosen.total(2 * self.half_width * chosen.sigma)
        return {"covered": covered, "width": width, "pixels": chosen.number()}

    def compute(self) -> dict[str, Tensor]:
        return {"coverage": share(self.covered, self.pixels), "interval_width": share(self.width, self.pixels)}


class GatedPixels(SumMetric):
    """The pixels that a gate sigma / d <= threshold keeps, for 91 thresholds from .01 to 10.

    The pixels are those with ground truth g and a valid depth and variance. ``compute()`` has curves [91], NaN where
    nothing is kept: ``gate_threshold``; ``gate_kept``, share of the pixels; of those kept, ``gate_error``, the median
    |d - g|/g, interpolated in classes 17 % wide, ``gate_delta1``, the share with |d - g| <= .25 g, and
    ``gate_coverage``, the share of those with a level whose interval of 90 % holds g.
    """

    OF_VARIANCE = "a gate"
    STATES = (
        ("errors", COUNT, len(_GATES) + 1, len(_ERRORS) + 1),
        *((name, COUNT, len(_GATES) + 1) for name in ("accurate", "with_level", "covered")),
    )

    CONSTANTS = MappingProxyType({"gates": torch.from_numpy(_GATES), "error_edges": torch.from_numpy(_ERRORS)})

    def sums(self, pixels: Pixels) -> Mapping[str, Tensor]:
        chosen, gates = pixels.judged, len(_GATES) + 1
        level = chosen.map("level")
        gate = _class_of(chosen.sigma / chosen.map("depth"), self.gates)  # d = 0 is beyond every gate
        joint = gate * (len(_ERRORS) + 1) + _class_of(chosen.relative, self.error_edges)
        sums = {
            "errors": chosen.histogram(joint, gates * (len(_ERRORS) + 1)).reshape(gates, -1),
            "accurate": chosen.parted(gate, gates, chosen.within)[1],
        }
        if len(level):
            sums["with_level"] = chosen.parted(gate, gates, level.isfinite())[1]
            sums["covered"] = chosen.parted(gate, gates, level <= LEVELS[_MIDDLE])[1]
        return sums

    def compute(self) -> dict[str, Tensor]:
        errors = self.errors.cumsum(0)[:-1]
        pixels = errors.sum(1)
        median = _median(errors, self.error_edges.log())
        accurate, with_level, covered = (x.cumsum(0)[:-1] for x in (self.accurate, self.with_level, self.covered))
        return {
            "gate_threshold": self.gates,
            "gate_kept": share(pixels, self.errors.sum()),
            "gate_error": median,
            "gate_delta1": share(accurate, pixels),
            "gate_coverage": share(covered, with_level),
        }


def _class_of(value: Tensor, edges: Tensor) -> Tensor:
    """[P] number of edges [E], which rise geometrically, below each value [P] by more than 1e-9 of it; E for NaN.
    ``searchsorted`` takes three times as long."""
    position = (value / edges[0]).log() * ((len(edges) - 1) / (edges[-1] / edges[0]).log())
    return (position - 1e-9).ceil().nan_to_num(len(edges)).clamp(0, len(edges)).long()


def _median(counts: Tensor, edges: Tensor) -> Tensor:
    """[G] exp of the medians of G histograms [G, E + 1] between the logarithms ``edges`` [E]; NaN without a count.
    Values below the first and above the last edge count as these."""
    below = counts.cumsum(1).double()
    half = below[:, -1:] / 2
    kind = (below < half).sum(1, keepdim=True).clamp_max(len(edges))
    start, end = torch.cat([edges[:1], edges]), torch.cat([edges, edges[-1:]])
    before = torch.gather(torch.nn.functional.pad(below, (1, 0)), 1, kind)
    share = (half - before) / (torch.gather(below, 1, kind) - before)
    return torch.lerp(start[kind], end[kind], share)[:, 0].exp()
