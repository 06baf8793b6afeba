"""Quantities of tables and figures: name, unit, better direction, and means over sequences; labels of rows."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from ufmstar_torch.eval.engine.record import Record
from ufmstar_torch.eval.methods.row import Row

LOWER, HIGHER = "↓", "↑"  # the better direction


@dataclass(frozen=True)
class Quantity:
    """A figure, its name and unit in tables and figures."""

    key: str  # of ``Record.values``: a figure, or "state.bytes_end", "ms.network", "frames.done"
    name: str
    decimals: int | None  # None = three significant digits
    better: str = ""  # "↓", "↑", or "" for neither
    unit: str = ""
    factor: float = 1.0  # from the recorded value to ``unit``

    @property
    def label(self) -> str:
        """The name with its unit: "RMSE [m]"."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def heading(self) -> str:
        """The label with an arrow in the better direction: "RMSE [m] ↓"."""
        return f"{self.label} {self.better}".strip()


NLL = Quantity("nll", "NLL", 2, LOWER)
ECE_DELTA = Quantity("ece_delta", "ECE_δ", 3, LOWER)
ECE_Q = Quantity("ece_q", "ECE_q", 3, LOWER)
SPEARMAN = Quantity("spearman", "Spearman", 2, HIGHER)
AUSE = Quantity("ause_rmse", "AUSE", 3, LOWER, "m")

# The cost of uncertainty, if it was measured.
ENERGY = Quantity("energy_mj", "energy", None, LOWER, "mJ")
MEMORY = Quantity("memory_mb", "memory", None, LOWER, "MB")

# The paper's columns, those of other suites' tables, and further columns that are usual in the field.
_STATE = Quantity("state.bytes_end", "state", None, "", "MB", 1e-6)  # after the last frame
PAPERS = (Quantity("delta1", "δ₁", 3, HIGHER), NLL, ECE_DELTA, ECE_Q, _STATE)
MAIN = (*PAPERS[:-1], AUSE, _STATE)
EXTRA = (
    Quantity("delta1_ratio", "δ₁ (ratio)", 3, HIGHER),
    Quantity("abs_rel", "AbsRel", 3, LOWER),
    Quantity("rmse", "RMSE", 3, LOWER, "m"),
    AUSE,
    Quantity("aurg_rmse", "AURG", 3, HIGHER, "m"),
    SPEARMAN,
    Quantity("overconfidence", "overconfidence", 3),
    Quantity("entropy", "entropy", 2, "", "nats"),
    Quantity("left_out_share", "no depth", 1, "", "%", 100.0),
    Quantity("nll_left_out_share", "no NLL", 1, "", "%", 100.0),
    # Shares of UfM*'s frames: without a segment, and (after the first) without a match of a segment with a component.
    Quantity("frames.without_segment", "no segment", 1, "", "%", 100.0),
    Quantity("frames.without_match", "no match", 1, "", "%", 100.0),
    Quantity("state.bytes_mean", "state, mean over frames", None, "", "MB", 1e-6),
    Quantity("ms.network", "network", 1, "", "ms"),
    Quantity("ms.uncertainty", "uncertainty", 1, "", "ms"),
)
# Of the posterior as a mixture, and the shares of the pixels with ground truth in central intervals; each is in the
# table if a row has it.
OPTIONAL = (
    Quantity("mixture_nll", "mixture: NLL", 2, LOWER),
    Quantity("mixture_ece_delta", "mixture: ECE_δ", 3, LOWER),
    Quantity("mixture_ece_q", "mixture: ECE_q", 3, LOWER),
    Quantity("mixture_coverage", "mixture: within 3 σ", 1, "", "%", 100.0),
    *(Quantity(f"coverage_{level}", f"in the {level} % interval", 1, "", "%", 100.0) for level in (50, 90, 99)),
)
OWN = "own."  # prefix of the figures of a user's metrics


def own_quantities(figures: Iterable[str]) -> list[Quantity]:
    """The columns of a user's metrics among the names of figures, without duplicates."""
    return [Quantity(key, key.removeprefix(OWN), 3) for key in dict.fromkeys(figures) if key.startswith(OWN)]


def row_labels(rows: Iterable[Row]) -> dict[Row, str]:
    """The titles or labels of a table's rows, without a preprocessing that all rows share."""
    listed = list(rows)
    shared = ("preprocess",) if len({row.setting.preprocess for row in listed}) == 1 else ()
    return {row: row.title or row.label_without(*shared) for row in listed}


def count(n: int, noun: str) -> str:
    """ "1 row", "2 rows"."""
    return f"{n} {noun}{'' if n == 1 else 's'}"


# ---- means over sequences, with 95 % confidence intervals from two sequences on ----


class Mean(NamedTuple):
    """A mean over sequences."""

    value: float = math.nan  # without a sequence
    half: float = math.nan  # half-width of its 95 % confidence interval, NaN below two sequences
    sequences: int = 0  # number of sequences with the figure


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
