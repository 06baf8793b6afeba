"""The paper's table of efficiency: what uncertainty adds, in time, power, energy and memory; one per architecture.

A part that was not measured has words in its cell, never a number: "not measurable here" without a sensor, "not
separable" where a network predicts depth and variance in one. A difference that the noise hides is an upper bound.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import row_from
from ufmstar_torch.eval.report.names import row_labels
from ufmstar_torch.eval.report.paper import PaperTable, paper_tables
from ufmstar_torch.eval.report.table import Cell, Column, Line, Table

# Keys and words of ``efficiency.json``, as eval/bench writes them.
DEPTH, NETWORK, MULTIVIEW = "depth", "network_uncertainty", "multiview"
CPU, GPU, GROSS = "cpu", "gpu", "gross"
NOT_MEASURABLE, NOT_SEPARABLE = "not measurable here", "not separable"
UNITS = {GPU: "GPU", CPU: "CPU"}
_SMALLEST = 0.01  # less prints as "<0.01"


def efficiency_tables(measured: Mapping[str, Any]) -> list[Table]:
    """One table per architecture of ``efficiency.json``, then the paper's table 2 of those of its networks that are
    among them, or of all of its."""
    tables = {row["network"]: run for run in architectures(measured) for row in run["rows"]}
    quoted = [table for table in paper_tables() if table.number == 2]
    known = [table for table in quoted if any(table.network.lower() in label.lower() for label in tables)]
    return [*(_table(run, label) for label, run in tables.items()), *map(_paper_table, known or quoted)]


def architectures(measured: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The measurements of ``efficiency.json``: one of the networks that were evaluated, and of further ones."""
    return [measured, *measured.get("further", ())]


def _table(run: Mapping[str, Any], label: str) -> Table:
    rows = [row for row in run["rows"] if row["network"] == label]
    bases = list(dict.fromkeys(row["base"] for row in rows))  # a block per base, as in the paper
    units, network = run["devices"]["units"], run["networks"][bases[0]]
    labels = [row["row"] for row in rows]
    if all("setting" in row for row in rows):
        known = [row_from(row) for row in rows]
        labels = [row_labels(known)[row] for row in known]
    lines = [Line(bases.index(row["base"]), label, _cells(row, units)) for row, label in zip(rows, labels, strict=True)]
    lines.sort(key=lambda line: line.block)
    return Table(
        f"efficiency-{''.join(c if c.isalnum() else '-' for c in label.lower())}",
        f"Efficiency of uncertainty, {label}",
        "Method",
        _columns(),
        lines,
        (_about_depth(network, units[DEPTH]), *_notes(run, rows)),
    )


def _paper_table(quoted: PaperTable) -> Table:
    """The paper's table 2 of one network, column below column of ours."""
    bases = list(dict.fromkeys(Method.parse(method).base for method in quoted.rows))
    lines = []
    for method, cells in quoted.rows.items():
        printed = tuple(cells.get(column, Cell()) for column in quoted.columns)
        lines.append(Line(bases.index(Method.parse(method).base), method, printed))
    alone = f"Depth alone: {quoted.alone['latency_ms']} ms, {quoted.alone['memory_mb']} MB."
    notes = (alone, f"Measured by the paper on {quoted.measured_on}.")
    title = f"The paper's table 2, {quoted.network}"
    return Table(f"paper-efficiency-{quoted.network}", title, "Method", _columns(), lines, notes)


def _columns() -> list[Column]:
    per_unit = ("Latency [ms]", "Power [W]", "Energy [mJ]")
    memory = ("DNN unc. [MB]", "MVD [MB]", "Overhead [%]")
    return [
        *(Column(unit, name) for unit in UNITS.values() for name in per_unit),
        Column("", "Energy overhead [%]"),
        *(Column("Memory", name) for name in memory),
    ]


def _cells(row: Mapping[str, Any], units: Mapping[str, str]) -> tuple[Cell, ...]:
    cells: list[str] = []
    for unit in UNITS:
        parts = [part for part in (NETWORK, MULTIVIEW) if _counts(row, part) and units[part] == unit]
        cells += _unit_cells([row["latency"][part] for part in parts], [row["energy"][part] for part in parts])
    overhead, memory = row["energy_overhead_percent"], row["memory"]
    if overhead is not None and GROSS in overhead:
        cells.append(_percent(overhead[GROSS]))
    else:
        whole = any("not_separable" in part for part in row["energy"].values())
        cells.append(NOT_SEPARABLE if whole else NOT_MEASURABLE)
    state = "" if memory["multiview"] is None else megabytes(memory["multiview"]["bytes_end"])
    if "not_measurable" in memory:
        cells += [NOT_MEASURABLE, state, NOT_MEASURABLE]
    else:
        cells += [megabytes(memory["network_uncertainty_bytes"]), state, _percent(memory["overhead_percent"])]
    return tuple(map(Cell, cells))


