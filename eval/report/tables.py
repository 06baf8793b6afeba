"""The tables of a report: the paper's columns, further ones, single sequences, and paired differences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby

from ufmstar_torch.eval.methods.method import UFM_STAR
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.report.aggregate import Mean, better, difference, has_variance, mean_of, references, value_of
from ufmstar_torch.eval.report.load import Results
from ufmstar_torch.eval.report.names import DIFFERENCES, EXTRA, MAIN, Quantity, row_label
from ufmstar_torch.eval.report.paper import BY_SUITE, PaperTable
from ufmstar_torch.eval.report.table import Cell, Column, Line, Table, mark_best
from ufmstar_torch.eval.results.record import Record

METHOD = "Method"
# [nats] Above it, a mean NLL is that of a few pixels: sigma = .25 d of a room makes about 1.
NLL_OF_FEW = 100.0
# LaTeX headings of the paper's columns.
_PAPER_COLUMNS = {
    "delta1": ("δ₁", r"$\delta_1$"),
    "nll": ("NLL", "NLL"),
    "ece_delta": ("ECE_δ", r"ECE$_{\delta}$"),
    "ece_q": ("ECE_q", r"ECE$_{q}$"),
    "energy_mj": ("energy [mJ]", "Energy [mJ]"),
    "memory_mb": ("memory [MB]", "Memory [MB]"),
}


def main_table(results: Results, dataset: str | None = None) -> Table:
    """The paper's columns; where the suite is the paper's, with the paper's own figures beside ours.

    Args:
        results: of an evaluation.
        dataset: one of its data sets; None = all sequences of all.
    """
    quoted = BY_SUITE.get(results.suite)
    table = _means(results, dataset, MAIN, "main", "Ours" if quoted else "")
    return table if quoted is None else _beside_paper(table, results, quoted)


def extra_table(results: Results, dataset: str | None = None) -> Table:
    """What the paper's tables leave out: errors in metres, ranking, pixels without a figure, times."""
    return _means(results, dataset, EXTRA, "extra", "")


def sequence_tables(results: Results, dataset: str) -> list[Table]:
    """The paper's columns for each sequence of a data set: no intervals, since it is one."""
    tables = []
    for name, sequence in results.sequences(dataset):
        of = {row: [r for r in results.of(row, name) if r.sequence == sequence] for row in results.rows}
        records = {row: found for row, found in of.items() if found}
        frames = max(int(value_of(found[0], "frames.done") or 0) for found in records.values())
        lines = _lines(results, {row: _cells(found, MAIN) for row, found in records.items()}, MAIN)
        title = f"{name}, {sequence}" + (f": {frames} frames" if frames else "")
        tables.append(Table(f"{name}-{sequence}", title, METHOD, _columns(MAIN, ""), lines))
    return tables


def difference_table(results: Results, dataset: str | None = None) -> Table:
    """Row less reference, in pairs on the same sequences; bold where the interval leaves out 0 to the better side."""
    lines: dict[str, list[Line]] = {}
    for row in results.rows:
        if not has_variance(results, row):
            continue
        for reference in references(results, row):
            found = [difference(results, row, reference, q, dataset) for q in DIFFERENCES]
            count = max(mean.sequences for mean in found)
            if count:
                label = f"{row_label(row)} – {row_label(reference)}"
                cells = [Cell(str(count)), *map(_difference_cell, found, DIFFERENCES)]
                lines.setdefault(row.method.base, []).append(Line(label, tuple(cells)))
    columns = (
        Column("sequences", "Sequences"),
        *(Column(f"Δ {q.heading}", rf"$\Delta$ {q.latex_heading}") for q in DIFFERENCES),
    )
    notes = (
        "Mean over sequences of row – reference on the same sequence, with its 95 % confidence interval.",
        "Bold: better beyond the interval. (worse): worse beyond it. All others may be chance, and with many rows "
        "one in twenty lies beyond its interval by chance.",
    )
    title = f"{results.title}, paired differences, {_where(results, dataset)}"
    return Table("differences", title, "Row – reference", columns, tuple(map(tuple, lines.values())), notes)


def _difference_cell(mean: Mean, quantity: Quantity) -> Cell:
    verdict = better(mean, quantity)
    cell = Cell.of(mean, quantity.decimals, signed=True, bold=verdict is True)
    return cell if verdict is not False else replace(cell, remark="worse")


