"""Means and paired differences over sequences, with 95 % confidence intervals from two sequences on."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

from ufmstar_torch.eval.methods.method import UFM_STAR
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.names import Quantity
from ufmstar_torch.eval.suite.record import Record

# With fewer sequences, an interval is marked as wide: Student's interval of so few values depends on normality.
FEW_SEQUENCES = 5


class Mean(NamedTuple):
    """A mean over sequences."""

    value: float = math.nan  # without a sequence
    half: float = math.nan  # half-width of its 95 % confidence interval, NaN below two sequences
    sequences: int = 0  # number of sequences with the figure

    @property
    def wide(self) -> bool:
        """True if the interval is one of few sequences."""
        return 2 <= self.sequences < FEW_SEQUENCES


def value_of(record: Record, key: str) -> float:
    """A figure of a record by ``Quantity.key``, frames without a segment or match as a share; NaN if it is missing."""
    value = record.values.get(key)
    if value is None:
        return math.nan
    share = key in ("frames.without_segment", "frames.without_match")
    return float(value) / max(1, record.frames.get("done", 0)) if share else float(value)


def mean_over(values: Iterable[float]) -> Mean:
    """The mean over sequences; NaN (no such figure) is ignored."""
    from ufmstar_torch.eval.metrics import mean_and_ci

    finite = [value for value in values if not math.isnan(value)]
    mean, half = mean_and_ci(finite)
    return Mean(mean, half, len(finite))


def mean_of(records: Iterable[Record], quantity: Quantity) -> Mean:
    """The mean of a figure over sequences, in the quantity's unit; several seeds of a sequence are averaged first."""
    return mean_over(_by_sequence(records, quantity).values())


def difference(records: Iterable[Record], reference: Iterable[Record], quantity: Quantity) -> Mean:
    """Mean of (row - reference) over common sequences.

    Sequences differ far more than methods; this part cancels in each difference.
    """
    baseline = _by_sequence(reference, quantity)
    return mean_over(v - baseline[key] for key, v in _by_sequence(records, quantity).items() if key in baseline)


def _by_sequence(records: Iterable[Record], quantity: Quantity) -> dict[tuple[str, str], float]:
    by_sequence: dict[tuple[str, str], list[float]] = {}
    for record in records:
        value = quantity.factor * value_of(record, quantity.key)
        by_sequence.setdefault((record.dataset, record.sequence), []).append(value)
    return {key: math.fsum(values) / len(values) for key, values in by_sequence.items()}


def reference_row(results: Results, base: str) -> Row | None:
    """The row with which the others of a base are compared: UfM*, or None without it."""
    rows = (row for row in results.default_rows(base) if row.method.fusion == UFM_STAR)
    return next((row for row in rows if not (row.method.full or row.method.fixed_param)), None)
