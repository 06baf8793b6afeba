"""The tables of a report and their files: the paper's columns, further ones, costs, and the tidy results."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

import pandas as pd

from ufmstar_torch.eval.engine.files import write_bytes_atomic
from ufmstar_torch.eval.engine.record import Record
from ufmstar_torch.eval.methods.row import Row, plain_rows
from ufmstar_torch.eval.methods.setting import OF_NETWORK
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.efficiency import efficiency_tables
from ufmstar_torch.eval.report.paper import paper_table_of
from ufmstar_torch.eval.report.quantities import (
    ENERGY,
    EXTRA,
    MAIN,
    MEMORY,
    OPTIONAL,
    PAPERS,
    Quantity,
    count,
    mean_of,
    mean_over,
    own_quantities,
    row_labels,
)
from ufmstar_torch.eval.report.table import Table, csv_text, printed

_PAPER_COLUMNS = {quantity.key: quantity for quantity in (*PAPERS, ENERGY, MEMORY)}
# With fewer sequences, the confidence interval depends on normality.
FEW_SEQUENCES = 5
_SEQUENCES = Quantity("", "sequences", 0)
Records = Mapping[Row, Sequence[Record]]
# By heading above the column ("" = none) and quantity, the cells by row.
Columns = dict[tuple[str, Quantity], dict[Row, str]]


def main_table(results: Results, dataset: str | None = None) -> Table:
    """The paper's columns, over the sequences of a data set or (None) of all; with the paper's figures next to ours if
    the suite is the paper's, and with energy and memory if they were measured."""
    records, quoted, efficiency = _records(results, dataset), paper_table_of(results.suite), results.efficiency
    group = "Ours" if quoted else ""
    plugin_columns = own_quantities(key for record in results.records for key in record.figures)
    columns, notes = _means(records, [*(PAPERS if quoted else MAIN), *plugin_columns], group), _notes(results, records)
    costs = _costs(efficiency, records, group) if efficiency else {}
    if efficiency and any(cell for cells in costs.values() for cell in cells.values()):
        columns |= costs
        notes.append(_cost_note(efficiency))
    if quoted:
        paper_cells = {row: quoted.rows.get(row.method.name, {}) for row in plain_rows(records)}
        for key in quoted.columns:
            quantity = replace(_PAPER_COLUMNS[key], better="")
            columns["Paper", quantity] = {row: cells[key] for row, cells in paper_cells.items() if key in cells}
        notes.append(f"The paper's own figures are of {quoted.network} on {quoted.measured_on}.")
    return _table("main", f"{results.title}, {_where(results, dataset)}", records, columns, notes)


def extra_table(results: Results, dataset: str | None = None) -> Table:
    """Figures beyond the paper's tables: errors in metres, ranking, pixels without a figure, times."""
    records = _records(results, dataset)
    figures = {name for record in results.records for name in record.figures}
    columns = _means(records, (*EXTRA, *(quantity for quantity in OPTIONAL if quantity.key in figures)))
    title = f"{results.title}, {_where(results, dataset)}"
    return _table("extra", title, records, columns, _notes(results, records))


def _records(results: Results, dataset: str | None) -> Records:
    return {row: listed for row in results.rows if (listed := results.of(row, dataset))}


def _means(records: Records, quantities: Iterable[Quantity], group: str = "") -> Columns:
    """A column for each quantity, with the means over the sequences."""
    return {(group, q): {row: printed(mean_of(listed, q), q) for row, listed in records.items()} for q in quantities}


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
            energy[row] = printed(mean_over(v for v in joules if v is not None), ENERGY)
            memory[row] = printed(mean_over(1e-6 * v for v in sizes if v is not None), MEMORY)
    return {(group, ENERGY): energy, (group, MEMORY): memory}


def _table(name: str, title: str, records: Records, columns: Columns, notes: Sequence[str]) -> Table:
    """Rows in blocks by base, the best of each block marked unless rows have different sequences; a single block if
    every base has one row, as in table 4."""
    same_sequences = len({frozenset((r.dataset, r.sequence) for r in listed) for listed in records.values()}) == 1
    if not same_sequences:
        group = next(iter(columns))[0]
        columns = {(group, _SEQUENCES): {row: str(len(listed)) for row, listed in records.items()}} | columns
        notes = [*notes, "The rows are means over different sequences, so none is marked as the best."]
    labels = row_labels(records)
    bases = [row.method.base for row in labels]
    blocks = [0] * len(bases) if len(set(bases)) == len(bases) else [
        number for number, (_, of_base) in enumerate(groupby(bases)) for _ in of_base
    ]  # fmt: skip
    lines = [
        (block, label, [cells.get(row, "") for cells in columns.values()])
        for block, (row, label) in zip(blocks, labels.items(), strict=True)
    ]
    table = Table.of(name, title, lines, [(group, q.heading) for group, q in columns], notes)
    return table.with_best([q.better for _, q in columns]) if same_sequences else table


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
    prepared = {row.setting.preprocess for row in records}
    if len(prepared) == 1 and not prepared & {OF_NETWORK}:
        notes.append(f"All rows: preprocess {prepared.pop()}.")
    if (most := max(map(len, records.values()))) == 1:
        return [*notes, "One sequence: no confidence intervals."]
    normal = f"; Student's interval of {most} sequences is wide and rests on normality" if most < FEW_SEQUENCES else ""
    return [*notes, f"Means over sequences with 95 % confidence intervals (those below 0.01 are left out{normal})."]


def _cost_note(efficiency: Mapping[str, Any]) -> str:
    used = set(efficiency["devices"]["units"].values())
    missing = "; ".join(dict.fromkeys(why for unit, why in efficiency["power"]["missing"].items() if unit in used))
    words = f"; energy is not measurable here: {missing}" if missing else ""
    measured = f"on all selected frames of {count(len(efficiency.get('sequences', ())), 'sequence')}"
    return f"Energy, and memory after the last frame, are what uncertainty adds to depth alone, {measured}{words}."


# ---- files ----


def all_tables(results: Results) -> dict[str, list[Table]]:
    """The tables by the name of their file, without empty ones: "main" and "extra" over all sequences (unless the
    suite's data sets are separate) and, with several data sets, over those of each ("main-DATASET"); "efficiency", if
    it was measured, with the paper's table 2 below ours."""
    files: dict[str, list[Table]] = {}
    for make in (main_table, extra_table):
        for dataset in results.tabulated:
            table = make(results, dataset)
            files[table.name if dataset is None else f"{table.name}-{dataset}"] = [table]
    files["efficiency"] = efficiency_tables(results.efficiency) if results.efficiency else []
    non_empty = {name: [table for table in listed if not table.is_empty] for name, listed in files.items()}
    return {name: listed for name, listed in non_empty.items() if listed}


def write_tables(folder: Path, files: Mapping[str, Sequence[Table]]) -> list[Path]:
    """Write ``NAME.tex`` of :func:`all_tables` into a folder. Returns their paths."""
    folder.mkdir(exist_ok=True)
    texts = {name: "\n".join(table.latex() for table in tables) for name, tables in files.items()}
    return [_write_text(folder / f"{name}.tex", text) for name, text in texts.items()]


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
