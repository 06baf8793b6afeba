"""The cost of uncertainty: the paper's table of time, power, energy and memory, one per architecture, and its figures.

The cell of a part that was not measured has words instead of a number: "not measurable here" without a sensor, "not
separable" if a network predicts depth and variance together. A difference below the noise is an upper bound.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import row_from
from ufmstar_torch.eval.report import style
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.paper import PaperTable, paper_tables
from ufmstar_torch.eval.report.quantities import count, row_labels
from ufmstar_torch.eval.report.table import Table, number
from ufmstar_torch.eval.run.colours import INK, plain

# Keys and words of ``efficiency.json``, as eval/bench writes them.
DEPTH, NETWORK, MULTIVIEW = "depth", "network_uncertainty", "multiview"
CPU, GPU, GROSS = "cpu", "gpu", "gross"
NOT_MEASURABLE, NOT_SEPARABLE = "not measurable here", "not separable"
UNITS = {GPU: "GPU", CPU: "CPU"}
_COLUMNS = [
    *((unit, name) for unit in UNITS.values() for name in ("Latency [ms]", "Power [W]", "Energy [mJ]")),
    ("", "Energy overhead [%]"),
    *(("Memory", name) for name in ("DNN unc. [MB]", "MVD [MB]", "Overhead [%]")),
    # Not in the paper.
    *(("Memory", name) for name in ("MVD, mean [MB]", "DNN buffers [MB]")),
]
_SMALLEST = 0.01  # less prints as "<0.01"


def efficiency_tables(measured: Mapping[str, Any]) -> list[Table]:
    """One table per architecture of ``efficiency.json``, then the paper's table 2 of the same networks, or of all its
    networks if none is the same."""
    labels = list(dict.fromkeys(row["network"] for row in measured["rows"]))
    quoted = [table for table in paper_tables() if table.number == 2]
    measured_tables = [table for table in quoted if any(table.network.lower() in label.lower() for label in labels)]
    return [*(_table(measured, label) for label in labels), *map(_paper_table, measured_tables or quoted)]


def _table(run: Mapping[str, Any], label: str) -> Table:
    rows = [row for row in run["rows"] if row["network"] == label]
    bases = list(dict.fromkeys(row["base"] for row in rows))  # a block per base, as in the paper
    labels = [row["row"] for row in rows]
    if all("setting" in row for row in rows):
        labels = list(row_labels(map(row_from, rows)).values())
    cells = [_cells(row, run["devices"]["units"]) for row in rows]
    lines = sorted(
        zip((bases.index(row["base"]) for row in rows), labels, cells, strict=True), key=lambda line: line[0]
    )
    name = f"efficiency-{''.join(c if c.isalnum() else '-' for c in label.lower())}"
    notes = _notes(run, rows, run["networks"][bases[0]])
    return Table.of(name, f"Efficiency of uncertainty, {label}", lines, _COLUMNS, notes)


def _paper_table(quoted: PaperTable) -> Table:
    """The paper's table 2 of one network, with our columns."""
    bases = list(dict.fromkeys(Method.parse(method).base for method in quoted.rows))
    further = [""] * (len(_COLUMNS) - len(quoted.columns))
    lines = [
        (bases.index(Method.parse(method).base), method, [*(cells.get(c, "") for c in quoted.columns), *further])
        for method, cells in quoted.rows.items()
    ]
    alone = f"Depth alone: {quoted.alone['latency_ms']} ms, {quoted.alone['memory_mb']} MB."
    notes = (alone, f"Measured by the paper on {quoted.measured_on}.")
    title = f"The paper's table 2, {quoted.network}"
    return Table.of(f"paper-efficiency-{quoted.network}", title, lines, _COLUMNS, notes)


def _cells(row: Mapping[str, Any], units: Mapping[str, str]) -> list[str]:
    """One row, in the order of ``_COLUMNS``."""
    cells: list[str] = []
    for unit in UNITS:
        cells += _unit_cells(row, [part for part in (NETWORK, MULTIVIEW) if _counts(row, part) and units[part] == unit])
    overhead, memory = row["energy_overhead_percent"], row["memory"]
    if overhead is not None and GROSS in overhead:
        cells.append(_percent(overhead[GROSS]))
    else:
        whole = any("not_separable" in part for part in row["energy"].values())
        cells.append(NOT_SEPARABLE if whole else NOT_MEASURABLE)
    kinds = ("bytes_end", "bytes_mean")
    end, mean = ("" if memory["multiview"] is None else megabytes(memory["multiview"][kind]) for kind in kinds)
    if "not_measurable" in memory:
        cells += [NOT_MEASURABLE, end, NOT_MEASURABLE, mean, NOT_MEASURABLE]
    else:
        overhead, buffers = _percent(memory["overhead_percent"]), megabytes(memory["buffers_bytes"])
        cells += [megabytes(memory["network_uncertainty_bytes"]), end, overhead, mean, buffers]
    return cells


def _counts(row: Mapping[str, Any], part: str) -> bool:
    """True if a row has this part."""
    return part in row["latency"] and "none" not in row["latency"][part]


def _unit_cells(row: Mapping[str, Any], parts: Sequence[str]) -> list[str]:
    """Milliseconds, watts and millijoules per frame of the parts that run on one unit."""
    if not parts:
        return ["", "", ""]
    times, energies = ([row[kind][part] for part in parts] for kind in ("latency", "energy"))
    latency = NOT_SEPARABLE
    if not any("not_separable" in time for time in times):
        latency = _sum([(time["median_ms"], time["q1_ms"], time["q3_ms"]) for time in times])
    for key, words in (("not_separable", NOT_SEPARABLE), ("not_measurable", NOT_MEASURABLE)):
        if any(key in energy for energy in energies):
            return [latency, words, words]
    used = [energy[GROSS] for energy in energies]
    joules = _sum([(one["millijoules"], one["q1"], one["q3"]) for one in used])
    seconds = sum(one["seconds"] for one in used)
    watts = ""
    if seconds > 0 and not joules.startswith("<"):
        watts = _digits(1e-3 * sum(max(0.0, one["millijoules"]) for one in used) / seconds)
    return [latency, watts, joules]


