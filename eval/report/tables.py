"""The tables of a report and their files: the paper's columns, further ones, single sequences, paired differences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
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
        tables.append(_table(f"{name}-{sequence}", title, records, _figures(records, MAIN)))
    return tables


def difference_table(results: Results, dataset: str | None = None) -> Table:
    """Row less reference, in pairs on the same sequences; a remark where the interval leaves out 0."""
    lines, labels = [], row_labels(results.rows)
    for row in sorted(results.rows, key=lambda row: results.bases.index(row.method.base)):
        listed = results.of(row, dataset)
        for reference in references(results, row) if has_variance(listed) else ():
            means = [difference(listed, results.of(reference, dataset), q) for q in DIFFERENCES]
            if count := max(mean.sequences for mean in means):
                figures = [
                    Cell.of(mean, q.decimals, signed=True, remark=_REMARKS[mean.better(q)])
                    for mean, q in zip(means, DIFFERENCES, strict=True)
                ]
                block = results.bases.index(row.method.base)
                lines.append(Line(block, f"{labels[row]} – {labels[reference]}", (Cell(str(count)), *figures)))
    columns = [Column("", "sequences"), *(Column("", f"Δ {q.heading}") for q in DIFFERENCES)]
    note = (
        "Mean over sequences of row – reference on the same sequence, with its 95 % confidence interval (from "
        f"{MIN_SEQUENCES} sequences on); better and worse: beyond the interval."
    )
    title = f"{results.title}, paired differences, {_where(results, dataset)}"
    return Table("differences", title, "Row – reference", columns, lines, (note,))


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
    group = "Ours" if quoted else ""
    own = own_quantities(key for r in results.records for key in r.figures) if name == "main" else []
    columns = _figures(records, [*quantities, *own], group)
    networks: dict[str, list[str]] = {}
    for base in results.bases:
        networks.setdefault(results.network(base) or "", []).append(base)
    several = ", ".join(f"{label} ({', '.join(bases)})" for label, bases in networks.items())
    notes = [f"Network: {next(iter(networks))}." if len(networks) == 1 else f"Networks: {several}."]
    if words := shared_words(records):
        notes.append(f"Images of all rows: {words}, resized to the networks' input.")
    notes.append(_interval_note(max(map(len, records.values()))))
    costs = _costs(results.efficiency, records, group) if name == "main" and results.efficiency else []
    if any(cell.value for column in costs for cell in column.cells.values()):
        columns += costs
        notes.append(_cost_note(results.efficiency or {}))
    if len({frozenset((r.dataset, r.sequence) for r in listed) for listed in records.values()}) > 1:
        counts = {row: Cell(str(len(listed))) for row, listed in records.items()}
        columns = [_Figures(Column(group, "sequences"), counts), *(c._replace(quantity=None) for c in columns)]
        notes.append("The rows are means over different sequences, so none is marked as the best.")
    if quoted:
        theirs = {row: quoted.rows.get(row.method.name, {}) for row in plain_rows(records)}
        for key in quoted.columns:
            cells = {row: cells[key] for row, cells in theirs.items() if key in cells}
            columns.append(_Figures(Column("Paper", _PAPER_COLUMNS[key].label), cells))
        notes.append(f"The paper's own figures are of {quoted.network} on {quoted.measured_on}.")
    return _table(name, f"{results.title}, {_where(results, dataset)}", records, columns, notes)


def _figures(
    records: Mapping[Row, Sequence[Record]], quantities: Sequence[Quantity], group: str = ""
) -> list[_Figures]:
    return [_column(q, group, {row: mean_of(listed, q) for row, listed in records.items()}) for q in quantities]


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


def _interval_note(most: int) -> str:
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
    files: dict[str, list[Table]] = {}
    for tables in overview(results).values():
        for dataset, table in tables.items():
            files[table.name if dataset is None else f"{table.name}-{dataset}"] = [table]
    for dataset in results.datasets:
        files[f"sequences-{dataset}"] = sequence_tables(results, dataset)
    if results.efficiency is not None:
        files["efficiency"] = efficiency_tables(results.efficiency)
    folder = results.out / "tables"
    folder.mkdir(exist_ok=True)
    written = []
    for name, listed in files.items():
        if shown := [table for table in listed if not table.is_empty]:
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


def write_tidy(results: Results) -> Path:
    """Write ``results.csv``, a line per row, sequence and figure, with a column for each setting; numbers in full,
    nothing for a missing value; its path."""
    lines = []
    for record in results.records:
        names = ("suite", "dataset", "sequence", "network", "method")
        about = {name: getattr(record, name) for name in names} | {"figure": "", "value": None} | dict(record.setting)
        plain = {name: csv_text(value) if isinstance(value, str) else value for name, value in about.items()}
        groups = {f"{name}.": getattr(record, name) for name in ("frames", "state", "ms")}
        figures = dict(record.figures)
        for group, values in groups.items():
            figures |= {f"{group}{key}": value for key, value in values.items() if isinstance(value, int | float)}
        lines += [{**plain, "figure": csv_text(key), "value": value} for key, value in figures.items()]
    table = pd.DataFrame(lines, dtype=object).to_csv(index=False, lineterminator="\n")
    return _write_text(results.out / "results.csv", table)


def _write_text(path: Path, text: str) -> Path:
    write_atomic(path, lambda file: file.write(text.encode()))
    return path
