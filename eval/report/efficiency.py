"""The paper's table of efficiency: what uncertainty adds, in time, power, energy and memory; one per architecture.

A part that was not measured has words in its cell, never a number: "not measurable here" without a sensor, "not
separable" where a network predicts depth and variance in one. A difference that the noise hides is an upper bound.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.report.data import setting_of
from ufmstar_torch.eval.report.names import row_labels
from ufmstar_torch.eval.report.paper import PaperTable, paper_tables
from ufmstar_torch.eval.report.table import Cell, Column, Line, Table, latex, markdown

# Keys and words of ``efficiency.json``, as eval/bench writes them.
DEPTH, NETWORK, MULTIVIEW = "depth", "network_uncertainty", "multiview"
WALL, PROCESSOR = "wall", "processor"
CPU, GPU = "cpu", "gpu"
NOT_MEASURABLE = "not measurable here"
NOT_SEPARABLE = "not separable"
UNITS = {GPU: "GPU", CPU: "CPU"}
_SMALLEST = 0.01  # less prints as "<0.01"


Measured = Mapping[str, Any] | Sequence[Mapping[str, Any]]


def efficiency_table(measured: Measured, **how: bool) -> tuple[str, str]:
    """:func:`efficiency_tables` as Markdown and as LaTeX."""
    tables = efficiency_tables(measured, **how)
    return "\n".join(map(markdown, tables)), "\n".join(map(latex, tables))


def efficiency_tables(measured: Measured, *, relative: bool = False, net: bool = False) -> list[Table]:
    """One table per architecture of what ``measure`` returned, once or several times.

    Args:
        relative: times as multiples of one inference of depth alone, of the same frame: for a machine that also
            does other work. Where all runs on the CPU, these are processor times, which such work does not stretch.
        net: power and energy less those of the idle machine.
    """
    runs = [measured] if isinstance(measured, Mapping) else list(measured)
    return [
        _table(run, label, relative, "net" if net else "gross")
        for run in runs
        for label in dict.fromkeys(row["network"] for row in run["rows"])
    ]


def paper_efficiency_tables(networks: Iterable[str]) -> list[Table]:
    """The paper's table 2 for each of its networks that is among ``networks`` (labels), for all if none is."""
    labels = [label.lower() for label in networks]
    quoted = [table for table in paper_tables() if table.number == 2]
    known = [table for table in quoted if any(table.network.lower() in label for label in labels)]
    return [_paper_table(table) for table in known or quoted]


def _table(run: Mapping[str, Any], label: str, relative: bool, kind: str) -> Table:
    rows = [row for row in run["rows"] if row["network"] == label]
    bases = list(dict.fromkeys(row["base"] for row in rows))  # a block per base, as in the paper
    units, network = run["devices"]["units"], run["networks"][bases[0]]
    labels = {row["row"]: row["row"] for row in rows}
    if all("setting" in row for row in rows):
        known = {row["row"]: Row(Method.parse(row["method"]), setting_of(row["setting"])) for row in rows}
        shown = row_labels(known.values())
        labels = {name: shown[row] for name, row in known.items()}
    lines = [
        Line(block, labels[row["row"]], False, _cells(row, units, _clock(units) if relative else None, kind))
        for block, base in enumerate(bases)
        for row in rows
        if row["base"] == base
    ]
    return Table(
        f"efficiency-{''.join(c if c.isalnum() else '-' for c in label.lower())}",
        f"Efficiency of uncertainty, {label}",
        "Method",
        _columns(relative),
        lines,
        (_about_depth(network, units[DEPTH], relative), *_notes(run, rows, relative, kind)),
    )


def _paper_table(quoted: PaperTable) -> Table:
    """The paper's table 2 of one network, column below column of ours."""
    bases = list(dict.fromkeys(Method.parse(method).base for method in quoted.rows))
    lines = []
    for method, cells in quoted.rows.items():
        printed = tuple(cells.get(column, Cell()) for column in quoted.columns)
        lines.append(Line(bases.index(Method.parse(method).base), method, method.startswith("UfM*"), printed))
    alone = f"Depth alone: {quoted.alone['latency_ms']} ms, {quoted.alone['memory_mb']} MB."
    notes = (alone, f"Measured by the paper on {quoted.measured_on}.")
    title = f"The paper's table 2, {quoted.network}"
    return Table(f"paper-efficiency-{quoted.network}", title, "Method", _columns(False), lines, notes)


def _columns(relative: bool) -> list[Column]:
    time = ("Latency [× depth]", r"Latency [$\times$ depth]") if relative else ("Latency [ms]",) * 2
    per_unit = (time, ("Power [W]",) * 2, ("Energy [mJ]",) * 2)
    return [
        *(Column(unit, f"{unit} {name}", tex) for unit in UNITS.values() for name, tex in per_unit),
        Column("", "Energy overhead [%]", r"Energy overhead [\%]"),
        Column("Memory", "DNN unc. mem. [MB]", "DNN unc. [MB]"),
        Column("Memory", "MVD mem. [MB]", "MVD [MB]"),
        Column("Memory", "Mem. overhead [%]", r"Overhead [\%]"),
    ]


def _clock(units: Mapping[str, str]) -> str:
    """Which times the ratios compare; a GPU's work takes no time of the processor's."""
    return PROCESSOR if set(units.values()) == {CPU} else WALL


