"""The tables of a report and their files: the paper's columns, further ones, single sequences, paired differences."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from ufmstar_torch.eval.methods.row import Row, plain_rows
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.efficiency import efficiency_tables
from ufmstar_torch.eval.report.means import (
    MIN_SEQUENCES,
    Mean,
    difference,
    has_variance,
    mean_of,
    mean_over,
    references,
    value_of,
)
from ufmstar_torch.eval.report.names import (
    DIFFERENCES,
    ENERGY,
    EXTRA,
    MAIN,
    MEMORY,
    Quantity,
    own_quantities,
    row_labels,
    shared_words,
)
from ufmstar_torch.eval.report.paper import PaperTable, paper_table_of
from ufmstar_torch.eval.report.table import Cell, Column, Line, Table, csv_text, latex, mark_best, markdown, table_csv
from ufmstar_torch.eval.run.files import write_atomic
from ufmstar_torch.eval.suite.record import Record

METHOD = "Method"
_PAPER_COLUMNS = {quantity.key: quantity for quantity in (*MAIN, ENERGY, MEMORY)}
_REMARKS = {True: "better", False: "worse", None: ""}


def main_table(results: Results, dataset: str | None = None) -> Table:
    """The paper's columns, over the sequences of a data set or (None) of all; where the suite is the paper's, with the
    paper's own figures beside ours."""
    return _means(results, dataset, MAIN, "main", paper_table_of(results.suite))


def extra_table(results: Results, dataset: str | None = None) -> Table:
    """Figures beyond the paper's tables: errors in metres, ranking, pixels without a figure, times."""
    return _means(results, dataset, EXTRA, "extra")


def sequence_tables(results: Results, dataset: str) -> list[Table]:
    """The paper's columns for each sequence of a data set: no intervals, since it is one."""
    tables = []
    for name, sequence in results.sequences(dataset):
        records = {row: listed for row in results.rows if (listed := results.of(row, name, sequence))}
        counts = (value_of(listed[0], "frames.done") for listed in records.values())
        frames = max((int(count) for count in counts if count == count), default=0)
        title = f"{name}, {sequence}" + (f": {frames} frames" if frames else "")
        tables.append(_table(f"{name}-{sequence}", title, records, _figures(records, MAIN, "")))
    return tables


def difference_table(results: Results, dataset: str | None = None) -> Table:
    """Row less reference, in pairs on the same sequences; a remark where the interval leaves out 0."""
    blocks: dict[str, int] = {}
    lines, labels = [], row_labels(results.rows)
    for row in results.rows:
        listed = results.of(row, dataset)
        for reference in references(results, row) if has_variance(listed) else ():
            means = [difference(listed, results.of(reference, dataset), q) for q in DIFFERENCES]
            count = max(mean.sequences for mean in means)
            if count:
                figures = map(_difference_cell, means, DIFFERENCES)
                block = blocks.setdefault(row.method.base, len(blocks))
                lines.append(Line(block, f"{labels[row]} – {labels[reference]}", (Cell(str(count)), *figures)))
    columns = [Column("", "sequences"), *(Column("", f"Δ {q.heading}") for q in DIFFERENCES)]
    note = (
        "Mean over sequences of row – reference on the same sequence, with its 95 % confidence interval (from "
        f"{MIN_SEQUENCES} sequences on); better and worse: beyond the interval."
    )
    title = f"{results.title}, paired differences, {_where(results, dataset)}"
    ordered = sorted(lines, key=lambda line: line.block)
    return Table("differences", title, "Row – reference", columns, ordered, (note,))


def _difference_cell(mean: Mean, quantity: Quantity) -> Cell:
    return Cell.of(mean, quantity.decimals, signed=True, remark=_REMARKS[mean.better(quantity)])


class _Figures(NamedTuple):
    """A column: its heading, its cells by row, and the figure by which the best of a block is marked."""

    head: Column
    cells: Mapping[Row, Cell]
    quantity: Quantity | None = None


