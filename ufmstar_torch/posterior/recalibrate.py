"""A monotone map of the variance, fitted on sequences with ground truth (``ufmstar recalibrate``)."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, Literal

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.arguments import as_path
from ufmstar_torch.runtime.checked import Checked, choice, flat
from ufmstar_torch.runtime.stateful import plain

VARIANCE: Final = "variance"
CONFIDENCE: Final = "confidence"
# Settings of UfM* that do not change what V means.
_HARMLESS = ("on_bad_frame", "backend", "initial_capacity", "max_components")


@dataclass(frozen=True)
class Recalibration(Checked):
    """A map V -> V', the same at every pixel.

    Between two knots log V' is linear in log V. Above the last knot V' / V is constant. Below the first knot V' is
    constant, since the data support no smaller variance: V = 0 gets the first knot's V'.

    A map of the network's confidence c is V' = h(c) V, with log h linear in c between two knots and constant beyond;
    h = 1 where c is NaN.

    Attributes:
        variance: V at the knots [m^2], positive and increasing; or c, increasing.
        recalibrated: V' at the knots [m^2], positive and not decreasing; or h, positive.
        covariate: argument of the map, "variance" or "confidence".
        row: name of the method in the fit, for example "UfM*-Anchored-DepthOnly".
        ufm: settings of UfM* in the fit (``UfMStarConfig.to_dict``); {} = unknown.
        network: file names of the network's weights in the fit, separated by commas; "" = unknown.
        sequences: names of the sequences in the fit, which must not serve for its evaluation.

    Raises:
        ValueError: invalid knots.
    """

    variance: tuple[float, ...]
    recalibrated: tuple[float, ...]
    covariate: Literal["variance", "confidence"] = choice(VARIANCE, CONFIDENCE)
    row: str = ""
    ufm: Mapping[str, Any] = field(default_factory=dict)
    network: str = ""
    sequences: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        v, r = self.variance, self.recalibrated
        if not all(isinstance(knots, tuple | list) for knots in (v, r)):
            raise ValueError("Recalibration.variance and recalibrated must be tuples of numbers")
        if not v or len(v) != len(r):
            raise ValueError(f"Recalibration needs knots, got {len(v)} and {len(r)} values")
        of_variance = self.covariate == VARIANCE
        numbers = all(isinstance(x, float | int) and math.isfinite(x) for x in (*v, *r))
        numbers = numbers and min((*v, *r) if of_variance else r) > 0
        if not numbers or any(b <= a for a, b in pairwise(v)):
            raise ValueError("Recalibration.variance must hold increasing positive numbers")
        if of_variance and any(b < a for a, b in pairwise(r)):
            raise ValueError("Recalibration.recalibrated must hold positive numbers that do not decrease")

    def __call__(self, variance: Tensor) -> Tensor:
        """V' at every pixel.

        Args:
            variance: [...] V >= 0 [m^2], NaN = no value.

        Returns:
            [...] in the same dtype [m^2], NaN where ``variance`` is NaN.
        """
        v, r = (torch.tensor(x, dtype=torch.float64, device=variance.device).log() for x in self._knots())
        position = variance.double().log()
        upper = torch.searchsorted(v, position.contiguous()).clamp(1, len(v) - 1)
        low, high = v[upper - 1], v[upper]
        share = ((position - low) / (high - low)).clamp(0, 1)  # log 0 = -inf: the first knot
        inside = r[upper - 1] + share * (r[upper] - r[upper - 1])
        beyond = (position - v[-1]).clamp_min(0)
        return torch.where(variance.isnan(), variance, (inside + beyond).exp().to(variance.dtype))

    def mapped(self, variance: Tensor, confidence: Tensor | None) -> Tensor:
        """V' of V [...], with the network's confidence [...] at the same pixels for a map of the confidence.

        Raises:
            ValueError: a map of the confidence without a confidence.
        """
        if self.covariate == VARIANCE:
            return self(variance)
        if confidence is None:
            raise ValueError("the recalibration maps the confidence, but the network predicts none")
        return variance * self.factor(confidence).to(variance.dtype)

    def factor(self, confidence: Tensor) -> Tensor:
        """h(c) [...] in float64, for a map of the confidence."""
        c, h = (torch.tensor(x, dtype=torch.float64, device=confidence.device) for x in self._knots())
        position = confidence.double().contiguous()
        upper = torch.searchsorted(c, position).clamp(1, len(c) - 1)
        share = ((position - c[upper - 1]) / (c[upper] - c[upper - 1])).clamp(0, 1)
        return torch.lerp(h.log()[upper - 1], h.log()[upper], share).exp().nan_to_num(1.0)

    def require(self, config: UfMStarConfig, network: str = "") -> None:
        """Check that settings and network are those of the fit.

        Args:
            config: of the UfM* whose variance is mapped.
            network: file names of the network's weights, separated by commas; "" = unknown.

        Raises:
            ValueError: the map was fitted with other settings of UfM*, or to another network.
        """
        fitted, current = flat(self.ufm), flat(plain(config))
        names = sorted((fitted.keys() | current.keys()) - set(_HARMLESS)) if fitted else []
        changed = [name for name in names if fitted.get(name) != current.get(name)]
        if changed:
            each = ", ".join(f"{name} = {fitted.get(name)!r} (now {current.get(name)!r})" for name in changed)
            raise ValueError(f"the recalibration was fitted to UfM* with {each}")
        if network and self.network and network != self.network:
            raise ValueError(f"the recalibration was fitted to the network {self.network}, not {network}")

    def save(self, path: str | Path) -> None:
        """Write the map as JSON for :meth:`from_json`."""
        path = as_path("path", path)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(self.to_dict(), indent=2) + "\n", encoding="utf-8")

    def _knots(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The knots, at least two; a single knot gets a second one above it, with the same V' / V or h."""
        v, r = self.variance, self.recalibrated
        if len(v) > 1:
            return v, r
        return ((v[0], 2 * v[0]), (r[0], 2 * r[0])) if self.covariate == VARIANCE else ((v[0], v[0] + 1), (r[0], r[0]))