def _cells(row: Mapping[str, Any], units: Mapping[str, str], clock: str | None, kind: str) -> tuple[Cell, ...]:
    cells: list[str] = []
    for unit in UNITS:
        parts = [part for part in (NETWORK, MULTIVIEW) if _counts(row, part) and units[part] == unit]
        cells += [_latency(row, parts, clock), *_power_and_energy(row, parts, kind)]
    overhead, memory = row["energy_overhead_percent"], row["memory"]
    if overhead is not None and kind in overhead:
        cells.append(_percent(overhead[kind]))
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
    """Whether a row has such a part at all."""
    return part in row["latency"] and "none" not in row["latency"][part]


def _latency(row: Mapping[str, Any], parts: Sequence[str], clock: str | None) -> str:
    """The sum over parts of the medians, in ms or as multiples of depth by a clock; "<" the upper quartile where the
    lower one is not above 0."""
    if not parts:
        return ""
    if any("not_separable" in row["latency"][part] for part in parts):
        return NOT_SEPARABLE
    if clock is None:
        decimals, names, of = 1, ("q1_ms", "median_ms", "q3_ms"), [row["latency"][part] for part in parts]
    else:
        decimals, names, of = 2, ("q1", "median", "q3"), [row["ratios_to_depth"][part][clock] for part in parts]
    spreads = [[times[name] for name in names] for times in of]
    if len(spreads) == 1 and spreads[0][0] <= 0:
        return f"<{_digits(max(spreads[0][2], _SMALLEST), decimals)}"
    return _digits(sum(max(0.0, middle) for _, middle, _ in spreads), decimals)


def _power_and_energy(row: Mapping[str, Any], parts: Sequence[str], kind: str) -> tuple[str, str]:
    """Of the parts on one unit: watts while they run, and millijoules per frame."""
    if not parts:
        return "", ""
    spent = [row["energy"][part] for part in parts]
    if any("not_separable" in one for one in spent):
        return NOT_SEPARABLE, NOT_SEPARABLE
    if any("not_measurable" in one for one in spent):
        return NOT_MEASURABLE, NOT_MEASURABLE
    if len(spent) == 1 and spent[0][kind]["q1"] <= 0:
        return "", f"<{_digits(max(spent[0][kind]['q3'], _SMALLEST), 1)}"
    energy = sum(max(0.0, one[kind]["millijoules"]) for one in spent)
    seconds = sum(one[kind]["seconds"] for one in spent)
    return _digits(1e-3 * energy / seconds, 1) if seconds > 0 else "", _digits(energy, 1)


def megabytes(count: float) -> str:
    """Bytes as megabytes (10^6), as the paper prints them: 1245, 74.6, 0.03, <0.01."""
    value = count / 1e6
    if 0 < value < _SMALLEST:
        return "<0.01"
    return f"{value:.{0 if value >= 1000 or value == 0 else 1 if value >= 1 else 2}f}"


def _percent(value: float) -> str:
    """As the paper prints it: 90.0, 0.2, 0.03, <0.01."""
    if 0 < value < _SMALLEST:
        return "<0.01"
    return f"{value:.{1 if value >= 0.095 or value == 0 else 2}f}"


def _digits(value: float, decimals: int) -> str:
    """Whole numbers from 10 on, where times and energies are not known any better."""
    if not math.isfinite(value):
        raise ValueError(f"a measured value must be finite, got {value}")
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.{decimals}f}"


# ---- below the table ----


def _about_depth(network: Mapping[str, Any], unit: str, relative: bool) -> str:
    """The paper's cell of the architecture."""
    memory = network["memory"]
    size = NOT_MEASURABLE if memory is None else f"{megabytes(memory['depth'])} MB"
    time = "" if relative else f"{network['latency'][DEPTH]['median_ms']:.0f} ms on the {UNITS[unit]}, "
    whole = "" if network["whole"] is None else f" (with its uncertainty: {network['whole']})"
    return f"Depth alone: {time}{size}{whole}."


def _notes(run: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], relative: bool, kind: str) -> list[str]:
    notes = []
    smoothing = max((row["memory"]["multiview"] or {}).get("smoothing_bytes", 0) for row in rows)
    if smoothing:
        notes.append(
            f"UfM* keeps a map for smoothing besides: {megabytes(smoothing)} MB, not counted above, as in the paper."
        )
    used = {run["devices"]["units"][part] for row in rows for part in (NETWORK, MULTIVIEW) if _counts(row, part)}
    missing = {UNITS[unit]: why for unit, why in run["power"]["missing"].items() if unit in used}
    notes += [f"Power and energy of the {unit} are {NOT_MEASURABLE}: {why}." for unit, why in missing.items()]
    if run["power"]["rails"] and kind == "net":
        notes.append("Power and energy are those beyond the idle machine's.")
    frames, name, threads = run["plan"]["frames"], run["sequence"]["name"], run["plan"]["threads"]
    hardware, gpu = run["machine"]["hardware"]["cpu"], run["machine"]["gpu"]
    ratios = "processor times" if _clock(run["devices"]["units"]) == PROCESSOR else "times"
    medians = f"ratios of {ratios} within a frame" if relative else "frames"
    place = f"{hardware}, {threads} thread{'s' if threads > 1 else ''}" + ("" if gpu is None else f", and {gpu}")
    notes.append(f"Medians of {frames} {medians} of {name}; {place}.")
    notes += [f"{method} is left out: {why}." for method, why in run["left_out"].items()]
    return notes
