"""Tables as LaTeX, set as the paper's: booktabs, a gap between blocks, the best in bold."""

from __future__ import annotations

import re
from itertools import groupby

from ufmstar_torch.eval.report.table import Cell, Line, Table

_ESCAPES = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "–": "--", "°": r"$^\circ$", "²": "$^2$",
    "³": "$^3$", "₀": "$_0$", "₁": "$_1$", "α": r"$\alpha$", "δ": r"$\delta$", "η": r"$\eta$", "μ": r"$\mu$",
    "π": r"$\pi$", "σ": r"$\sigma$", "<": "$<$", ">": "$>$", "Δ": r"$\Delta$", "*": "$^*$",
    "↓": r"$\downarrow$", "↑": r"$\uparrow$", "×": r"$\times$",
}  # fmt: skip


def latex(table: Table) -> str:
    """A ``table`` environment; the document needs the package booktabs."""
    blocks = ("\n".join(_line(line) for line in block) for block in table.blocks)
    caption = " ".join([f"{escape(table.title)}.", *map(escape, table.notes)])
    return "\n".join(
        [
            "% needs \\usepackage{booktabs}",
            r"\begin{table}[t]",
            r"\centering",
            rf"\caption{{{caption}}}",
            rf"\label{{tab:{re.sub(r'[^A-Za-z0-9.-]+', '-', table.name)}}}",
            rf"\begin{{tabular}}{{l{'c' * len(table.columns)}}}",
            r"\toprule",
            *_groups(table),
            " & ".join([escape(table.first), *(column.latex for column in table.columns)]) + r" \\",
            r"\midrule",
            "\n\\addlinespace\n".join(blocks),
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def escape(text: str) -> str:
    """Plain text as LaTeX; "UfM*" gets its star as an exponent."""
    return "".join(_ESCAPES.get(character, character) for character in text)


def _groups(table: Table) -> list[str]:
    """The line of headings over several columns and its rules, where there are any."""
    if not any(column.group for column in table.columns):
        return []
    heads, rules, start = [], [], 2
    for group, columns in groupby(table.columns, key=lambda column: column.group):
        count = len(list(columns))
        heads.append(rf"\multicolumn{{{count}}}{{c}}{{{escape(group)}}}")
        rules.append(rf"\cmidrule(lr){{{start}-{start + count - 1}}}" if group else "")
        start += count
    return [f" & {' & '.join(heads)} \\\\", "".join(rules)]


def _line(line: Line) -> str:
    label = rf"\textbf{{{escape(line.label)}}}" if line.bold else escape(line.label)
    return f"{' & '.join([label, *map(_cell, line.cells)])} \\\\"


def _cell(cell: Cell) -> str:
    if not cell.value:
        return "--"
    if cell.value[0].isalpha():  # words instead of a number
        return escape(cell.value)
    value = rf"\mathbf{{{cell.value}}}" if cell.bold else cell.value
    text = f"${value} \\pm {cell.half}$" if cell.half else f"${value}$"
    return f"{text} ({escape(cell.remark)})" if cell.remark else text
