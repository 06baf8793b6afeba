"""Table and picture of the active-learning example: means over the seeds, and how far they can be trusted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean, median, stdev
from typing import Any

from ufmstar_torch.eval.run.files import write_atomic

BEFORE = "before"
_INK, _FAINT = "#22272e", "#6b6b6b"
# Okabe and Ito's colours, which the colour-blind tell apart.
_COLOURS = {
    "random": "#6b6b6b",
    "aleatoric": "#E69F00",
    "ufmstar": "#0072B2",
    "disagreement": "#56B4E9",
    "oracle": "#009E73",
    "everything": "#CC79A7",
}
_UNITS = {"delta1": "δ₁", "rmse": "RMSE [m]", "nll": "NLL [nats]"}


def interval(values: Sequence[float]) -> dict[str, Any]:
    """Mean, half width of its 95 % confidence interval (Student's t; NaN with fewer than two) and the values."""
    from scipy.stats import t

    n = len(values)
    half = float(t.ppf(0.975, n - 1)) * stdev(values) / math.sqrt(n) if n > 1 else math.nan
    return {"mean": fmean(values), "ci95": half, "values": list(values)}


def summarise(results: Mapping[str, Any]) -> dict[str, Any]:
    """By part of the held-back views and by strategy: each figure over the seeds, and how it differs from random's.

    Rooms differ more than strategies do: the difference within a seed tells more than two means side by side.
    """
    after = {(run["seed"], run["strategy"]): run["after"] for run in results["runs"]}
    after |= {(seed, BEFORE): place["before"] for seed, place in enumerate(results["places"])}
    strategies = (BEFORE, *results["settings"]["strategies"])
    summary: dict[str, Any] = {}
    for part in dict.fromkeys(part for place in results["places"] for part in place["before"]):
        seeds = [seed for seed, place in enumerate(results["places"]) if part in place["before"]]
        summary[part] = {}
        for strategy in strategies:
            figures = {m: interval([after[seed, strategy][part][m] for seed in seeds]) for m in _UNITS}
            if "random" in strategies and strategy not in (BEFORE, "random"):
                for m in _UNITS:
                    gaps = [after[seed, strategy][part][m] - after[seed, "random"][part][m] for seed in seeds]
                    figures[f"{m}_minus_random"] = interval(gaps)
            summary[part][strategy] = figures
    return summary


def unseen_share(results: Mapping[str, Any], strategy: str) -> list[float]:
    """Per seed, which share of the picks was taken in rooms of the unseen style."""
    shares = []
    for run in results["runs"]:
        if run["strategy"] == strategy:
            rooms = results["places"][run["seed"]]["rooms"]
            shares.append(fmean(rooms[i] == "unseen" for i in run["picks"]))
    return shares


def rank_correlation(results: Mapping[str, Any], strategy: str) -> list[float]:
    """Per seed, Spearman's correlation of an image's score before fine-tuning and its true mean squared error."""
    from scipy.stats import spearmanr

    scores = [place["scores"] for place in results["places"] if strategy in place["scores"]]
    return [float(spearmanr(own[strategy], own["oracle"], nan_policy="omit").statistic) for own in scores]


def report(results: Mapping[str, Any]) -> str:
    """The tables as Markdown."""
    lines = []
    for part, rows in results["summary"].items():
        seeds = len(rows[BEFORE]["rmse"]["values"])
        where = {"all": "all held-back views", "seen": "rooms of the seen style", "unseen": "the unseen room"}[part]
        lines += [f"\n{where} ({seeds} seeds, mean ± 95 % confidence)\n"]
        lines += ["| picks by | δ₁ | RMSE [m] | NLL [nats] | RMSE less random's [m] |", "|---|---|---|---|---|"]
        for strategy, figures in rows.items():
            gap = _cell(figures["rmse_minus_random"], "+.3f") if "rmse_minus_random" in figures else "-"
            cells = [_cell(figures["delta1"], ".3f"), _cell(figures["rmse"], ".3f"), _cell(figures["nll"], ".2f")]
            lines.append(f"| {strategy} | {' | '.join(cells)} | {gap} |")
    lines += ["", "| picks by | picked in the unseen room | rank correlation of score and error |", "|---|---|---|"]
    for strategy in results["settings"]["strategies"]:
        share, rho = unseen_share(results, strategy), rank_correlation(results, strategy)
        lines.append(f"| {strategy} | {fmean(share):.0%} | {_cell(interval(rho), '.2f') if rho else '-'} |")
    return "\n".join([*lines, "", cost_line(results)])


def cost_line(results: Mapping[str, Any]) -> str:
    """What the score costs, in a sentence."""
    costs = [place["cost"] for place in results["places"]]
    network, dense, sample, ratio = (
        median(c[k] for c in costs) for k in ("network_ms", "dense_ms", "sample_ms", "ratio")
    )
    agree = fmean(c["picks_agree"] for c in costs)
    budget, pixels, threads = results["settings"]["budget"], costs[0]["pixels"], costs[0]["threads"]
    return (
        f"Mean of V over {pixels} pixels: {sample:.1f} ms an image, dense map: {dense:.1f} ms (processor time: "
        f"{ratio:.2f} of it), network: {network:.1f} ms; medians, {threads} thread(s). Of {budget} picks, {agree:.1f} "
        f"are those of the dense map. The whole run: {results['seconds']:.0f} s, of processor time "
        f"{results['processor_seconds']:.0f} s."
    )


def draw(path: Path, results: Mapping[str, Any]) -> None:
    """Write the picture: errors with their spread, and which frames of the first pool were picked."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    parts = [part for part in results["summary"] if part != "all"] or ["all"]
    figure = Figure(figsize=(10.5, 6.2), dpi=90, facecolor="white", layout="constrained")
    canvas = FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, len(parts))
    for column, part in enumerate(parts):
        _draw_errors(figure.add_subplot(grid[0, column]), results, part)
    _draw_picks(figure.add_subplot(grid[1, :]), results)
    write_atomic(path, lambda file: canvas.print_png(file))


def _draw_errors(axes: Any, results: Mapping[str, Any], part: str) -> None:
    """Per strategy the change of the RMSE by fine-tuning: a dot per seed, mean and confidence beside."""
    rows = results["summary"][part]
    before = rows[BEFORE]["rmse"]["values"]
    for x, strategy in enumerate(results["settings"]["strategies"]):
        change = [a - b for a, b in zip(rows[strategy]["rmse"]["values"], before, strict=True)]
        mean = interval(change)
        axes.scatter([x - 0.12] * len(change), change, s=14, color=_COLOURS[strategy], alpha=0.5)
        error = 0.0 if math.isnan(mean["ci95"]) else mean["ci95"]
        axes.errorbar(x + 0.12, mean["mean"], error, fmt="o", color=_COLOURS[strategy], capsize=4)
    axes.axhline(0, color=_FAINT, linewidth=0.8)
    axes.set_xticks(
        range(len(results["settings"]["strategies"])), results["settings"]["strategies"], size=8, rotation=20
    )
    names = {"all": "all views", "seen": "rooms of the seen style", "unseen": "the unseen room"}
    axes.set_title(f"{names[part]}: RMSE after - before ({fmean(before):.2f} m)", size=10, color=_INK)
    axes.set_ylabel("[m]; below 0 = better", size=8, color=_INK)
    _plain(axes)


def _draw_picks(axes: Any, results: Mapping[str, Any]) -> None:
    """The first seed's pool from left to right: scores as lines, picks as marks, the unseen room shaded."""
    place = results["places"][0]
    for i, room in enumerate(place["rooms"]):
        if room == "unseen":
            axes.axvspan(i - 0.5, i + 0.5, color="#eeeeee", linewidth=0)
    shown = [s for s in results["settings"]["strategies"] if s != "everything"]
    for y, strategy in enumerate(reversed(shown)):
        scores = place["scores"].get(strategy)
        if scores:
            low, high = min(scores), max(scores)
            line = [y + 0.75 * (s - low) / ((high - low) or 1) for s in scores]
            axes.plot(line, color=_COLOURS[strategy], linewidth=0.9)
        run = next(r for r in results["runs"] if r["seed"] == 0 and r["strategy"] == strategy)
        axes.scatter(run["picks"], [y - 0.1] * len(run["picks"]), marker="^", s=22, color=_COLOURS[strategy])
    axes.set_yticks(range(len(shown)), list(reversed(shown)), size=8)
    axes.set_xlim(-0.5, len(place["rooms"]) - 0.5)
    axes.set_xlabel("frame of the pool", size=8, color=_INK)
    title = f"{place['name']}: score before fine-tuning (line) and picks (marks); shaded: the unseen room"
    axes.set_title(title, size=10, color=_INK)
    _plain(axes)


def _plain(axes: Any) -> None:
    axes.tick_params(labelsize=8, color=_FAINT, labelcolor=_INK)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _cell(figure: Mapping[str, Any], form: str) -> str:
    return f"{figure['mean']:{form}} ± {figure['ci95']:{form.lstrip('+')}}"
