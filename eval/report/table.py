"""A table as values, before it is Markdown or LaTeX."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ufmstar_torch.eval.report.aggregate import Mean
from ufmstar_torch.eval.report.names import LOWER, Quantity

# A narrower interval is not printed, as in the paper.
SMALL_INTERVAL = 0.01


@dataclass(frozen=True)
class Cell:
    """What stands in a cell.

    Attributes:
        value: as printed; "" = nothing to print (a dash).
        half: half-width of its confidence interval as printed, "" = none.
        bold: the best of its block.
        remark: a word behind it.
    """

    value: str = ""
    half: str = ""
    bold: bool = False
    remark: str = ""

    @classmethod
    def of(cls, mean: Mean, decimals: int | None, *, signed: bool = False, bold: bool = False) -> Cell:
        """A mean with its interval; intervals below .01 are left out, and those of a single sequence."""
        if math.isnan(mean.value):
            return cls()
        if decimals is None:
            decimals = significant(mean.value)
        value = number(mean.value, decimals, signed=signed)
        wide = mean.half >= SMALL_INTERVAL or (signed and mean.half > 0)
        return cls(value, number(mean.half, decimals) if wide else "", bold)


@dataclass(frozen=True)
class Column:
    """A column's heading; ``group`` stands over neighbours of the same group, "" = none."""

    name: str
    latex: str
    group: str = ""


@dataclass(frozen=True)
class Line:
    """A row of a table."""

    label: str
    cells: tuple[Cell, ...]
    bold: bool = False


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        name: of its files.
        title: its caption.
        first: heading of the labels.
        columns: headings.
        blocks: lines by what belongs together.
        notes: sentences below.
    """

    name: str
    title: str
    first: str
    columns: tuple[Column, ...]
    blocks: tuple[tuple[Line, ...], ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for line in self.lines:
            if len(line.cells) != len(self.columns):
                found = f"{len(line.cells)} cells for {len(self.columns)} columns"
                raise ValueError(f"{self.name}: {line.label} has {found}")

    @property
    def lines(self) -> tuple[Line, ...]:
        """Of all blocks."""
        return tuple(line for block in self.blocks for line in block)


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


def mark_best(cells: Sequence[Cell], quantity: Quantity) -> list[Cell]:
    """Bold where a cell prints the best value of its block; none where all print the same, or stand alone."""
    printed = [float(cell.value) for cell in cells if cell.value]
    if quantity.better is None or len(set(printed)) < 2:
        return list(cells)
    best = min(printed) if quantity.better == LOWER else max(printed)
    return [replace(cell, bold=bool(cell.value) and float(cell.value) == best) for cell in cells]
