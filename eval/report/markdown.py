"""Tables as Markdown."""

from __future__ import annotations

from ufmstar_torch.eval.report.table import Cell, Table

DASH = "–"


def markdown(table: Table) -> str:
    """The table under its title, with its notes below."""
    head = [table.first, *(column.name for column in table.columns)]
    rows = [
        [f"**{_text(line.label)}**" if line.bold else _text(line.label), *map(_cell, line.cells)]
        for line in table.lines
    ]
    ruled = [head, ["---", *("---:" for _ in table.columns)], *rows]
    body = "\n".join(f"| {' | '.join(cells)} |" for cells in ruled)
    parts = [f"### {_text(table.title)}", body, "\n".join(f"- {_text(note)}" for note in table.notes)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _cell(cell: Cell) -> str:
    if not cell.value:
        return DASH
    value = cell.value.replace("<", "&lt;")
    value = f"**{value}**" if cell.bold else value
    value = f"{value} ± {cell.half}" if cell.half else value
    return f"{value} ({cell.remark})" if cell.remark else value


def _text(text: str) -> str:
    """With the characters escaped that Markdown would take for its own."""
    for character in ("\\", "|", "*", "_", "<", "`"):
        text = text.replace(character, f"\\{character}")
    return text
