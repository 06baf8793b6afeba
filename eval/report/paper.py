"""The paper's own numbers (``paper.toml``), for columns beside ours."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files

from ufmstar_torch.eval.report.table import Cell


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper.

    Attributes:
        number, network, measured_on: its number, the depth network, data and machine.
        columns: keys, those of ``Record.figures`` where they mean the same.
        rows: cells as printed, by method and column; a column in which a dash is printed is missing.
        suite: the suite that repeats it, "" = none.
        alone: latency_ms and memory_mb of the network without uncertainty, as printed (table 2).
    """

    number: int
    network: str
    measured_on: str
    columns: tuple[str, ...]
    rows: Mapping[str, Mapping[str, Cell]]
    suite: str = ""
    alone: Mapping[str, str] = field(default_factory=dict)


@cache
def paper_tables() -> tuple[PaperTable, ...]:
    """All tables, in the order of the file; table 2 once for each of its networks."""
    listed = tomllib.loads((files("ufmstar_torch.eval.report") / "paper.toml").read_text(encoding="utf-8"))["table"]
    tables = []
    for entry in listed:
        columns = tuple(entry.pop("columns"))
        printed = {name: zip(columns, values, strict=True) for name, values in entry.pop("rows").items()}
        rows = {name: {c: Cell(*v.split(" ± ")) for c, v in cells if v != "-"} for name, cells in printed.items()}
        tables.append(PaperTable(columns=columns, rows=rows, **entry))
    return tuple(tables)


def paper_table_of(suite: str) -> PaperTable | None:
    """The table that a suite repeats, None of another suite."""
    return next((table for table in paper_tables() if table.suite == suite), None)
