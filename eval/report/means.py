"""Means and paired differences over sequences, with 95 % confidence intervals where there are enough sequences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from ufmstar_torch.eval.methods.method import ALONE, UFM, UFM_STAR
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.names import LOWER, NO_MATCH, NO_SEGMENT, OWN, Quantity
from ufmstar_torch.eval.suite.record import Record

# Student's interval of fewer values rests on a normal distribution, which nobody checked: no interval is given.
MIN_SEQUENCES = 5


class Mean(NamedTuple):
    """A mean over sequences."""

    value: float = math.nan  # without a sequence
    half: float = math.nan  # half-width of its 95 % confidence interval, NaN below MIN_SEQUENCES
    sequences: int = 0  # that have the figure

    def better(self, quantity: Quantity) -> bool | None:
        """True if a difference beyond its interval is an improvement; None within the interval, without one, or where
        neither direction is better."""
        if not abs(self.value) > self.half or quantity.better is None:
            return None
        return (self.value < 0) == (quantity.better == LOWER)


def value_of(record: Record, key: str) -> float:
    """A figure of a record by ``Quantity.key``; NaN where it has none."""
    group, _, name = key.rpartition(".")
    if key in (NO_SEGMENT.key, NO_MATCH.key):  # as a share
        return record.frames.get(name, math.nan) / max(1, record.frames.get("done", 0))
    if group == OWN:
        name, group = key, ""
    value = {"": record.figures, "state": record.state, "ms": record.ms, "frames": record.frames}[group].get(name)
    return math.nan if value is None else float(value)


def mean_over(values: Iterable[float]) -> Mean:
    """The mean over sequences; NaN (no such figure) is left out."""
    from ufmstar_torch.eval.metrics import mean_and_ci

    known = [value for value in values if not math.isnan(value)]
    mean, half = mean_and_ci(known)
    return Mean(mean, half if len(known) >= MIN_SEQUENCES else math.nan, len(known))


def mean_of(records: Iterable[Record], quantity: Quantity) -> Mean:
    """The mean of a figure over sequences, in the quantity's unit; several seeds of a sequence are averaged first."""
    return mean_over(_by_sequence(records, quantity).values())


def difference(records: Iterable[Record], reference: Iterable[Record], quantity: Quantity) -> Mean:
    """Mean of (row - reference) over the sequences that both have.

    Sequences differ far more than methods do, and that part cancels in each difference.
    """
    theirs = _by_sequence(reference, quantity)
    return mean_over(v - theirs[where] for where, v in _by_sequence(records, quantity).items() if where in theirs)


def _by_sequence(records: Iterable[Record], quantity: Quantity) -> dict[tuple[str, str], float]:
    by_sequence: dict[tuple[str, str], list[float]] = {}
    for record in records:
        value = quantity.factor * value_of(record, quantity.key)
        by_sequence.setdefault((record.dataset, record.sequence), []).append(value)
    return {where: math.fsum(values) / len(values) for where, values in by_sequence.items()}


def references(results: Results, row: Row) -> list[Row]:
    """The rows with a variance with which a row is compared.

    The base alone on the same images; UfM of the same base, pruned rather than not, for rows of UfM*; plain UfM* for
    its variants; the row as it is for a row of an ablation, and our defaults for the paper's settings.
    """
    method, base = row.method, row.method.base
    same_images = Setting(skip=row.setting.skip, preprocess=row.setting.preprocess)
    plain = Setting(preprocess=row.setting.preprocess)
    others = [r for r in results.rows if r.method.base == base and r != row]
    expected: list[Row] = []
    if method.fusion != ALONE:
        expected += [r for r in others if r.method.fusion == ALONE and r.setting == same_images]
    if method.fusion == UFM_STAR and row.setting.plain:
        points = [r for r in others if r.method.fusion == UFM and not r.method.full and r.setting == plain]
        expected += sorted(points, key=lambda r: r.method.max_points or math.inf)[:1]
        if method.full or method.fixed_param:
            alike = (r for r in others if r.method.fusion == UFM_STAR and r.setting == row.setting)
            expected += [r for r in alike if not (r.method.full or r.method.fixed_param)]
    if row.setting != plain:  # an ablation's row, or the paper's settings, to ours
        expected += [r for r in others if r.method == method and r.setting == row.setting.chosen]
        expected += [r for r in others if r.method == method and row.setting.plain and r.setting == plain]
    return [r for r in expected if has_variance(results.of(r))]


def has_variance(records: Sequence[Record]) -> bool:
    """Return whether a row has a variance: a network of depth alone has none."""
    return any(not math.isnan(value_of(record, "ece_delta")) for record in records)