def _means(
    results: Results, dataset: str | None, quantities: Sequence[Quantity], name: str, quoted: PaperTable | None = None
) -> Table:
    """A table of means over the sequences of one data set, or of all; the paper's columns last."""
    records = {row: listed for row in results.rows if (listed := results.of(row, dataset))}
    alike = len({frozenset((r.dataset, r.sequence) for r in listed) for listed in records.values()}) == 1
    group = "Ours" if quoted else ""
    own = own_quantities(key for r in results.records for key in r.figures) if name == "main" else []
    columns = _figures(records, [*quantities, *own], group)
    notes = [_network_note(results), _prepared_note(records), _interval_note(records)]
    costs = _costs(results.efficiency, records, group) if name == "main" and results.efficiency else []
    if any(cell.value for column in costs for cell in column.cells.values()):
        columns += costs
        notes.append(_cost_note(results.efficiency or {}))
    if not alike:
        counts = {row: Cell(str(len(listed))) for row, listed in records.items()}
        unmarked = (column._replace(quantity=None) for column in columns)
        columns = [_Figures(Column(group, "sequences"), counts), *unmarked]
        notes.append("The rows are means over different sequences, so none is marked as the best.")
    if quoted:
        columns += _quoted(quoted, records)
        notes.append(f"The paper's own figures are of {quoted.network} on {quoted.measured_on}.")
    title = f"{results.title}, {_where(results, dataset)}"
    return _table(name, title, records, columns, tuple(filter(None, notes)))


def _figures(records: Mapping[Row, Sequence[Record]], quantities: Sequence[Quantity], group: str) -> list[_Figures]:
    means = [(q, {row: mean_of(listed, q) for row, listed in records.items()}) for q in quantities]
    return [_column(quantity, group, of_rows) for quantity, of_rows in means]


def _column(quantity: Quantity, group: str, means: Mapping[Row, Mean]) -> _Figures:
    cells = {row: Cell.of(mean, quantity.decimals) for row, mean in means.items()}
    return _Figures(Column(group, quantity.heading), cells, quantity)


def _costs(efficiency: Mapping[str, Any], records: Mapping[Row, Sequence[Record]], group: str) -> list[_Figures]:
    """Energy and memory of the rows' uncertainty: energy over the sequences that were measured, memory over all of
    them; dashes where nothing was measured."""
    measured_rows = {line["row"]: line for line in efficiency.get("rows", ())}
    energy, memory = {}, {}
    for row, listed in records.items():
        if row.label in measured_rows:
            where = {(record.dataset, record.sequence) for record in listed}
            measured = (one for one in efficiency.get("sequences", ()) if (one["dataset"], one["sequence"]) in where)
            energy[row] = mean_over(v for one in measured if (v := one["energy_mj"].get(row.label)) is not None)
            network = measured_rows[row.label]["memory"].get("network_uncertainty_bytes")
            sizes = () if network is None else (network + (r.state.get("bytes_mean") or 0.0) for r in listed)
            memory[row] = mean_over(1e-6 * size for size in sizes)
    return [_column(ENERGY, group, energy), _column(MEMORY, group, memory)]


def _quoted(quoted: PaperTable, rows: Iterable[Row]) -> list[_Figures]:
    """The paper's columns, for rows of its own settings."""
    theirs = {row: quoted.rows.get(row.method.name, {}) for row in plain_rows(rows)}
    columns = []
    for key in quoted.columns:
        head = Column("Paper", _PAPER_COLUMNS[key].label)
        columns.append(_Figures(head, {row: cells[key] for row, cells in theirs.items() if key in cells}))
    return columns


def _table(name: str, title: str, rows: Iterable[Row], columns: Sequence[_Figures], notes: Sequence[str] = ()) -> Table:
    """Rows by base, the best of each in bold; one block where every base has a single row, as in table 4."""
    labels = row_labels(rows)
    bases = [row.method.base for row in labels]
    together = len(set(bases)) == len(bases)
    lines = []
    for block, (_, group) in enumerate(groupby(labels, key=lambda row: None if together else row.method.base)):
        of_block = list(group)
        marked = [mark_best([c.cells.get(row, Cell()) for row in of_block], c.quantity) for c in columns]
        for row, cells in zip(of_block, zip(*marked, strict=True), strict=True):
            lines.append(Line(block, labels[row], cells))
    return Table(name, title, METHOD, [column.head for column in columns], lines, notes)


def _where(results: Results, dataset: str | None) -> str:
    count = len(results.sequences(dataset))
    sequences = f"{count} sequence{'s' if count > 1 else ''}"
    if dataset is not None or len(results.datasets) == 1:
        return f"{sequences} of {dataset or results.datasets[0]}"
    return f"{sequences} of {len(results.datasets)} data sets ({', '.join(results.datasets)})"


# ---- notes ----


def _network_note(results: Results) -> str:
    networks: dict[str, list[str]] = {}
    for base in results.bases:
        networks.setdefault(results.network(base) or "", []).append(base)
    if len(networks) == 1:
        return f"Network: {next(iter(networks))}."
    return "Networks: " + ", ".join(f"{name} ({', '.join(bases)})" for name, bases in networks.items()) + "."


