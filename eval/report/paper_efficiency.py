"""The paper's table of efficiency, to stand below ours: its machine is an Nvidia Orin AGX."""

from __future__ import annotations

from collections.abc import Iterable

from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.report.paper import TABLE_2, TABLE_2_NETWORKS
from ufmstar_torch.eval.report.table import Cell, Column, Line, Table

_PER_UNIT = ("Latency [ms]", "Power [W]", "Energy [mJ]")
_COLUMNS = (
    *(Column(f"{unit} {name}", name, unit) for unit in ("GPU", "CPU") for name in _PER_UNIT),
    Column("Energy overhead [%]", r"Energy overhead [\%]"),
    Column("DNN unc. mem. [MB]", "DNN unc. [MB]", "Memory"),
    Column("MVD mem. [MB]", "MVD [MB]", "Memory"),
    Column("Mem. overhead [%]", r"Overhead [\%]", "Memory"),
)


def paper_efficiency_tables(networks: Iterable[str]) -> list[Table]:
    """The paper's table 2 for each of its networks that is among ``networks`` (labels), for all if none is."""
    labels = list(networks)
    known = [name for name in TABLE_2 if any(name.lower() in label.lower() for label in labels)]
    return [_table(name) for name in known or TABLE_2]


def _table(network: str) -> Table:
    quoted = TABLE_2[network]
    lines: dict[str, list[Line]] = {}
    for method, found in quoted.rows.items():
        cells = (found.get(column) for column in quoted.columns)
        line = Line(method, tuple(Cell(c.value, c.half) if c else Cell() for c in cells), method.startswith("UfM*"))
        lines.setdefault(Method.parse(method).base, []).append(line)
    latency, memory = TABLE_2_NETWORKS[network]
    return Table(
        f"paper-efficiency-{network}",
        f"The paper's table 2, {network}",
        "Method",
        _COLUMNS,
        tuple(map(tuple, lines.values())),
        (f"Depth alone: {latency.value} ms, {memory.value} MB.", f"Measured by the paper on {quoted.told}."),
    )
