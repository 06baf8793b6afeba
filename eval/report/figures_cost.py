"""Figures of cost: time by method and by stage, calibration against memory and time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ufmstar_torch.eval.methods.method import BASES
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.report import style
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.efficiency import architectures
from ufmstar_torch.eval.report.means import Mean, mean_of
from ufmstar_torch.eval.report.names import ECE_DELTA, NETWORK_MS, STATE, TOTAL_MS, UNCERTAINTY_MS
from ufmstar_torch.eval.run.colours import INK, plain

NETWORK_COLOUR = "#bdbdbd"
# The stages of a step of UfM*, from dark to light, as a print in grey needs it.
STAGES = {
    "check": "#4d4d4d", "segment": "#0072B2", "correspond": "#009E73", "fuse": "#D55E00", "append": "#CC79A7",
    "regress": "#E69F00", "average": "#56B4E9",
}  # fmt: skip
_BASE_MARKERS = dict(zip(BASES, "osD^vP", strict=True))


def draw_latency(results: Results) -> Any | None:
    """Time per frame of every method: the network's, and what uncertainty takes; None where nothing was timed."""
    timed: list[tuple[Row, Mean, Mean]] = []
    for row in results.default_rows():
        network, uncertainty = (mean_of(results.of(row), quantity) for quantity in (NETWORK_MS, UNCERTAINTY_MS))
        if network.sequences or uncertainty.sequences:
            timed.append((row, network, uncertainty))
    if not timed:
        return None
    figure = style.new_figure(7.6, 1.2 + 0.27 * len(timed), "Time per frame")
    axes = figure.subplots()
    longest = 0.0
    for y, (row, network, uncertainty) in enumerate(timed):
        n, u = (mean.value if mean.sequences else 0.0 for mean in (network, uncertainty))
        axes.barh(y, n, color=NETWORK_COLOUR, height=0.66)
        axes.barh(y, u, left=n, color=style.look_of(row.method).colour, height=0.66)
        words = f"  {f'{n:.1f}' if network.sequences else 'network not timed'} + {u:.1f} ms"
        axes.text(n + u, y, words, size=style.TICK, va="center", color=INK)
        longest = max(longest, n + u)
    axes.set(xlim=(0, 1.3 * longest), ylim=(len(timed) - 0.4, -0.6))
    axes.set_yticks(range(len(timed)), [row.method.name for row, _, _ in timed])
    style.finish(axes, x="network (grey) + uncertainty (coloured) [ms], mean over sequences of the median frame")
    axes.grid(visible=False, axis="y")
    return figure


def draw_stages(results: Results) -> Any | None:
    """Shares of the stages in a step of UfM*, the paper's figure; None unless ``efficiency.json`` has it."""
    measured = [] if results.efficiency is None else architectures(results.efficiency)
    staged = [row for run in measured for row in run["rows"] if row.get("stages")]
    if not staged:
        return None
    figure = style.new_figure(8.6, 1.5 + 0.5 * len(staged), "Where the time of UfM* goes")
    axes = figure.subplots()
    for y, row in enumerate(staged):
        times = {name: row["stages"]["stages"][name]["median_ms"] for name in STAGES if name in row["stages"]["stages"]}
        _draw_stages(axes, y, times)
    axes.set_yticks(range(len(staged)), [plain(f"{row['row']}\n{row['network']}") for row in staged])
    style.finish(axes, x="share of the step [%], medians of its stages")
    axes.grid(visible=False)
    axes.set(xlim=(0, 100), ylim=(len(staged) - 0.4, -0.6))
    from matplotlib.patches import Patch

    handles = [Patch(color=colour, label=name) for name, colour in STAGES.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=style.TICK)
    return figure


def _draw_stages(axes: Any, y: int, times: Mapping[str, float]) -> None:
    """One bar of shares, with their numbers where there is room, and the sum behind."""
    total, left = math.fsum(times.values()), 0.0
    for name, ms in times.items():
        share = 100 * ms / total
        axes.barh(y, share, left=left, color=STAGES[name], height=0.62, edgecolor="white", linewidth=0.5)
        if share >= 6:
            letters = INK if name in ("regress", "average") else "white"  # dark on the light colours
            words = {"size": style.TICK, "color": letters, "ha": "center", "va": "center"}
            axes.text(left + share / 2, y, f"{share:.0f} %", **words)
        left += share
    axes.text(101, y, f"{total:.1f} ms", size=style.TICK, color=INK, va="center")


def draw_tradeoff(results: Results) -> Any | None:
    """ECE_delta against the bytes that are kept between frames, and against the time per frame; None without points."""
    points = {row: mean_of(results.of(row), ECE_DELTA) for row in results.default_rows()}
    points = {row: mean for row, mean in points.items() if mean.sequences}
    sizes = {row: mean_of(results.of(row), STATE).value for row in points}
    sizes = {row: 0.0 if math.isnan(x) else x for row, x in sizes.items()}  # a method alone keeps nothing
    times = {row: mean_of(results.of(row), TOTAL_MS).value for row in points}
    times = {row: x for row, x in times.items() if not math.isnan(x)}
    if not any(sizes.values()):
        return None
    figure = style.new_figure(11.0, 4.8, "Calibration against cost on all sequences")
    words = ("state [MB]", "time per frame [ms]")
    for axes, panel, word in zip(figure.subplots(1, 2, sharey=True), (sizes, times), words, strict=True):
        for row, x in panel.items():
            mean = points[row]
            axes.errorbar(
                x, mean.value, yerr=np.nan_to_num(mean.half), color=style.look_of(row.method).colour, markersize=6,
                marker=_BASE_MARKERS[row.method.base], linewidth=1, elinewidth=0.5, capsize=0,
            )  # fmt: skip
        # Methods alone keep nothing: there is room for 0 at the left.
        style.stretch(axes, list(panel.values()), 8, linthresh=0.5, linscale=0.8)
        if axes.get_xscale() == "linear":
            axes.set_xlim(left=0)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.set_ylim(bottom=0)
        style.finish(axes, x=word, y="ECE_δ ↓ (bar: 95 % interval)")
    figure.legend(handles=_legend(list(points)), loc="outside right upper", frameon=False, fontsize=style.TICK)
    return figure


def _legend(rows: Sequence[Row]) -> list[Any]:
    """Colours are methods, marks are networks."""
    from matplotlib.lines import Line2D

    how: dict[str, Any] = {"linestyle": "", "markersize": 6}
    looks = {look.name: look for look in (style.look_of(row.method) for row in rows)}.values()
    bases = dict.fromkeys(row.method.base for row in rows)
    return [
        *(Line2D([], [], marker="o", color=look.colour, label=look.name, **how) for look in looks),
        *(Line2D([], [], marker=_BASE_MARKERS[base], color=INK, label=BASES[base][1], **how) for base in bases),
    ]
