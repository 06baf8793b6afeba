"""The diagram of growth: components and time of a step over the frames of a long run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ufmstar_torch.eval.report.style import Style, finish, label_ends, new_figure

# Runs differ in their limit of merging; off comes first.
_STYLES = (Style("#6b6b6b", "^"), Style("#0072B2", "o"), Style("#D55E00", "v"), Style("#009E73", "D"))
_PANELS = {"components": "components", "step_median_ms": "time of a step [ms], median"}


def draw_growth(runs: Sequence[Mapping[str, Any]]) -> Any:
    """Components, and the time of a step, over frames.

    Args:
        runs: of ``eval.bench.step.measure_long_run``, each with its limit of merging, "merge".
    """
    figure = new_figure(8.6, 3.4, f"Growth in one room, {runs[0]['frames']} frames")
    for panel, (key, words) in zip(figure.subplots(1, 2), _PANELS.items(), strict=True):
        ends = []
        for index, run in enumerate(runs):
            style = _STYLES[index % len(_STYLES)]
            values = [row[key] for row in run["rows"]]
            panel.plot([row["frames"][1] for row in run["rows"]], values, color=style.colour, linewidth=1.6)
            ends.append((values[-1], f"merge {run['merge']:g}" if run["merge"] else "off", style.colour))
        panel.set_ylim(bottom=0)
        finish(panel, x="frames", y=words)
        label_ends(panel, ends)
    return figure
