"""A table of printed cells, and its files: LaTeX (booktabs), CSV and Markdown; ``report.html.j2`` has its HTML."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, NamedTuple

import pandas as pd

from ufmstar_torch.eval.report.means import Mean
from ufmstar_torch.eval.report.names import LOWER, Quantity

# A narrower interval is not printed, as in the paper.
SMALL_INTERVAL = 0.01
DASH = "–"


@dataclass(frozen=True)
class Cell:
    """The content of a cell, as printed: "" = no such figure (a dash), the half-width of its confidence interval ("" =
    none), whether it is the best of its block, and a word behind it.
    """

    value: str = ""
    half: str = ""
    bold: bool = False
    remark: str = ""

    @classmethod
    def of(cls, mean: Mean, decimals: int | None, *, signed: bool = False, remark: str = "") -> Cell:
        """A mean with its interval, where there is one and it is at least .01 wide (of differences, any)."""
        if math.isnan(mean.value):
            return cls()
        decimals = significant(mean.value) if decimals is None else decimals
        wide = mean.half >= SMALL_INTERVAL or (signed and mean.half > 0)
        half = number(mean.half, decimals) if wide else ""
        return cls(number(mean.value, decimals, signed=signed), half, remark=remark)


class Column(NamedTuple):
    """A column's heading; neighbours of the same ``group`` share a heading above ("" = none)."""

    group: str
    name: str

    @property
    def label(self) -> str:
        """The heading where there is none above: "Paper: NLL"."""
        return f"{self.group}: {self.name}" if self.group else self.name