def _sum(parts: Sequence[tuple[float, float, float]]) -> str:
    """The sum of medians over parts (median, q1, q3); for one part "<" and q3 if q1 is not positive."""
    if len(parts) == 1 and parts[0][1] <= 0:
        return f"<{_digits(max(parts[0][2], _SMALLEST))}"
    return _digits(sum(max(0.0, median) for median, _, _ in parts))


def megabytes(size: float) -> str:
    """Bytes as megabytes (10^6) in the paper's format: 1245, 74.6, 0.03, <0.01."""
    value = size / 1e6
    return _printed(value, 0 if value >= 1000 or value == 0 else 1 if value >= 1 else 2)


def _percent(value: float) -> str:
    """A percentage in the paper's format: 90.0, 0.2, 0.03, <0.01."""
    return _printed(value, 1 if value >= 0.095 or value == 0 else 2)


def _printed(value: float, decimals: int) -> str:
    return "<0.01" if 0 < value < _SMALLEST else number(value, decimals)


def _digits(value: float) -> str:
    """One decimal below 10, none above: the accuracy of times and energies."""
    return number(value, 0 if abs(value) >= 10 else 1)


def _notes(run: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], network: Mapping[str, Any]) -> list[str]:
    """Depth alone, as in the paper's cell of the architecture; smoothing, missing meters, frames and machine."""
    units, power, plan = run["devices"]["units"], run["power"], run["plan"]
    size = NOT_MEASURABLE if network["memory"] is None else f"{megabytes(network['memory']['depth'])} MB"
    whole = "" if network["whole"] is None else f" (with its uncertainty: {network['whole']})"
    ms = network["latency"][DEPTH]["median_ms"]
    notes = [f"Depth alone: {ms:.0f} ms on the {UNITS[units[DEPTH]]}, {size}{whole}."]
    if smoothing := max((row["memory"]["multiview"] or {}).get("smoothing_bytes", 0) for row in rows):
        smoothing_size = f"{megabytes(smoothing)} MB, not counted above, as in the paper"
        notes.append(f"UfM* keeps a map for smoothing besides: {smoothing_size}.")
    used = {units[part] for row in rows for part in (NETWORK, MULTIVIEW) if _counts(row, part)}
    missing = {UNITS[unit]: why for unit, why in power["missing"].items() if unit in used}
    notes += [f"Power and energy of the {unit} are {NOT_MEASURABLE}: {why}." for unit, why in missing.items()]
    gpu = "" if run["machine"]["gpu"] is None else f", and {run['machine']['gpu']}"
    machine = f"{run['machine']['hardware']['cpu']}, {count(plan['threads'], 'thread')}{gpu}"
    frames = f"all {plan['frames']} selected frames" if plan["whole"] else f"{plan['frames']} frames"
    of = f"{frames} of {run['sequence']['name']}"
    notes.append(f"Medians of {of}, measured in a pass of their own; {machine}.")
    notes.append("Memory is that of parameters and, after the last frame, of the multiview state; buffers beside.")
    return [*notes, *(f"{method} is left out: {why}." for method, why in run["left_out"].items())]


# ---- the paper's figure of the time of UfM*'s stages ----

# The stages of a step of UfM*, from dark to light, for prints in grey.
STAGES = {
    "check": "#4d4d4d", "segment": "#0072B2", "correspond": "#009E73", "fuse": "#D55E00", "append": "#CC79A7",
    "regress": "#E69F00", "average": "#56B4E9",
}  # fmt: skip


def draw_stages(results: Results) -> Any | None:
    """The paper's figure of the stages' shares in a step of UfM*, with numbers in wide bars and the sum at the right;
    None unless ``efficiency.json`` has stages."""
    measured = [] if results.efficiency is None else results.efficiency["rows"]
    staged = [row for row in measured if row.get("stages")]
    if not staged:
        return None
    figure = style.new_figure(8.6, 1.5 + 0.5 * len(staged), "Where the time of UfM* goes")
    axes = figure.subplots()
    for y, row in enumerate(staged):
        times = {name: stage["median_ms"] for name, stage in row["stages"]["stages"].items()}
        total, left = math.fsum(times.values()), 0.0
        for name, colour in STAGES.items():
            share = 100 * times[name] / total
            label = name if y == 0 else ""
            axes.barh(y, share, left=left, color=colour, label=label, height=0.62, edgecolor="white", linewidth=0.5)
            if share >= 6:
                letters = INK if name in ("regress", "average") else "white"  # dark on the light colours
                words = {"size": style.TICK, "color": letters, "ha": "center", "va": "center"}
                axes.text(left + share / 2, y, f"{share:.0f} %", **words)
            left += share
        axes.text(101, y, f"{total:.1f} ms", size=style.TICK, color=INK, va="center")
    axes.set_yticks(range(len(staged)), [plain(f"{row['row']}\n{row['network']}") for row in staged])
    style.finish(axes, x="share of the step [%], medians of its stages")
    axes.grid(visible=False)
    axes.set(xlim=(0, 100), ylim=(len(staged) - 0.4, -0.6))
    style.legend_below(figure)
    return figure
