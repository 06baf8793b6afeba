"""The results of ``ufmstar eval``: records, sums over the sequences of a data set, failed and missing sequences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.engine.judge import CONFIDENCE
from ufmstar_torch.eval.engine.record import FORMAT, METRICS, SUMS, Record, ResultsError, Sums
from ufmstar_torch.eval.methods.row import Row, plain_rows, row_from
from ufmstar_torch.eval.suite.folder import FAILED, EvalFolder
from ufmstar_torch.files.limits import read_json

Curves = Mapping[str, list[float]]


@dataclass(frozen=True)
class Results:
    """The results of an evaluation, finished or not."""

    out: Path
    about: Mapping[str, Any]  # eval.json
    records: tuple[Record, ...]  # ordered by data set and row (in the evaluation's order) and sequence
    # ``SequenceMetrics.curves()`` and "nll_by_error:REFERENCE" over all pixels of a data set, by (dataset, row); only
    # if the sums of all sequences exist.
    merged: Mapping[tuple[str, Row], Curves] = field(default_factory=dict)
    # By (dataset, sequence), why it could not be evaluated.
    failed: Mapping[tuple[str, str], str] = field(default_factory=dict)
    missing: tuple[tuple[str, str, Row], ...] = ()  # (dataset, sequence, row) not evaluated yet
    efficiency: Mapping[str, Any] | None = None  # efficiency.json
    notes: tuple[str, ...] = ()  # problems of the folder, one sentence each

    @property
    def suite(self) -> str:
        """The suite's name, as "paper-table-1"."""
        return str(self.about["suite"])

    @property
    def title(self) -> str:
        """The suite's title."""
        return str(self.about.get("title") or self.suite)

    @cached_property
    def rows(self) -> tuple[Row, ...]:
        """Rows with a record, in the suite's order, then by name."""
        listed = [row for row in listed_rows(self.about) if row in self._by_row]
        return (*listed, *sorted(self._by_row.keys() - set(listed), key=lambda row: row.slug))

    @cached_property
    def bases(self) -> tuple[str, ...]:
        """Bases (kinds of network) of the rows, in order."""
        return tuple(dict.fromkeys(row.method.base for row in self.rows))

    @cached_property
    def datasets(self) -> tuple[str, ...]:
        """Names of the data sets in the order of the evaluation."""
        return tuple(dict.fromkeys(record.dataset for record in self.records))

    @property
    def tabulated(self) -> tuple[str | None, ...]:
        """The data sets of the tables; None = the mean over all."""
        each = self.datasets if len(self.datasets) > 1 else ()
        return each if each and self.about.get("separate") is True else (None, *each)

    def of(self, row: Row, dataset: str | None = None, sequence: str | None = None) -> tuple[Record, ...]:
        """The records of a row, ordered by data set and sequence; of one data set or sequence, or (None) of all."""
        listed = self._by_row.get(row, ())
        return tuple(r for r in listed if dataset in (None, r.dataset) and sequence in (None, r.sequence))

    def default_rows(self, base: str | None = None) -> list[Row]:
        """The first row of each method without ablated settings, of one base or (None) of all."""
        return [row for row in plain_rows(self.rows) if base in (None, row.method.base)]

    def posterior_rows(self) -> list[Row]:
        """The first row of each base with a posterior."""
        first: dict[str, Row] = {}
        for row in self.rows:
            if row.setting.posterior:
                first.setdefault(row.method.base, row)
        return list(first.values())

    def sequences(self, dataset: str | None = None) -> tuple[tuple[str, str], ...]:
        """(dataset, sequence) with a record, in the order of the data sets, then by name."""
        return tuple(dict.fromkeys((r.dataset, r.sequence) for r in self.records if dataset in (None, r.dataset)))

    def network(self, base: str) -> str | None:
        """The label of the network of a base; None without a record."""
        return next((r.network for r in self.records if r.row.method.base == base), None)

    def folder(self, dataset: str, sequence: str) -> Path:
        """The folder of a sequence with a record."""
        return next(r.path.parent for r in self.records if (r.dataset, r.sequence) == (dataset, sequence))

    @cached_property
    def _by_row(self) -> dict[Row, list[Record]]:
        groups: dict[Row, list[Record]] = {}
        for record in self.records:
            groups.setdefault(record.row, []).append(record)
        return groups


