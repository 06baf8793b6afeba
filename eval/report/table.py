"""A table of printed cells. pandas makes its LaTeX (booktabs) and its HTML; a terminal gets aligned columns."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import pandas as pd

from ufmstar_torch.eval.report.quantities import LOWER, Mean, Quantity

# Smallest half-width of a printed interval, as in the paper.
SMALL_INTERVAL = 0.01
DASH = "–"
_LATEX = str.maketrans({
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "–": "--", "°": r"$^\circ$", "²": "$^2$",
    "³": "$^3$", "₀": "$_0$", "₁": "$_1$", "α": r"$\alpha$", "δ": r"$\delta$", "η": r"$\eta$", "μ": r"$\mu$",
    "π": r"$\pi$", "σ": r"$\sigma$", "<": "$<$", ">": "$>$", "*": "$^*$", "↓": r"$\downarrow$", "↑": r"$\uparrow$",
})  # fmt: skip


@dataclass(frozen=True)
class Table:
    """A table of texts."""

    name: str  # of its file
    title: str
    # By (block, label) and (group, heading); "" = no such figure. Columns of a group share a heading above ("" = none).
    cells: pd.DataFrame
    notes: Sequence[str] = ()
    best: pd.DataFrame | None = None  # True where a cell is the best of its block; None = nowhere

    @classmethod
    def of(
        cls,
        name: str,
        title: str,
        lines: Sequence[tuple[int, str, Sequence[str]]],
        columns: Sequence[tuple[str, str]],
        notes: Sequence[str] = (),
    ) -> Table:
        """The table from the block, the label and the cells of each row, and the group and heading of each column."""
        index = pd.MultiIndex.from_tuples([line[:2] for line in lines])
        cells = pd.DataFrame([list(line[2]) for line in lines], index, pd.MultiIndex.from_tuples(columns), dtype=object)
        return cls(name, title, cells, notes)

    def with_best(self, better: Sequence[str]) -> Table:
        """The table with the best printed values of each block marked, by the better direction of each column ("" =
        neither), unless all values of the block are equal."""
        best = pd.DataFrame(False, self.cells.index, self.cells.columns)
        numbers = self.cells.map(lambda cell: float(cell.partition(" ")[0]) if cell else math.nan)
        for column, direction in enumerate(better):
            of_block = numbers.iloc[:, column].groupby(level=0)
            extreme = of_block.transform("min" if direction == LOWER else "max")
            marked = (numbers.iloc[:, column] == extreme) & (of_block.transform("nunique") > 1)
            best.iloc[:, column] = marked & bool(direction)
        return Table(self.name, self.title, self.cells, self.notes, best)

    @property
    def is_empty(self) -> bool:
        """True if the table has no row, or no figure."""
        return not (self.cells != "").to_numpy().any()

    def text(self) -> str:
        """The table for a terminal, with its title above and its notes below."""
        headings = [f"{group}: {name}" if group else name for group, name in self.cells.columns]
        rows = [[label, *(cell or DASH for cell in line)] for (_, label), line in zip(
            self.cells.index, self.cells.to_numpy(), strict=True)]  # fmt: skip
        return "\n".join([self.title, *aligned([["", *headings], *rows]), *self.notes])

    def latex(self) -> str:
        """The table for booktabs, with title and notes as its caption."""
        how = {"caption": " ".join([f"{self.title}.", *self.notes]).translate(_LATEX), "position": "t"}
        how |= {"label": "tab:" + re.sub(r"[^A-Za-z0-9-]+", "-", self.name), "position_float": "centering"}
        columns = "l" + "c" * self.cells.shape[1]
        styler = self._styled(lambda text: text.translate(_LATEX), _latex_heading)
        lines = styler.to_latex(
            hrules=True, convert_css=True, multicol_align="c", column_format=columns, **how
        ).splitlines()
        first, blocks = lines.index(r"\midrule") + 1, [block for block, _ in self.cells.index]
        for n in reversed(range(1, len(blocks))):  # a space between blocks
            if blocks[n] != blocks[n - 1]:
                lines.insert(first + n, r"\addlinespace")
        return "\n".join([r"% needs \usepackage{booktabs}", *lines, ""])

    def html(self) -> str:
        """The table without title and notes."""
        blocks = self.cells.index.get_level_values(0)
        starts = [n > 0 and blocks[n] != blocks[n - 1] for n in range(len(blocks))]
        lines = pd.DataFrame(dict.fromkeys(self.cells.columns, starts), self.cells.index)
        styler = self._styled(typeset, typeset)
        styler.apply(lambda _: lines.map({True: "border-top: 1px solid", False: ""}.get), axis=None)
        named = re.sub(r"[^A-Za-z0-9-]+", "-", self.name)
        return str(styler.to_html(uuid=named, table_attributes=f'aria-label="{escape(self.title)}"'))

    def _styled(self, text: Callable[[str], str], heading: Callable[[str], str]) -> Any:
        """pandas' Styler, with functions that typeset cells and headings."""
        styler = self.cells.replace("", DASH).style.hide(axis="index", level=0)
        if not any(group for group, _ in self.cells.columns):
            styler.hide(axis="columns", level=0)
        if (best := self.best) is not None:
            styler.apply(lambda _: best.map({True: "font-weight: bold", False: ""}.get), axis=None)
        return styler.format(text).format_index(text, axis=0, level=1).format_index(heading, axis=1)


def printed(mean: Mean, quantity: Quantity) -> str:
    """A mean, with its interval if its half-width is at least .01: "0.96 ± 0.19"; "" without a figure."""
    if math.isnan(mean.value):
        return ""
    decimals = significant(mean.value) if quantity.decimals is None else quantity.decimals
    interval = f" ± {number(mean.half, decimals)}" if mean.half >= SMALL_INTERVAL else ""
    return number(mean.value, decimals) + interval


def number(value: float, decimals: int) -> str:
    """A number as text: never "-0.00", large numbers with an exponent."""
    if abs(value) >= 1e6:
        return f"{value:.2e}"
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if float(text) == 0 else text


def significant(value: float) -> int:
    """Decimals with which a number has three significant digits."""
    return max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table: the first column to the left, the others to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [
        "  ".join(cell.rjust(w) if i else cell.ljust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True)))
        for row in rows
    ]


def typeset(text: str) -> str:
    """Text as HTML, with a minus for a hyphen before a number, and narrow no-break spaces around units and ±."""
    text = re.sub(r"(?<![\w.–-])-(?=\d)", "−", escape(text))
    return text.replace(" ± ", "\u202f±\u202f").replace(" %", "\u202f%")


def _latex_heading(name: str) -> str:
    """A heading as LaTeX: the letter after "_" becomes an index."""
    first, *rest = name.split("_")
    indices = (f"$_{{{part[0].translate(_LATEX).strip('$')}}}${part[1:].translate(_LATEX)}" for part in rest)
    return first.translate(_LATEX) + "".join(indices)


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