class Line(NamedTuple):
    """A row of a table: its block (rows that belong together), its label and its cells."""

    block: int
    label: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Table:
    """A table. Bold means one thing: the best value of a block."""

    name: str  # of its files
    title: str
    first: str  # heading of the labels
    columns: Sequence[Column]
    lines: Sequence[Line]
    notes: Sequence[str] = ()

    @property
    def blocks(self) -> Iterator[list[Line]]:
        """The rows by block."""
        return (list(lines) for _, lines in groupby(self.lines, key=lambda line: line.block))

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Headings over neighbouring columns, and the number of columns below each; [] without any heading."""
        spans = [(name, len(list(of))) for name, of in groupby(self.columns, key=lambda column: column.group)]
        return spans if any(name for name, _ in spans) else []

    @property
    def is_empty(self) -> bool:
        """True if the table has no line, or only dashes."""
        return not any(cell.value for line in self.lines for cell in line.cells)


def number(value: float, decimals: int | None, *, signed: bool = False) -> str:
    """A number as printed: never "-0.00", and large ones with an exponent; decimals None = three significant digits."""
    sign = "+" if signed else ""
    if decimals is None:
        decimals = significant(value)
    if abs(value) >= 1e6:
        return f"{value:{sign}.2e}"
    text = f"{value:{sign}.{decimals}f}"
    return text.replace("-", "+" if signed else "") if float(text) == 0 else text


def significant(value: float) -> int:
    """Decimals with which a number has three significant digits."""
    return max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0


def mark_best(cells: Sequence[Cell], quantity: Quantity | None) -> list[Cell]:
    """Bold where a cell prints the best value of its block; none where all print the same, or there is one alone."""
    if quantity is None or quantity.better is None:
        return list(cells)
    printed = [float(cell.value) for cell in cells if cell.value]
    if len(set(printed)) < 2:
        return list(cells)
    best = min(printed) if quantity.better == LOWER else max(printed)
    return [replace(cell, bold=bool(cell.value) and float(cell.value) == best) for cell in cells]


# ---- Markdown ----


def markdown(table: Table) -> str:
    """The table under its title, with its notes below."""
    rows = [[table.first, *(column.label for column in table.columns)], ["---", *("---:" for _ in table.columns)]]
    rows += [[markdown_text(line.label), *map(_markdown_cell, line.cells)] for line in table.lines]
    body = "\n".join(f"| {' | '.join(cells)} |" for cells in rows)
    notes = "\n".join(f"- {markdown_text(note)}" for note in table.notes)
    return "\n\n".join(filter(None, (f"### {markdown_text(table.title)}", body, notes))) + "\n"


def markdown_text(text: str) -> str:
    """Plain text for Markdown, on one line: nothing of it becomes emphasis, code, HTML, a formula or a link.

    Links without brackets ("https://...", "www...", addresses with an @) are known by letters alone, which cannot be
    escaped: an invisible word joiner (U+2060) breaks them.
    """
    text = re.sub(r"([\\|*_<`\[\]~$])", r"\\\1", " ".join(text.split()))
    return re.sub(r"(?i)://|(?<=\bwww)\.|(?<=\w)@(?=\w)", lambda mark: f"\u2060{mark[0]}", text)


def _markdown_cell(cell: Cell) -> str:
    if not cell.value:
        return DASH
    value = cell.value.replace("<", "&lt;")
    value = f"**{value}**" if cell.bold else value
    value = f"{value} ± {cell.half}" if cell.half else value
    return f"{value} ({cell.remark})" if cell.remark else value


# ---- LaTeX ----

_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "–": "--", "°": r"$^\circ$", "²": "$^2$",
    "³": "$^3$", "₀": "$_0$", "₁": "$_1$", "α": r"$\alpha$", "δ": r"$\delta$", "η": r"$\eta$", "μ": r"$\mu$",
    "π": r"$\pi$", "σ": r"$\sigma$", "<": "$<$", ">": "$>$", "Δ": r"$\Delta$", "*": "$^*$",
    "↓": r"$\downarrow$", "↑": r"$\uparrow$", "×": r"$\times$",
}  # fmt: skip


def latex(table: Table) -> str:
    """The table for booktabs, with title and notes as its caption."""
    heads: Any = [(latex_text(column.group), _latex_name(column.name)) for column in table.columns]
    heads = pd.MultiIndex.from_tuples(heads) if table.groups else [name for _, name in heads]
    frame = pd.DataFrame(
        [[_latex_cell(cell) for cell in line.cells] for line in table.lines],
        index=[latex_text(line.label) for line in table.lines],
        columns=heads,
    )
    frame.columns.names = [*[""] * (frame.columns.nlevels - 1), latex_text(table.first)]
    caption = latex_text(" ".join([f"{table.title}.", *table.notes]))
    label = "tab:" + re.sub(r"[^A-Za-z0-9-]+", "-", table.name)
    how = {"caption": caption, "label": label, "position": "t", "multicolumn_format": "c"}
    lines = frame.to_latex(column_format="l" + "c" * len(table.columns), **how).splitlines()
    lines.insert(1, r"\centering")
    at = lines.index(r"\midrule") + 1
    for block in [*table.blocks][:-1]:
        at += len(block) + 1
        lines.insert(at - 1, r"\addlinespace")
    return "\n".join([r"% needs \usepackage{booktabs}", *lines, ""])


def latex_text(text: str) -> str:
    """Plain text as LaTeX; "UfM*" gets its star as an exponent."""
    return "".join(_LATEX.get(character, character) for character in text)


def _latex_name(name: str) -> str:
    """A heading as LaTeX: the letter behind "_" becomes an index."""
    first, *rest = name.split("_")
    return latex_text(first) + "".join(
        f"$_{{{latex_text(part[0]).strip('$')}}}${latex_text(part[1:])}" for part in rest
    )


def _latex_cell(cell: Cell) -> str:
    if not cell.value:
        return "--"
    if cell.value[0].isalpha():  # words instead of a number
        return latex_text(cell.value)
    value = rf"\mathbf{{{cell.value}}}" if cell.bold else cell.value
    text = f"${value} \\pm {cell.half}$" if cell.half else f"${value}$"
    return f"{text} ({latex_text(cell.remark)})" if cell.remark else text


# ---- CSV ----


def table_csv(tables: Iterable[Table]) -> str:
    """Tables below each other: title, label, and for each column its value and, where any has one, its half-width."""
    frames = []
    for table in tables:
        columns: dict[str, list[str]] = {
            "table": [table.title] * len(table.lines), table.first: [line.label for line in table.lines],
        }  # fmt: skip
        for column, cells in zip(table.columns, zip(*(line.cells for line in table.lines), strict=True), strict=True):
            columns[column.label] = [cell.value for cell in cells]
            if any(cell.half for cell in cells):
                columns[f"{column.label} ±"] = [cell.half for cell in cells]
        frames.append(pd.DataFrame(columns, dtype=object))
    return pd.concat(frames).map(csv_text).to_csv(index=False, lineterminator="\n")


def csv_text(value: Any) -> str:
    """A CSV field: text that a spreadsheet would take for a formula gets an apostrophe, numbers do not."""
    text = "" if value is None or value != value else str(value)
    if text[:1] not in ("=", "+", "-", "@", "\t", "\r"):
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text
