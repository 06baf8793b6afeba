"""The tables of a report and their files: the paper's columns, further ones, single sequences, paired differences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

import pandas as pd

from ufmstar_torch.eval.methods.row import Row, plain_rows
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.efficiency import efficiency_tables
from ufmstar_torch.eval.report.means import (
    FEW_SEQUENCES,
    difference,
    mean_of,
    mean_over,
    reference_row,
)
from ufmstar_torch.eval.report.names import (
    DIFFERENCES,
    ENERGY,
    EXTRA,
    INTERVALS,
    MAIN,
    MEMORY,
    MIXTURE,
    PAPERS,
    Quantity,
    count,
    own_quantities,
    row_labels,
    shared_words,
)
from ufmstar_torch.eval.report.paper import paper_table_of
from ufmstar_torch.eval.report.table import Cell, Table, csv_text, frame_of, latex, mark_best, markdown, table_csv
from ufmstar_torch.eval.run.files import write_bytes_atomic
from ufmstar_torch.eval.suite.record import Record

OURS, PAPER = "Ours", "Paper"
_PAPER_COLUMNS = {quantity.key: quantity for quantity in (*PAPERS, ENERGY, MEMORY)}
_SEQUENCES = Quantity("", "sequences", 0)
Records = Mapping[Row, Sequence[Record]]
# By heading above the column ("" = none) and quantity, the cells by row.
Columns = dict[tuple[str, Quantity], dict[Row, Cell]]


def main_table(results: Results, dataset: str | None = None) -> Table:
    """The paper's columns, over the sequences of a data set or (None) of all; with the paper's figures next to ours if
    the suite is the paper's, and with energy and memory if they were measured."""
    records, quoted, efficiency = _records(results, dataset), paper_table_of(results.suite), results.efficiency
    group = OURS if quoted else ""
    plugin_columns = own_quantities(key for record in results.records for key in record.figures)
    columns = _means(records, [*(PAPERS if quoted else MAIN), *plugin_columns], group)
    notes = _notes(results, records)
    costs = _costs(efficiency, records, group) if efficiency else {}
    if efficiency and any(cell.value for cells in costs.values() for cell in cells.values()):
        columns |= costs
        notes.append(_cost_note(efficiency))
    if quoted:
        paper_cells = {row: quoted.rows.get(row.method.name, {}) for row in plain_rows(records)}
        for key in quoted.columns:
            quantity = replace(_PAPER_COLUMNS[key], better="")
            columns[PAPER, quantity] = {row: cells[key] for row, cells in paper_cells.items() if key in cells}
        notes.append(f"The paper's own figures are of {quoted.network} on {quoted.measured_on}.")
    return _table("main", f"{results.title}, {_where(results, dataset)}", records, columns, notes)


def extra_table(results: Results, dataset: str | None = None) -> Table:
    """Figures beyond the paper's tables: errors in metres, ranking, pixels without a figure, times."""
    records = _records(results, dataset)
    figures = {name for record in results.records for name in record.figures}
    optional = [q for group in (MIXTURE, INTERVALS) if group[0].key in figures for q in group]
    columns, notes = _means(records, (*EXTRA, *optional)), _notes(results, records)
    return _table("extra", f"{results.title}, {_where(results, dataset)}", records, columns, notes)


def sequence_tables(results: Results, dataset: str) -> list[Table]:
    """The paper's columns for each sequence of a data set, without intervals."""
    tables = []
    for _, sequence in results.sequences(dataset):
        records = _records(results, dataset, sequence)
        frames = max(int(listed[0].frames.get("done", 0)) for listed in records.values())
        title = f"{dataset}, {sequence}" + (f": {frames} frames" if frames else "")
        tables.append(_table(f"{dataset}-{sequence}", title, records, _means(records, MAIN)))
    return tables


