"""A table of printed cells, and its files: LaTeX (booktabs), CSV and Markdown; ``report.html.j2`` has its HTML."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import pandas as pd

from ufmstar_torch.eval.report.means import Mean
from ufmstar_torch.eval.report.names import LOWER, Quantity

WIDE = " w"  # after an interval of few sequences
# Smallest half-width of a printed interval, as in the paper.
SMALL_INTERVAL = 0.01
DASH = "–"


@dataclass(frozen=True)
class Cell:
    """The printed content of a cell: value ("" = a dash), half-width of the confidence interval ("" = none), bold for
    the best of a block, and a remark after it.
    """

    value: str = ""
    half: str = ""
    bold: bool = False
    remark: str = ""
    wide: bool = False

    @classmethod
    def of(cls, mean: Mean, quantity: Quantity, *, signed: bool = False) -> Cell:
        """A mean with its interval if its half-width is at least .01. A difference (``signed``) has an interval of any
        width, and "better" or "worse" if the interval excludes 0 and is not marked as wide."""
        if math.isnan(mean.value):
            return cls()
        decimals = significant(mean.value) if quantity.decimals is None else quantity.decimals
        shown = mean.half >= SMALL_INTERVAL or (signed and mean.half > 0)
        remark = ""
        if signed and quantity.better and abs(mean.value) > mean.half and not mean.wide:
            remark = "better" if (mean.value < 0) == (quantity.better == LOWER) else "worse"
        half = number(mean.half, decimals) if shown else ""
        return cls(number(mean.value, decimals, signed=signed), half, remark=remark, wide=bool(half) and mean.wide)


@dataclass(frozen=True)
class Table:
    """A table. The best value of a block is bold."""

    name: str  # of its files
    title: str
    first: str  # heading of the labels
    # Cells by (block, label) and (group, heading). Adjacent columns of a group share a heading above ("" = none).
    cells: pd.DataFrame
    notes: Sequence[str] = ()

    @property
    def labels(self) -> list[str]:
        """The labels of the rows."""
        return [label for _, label in self.cells.index]

    @property
    def headings(self) -> list[str]:
        """The headings of the columns in one line: "Paper: NLL"."""
        return [f"{group}: {name}" if group else name for group, name in self.cells.columns]

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Headings over adjacent columns, and the number of columns below each; [] without such headings."""
        spans = [(name, len(list(of))) for name, of in groupby(group for group, _ in self.cells.columns)]
        return spans if any(name for name, _ in spans) else []

    @property
    def is_empty(self) -> bool:
        """True if the table has no row, or only dashes."""
        return not any(cell.value for cell in self.cells.to_numpy().flat)


def frame_of(lines: Sequence[tuple[int, str, Sequence[Cell]]], columns: Sequence[tuple[str, str]]) -> pd.DataFrame:
    """``Table.cells`` from the block, the label and the cells of each row, and the group and heading of each column."""
    index = pd.MultiIndex.from_tuples([line[:2] for line in lines], names=("block", "label"))
    heads = pd.MultiIndex.from_tuples(columns, names=("group", "heading"))
    return pd.DataFrame([list(cells) for *_, cells in lines], index, heads, dtype=object)


def number(value: float, decimals: int, *, signed: bool = False) -> str:
    """A number as text: never "-0.00", large numbers with an exponent."""
    sign = "+" if signed else ""
    if abs(value) >= 1e6:
        return f"{value:{sign}.2e}"
    text = f"{value:{sign}.{decimals}f}"
    return text.replace("-", sign) if float(text) == 0 else text


def significant(value: float) -> int:
    """Decimals with which a number has three significant digits."""
    return max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0


def mark_best(cells: Sequence[Cell], quantity: Quantity) -> list[Cell]:
    """Make the best printed values of a block bold, unless all are equal or there is only one."""
    printed = [float(cell.value) for cell in cells if cell.value]
    if not quantity.better or len(set(printed)) < 2:
        return list(cells)
    best = min(printed) if quantity.better == LOWER else max(printed)
    return [replace(cell, bold=bool(cell.value) and float(cell.value) == best) for cell in cells]


# ---- Markdown ----


def markdown(table: Table) -> str:
    """The table with its title above and its notes below."""
    rows = [[table.first, *table.headings], ["---", *["---:"] * len(table.headings)]]
    cells = table.cells.map(_markdown_cell).to_numpy().tolist()
    rows += [[markdown_text(label), *line] for label, line in zip(table.labels, cells, strict=True)]
    body = "\n".join(f"| {' | '.join(cells)} |" for cells in rows)
    notes = "\n".join(f"- {markdown_text(note)}" for note in table.notes)
    return "\n\n".join(filter(None, (f"### {markdown_text(table.title)}", body, notes))) + "\n"