def _counts(row: Mapping[str, Any], part: str) -> bool:
    """Return whether a row has this part."""
    return part in row["latency"] and "none" not in row["latency"][part]


def _unit_cells(times: Sequence[Any], energies: Sequence[Any]) -> list[str]:
    """Milliseconds, watts and millijoules per frame of the parts that run on one unit."""
    if not times:
        return ["", "", ""]
    if any("not_separable" in time for time in times):
        latency = NOT_SEPARABLE
    else:
        latency = _sum([(time["median_ms"], time["q1_ms"], time["q3_ms"]) for time in times])
    for key, words in (("not_separable", NOT_SEPARABLE), ("not_measurable", NOT_MEASURABLE)):
        if any(key in energy for energy in energies):
            return [latency, words, words]
    used = [energy[GROSS] for energy in energies]
    joules = _sum([(one["millijoules"], one["q1"], one["q3"]) for one in used])
    seconds = sum(one["seconds"] for one in used)
    watts = 1e-3 * sum(max(0.0, one["millijoules"]) for one in used) / seconds if seconds > 0 else None
    return [latency, "" if watts is None or joules.startswith("<") else _digits(watts), joules]


def _sum(parts: Sequence[tuple[float, float, float]]) -> str:
    """The sum of medians over parts, each with its quartiles; "<" the upper one where the lower one is not above 0."""
    if len(parts) == 1 and parts[0][1] <= 0:
        return f"<{_digits(max(parts[0][2], _SMALLEST))}"
    return _digits(sum(max(0.0, median) for median, _, _ in parts))


def megabytes(count: float) -> str:
    """Bytes as megabytes (10^6), as the paper prints them: 1245, 74.6, 0.03, <0.01."""
    value = count / 1e6
    if 0 < value < _SMALLEST:
        return "<0.01"
    return f"{value:.{0 if value >= 1000 or value == 0 else 1 if value >= 1 else 2}f}"


def _percent(value: float) -> str:
    """Format a percentage as the paper prints it: 90.0, 0.2, 0.03, <0.01."""
    if 0 < value < _SMALLEST:
        return "<0.01"
    return f"{value:.{1 if value >= 0.095 or value == 0 else 2}f}"


def _digits(value: float) -> str:
    """A decimal below 10; times and energies are not known any better."""
    if not math.isfinite(value):
        raise ValueError(f"a measured value must be finite, got {value}")
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.1f}"


def _about_depth(network: Mapping[str, Any], unit: str) -> str:
    """The paper's cell of the architecture."""
    size = NOT_MEASURABLE if network["memory"] is None else f"{megabytes(network['memory']['depth'])} MB"
    whole = "" if network["whole"] is None else f" (with its uncertainty: {network['whole']})"
    return f"Depth alone: {network['latency'][DEPTH]['median_ms']:.0f} ms on the {UNITS[unit]}, {size}{whole}."


def _notes(run: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> list[str]:
    notes = []
    if smoothing := max((row["memory"]["multiview"] or {}).get("smoothing_bytes", 0) for row in rows):
        notes.append(
            f"UfM* keeps a map for smoothing besides: {megabytes(smoothing)} MB, not counted above, as in the paper."
        )
    used = {run["devices"]["units"][part] for row in rows for part in (NETWORK, MULTIVIEW) if _counts(row, part)}
    missing = {UNITS[unit]: why for unit, why in run["power"]["missing"].items() if unit in used}
    notes += [f"Power and energy of the {unit} are {NOT_MEASURABLE}: {why}." for unit, why in missing.items()]
    frames, name, threads = run["plan"]["frames"], run["sequence"]["name"], run["plan"]["threads"]
    hardware, gpu = run["machine"]["hardware"]["cpu"], run["machine"]["gpu"]
    place = f"{hardware}, {threads} thread{'s' if threads > 1 else ''}" + ("" if gpu is None else f", and {gpu}")
    notes.append(f"Medians of {frames} frames of {name}; {place}.")
    notes += [f"{method} is left out: {why}." for method, why in run["left_out"].items()]
    return notes