def difference_table(results: Results, dataset: str | None = None) -> Table:
    """Rows minus UfM* of the same base, paired by sequence; with a remark if the interval excludes 0."""
    lines, labels = [], row_labels(results.rows)
    for block, base in enumerate(results.bases):
        ours = reference_row(results, base)
        if ours is None:
            continue
        for row in (row for row in results.rows if row.method.base == base and row != ours):
            means = {q: difference(results.of(row, dataset), results.of(ours, dataset), q) for q in DIFFERENCES}
            if pairs := max(mean.sequences for mean in means.values()):
                cells = (Cell.of(mean, q, signed=True) for q, mean in means.items())
                lines.append((block, f"{labels[row]} – {labels[ours]}", (Cell(str(pairs)), *cells)))
    columns = [("", "sequences"), *(("", f"Δ {q.heading}") for q in DIFFERENCES)]
    note = (
        "Mean over sequences of row – UfM* on the same sequence, with its 95 % confidence interval (w: wide, of fewer "
        f"than {FEW_SEQUENCES} sequences); better and worse: beyond the interval, from {FEW_SEQUENCES} sequences on."
    )
    title = f"{results.title}, paired differences, {_where(results, dataset)}"
    return Table("differences", title, "Row – UfM*", frame_of(lines, columns), (note,))


def _records(results: Results, dataset: str | None, sequence: str | None = None) -> Records:
    return {row: listed for row in results.rows if (listed := results.of(row, dataset, sequence))}


def _means(records: Records, quantities: Iterable[Quantity], group: str = "") -> Columns:
    """A column for each quantity, with the means over the sequences."""
    return {(group, q): {row: Cell.of(mean_of(listed, q), q) for row, listed in records.items()} for q in quantities}


def _costs(efficiency: Mapping[str, Any], records: Records, group: str) -> Columns:
    """Energy and memory of the rows' uncertainty over the measured sequences, as in the table of efficiency; dashes
    where nothing was measured."""
    measured = {line["row"]: line for line in efficiency.get("rows", ())}
    energy, memory = {}, {}
    for row, listed in records.items():
        if row.label in measured:
            keys = {(record.dataset, record.sequence) for record in listed}
            runs = [one for one in efficiency.get("sequences", ()) if (one["dataset"], one["sequence"]) in keys]
            joules, sizes = ([one[name].get(row.label) for one in runs] for name in ("energy_mj", "memory_bytes"))
            energy[row] = Cell.of(mean_over(v for v in joules if v is not None), ENERGY)
            memory[row] = Cell.of(mean_over(1e-6 * v for v in sizes if v is not None), MEMORY)
    return {(group, ENERGY): energy, (group, MEMORY): memory}


def _table(name: str, title: str, records: Records, columns: Columns, notes: Sequence[str] = ()) -> Table:
    """Rows in blocks by base, the best of each block in bold unless rows have different sequences; a single block if
    every base has one row, as in table 4."""
    same_sequences = len({frozenset((r.dataset, r.sequence) for r in listed) for listed in records.values()}) == 1
    if not same_sequences:
        group = next(iter(columns))[0]
        columns = {(group, _SEQUENCES): {row: Cell(str(len(listed))) for row, listed in records.items()}} | columns
        notes = [*notes, "The rows are means over different sequences, so none is marked as the best."]
    labels = row_labels(records)
    bases = [row.method.base for row in labels]
    single_block = len(set(bases)) == len(bases)
    lines = []
    for block, (_, of_base) in enumerate(groupby(labels, key=lambda row: None if single_block else row.method.base)):
        rows = list(of_base)
        by_column = [[cells.get(row, Cell()) for row in rows] for cells in columns.values()]
        if same_sequences:
            by_column = [mark_best(cells, q) for (_, q), cells in zip(columns, by_column, strict=True)]
        lines += [(block, labels[row], cells) for row, *cells in zip(rows, *by_column, strict=True)]
    return Table(name, title, "Method", frame_of(lines, [(group, q.heading) for group, q in columns]), notes)


def _where(results: Results, dataset: str | None) -> str:
    sequences = count(len(results.sequences(dataset)), "sequence")
    if dataset is not None or len(results.datasets) == 1:
        return f"{sequences} of {dataset or results.datasets[0]}"
    return f"{sequences} of {len(results.datasets)} data sets ({', '.join(results.datasets)})"