def markdown_text(text: str) -> str:
    """Escape plain text for Markdown, on one line: no part becomes emphasis, code, HTML, a formula or a link.

    Links without brackets ("https://...", "www...", addresses with an @) cannot be escaped; an invisible word joiner
    (U+2060) breaks them.
    """
    text = re.sub(r"([\\|*_<`\[\]~$])", r"\\\1", " ".join(text.split()))
    return re.sub(r"(?i)://|(?<=\bwww)\.|(?<=\w)@(?=\w)", lambda mark: f"\u2060{mark[0]}", text)


def _markdown_cell(cell: Cell) -> str:
    value = cell.value.replace("<", "&lt;") or DASH
    value = f"**{value}**" if cell.bold else value
    value = f"{value} ± {cell.half}{WIDE if cell.wide else ''}" if cell.half else value
    return f"{value} ({cell.remark})" if cell.remark else value


# ---- LaTeX ----

_LATEX = str.maketrans({
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "–": "--", "°": r"$^\circ$", "²": "$^2$",
    "³": "$^3$", "₀": "$_0$", "₁": "$_1$", "α": r"$\alpha$", "δ": r"$\delta$", "η": r"$\eta$", "μ": r"$\mu$",
    "π": r"$\pi$", "σ": r"$\sigma$", "<": "$<$", ">": "$>$", "Δ": r"$\Delta$", "*": "$^*$",
    "↓": r"$\downarrow$", "↑": r"$\uparrow$", "×": r"$\times$",
})  # fmt: skip


def latex(table: Table) -> str:
    """The table for booktabs, with title and notes as its caption."""
    frame = table.cells.map(_latex_cell)
    frame.index = pd.Index([label.translate(_LATEX) for label in table.labels])
    heads: Any = [(group.translate(_LATEX), _latex_heading(name)) for group, name in table.cells.columns]
    frame.columns = pd.MultiIndex.from_tuples(heads) if table.groups else pd.Index([name for _, name in heads])
    frame.columns.names = [*[""] * (frame.columns.nlevels - 1), table.first.translate(_LATEX)]
    caption = " ".join([f"{table.title}.", *table.notes]).translate(_LATEX)
    label = "tab:" + re.sub(r"[^A-Za-z0-9-]+", "-", table.name)
    how = {"caption": caption, "label": label, "position": "t", "multicolumn_format": "c"}
    lines = frame.to_latex(column_format="l" + "c" * len(heads), **how).splitlines()
    lines.insert(1, r"\centering")
    at = lines.index(r"\midrule") + 1
    blocks = [block for block, _ in table.cells.index]
    for n in reversed(range(1, len(blocks))):  # a space between blocks
        if blocks[n] != blocks[n - 1]:
            lines.insert(at + n, r"\addlinespace")
    return "\n".join([r"% needs \usepackage{booktabs}", *lines, ""])


def _latex_heading(name: str) -> str:
    """A heading as LaTeX: the letter after "_" becomes an index."""
    first, *rest = name.split("_")
    indices = (f"$_{{{part[0].translate(_LATEX).strip('$')}}}${part[1:].translate(_LATEX)}" for part in rest)
    return first.translate(_LATEX) + "".join(indices)


def _latex_cell(cell: Cell) -> str:
    if not cell.value or cell.value[0].isalpha():  # words instead of a number
        return (cell.value or DASH).translate(_LATEX)
    value = rf"\mathbf{{{cell.value}}}" if cell.bold else cell.value
    wide = rf"\,\mathrm{{{WIDE.strip()}}}" if cell.wide else ""
    text = f"${value} \\pm {cell.half}{wide}$" if cell.half else f"${value}$"
    return f"{text} ({cell.remark.translate(_LATEX)})" if cell.remark else text


# ---- CSV ----


def table_csv(tables: Iterable[Table]) -> str:
    """Tables below each other: title, label, and for each column its values and, if it has any, its half-widths."""
    frames = []
    for table in tables:
        columns: dict[str, Any] = {"table": table.title, table.first: table.labels}
        for heading, cells in zip(table.headings, table.cells.to_numpy().T, strict=True):
            columns[heading] = [cell.value for cell in cells]
            if any(cell.half for cell in cells):
                columns[f"{heading} ±"] = [cell.half for cell in cells]
        frames.append(pd.DataFrame(columns, dtype=object))
    return pd.concat(frames).map(csv_text).to_csv(index=False, lineterminator="\n")


def csv_text(value: Any) -> str:
    """A CSV field: text that a spreadsheet would read as a formula gets an apostrophe, numbers do not."""
    text = "" if value is None or value != value else str(value)
    if text[:1] not in ("=", "+", "-", "@", "\t", "\r"):
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text