def _prepared_note(rows: Iterable[Row]) -> str:
    words = shared_words(rows)
    return f"Images of all rows: {words}, resized to the networks' input." if words else ""


def _interval_note(records: Mapping[Row, Sequence[Record]]) -> str:
    most = max(len(listed) for listed in records.values())
    if most < MIN_SEQUENCES:
        number = "One sequence" if most == 1 else f"{most} sequences, fewer than {MIN_SEQUENCES}"
        return f"{number}: no confidence intervals."
    return (
        "Means over sequences, each counting the same, with 95 % confidence intervals (those below 0.01 are left out)."
    )


def _cost_note(efficiency: Mapping[str, Any]) -> str:
    used = set(efficiency["devices"]["units"].values())
    missing = "; ".join(dict.fromkeys(why for unit, why in efficiency["power"]["missing"].items() if unit in used))
    measured = f", energy on {len(efficiency.get('sequences', ()))} of them"
    words = f"; energy is not measurable here: {missing}" if missing else measured
    return f"Energy and memory are what uncertainty adds to depth alone, memory on all sequences{words}."


# ---- files ----


def write_tables(results: Results) -> list[Path]:
    """Write ``tables/NAME.md``, ``.tex`` and ``.csv``: those of :func:`overview`, ``sequences-DATASET`` for single
    sequences, and ``efficiency`` with the paper's table 2 below ours where it was measured; their paths."""
    folder = results.out / "tables"
    folder.mkdir(exist_ok=True)
    written = []
    for name, tables in _table_files(results):
        shown = [table for table in tables if not table.is_empty]
        if shown:
            forms = {
                "md": "\n".join(map(markdown, shown)),
                "tex": "\n".join(map(latex, shown)),
                "csv": table_csv(shown),
            }
            written += [_write_text(folder / f"{name}.{kind}", text) for kind, text in forms.items()]
    return written


def overview(results: Results) -> dict[str, dict[str | None, Table]]:
    """The main table, paired differences and further figures by title: over all sequences (None) and, where there are
    several data sets, over those of each, as far as they are not empty."""
    each = results.datasets if len(results.datasets) > 1 else ()
    makers = {"Main table": main_table, "Paired differences": difference_table, "Further figures": extra_table}
    made = {title: {over: make(results, over) for over in (None, *each)} for title, make in makers.items()}
    return {title: {k: table for k, table in tables.items() if not table.is_empty} for title, tables in made.items()}


def _table_files(results: Results) -> Iterator[tuple[str, list[Table]]]:
    for tables in overview(results).values():
        for dataset, table in tables.items():
            yield table.name if dataset is None else f"{table.name}-{dataset}", [table]
    for dataset in results.datasets:
        yield f"sequences-{dataset}", sequence_tables(results, dataset)
    if results.efficiency is not None:
        yield "efficiency", efficiency_tables(results.efficiency)


def write_tidy(results: Results) -> Path:
    """Write ``results.csv``, a line per row, sequence and figure; its path."""
    lines = [
        {
            "suite": record.suite, "dataset": record.dataset, "sequence": record.sequence, "network": record.network,
            "method": record.method, "setting": dict(record.setting), "figure": key, "value": value,
        }
        for record in results.records
        for key, value in _values(record)
    ]  # fmt: skip
    return _write_text(results.out / "results.csv", _tidy_csv(lines))


def _values(record: Record) -> Iterator[tuple[str, float | None]]:
    """(figure, value) of all numbers of a record: figures, then counts of frames, state and times."""
    yield from record.figures.items()
    for name in ("frames", "state", "ms"):
        group: Mapping[str, Any] = getattr(record, name)
        yield from ((f"{name}.{key}", value) for key, value in group.items() if isinstance(value, int | float))


def _tidy_csv(lines: Sequence[Mapping[str, Any]]) -> str:
    """Lines with a column for each setting; numbers in full, nothing for a missing value."""
    flat = ({**line, **line["setting"]} for line in lines)
    rows = [{name: csv_text(v) if isinstance(v, str) else v for name, v in line.items()} for line in flat]
    return pd.DataFrame(rows, dtype=object).drop(columns="setting").to_csv(index=False, lineterminator="\n")


def _write_text(path: Path, text: str) -> Path:
    write_atomic(path, lambda file: file.write(text.encode()))
    return path
