"""The diagram of growth: components in memory and time of a step over the frames of long runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ufmstar_torch.eval.report.style import Style, finish, label_ends, new_figure

# Runs of one world differ in their limits of merging and of components in memory; without either comes first.
_STYLES = (Style("#6b6b6b", "^"), Style("#0072B2", "o"), Style("#D55E00", "v"), Style("#009E73", "D"))
_PANELS = {"components": "components in memory", "step_median_ms": "time of a step [ms], median"}


def draw_growth(runs: Sequence[Mapping[str, Any]]) -> Any:
    """Components, and the time of a step, over frames; a row of panels for each world.

    Args:
        runs: of ``eval.bench.growth.measure_growth``.
    """
    worlds = list(dict.fromkeys(run["world"] for run in runs))
    figure = new_figure(8.6, 3.4 * len(worlds), f"Growth: {', '.join(worlds)}; {runs[0]['frames']} frames")
    for world, panels in zip(worlds, figure.subplots(len(worlds), 2, squeeze=False), strict=True):
        own = [run for run in runs if run["world"] == world]
        for panel, (key, words) in zip(panels, _PANELS.items(), strict=True):
            ends = []
            for index, run in enumerate(own):
                style = _STYLES[index % len(_STYLES)]
                values = [row[key] for row in run["rows"]]
                panel.plot([row["frames"][1] for row in run["rows"]], values, color=style.colour, linewidth=1.6)
                ends.append((values[-1], _label(run), style.colour))
            panel.set_ylim(bottom=0)
            finish(panel, x=f"frames, {world}", y=words)
            label_ends(panel, ends)
    return figure


def _label(run: Mapping[str, Any]) -> str:
    merge = f"merge {run['merge']:g}" if run["merge"] else ""
    most = f"at most {run['max_components']}" if run["max_components"] else ""
    return ", ".join(words for words in (merge, most) if words) or "off"