def load_results(out: Path, *, with_sums: bool = True) -> Results:
    """Read the folder of an evaluation, finished or not. ``with_sums`` adds the sums over the sequences of each data
    set, which figures need (some milliseconds per record).

    Raises:
        ResultsError: the folder is no evaluation, has no record, or has inconsistent records.
        OSError: a file cannot be read.
    """
    about = _about(out)
    order = {row: number for number, row in enumerate(listed_rows(about))}
    loaded = [Record.load(path) for path in out.glob("records/*/*/*.json") if path.name != FAILED]
    order_of_dataset = {name: number for number, name in enumerate(about.get("datasets", []))}

    def key(r: Record) -> tuple[Any, ...]:
        dataset = order_of_dataset.get(r.dataset, len(order_of_dataset)), r.dataset
        return *dataset, r.sequence, order.get(r.row, len(order)), r.row.slug, r.path

    records = tuple(sorted(loaded, key=key))
    _check(out, records)
    failed = dict(sorted(EvalFolder(out).failures().items()))
    done = {(r.dataset, r.sequence, r.row) for r in records}
    expected = sorted((s["dataset"], s["sequence"]) for s in about.get("sequences", []))
    missing = tuple((*s, row) for s in expected if s not in failed for row in order if (*s, row) not in done)
    merged, notes = _merged(records) if with_sums else ({}, [])
    return Results(out, about, records, merged, failed, missing, _read_json(out / "efficiency.json"), tuple(notes))


def listed_rows(about: Mapping[str, Any]) -> list[Row]:
    """The suite's rows, as ``eval.json`` lists them."""
    return list(dict.fromkeys(map(row_from, about.get("rows", []))))


def _about(out: Path) -> dict[str, Any]:
    path = out / "eval.json"
    if not path.is_file():
        raise ResultsError(f"{out} is no folder of `ufmstar eval`: it has no eval.json")
    about = _read_json(path)
    try:
        if about["format"] != FORMAT:
            raise ValueError(f"its format is {about['format']}")
        named = [sequence[key] for sequence in about.get("sequences", []) for key in ("dataset", "sequence")]
        if not all(isinstance(name, str) for name in (about["suite"], *about.get("datasets", []), *named)):
            raise TypeError("a name is no text")
        listed_rows(about)
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        raise ResultsError(f"{path} is not the description of an evaluation of format {FORMAT}: {error!r}") from error
    return dict(about)


def _read_json(path: Path) -> Any:
    """The content of a JSON file, None if it does not exist."""
    try:
        return read_json(path) if path.is_file() else None
    except ValueError as error:
        raise ResultsError(f"{path} is not JSON: {error}") from error


def _check(out: Path, records: Sequence[Record]) -> None:
    """Raises ResultsError: there is no record, or records of one base are of several networks."""
    if not records:
        raise ResultsError(f"{out} holds no finished sequence yet (no record under {out / 'records'})")
    first: dict[str, Record] = {}
    for record in records:
        base = record.row.method.base
        other = first.setdefault(base, record)
        if record.network != other.network:
            raise ResultsError(
                f"records of {base} are of mixed networks, which have no common mean: {other.network} in {other.path}, "
                f"{record.network} in {record.path}"
            )


# ---- sums over sequences ----


def _merged(records: Sequence[Record]) -> tuple[dict[tuple[str, Row], Curves], list[str]]:
    """Curves of each (dataset, row) from sums over its sequences, and notes on missing files."""
    groups: dict[tuple[str, Row], list[Record]] = {}
    for record in records:
        groups.setdefault((record.dataset, record.row), []).append(record)
    merged, notes = {}, []
    for (dataset, row), of_row in groups.items():
        if gone := [path for record in of_row if not (path := record.path.with_suffix(SUMS)).is_file()]:
            notes.append(f"{dataset}, {row.label}: no curve over all sequences, {gone[0]} is not there")
            continue
        total: Sums = {}
        try:
            for record in of_row:  # their order decides the last bits
                total = _added(total, record.load_sums())
            merged[dataset, row] = _curves(total)
        except RuntimeError as error:
            text = " ".join(str(error).split())[:200]
            raise ResultsError(f"{record.path.with_suffix(SUMS)} holds sums of other metrics: {text}") from error
    return merged, notes


def _added(total: Sums, sums: Sums) -> Sums:
    """The total plus the sums of another sequence. Raises RuntimeError: the sums are of other metrics."""
    added = dict(total)
    for name, states in sums.items():
        before = total.get(name, states)
        if {key: v.shape for key, v in before.items()} != {key: v.shape for key, v in states.items()}:
            raise RuntimeError(f"{name} of other shapes than in the sequences before it")
        if name != CONFIDENCE:  # samples, no sums
            added[name] = {key: before[key] + v for key, v in states.items()} if name in total else states
    return added


def _curves(total: Sums) -> Curves:
    """Curves of summed states."""
    from ufmstar_torch.eval.metrics.ranking import NLLByError
    from ufmstar_torch.eval.metrics.sequence import SequenceMetrics

    states = total[METRICS]
    judged = any(key.startswith("metrics.NLL.") for key in states)
    many = judged and states["metrics.ECEDelta.pixels"].numel() == 100
    metrics = SequenceMetrics(with_variance=judged, bins="authors" if many else "ours")
    metrics.load_state_dict({key: value for key, value in states.items() if not key.startswith("metrics.own_")})
    curves = metrics.curves()
    for name in total.keys() - {METRICS}:
        by_error = NLLByError()
        by_error.load_state_dict(total[name])
        curves[name] = by_error.compute()["nll_by_error"].tolist()
    return curves