def _means(results: Results, dataset: str | None, quantities: Sequence[Quantity], name: str, group: str) -> Table:
    """A table of means over the sequences of one data set, or of all."""
    records = {row: results.of(row, dataset) for row in results.rows}
    records = {row: found for row, found in records.items() if found}
    on = {row: {(r.dataset, r.sequence) for r in found} for row, found in records.items()}
    alike = len({frozenset(where) for where in on.values()}) == 1
    cells = {row: _cells(found, quantities) for row, found in records.items()}
    columns = _columns(quantities, group)
    notes = [_network_note(results), _interval_note(records), _nll_note(records, quantities)]
    if not alike:
        columns = (Column("sequences", "Sequences", group), *columns)
        cells = {row: [Cell(str(len(on[row]))), *found] for row, found in cells.items()}
        notes.append("The rows are means over different sequences, so none is marked as the best.")
    lines = _lines(results, cells, quantities if alike else ())
    title = f"{results.title}, {_where(results, dataset)}"
    return Table(name, title, METHOD, columns, lines, tuple(filter(None, notes)))


def _cells(records: Sequence[Record], quantities: Sequence[Quantity]) -> list[Cell]:
    return [Cell.of(mean_of(records, q), q.decimals) for q in quantities]


def _columns(quantities: Sequence[Quantity], group: str) -> tuple[Column, ...]:
    return tuple(Column(q.heading, q.latex_heading, group) for q in quantities)


def _lines(
    results: Results, cells: Mapping[Row, Sequence[Cell]], quantities: Sequence[Quantity]
) -> tuple[tuple[Line, ...], ...]:
    """Rows by base, the best of each in bold; one block where every base has a single row, as in table 4."""
    bases = [row.method.base for row in cells]
    together = len(set(bases)) == len(bases)
    blocks = []
    for _, group in groupby(cells, key=lambda row: None if together else row.method.base):
        rows = list(group)
        columns = list(zip(*(cells[row] for row in rows), strict=True))
        if quantities:
            columns = [tuple(mark_best(column, q)) for column, q in zip(columns, quantities, strict=True)]
        lines = zip(rows, zip(*columns, strict=True), strict=True)
        blocks.append(tuple(Line(row_label(row), tuple(found), row.method.fusion == UFM_STAR) for row, found in lines))
    return tuple(blocks)


def _beside_paper(table: Table, results: Results, quoted: PaperTable) -> Table:
    """The table with the paper's columns added."""
    heads = [_PAPER_COLUMNS[key] for key in quoted.columns]
    columns = tuple(Column(f"paper: {name}", latex, "Paper") for name, latex in heads)
    names = {row_label(row): row.method.name for row in results.rows}

    def extended(line: Line) -> Line:
        found = quoted.rows.get(names[line.label], {})
        cells = (found.get(key) for key in quoted.columns)
        return Line(line.label, (*line.cells, *(Cell(c.value, c.half) if c else Cell() for c in cells)), line.bold)

    note = (
        f"The paper's own figures are of {quoted.network} on {quoted.told}; compare the differences between rows, "
        "not the rows with each other."
    )
    blocks = tuple(tuple(map(extended, block)) for block in table.blocks)
    return Table(table.name, table.title, table.first, (*table.columns, *columns), blocks, (*table.notes, note))


def _where(results: Results, dataset: str | None) -> str:
    count = len(results.sequences(dataset))
    sequences = f"{count} sequence{'s' if count > 1 else ''}"
    if dataset is not None:
        return f"{sequences} of {dataset}"
    if len(results.datasets) == 1:
        return f"{sequences} of {results.datasets[0]}"
    return f"{sequences} of {len(results.datasets)} data sets ({', '.join(results.datasets)})"


def _network_note(results: Results) -> str:
    networks: dict[str, list[str]] = {}
    for base in dict.fromkeys(row.method.base for row in results.rows):
        networks.setdefault(results.network(base) or "", []).append(base)
    if len(networks) == 1:
        return f"Network: {next(iter(networks))}."
    return "Networks: " + ", ".join(f"{name} ({', '.join(bases)})" for name, bases in networks.items()) + "."


def _interval_note(records: Mapping[Row, Sequence[Record]]) -> str:
    most = max(len(found) for found in records.values())
    if most == 1:
        return "One sequence: no confidence intervals."
    return (
        "Means over sequences, each counting the same, with 95 % confidence intervals (those below 0.01 are left out)."
    )


def _nll_note(records: Mapping[Row, Sequence[Record]], quantities: Sequence[Quantity]) -> str:
    """A warning where the NLL is that of a few pixels."""
    shown = any(quantity.key == "nll" for quantity in quantities)
    found = [record.figures.get("nll") for of_row in records.values() for record in of_row]
    if not shown or max((nll for nll in found if nll is not None), default=0.0) < NLL_OF_FEW:
        return ""
    return (
        f"An NLL above {NLL_OF_FEW:.0f} tells of a few pixels with almost no variance and of nothing else; those with "
        "none at all have no NLL (their share stands among the further figures)."
    )


def is_empty(table: Table) -> bool:
    """Whether a table has nothing to say: no line, or only dashes."""
    return not any(cell.value for line in table.lines for cell in line.cells)


def finite(value: float) -> float | None:
    """A number for JSON: None for NaN."""
    return None if math.isnan(value) else value
