"""Means and paired differences over sequences, with their confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from ufmstar_torch.eval.methods.method import ALONE, UFM, UFM_STAR
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import DEFAULT, Setting
from ufmstar_torch.eval.report.load import Results
from ufmstar_torch.eval.report.names import LOWER, Quantity
from ufmstar_torch.eval.results.record import Record


@dataclass(frozen=True)
class Mean:
    """A mean over sequences.

    Attributes:
        value: NaN without a sequence.
        half: half-width of its 95 % confidence interval, NaN for fewer than two sequences.
        sequences: how many had the figure.
    """

    value: float
    half: float
    sequences: int

    @property
    def beyond(self) -> bool:
        """Whether 0 lies outside the interval; False where there is no interval."""
        return abs(self.value) > self.half


def value_of(record: Record, key: str) -> float:
    """A figure of a record by ``Quantity.key``; NaN where it has none."""
    group, _, name = key.rpartition(".")
    if key == "ms.total":
        parts = [record.ms.get(part) for part in ("network", "uncertainty")] + [record.ms.get("anchors", 0.0)]
        # Predictions from the cache were not timed: without them there is no sum.
        return math.nan if None in parts else math.fsum(float(part) for part in parts if part is not None)
    value = {"": record.figures, "state": record.state, "ms": record.ms, "frames": record.frames}[group].get(name)
    return math.nan if value is None else float(value)


def mean_over(values: Sequence[float]) -> Mean:
    """The mean over sequences; NaN (no such figure) is left out."""
    from ufmstar_torch.eval.metrics import mean_and_ci

    kept = [value for value in values if not math.isnan(value)]
    return Mean(*mean_and_ci(kept), len(kept))


def mean_of(records: Sequence[Record], quantity: Quantity) -> Mean:
    """The mean of a figure over the records of one row, in the quantity's unit."""
    return mean_over([quantity.factor * value_of(record, quantity.key) for record in records])


def difference(results: Results, row: Row, reference: Row, quantity: Quantity, dataset: str | None = None) -> Mean:
    """Mean of row - reference over the sequences that have both.

    Sequences differ far more than methods do, and that part cancels in each difference.
    """
    theirs = {(r.dataset, r.sequence): value_of(r, quantity.key) for r in results.of(reference, dataset)}
    mine = ((r, theirs.get((r.dataset, r.sequence), math.nan)) for r in results.of(row, dataset))
    return mean_over([quantity.factor * (value_of(r, quantity.key) - other) for r, other in mine])


def better(mean: Mean, quantity: Quantity) -> bool | None:
    """Whether a difference beyond its interval is to the better; None where it is not beyond, or neither way is."""
    if not mean.beyond or quantity.better is None:
        return None
    return (mean.value < 0) == (quantity.better == LOWER)


def references(results: Results, row: Row) -> Iterator[Row]:
    """The rows beside which a row is to be judged, of those that are there and have a variance.

    The base alone on the same images; UfM of the same base, pruned rather than not, for rows of UfM*; UfM* as it is
    for its variants; and the default for a row of an ablation.
    """
    method, base = row.method, row.method.base
    same_images = Setting(skip=row.setting.skip)
    mine = [r for r in results.rows if r.method.base == base and r != row]
    wanted: list[Row] = []
    if method.fusion != ALONE:
        wanted += [r for r in mine if r.method.fusion == ALONE and r.setting == same_images]
    if method.fusion == UFM_STAR and row.setting == DEFAULT:
        points = [r for r in mine if r.method.fusion == UFM and not r.method.full and r.setting == DEFAULT]
        wanted += sorted(points, key=lambda r: r.method.max_points or math.inf)[:1]
        if method.full or method.fixed_param:
            plain = (r for r in mine if r.method.fusion == UFM_STAR and r.setting == DEFAULT)
            wanted += [r for r in plain if not (r.method.full or r.method.fixed_param)]
    if row.setting != DEFAULT:
        wanted += [r for r in mine if r.method == method and r.setting == DEFAULT]
    return (r for r in wanted if has_variance(results, r))


def has_variance(results: Results, row: Row) -> bool:
    """Whether a row says how far it may be trusted: a network of depth alone does not."""
    return any(not math.isnan(value_of(record, "ece_delta")) for record in results.of(row))
