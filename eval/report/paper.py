"""The paper's own numbers (``paper.toml``), for columns beside ours."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from ufmstar_torch.eval.report.table import Cell


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper.

    Attributes:
        number: its number.
        network: the depth network.
        measured_on: data and machine.
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
    suite: str
    alone: Mapping[str, str]


@cache
def paper_tables() -> tuple[PaperTable, ...]:
    """All tables, in the order of the file; table 2 once for each of its networks."""
    listed = tomllib.loads((files("ufmstar_torch.eval.report") / "paper.toml").read_text(encoding="utf-8"))["table"]
    return tuple(
        PaperTable(
            entry["number"],
            entry["network"],
            entry["measured_on"],
            tuple(entry["columns"]),
            {
                method: {c: Cell(*v.split(" ± ")) for c, v in zip(entry["columns"], values, strict=True) if v != "-"}
                for method, values in entry["rows"].items()
            },
            entry.get("suite", ""),
            entry.get("alone", {}),
        )
        for entry in listed
    )


def paper_table_of(suite: str) -> PaperTable | None:
    """The table that a suite repeats, None of another suite."""
    return next((table for table in paper_tables() if table.suite == suite), None)
