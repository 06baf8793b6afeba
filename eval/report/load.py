"""The folder of ``ufmstar eval``, read: records, sums over sequences, what failed and what is missing."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.report.sums import Merged, SumsError, merge_sums
from ufmstar_torch.eval.results.record import Record

FORMAT = 1
FAILED = "failed.json"
# What stands in ``Setting.to_dict()`` beside the overrides of the config.
OWN = tuple(f.name for f in fields(Setting) if f.name != "overrides")


class ResultsError(ValueError):
    """The folder is no evaluation, or its records do not belong together; the message names the file."""


@dataclass(frozen=True)
class Failed:
    """A sequence that could not be evaluated, and why."""

    dataset: str
    sequence: str
    reason: str
    rows: tuple[str, ...] = ()


@dataclass(frozen=True)
class Results:
    """What an evaluation has found so far.

    Attributes:
        out: its folder.
        about: ``eval.json``.
        records: by data set, sequence and row (rows in the suite's order), so the same however it was shared out.
        merged: figures and curves over all pixels of a data set's sequences, by (dataset, row); without those
            of which the sums of a sequence are gone.
        failed: sequences that could not be evaluated.
        missing: (dataset, sequence, row) still to be evaluated.
        efficiency: ``efficiency.json``, or None.
        notes: what a reader should know about the folder.
    """

    out: Path
    about: Mapping[str, Any]
    records: tuple[Record, ...]
    merged: Mapping[tuple[str, Row], Merged] = field(default_factory=dict)
    failed: tuple[Failed, ...] = ()
    missing: tuple[tuple[str, str, Row], ...] = ()
    efficiency: Mapping[str, Any] | None = None
    notes: tuple[str, ...] = ()

    @property
    def suite(self) -> str:
        """Its name, as "paper-table-1"."""
        return str(self.about["suite"])

    @property
    def title(self) -> str:
        """For people."""
        return str(self.about.get("title") or self.suite)

    @cached_property
    def rows(self) -> tuple[Row, ...]:
        """Those of which there is a record, in the suite's order, then in the order of their names."""
        there = {row_of(r) for r in self.records}
        listed = [row for row in listed_rows(self.about) if row in there]
        return (*listed, *sorted(there - set(listed), key=lambda row: row.slug))

    @cached_property
    def datasets(self) -> tuple[str, ...]:
        """Names, sorted."""
        return tuple(sorted({r.dataset for r in self.records}))

    def of(self, row: Row, dataset: str | None = None) -> tuple[Record, ...]:
        """The records of a row, of one data set or (None) of all, by data set and sequence."""
        return self._by_row.get((row, dataset), ())

    def sequences(self, dataset: str | None = None) -> tuple[tuple[str, str], ...]:
        """(dataset, sequence) with a record, sorted."""
        return tuple(sorted({(r.dataset, r.sequence) for r in self.records if dataset in (None, r.dataset)}))

    def network(self, base: str) -> str | None:
        """The network behind the rows of a base, as shown; None without a record."""
        return next((r.network for r in self.records if Method.parse(r.method).base == base), None)

    @cached_property
    def _by_row(self) -> dict[tuple[Row, str | None], tuple[Record, ...]]:
        found: dict[tuple[Row, str | None], list[Record]] = {}
        for record in self.records:
            for dataset in (record.dataset, None):
                found.setdefault((row_of(record), dataset), []).append(record)
        return {key: tuple(records) for key, records in found.items()}


def load_results(out: Path, *, with_sums: bool = True) -> Results:
    """Read what ``ufmstar eval`` has left in a folder, finished or not.

    Args:
        out: the folder.
        with_sums: also add up the sums of the sequences of each data set, which figures need (some milliseconds
            a record); otherwise ``merged`` is empty.

    Raises:
        ResultsError: the folder is no evaluation, holds no record, or records that do not belong together.
        OSError: a file cannot be read.
    """
    about = _about(out)
    found = {path: _record(path) for path in sorted((out / "records").rglob("*.json")) if path.name != FAILED}
    order = {row: number for number, row in enumerate(listed_rows(about))}
    paths = sorted(found, key=lambda path: _place(found[path], order))
    records = [found[path] for path in paths]
    _check(out, about, paths, records)
    failed = _failed(out)
    merged, notes = _merged(paths, records) if with_sums else ({}, [])
    return Results(
        out=out,
        about=about,
        records=tuple(records),
        merged=merged,
        failed=failed,
        missing=_missing(about, records, failed),
        efficiency=_optional(out / "efficiency.json"),
        notes=tuple(notes),
    )


def row_of(record: Record) -> Row:
    """The row of a record."""
    return Row(Method.parse(record.method), setting_of(record.setting))


def setting_of(values: Mapping[str, Any]) -> Setting:
    """The inverse of ``Setting.to_dict()``."""
    own = {name: values[name] for name in OWN if name in values}
    return Setting(overrides={name: value for name, value in values.items() if name not in OWN}, **own)


def listed_rows(about: Mapping[str, Any]) -> list[Row]:
    """The suite's rows, as ``eval.json`` lists them."""
    rows = (Row(Method.parse(r["method"]), setting_of(r.get("setting", {}))) for r in about.get("rows", []))
    return list(dict.fromkeys(rows))


def _about(out: Path) -> dict[str, Any]:
    path = out / "eval.json"
    if not path.is_file():
        raise ResultsError(f"{out} is no folder of `ufmstar eval`: it has no eval.json")
    about = _optional(path)
    if not isinstance(about, dict) or about.get("format") != FORMAT or not isinstance(about.get("suite"), str):
        raise ResultsError(f"{path} is not the description of an evaluation of format {FORMAT}")
    try:
        listed_rows(about)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ResultsError(f"{path} lists a row that cannot be: {error}") from error
    return about


def _optional(path: Path) -> Any:
    if not path.is_file():
        return None
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ResultsError(f"{path} is not JSON: {error}") from error


def _record(path: Path) -> Record:
    try:
        record = Record.load(path)
        row_of(record)
    except ValueError as error:
        text = str(error)
        raise ResultsError(text if str(path) in text else f"{path}: {text}") from error
    return record


def _place(record: Record, order: Mapping[Row, int]) -> tuple[str, str, int, str]:
    """The key by which records are sorted: nothing of it depends on who wrote them, or when."""
    row = row_of(record)
    return record.dataset, record.sequence, order.get(row, len(order)), row.slug


def _check(out: Path, about: Mapping[str, Any], paths: Sequence[Path], records: Sequence[Record]) -> None:
    """Raise ResultsError where the records are none, or not of one evaluation."""
    if not records:
        raise ResultsError(f"{out} holds no finished sequence yet (no record under {out / 'work'})")
    networks: dict[str, tuple[str, Path]] = {}
    seen: dict[tuple[str, str, Row], Path] = {}
    for path, record in zip(paths, records, strict=True):
        if record.suite != about["suite"]:
            raise ResultsError(f"{path} is of the suite {record.suite!r}, not of {about['suite']!r} as eval.json says")
        base = Method.parse(record.method).base
        network, first = networks.setdefault(base, (record.network, path))
        if network != record.network:
            raise ResultsError(
                f"records of {base} are of mixed networks, which have no common mean: {network} in {first}, "
                f"{record.network} in {path}"
            )
        twin = seen.setdefault((record.dataset, record.sequence, row_of(record)), path)
        if twin != path:
            raise ResultsError(f"{twin} and {path} are of the same row on the same sequence")


def _failed(out: Path) -> tuple[Failed, ...]:
    found = []
    for path in sorted((out / "records").rglob(FAILED)):
        values = _optional(path)
        if not isinstance(values, dict) or "reason" not in values:
            raise ResultsError(f"{path} does not say why a sequence failed")
        dataset = str(values.get("dataset") or path.parent.parent.name)
        sequence = str(values.get("sequence") or path.parent.name)
        found.append(Failed(dataset, sequence, str(values["reason"]), tuple(map(str, values.get("rows", ())))))
    return tuple(sorted(found, key=lambda f: (f.dataset, f.sequence)))


def _missing(
    about: Mapping[str, Any], records: Iterable[Record], failed: Iterable[Failed]
) -> tuple[tuple[str, str, Row], ...]:
    """What ``eval.json`` promises, less what is there and what has failed."""
    there = {(r.dataset, r.sequence, row_of(r)) for r in records}
    broken = {(f.dataset, f.sequence) for f in failed}
    wanted = sorted((s["dataset"], s["sequence"]) for s in about.get("sequences", []))
    rows = listed_rows(about)
    return tuple((*s, row) for s in wanted if s not in broken for row in rows if (*s, row) not in there)


def _merged(paths: Sequence[Path], records: Sequence[Record]) -> tuple[dict[tuple[str, Row], Merged], list[str]]:
    """Sums of each (dataset, row), added in the order of the sequences; and what could not be added."""
    groups: dict[tuple[str, Row], list[Path]] = {}
    for path, record in zip(paths, records, strict=True):
        groups.setdefault((record.dataset, row_of(record)), []).append(path.with_suffix(".pt"))
    merged, notes = {}, []
    for (dataset, row), sums in groups.items():
        gone = [path for path in sums if not path.is_file()]
        if gone:
            notes.append(f"{dataset}, {row.label}: no curve over all sequences, {gone[0]} is not there")
            continue
        try:
            merged[dataset, row] = merge_sums(sums)
        except SumsError as error:
            raise ResultsError(str(error)) from error
    return merged, notes