def _notes(results: Results, records: Records) -> list[str]:
    """Notes on networks, preprocessing and intervals."""
    networks: dict[str, list[str]] = {}
    for base in results.bases:
        networks.setdefault(results.network(base) or "", []).append(base)
    several = ", ".join(f"{label} ({', '.join(bases)})" for label, bases in networks.items())
    notes = [f"Network: {next(iter(networks))}." if len(networks) == 1 else f"Networks: {several}."]
    if words := shared_words(records):
        notes.append(f"Images of all rows: {words}, resized to the networks' input.")
    most = max(map(len, records.values()))
    if most == 1:
        return [*notes, "One sequence: no confidence intervals."]
    intervals = "with 95 % confidence intervals (those below 0.01 are left out"
    few = "" if most >= FEW_SEQUENCES else f"; w: wide, since Student's interval of {most} sequences rests on normality"
    return [*notes, f"Means over sequences, each counting the same, {intervals}{few})."]


def _cost_note(efficiency: Mapping[str, Any]) -> str:
    used = set(efficiency["devices"]["units"].values())
    missing = "; ".join(dict.fromkeys(why for unit, why in efficiency["power"]["missing"].items() if unit in used))
    words = f"; energy is not measurable here: {missing}" if missing else ""
    measured = f"on all selected frames of {count(len(efficiency.get('sequences', ())), 'sequence')}"
    return f"Energy, and memory after the last frame, are what uncertainty adds to depth alone, {measured}{words}."


# ---- files ----


def all_tables(results: Results) -> dict[str, list[Table]]:
    """The tables by the name of their file, without empty ones: "main", "differences" and "extra" over all sequences
    (unless the suite's data sets are separate) and, with several data sets, over those of each ("main-DATASET");
    "sequences-DATASET" of single sequences; "efficiency", if it was measured, with the paper's table 2 below ours."""
    files: dict[str, list[Table]] = {}
    for make in (main_table, difference_table, extra_table):
        for dataset in results.tabulated:
            table = make(results, dataset)
            files[table.name if dataset is None else f"{table.name}-{dataset}"] = [table]
    files |= {f"sequences-{dataset}": sequence_tables(results, dataset) for dataset in results.datasets}
    files["efficiency"] = efficiency_tables(results.efficiency) if results.efficiency else []
    non_empty = {name: [table for table in listed if not table.is_empty] for name, listed in files.items()}
    return {name: listed for name, listed in non_empty.items() if listed}


def write_tables(folder: Path, files: Mapping[str, Sequence[Table]]) -> list[Path]:
    """Write ``NAME.md``, ``.tex`` and ``.csv`` of :func:`all_tables` into a folder. Returns their paths."""
    folder.mkdir(exist_ok=True)
    written = []
    for name, tables in files.items():
        forms = {"md": "\n".join(map(markdown, tables)), "tex": "\n".join(map(latex, tables)), "csv": table_csv(tables)}
        written += [_write_text(folder / f"{name}.{kind}", text) for kind, text in forms.items()]
    return written


def write_tidy(results: Results) -> Path:
    """Write ``results.csv``, a line per row, sequence and figure, with a column for each setting; numbers in full,
    missing values empty. Returns its path."""
    lines = []
    for record in results.records:
        names = ("suite", "dataset", "sequence", "network", "method")
        about = {name: getattr(record, name) for name in names} | {"figure": "", "value": None} | dict(record.setting)
        plain = {name: csv_text(value) if isinstance(value, str) else value for name, value in about.items()}
        lines += [{**plain, "figure": csv_text(key), "value": value} for key, value in record.values.items()]
    table = pd.DataFrame(lines, dtype=object).to_csv(index=False, lineterminator="\n")
    return _write_text(results.out / "results.csv", table)


def _write_text(path: Path, text: str) -> Path:
    write_bytes_atomic(path, text.encode())
    return path
