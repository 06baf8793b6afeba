"""The paper's numbers (``paper.toml``), for columns next to ours."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper."""

    number: int
    network: str
    measured_on: str  # data and machine
    columns: tuple[str, ...]  # keys; for equal quantities those of Record.figures
    rows: Mapping[str, Mapping[str, str]]  # printed cells by method and column, without dashes
    suite: str = ""  # name of the suite that repeats it
    alone: Mapping[str, str] = field(default_factory=dict)  # latency_ms, memory_mb without uncertainty (table 2)


@cache
def paper_tables() -> tuple[PaperTable, ...]:
    """All tables, in the order of the file; table 2 once for each of its networks."""
    listed = tomllib.loads((files("ufmstar_torch.eval.report") / "paper.toml").read_text(encoding="utf-8"))["table"]
    tables = []
    for entry in listed:
        columns = tuple(entry.pop("columns"))
        printed = {name: zip(columns, values, strict=True) for name, values in entry.pop("rows").items()}
        rows = {name: {c: v for c, v in cells if v != "-"} for name, cells in printed.items()}
        tables.append(PaperTable(columns=columns, rows=rows, **entry))
    return tuple(tables)


def paper_table_of(suite: str) -> PaperTable | None:
    """The table that a suite repeats, or None."""
    return next((table for table in paper_tables() if table.suite == suite), None)
