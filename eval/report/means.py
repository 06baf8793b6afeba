"""Means and paired differences over sequences, with 95 % confidence intervals where there are enough sequences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from ufmstar_torch.eval.methods.method import ALONE, UFM, UFM_STAR
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.names import LOWER, Quantity
from ufmstar_torch.eval.suite.record import Record

# With fewer sequences there is neither an interval nor a verdict: Student's interval of two to four values assumes a
# normal distribution, which was not checked.
MIN_SEQUENCES = 5


class Mean(NamedTuple):
    """A mean over sequences."""

    value: float = math.nan  # without a sequence
    half: float = math.nan  # half-width of its 95 % confidence interval, NaN below MIN_SEQUENCES
    sequences: int = 0  # that have the figure

    @property
    def beyond(self) -> bool:
        """Whether 0 lies outside the interval; False where there is no interval."""
        return abs(self.value) > self.half

    @property
    def decidable(self) -> bool:
        """Whether there are enough sequences for an interval."""
        return self.sequences >= MIN_SEQUENCES


def value_of(record: Record, key: str) -> float:
    """A figure of a record by ``Quantity.key``; NaN where it has none."""
    group, _, name = key.rpartition(".")
    if key == "ms.total":
        parts = [record.ms.get(part) for part in ("network", "uncertainty")] + [record.ms.get("anchors", 0.0)]
        # Predictions from the cache were not timed: without them there is no sum.
        return math.nan if None in parts else math.fsum(float(part) for part in parts if part is not None)
    value = {"": record.figures, "state": record.state, "ms": record.ms, "frames": record.frames}[group].get(name)
    return math.nan if value is None else float(value)


def mean_over(values: Iterable[float]) -> Mean:
    """The mean over sequences; NaN (no such figure) is left out."""
    from ufmstar_torch.eval.metrics import mean_and_ci

    kept = [value for value in values if not math.isnan(value)]
    mean, half = mean_and_ci(kept)
    return Mean(mean, half if len(kept) >= MIN_SEQUENCES else math.nan, len(kept))


def mean_of(records: Iterable[Record], quantity: Quantity) -> Mean:
    """The mean of a figure over sequences, in the quantity's unit; several seeds of a sequence are averaged first."""
    return mean_over(_by_sequence(records, quantity).values())


def paired(mine: Iterable[Record], theirs: Iterable[Record], quantity: Quantity) -> list[tuple[float, float]]:
    """A figure of both sides on the sequences that have it on both."""
    others = _by_sequence(theirs, quantity)
    pairs = ((value, others.get(where, math.nan)) for where, value in _by_sequence(mine, quantity).items())
    return [pair for pair in pairs if not any(map(math.isnan, pair))]


def difference(mine: Iterable[Record], theirs: Iterable[Record], quantity: Quantity) -> Mean:
    """Mean of mine - theirs over the sequences that both have.

    Sequences differ far more than methods do, and that part cancels in each difference.
    """
    return mean_over(one - other for one, other in paired(mine, theirs, quantity))


def _by_sequence(records: Iterable[Record], quantity: Quantity) -> dict[tuple[str, str], float]:
    by_sequence: dict[tuple[str, str], list[float]] = {}
    for record in records:
        value = quantity.factor * value_of(record, quantity.key)
        by_sequence.setdefault((record.dataset, record.sequence), []).append(value)
    return {where: math.fsum(values) / len(values) for where, values in by_sequence.items()}


def better(mean: Mean, quantity: Quantity) -> bool | None:
    """Whether a difference beyond its interval is to the better; None where it is not beyond, or neither way is."""
    if not mean.beyond or quantity.better is None:
        return None
    return (mean.value < 0) == (quantity.better == LOWER)


def references(results: Results, row: Row) -> list[Row]:
    """The rows with a variance with which a row is compared.

    The base alone on the same images; UfM of the same base, pruned rather than not, for rows of UfM*; plain UfM* for
    its variants; the row as it is for a row of an ablation, and our defaults for the paper's settings.
    """
    method, base = row.method, row.method.base
    same_images = Setting(skip=row.setting.skip, preprocess=row.setting.preprocess)
    plain = Setting(preprocess=row.setting.preprocess)
    mine = [r for r in results.rows if r.method.base == base and r != row]
    expected: list[Row] = []
    if method.fusion != ALONE:
        expected += [r for r in mine if r.method.fusion == ALONE and r.setting == same_images]
    if method.fusion == UFM_STAR and row.setting.plain:
        points = [r for r in mine if r.method.fusion == UFM and not r.method.full and r.setting == plain]
        expected += sorted(points, key=lambda r: r.method.max_points or math.inf)[:1]
        if method.full or method.fixed_param:
            alike = (r for r in mine if r.method.fusion == UFM_STAR and r.setting == row.setting)
            expected += [r for r in alike if not (r.method.full or r.method.fixed_param)]
    if row.setting != plain:  # an ablation's row, or the paper's settings, to ours
        expected += [r for r in mine if r.method == method and r.setting == row.setting.chosen]
        expected += [r for r in mine if r.method == method and row.setting.plain and r.setting == plain]
    return [r for r in expected if has_variance(results.of(r))]


def has_variance(records: Sequence[Record]) -> bool:
    """Whether a row has a variance: a network of depth alone has none."""
    return any(not math.isnan(value_of(record, "ece_delta")) for record in records)
