"""Tables of a report as HTML: scrolling sideways where they are wide, and sortable where there is a script."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby

from ufmstar_torch.eval.report.markup import Child, Markup, tag, typeset
from ufmstar_torch.eval.report.table import Cell, Column, Table


def html_table(table: Table, *, caption: bool = True) -> Markup:
    """The table with its caption, groups of columns, blocks of rows, and its notes below.

    Args:
        table: what it shows.
        caption: with its title.
    """
    grouped = any(column.group for column in table.columns)
    heads = tag("tr", tag("th", table.first, scope="col"), [_head(column) for column in table.columns])
    above = _groups(table.columns) if grouped else None
    blocks = [tag("tbody", [_line(line.label, line.cells, line.bold) for line in block]) for block in table.blocks]
    return framed(
        tag("table", tag("caption", table.title) if caption else None, tag("thead", above, heads), blocks),
        table.title,
        table.notes,
    )


def plain_table(title: str, heads: Sequence[str], rows: Iterable[Sequence[Child]], notes: Sequence[str] = ()) -> Markup:
    """A table of words."""
    head = tag("tr", [tag("th", name, scope="col") for name in heads])
    body = [tag("tr", [tag("td", cell, class_="words") for cell in row]) for row in rows]
    return framed(tag("table", tag("caption", title), tag("thead", head), tag("tbody", body)), title, notes)


def framed(table: Markup, label: str, notes: Sequence[str]) -> Markup:
    """A table in a frame of its own that scrolls, which the keyboard reaches too."""
    below = tag("ul", [tag("li", typeset(note)) for note in notes], class_="notes") if notes else None
    scrolled = tag("div", table, class_="scroll", role="region", aria_label=label, tabindex="0")
    return tag("div", scrolled, below, class_="table")


def _groups(columns: Sequence[Column]) -> Markup:
    """A row of headings over neighbours of the same group."""
    spans = [(name, len(list(of))) for name, of in groupby(columns, key=lambda column: column.group)]
    cells = [
        tag("th", name, scope="colgroup", colspan=str(count), class_="group" if name else None) for name, count in spans
    ]
    return tag("tr", tag("td"), cells)


def _head(column: Column) -> Markup:
    # Under its group a column needs no prefix.
    name = column.name
    prefix = f"{column.group}: ".lower()
    if column.group and name.lower().startswith(prefix):
        name = name[len(prefix) :]
    return tag("th", name, scope="col", class_="number")


def _line(label: str, cells: Sequence[Cell], bold: bool) -> Markup:
    name = tag("strong", label) if bold else label
    return tag("tr", tag("th", name, scope="row"), [_cell(cell) for cell in cells])


def _cell(cell: Cell) -> Markup:
    if not cell.value:
        return tag("td", tag("span", "–", class_="none", title="no such figure"), class_="number")
    value = tag("strong", typeset(cell.value)) if cell.bold else typeset(cell.value)
    half = tag("span", typeset(f" ± {cell.half}"), class_="half") if cell.half else None
    remark = [" ", tag("span", cell.remark, class_="worse")] if cell.remark else None
    return tag("td", value, half, remark, class_="number")
