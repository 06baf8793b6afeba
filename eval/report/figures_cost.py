"""The paper's figure of the time of UfM*'s stages."""

from __future__ import annotations

import math
from typing import Any

from ufmstar_torch.eval.report import style
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.efficiency import architectures
from ufmstar_torch.eval.run.colours import INK, plain

# The stages of a step of UfM*, from dark to light, for prints in grey.
STAGES = {
    "check": "#4d4d4d", "segment": "#0072B2", "correspond": "#009E73", "fuse": "#D55E00", "append": "#CC79A7",
    "regress": "#E69F00", "average": "#56B4E9",
}  # fmt: skip


def draw_stages(results: Results) -> Any | None:
    """The paper's figure of the stages' shares in a step of UfM*, with numbers in wide bars and the sum at the right;
    None unless ``efficiency.json`` has stages."""
    measured = [] if results.efficiency is None else architectures(results.efficiency)
    staged = [row for run in measured for row in run["rows"] if row.get("stages")]
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
