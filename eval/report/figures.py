"""The diagrams of a report: calibration, NLL by error, entropy, cost; a file's first word is its kind."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.methods.method import ALONE, BASES, UFM_STAR, Method
from ufmstar_torch.eval.methods.row import Row, plain_rows
from ufmstar_torch.eval.report.colours import FAINT, INK, plain
from ufmstar_torch.eval.report.data import BY_ERROR, Merged, Results
from ufmstar_torch.eval.report.figures_sweep import draw_changes, draw_sweep
from ufmstar_torch.eval.report.means import Mean, mean_of, value_of
from ufmstar_torch.eval.report.names import ECE_DELTA, NETWORK_MS, STATE, TOTAL_MS, UNCERTAINTY_MS
from ufmstar_torch.eval.report.pictures import DRAWING_ERRORS
from ufmstar_torch.eval.report.style import (
    LABEL,
    TICK,
    Style,
    counted,
    finish,
    label_ends,
    new_figure,
    save_figure,
    short_name,
    spread_apart,
    style_of,
)
from ufmstar_torch.eval.report.sweeps import sweeps
from ufmstar_torch.eval.results.record import Record

Curves = Mapping[str, Sequence[float]]
SVG, PNG = "svg", "png"
PER_LINE, MOST_SEQUENCES = 3, 12
# Entropy [nats] of a Gaussian with a standard deviation of 1 m.
ONE_METRE = 0.5 * math.log(2 * math.pi * math.e)
_DECADES = (0.001, 0.01, 0.1, 1.0, 10.0, 100.0)
NETWORK_COLOUR = "#bdbdbd"
MOST_NAMES = 10  # more points have a legend instead
# The stages of a step of UfM*, from dark to light, as a print in grey needs it.
STAGES = {
    "check": "#4d4d4d", "segment": "#0072B2", "correspond": "#009E73", "fuse": "#D55E00", "append": "#CC79A7",
    "regress": "#E69F00", "average": "#56B4E9",
}  # fmt: skip
_BASE_MARKERS = dict(zip(BASES, "osD^vP", strict=True))


def write_figures(results: Results, kind: str, undrawn: dict[str, str]) -> list[Path]:
    """Draw every figure for which there are results into ``figures/``.

    Args:
        results: of an evaluation, with the sums over sequences.
        kind: "svg" or "png".
        undrawn: gets the reason of each figure that cannot be drawn, by its name.

    Returns:
        The files.

    Raises:
        ValueError: another kind.
        ImportError: matplotlib is missing.
        OSError: a file cannot be written.
    """
    if kind not in (SVG, PNG):
        raise ValueError(f"figures must be {SVG} or {PNG}, got {kind!r}")
    folder = results.out / "figures"
    folder.mkdir(exist_ok=True)
    written = []
    for name, draw in _figures(results):
        path = folder / f"{re.sub(r'[^A-Za-z0-9.-]+', '-', name.replace('/', '_'))}.{kind}"
        try:
            figure = draw()
            if figure is not None:
                save_figure(figure, path)
                written.append(path)
        except DRAWING_ERRORS as error:
            undrawn[name] = " ".join(str(error).split()) or type(error).__name__
    return written


def _figures(results: Results) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Name and function of every figure; the function returns None where there is nothing to draw."""
    for dataset in results.datasets:
        yield f"calibration {dataset}", partial(draw_calibration, results, dataset)
        for base in results.bases:
            yield (
                f"calibration sequences {dataset} {base}",
                partial(draw_sequence_calibration, results, dataset, base),
            )
        yield f"error {dataset}", partial(draw_error, results, dataset)
    for base in results.bases:
        yield f"entropy {base}", partial(draw_entropy, results, base)
    for base, name in sweeps(results):
        yield f"sweep {base} {name}", partial(draw_sweep, results, base, name)
    for base in results.bases:
        yield f"sweep changes {base}", partial(draw_changes, results, base)
    yield "latency", partial(draw_latency, results)
    yield "latency stages", partial(draw_stages, results)
    yield "tradeoff", partial(draw_tradeoff, results)


def _default_rows(results: Results, base: str | None = None) -> list[Row]:
    return [row for row in plain_rows(results.rows) if base in (None, row.method.base)]


def _hidden_panels(figure: Any, lines: int, columns: int) -> Any:
    """[lines, columns] axes that are invisible until they are drawn on."""
    axes = figure.subplots(lines, columns, squeeze=False)
    for panel in axes.flat:
        panel.set_visible(False)
    return axes


# ---- calibration ----


def draw_calibration(results: Results, dataset: str) -> Any | None:
    """Both curves over all pixels of a data set, a column per network; None where no row has a variance."""
    merged = {row: results.merged.get((dataset, row)) for row in _default_rows(results)}
    curves = {row: sums.curves for row, sums in merged.items() if sums is not None and _has_curves(sums.curves)}
    bases = list(dict.fromkeys(row.method.base for row in curves))
    if not bases:
        return None
    columns = min(len(bases), PER_LINE)
    lines = -(-len(bases) // columns)
    title = f"Calibration on {dataset}, all pixels of {counted(len(results.sequences(dataset)))}"
    axes = _hidden_panels(new_figure(0.5 + 3.4 * columns, 0.4 + 6.0 * lines, title), 2 * lines, columns)
    for number, base in enumerate(bases):
        line, column = divmod(number, columns)
        of_base = {row: values for row, values in curves.items() if row.method.base == base}
        _draw_calibration(axes[2 * line : 2 * line + 2, column], of_base, (BASES[base][0], ""), ends=True)
    return axes[0][0].figure


def draw_sequence_calibration(results: Results, dataset: str, base: str) -> Any | None:
    """Both curves of single sequences, from the one on which UfM* is best to that on which it is worst."""
    names = chosen_sequences(results, dataset, base)
    if not names:
        return None
    columns = min(len(names), 4)
    lines = -(-len(names) // columns)
    title = f"Calibration on single sequences of {dataset}, {BASES[base][0]}; errors alone → UfM*, from best to worst"
    figure = new_figure(0.4 + 2.45 * columns, 0.7 + 4.9 * lines, title)
    axes = _hidden_panels(figure, 2 * lines, columns)
    for number, name in enumerate(names):
        line, column = divmod(number, columns)
        of = {row: [r for r in results.of(row, dataset) if r.sequence == name] for row in _default_rows(results, base)}
        shown = {row: records[0] for row, records in of.items() if records and _has_curves(records[0].curves)}
        curves = {row: record.curves for row, record in shown.items()}
        titles = (f"{name}\n{_errors(shown, 'ece_delta', 'δ')}", _errors(shown, "ece_q", "q"))
        _draw_calibration(axes[2 * line : 2 * line + 2, column], curves, titles, named=column == 0)
    from matplotlib.lines import Line2D

    rows = {short_name(row.method): row for row in _default_rows(results, base)}
    judged = {name: row for name, row in rows.items() if any(_has_curves(r.curves) for r in results.of(row))}
    handles = [Line2D([], [], label=name, **style_of(row.method).line) for name, row in judged.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=8)
    return figure


def chosen_sequences(results: Results, dataset: str, base: str) -> list[str]:
    """At most ``MOST_SEQUENCES``, evenly over the order of the ECE_delta of a base's UfM* (or last row)."""
    of = {row: [r for r in results.of(row, dataset) if _has_curves(r.curves)] for row in _default_rows(results, base)}
    rows = [row for row, records in of.items() if records]
    if not rows:
        return []
    judge = next((row for row in rows if row.method.fusion == UFM_STAR and not row.method.full), rows[-1])
    names = [r.sequence for r in sorted(of[judge], key=lambda r: (value_of(r, "ece_delta"), r.sequence))]
    if len(names) <= MOST_SEQUENCES:
        return names
    return [names[i] for i in np.linspace(0, len(names) - 1, MOST_SEQUENCES).round().astype(int)]


def _draw_calibration(
    axes: Sequence[Any],
    curves: Mapping[Row, Curves],
    titles: tuple[str, str],
    *,
    named: bool = True,
    ends: bool = False,
) -> None:
    """Both curves of some rows of one base, UfM* last and so on top.

    Args:
        axes: two panels: delta and quantile calibration.
        curves: by row.
        titles: of the panels.
        named: with words at the y axes.
        ends: with the rows' names at the right.
    """
    ordered = sorted(curves.items(), key=lambda item: (item[0].method.fusion == UFM_STAR, item[0].method.full))
    lines = {short_name(row.method): (style_of(row.method), values) for row, values in ordered}
    draw_delta(axes[0], lines, titles[0], "true share" if named else "", ends)
    draw_quantiles(axes[1], lines, titles[1], "share of truth below" if named else "", ends)


def draw_delta(
    axes: Any, lines: Mapping[str, tuple[Style, Curves]], title: str, y: str = "true share", ends: bool = False
) -> None:
    """Confidence that the depth is within 25 %, and how often it is; bins with hardly a pixel are left out."""
    shown = {}
    for name, (style, values) in lines.items():
        confidence, accuracy, pixels = (
            np.array(values[f"ece_delta_{what}"], float) for what in ("confidence", "accuracy", "pixels")
        )
        kept = pixels > 0.001 * pixels.sum()
        shown[name] = (style, confidence[kept], accuracy[kept])
    _draw_shares(axes, shown, title, ("predicted share within 25 %", y), ends)


def draw_quantiles(
    axes: Any,
    lines: Mapping[str, tuple[Style, Curves]],
    title: str,
    y: str = "share of truth below",
    ends: bool = False,
) -> None:
    """Predicted quantiles of the depth, and the share of the truth below them."""
    shown = {n: (s, np.array(v["ece_q_levels"]), np.array(v["ece_q_observed"])) for n, (s, v) in lines.items()}
    _draw_shares(axes, shown, title, ("predicted quantile", y), ends)


def _draw_shares(
    axes: Any, lines: Mapping[str, tuple[Style, Any, Any]], title: str, words: tuple[str, str], ends: bool
) -> None:
    """Lines in the unit square with its diagonal."""
    axes.set_visible(True)
    axes.plot([0, 1], [0, 1], linestyle="--", linewidth=1.0, color=FAINT)
    for name, (style, x, y) in lines.items():
        axes.plot(x, y, label=name, clip_on=False, **style.line)
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", xticks=[0, 0.5, 1], yticks=[0, 0.5, 1])
    finish(axes, title=title, x=words[0], y=words[1])
    if ends:
        last = [(y[-1], name, style.colour) for name, (style, _, y) in lines.items() if len(y)]
        label_ends(axes, [*last, (1.0, "exactly right", FAINT)])


def _has_curves(curves: Mapping[str, Any]) -> bool:
    """Whether a variance was judged, on any pixel at all (a curve without one is NaN, None in a record)."""
    levels = curves.get("ece_q_observed") or ()
    return len(levels) > 0 and all(value is not None and value == value for value in levels)


def _errors(records: Mapping[Row, Record], key: str, letter: str) -> str:
    """The calibration errors of the base alone and of UfM*, or of the first and the last row."""
    rows = list(records)
    ours = next((row for row in rows if row.method.fusion == UFM_STAR and not row.method.full), rows[-1])
    values = (f"{value_of(records[row], key):.3f}" for row in dict.fromkeys((rows[0], ours)))
    return f"ECE_{letter} {' → '.join(values)}"


# The looks of methods that are known by name alone, as the demo's.
_BY_ORDER = (("#6b6b6b", "^"), ("#E69F00", "s"), ("#0072B2", "o"), ("#009E73", "D"), ("#CC79A7", "v"), ("#D55E00", "P"))


def write_curves(path: Path, curves: Mapping[str, Curves], *, title: str = "") -> None:
    """Draw delta calibration, quantile calibration and sparsification side by side and write the picture (PNG).

    Args:
        path: the file; its folder must exist.
        curves: ``SequenceMetrics.curves()`` by the name that the legend shows.
        title: over the picture.

    Raises:
        ValueError: there are no curves, or more than can be told apart.
        ImportError: matplotlib is missing.
    """
    if not 1 <= len(curves) <= len(_BY_ORDER):
        raise ValueError(f"curves must hold 1 to {len(_BY_ORDER)} methods, got {len(curves)}")
    figure = new_figure(12.6, 4.6, title)
    delta, quantiles, sparse = figure.subplots(1, 3)
    lines = {name: (Style(*look), curves[name]) for name, look in zip(curves, _BY_ORDER, strict=False)}
    draw_delta(delta, lines, "δ calibration")
    draw_quantiles(quantiles, lines, "quantile calibration")
    for style, values in lines.values():
        x = np.arange(len(values["sparsification_rmse"])) / len(values["sparsification_rmse"])
        sparse.plot(x, values["sparsification_rmse"], markevery=10, **style.line)
        sparse.plot(x, values["sparsification_oracle_rmse"], linewidth=1.0, linestyle=":", color=style.colour)
    sparse.set_xlim(0, 1)
    sparse.set_ylim(bottom=0)
    words = ("sparsification (dotted: best possible)", "share of pixels left out, largest σ first", "RMSE [m]")
    finish(sparse, title=words[0], x=words[1], y=words[2])
    figure.legend(*delta.get_legend_handles_labels(), loc="outside lower center", ncols=len(curves) + 1, frameon=False)
    save_figure(figure, path)


# ---- the paper's figure of binned error against NLL, over the pixels of which a reference method is confident ----


def draw_error(results: Results, dataset: str) -> Any | None:
    """A line of panels per network, a panel per reference; None where no row was judged so."""
    panels = {base: of_base for base in results.bases if (of_base := _error_curves(results, dataset, base))}
    if not panels:
        return None
    columns = max(map(len, panels.values()))
    title = f"NLL by size of the error on {dataset}"
    figure = new_figure(0.6 + 4.3 * columns, 0.5 + 3.1 * len(panels), title)
    for line, (base, by_reference) in zip(_hidden_panels(figure, len(panels), columns), panels.items(), strict=True):
        for axes, (reference, curves) in zip(line, by_reference.items(), strict=False):
            method = Method.parse(reference)
            judge = "it" if method.fusion == ALONE else short_name(method)
            _draw_error(axes, f"{BASES[base][0]}: where {judge} is confident", curves)
    return figure


def _draw_error(axes: Any, title: str, curves: Mapping[Row, Sequence[float]]) -> None:
    """The mean NLL of each tenth of the pixels, from the smallest errors to the largest."""
    axes.set_visible(True)
    for row, values in sorted(curves.items(), key=lambda item: item[0].method.fusion == UFM_STAR):
        x = (np.arange(len(values)) + 0.5) * 100 / len(values)
        axes.plot(x, np.array(values, float), label=row.method.name, **style_of(row.method).line)
    axes.set(xlim=(0, 100), xticks=[0, 25, 50, 75, 100])
    finish(axes, title=title, x="percentile of the row's error", y="mean NLL [nats]")
    # At the last group that had a pixel.
    ends = {row: next(value for value in reversed(values) if value == value) for row, values in curves.items()}
    label_ends(axes, [(y, short_name(row.method), style_of(row.method).colour) for row, y in ends.items()])


def _error_curves(results: Results, dataset: str, base: str) -> dict[str, dict[Row, Sequence[float]]]:
    """Curves by row, by reference: the base alone first, then UfM."""
    curves: dict[str, dict[Row, Sequence[float]]] = {}
    for row in _default_rows(results, base):
        merged = results.merged.get((dataset, row))
        for name, values in (merged.curves if merged else {}).items():
            reference = name.removeprefix(BY_ERROR)
            if reference != name and np.isfinite(values).any() and Method.parse(reference).base == base:
                curves.setdefault(reference, {})[row] = values
    return dict(sorted(curves.items(), key=lambda item: (item[0].startswith("UfM"), item[0])))


# ---- the paper's figure of predictive entropy ----


def draw_entropy(results: Results, base: str) -> Any | None:
    """Data sets below each other on one axis; None where no row of the base has a variance."""
    panels: dict[str, dict[Row, Merged]] = {}
    for dataset in results.datasets:
        for row in _default_rows(results, base):
            merged = results.merged.get((dataset, row))
            if merged is not None and sum(merged.curves.get("entropy_counts", ())) > 0:
                panels.setdefault(dataset, {})[row] = merged
    if not panels:
        return None
    figure = new_figure(7.6, 1.0 + 2.1 * len(panels), f"Predictive entropy by data set, {BASES[base][0]}")
    axes = figure.subplots(len(panels), 1, squeeze=False, sharex=True)[:, 0]
    low, high = entropy_range([merged for rows in panels.values() for merged in rows.values()])
    for panel, (dataset, rows) in zip(axes, panels.items(), strict=True):
        panel.set_xlim(low, high)
        _draw_histograms(panel, rows)
        finish(panel, title=dataset, y="share of pixels per nat")
    axes[-1].set_xlabel("entropy ½ ln(2πeV) [nats]", size=LABEL, color=INK)
    _sigma_axis(axes[0], low, high)
    return figure


def entropy_range(merged: Sequence[Merged]) -> tuple[float, float]:
    """Where 99.8 % of every histogram lie, and a margin of half a nat [nats]."""
    lows, highs = [], []
    for one in merged:
        counts, edges = np.array(one.curves["entropy_counts"]), np.array(one.curves["entropy_edges"])
        share = counts.cumsum() / counts.sum()
        # share[k] is what lies below edges[k]; the last one has no edge above it.
        lows.append(edges[max(int(np.searchsorted(share[:-1], 0.001, side="right")) - 1, 0)])
        highs.append(edges[min(int(np.searchsorted(share[:-1], 0.999)), len(edges) - 1)])
    low, high = float(min(lows)) - 0.5, float(max(highs)) + 0.5
    return max(low, float(edges[0])), min(high, float(edges[-1]))


def density(merged: Merged) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[bins] share of all pixels per nat, and [bins + 1] the bins' edges [nats]."""
    counts, edges = np.array(merged.curves["entropy_counts"]), np.array(merged.curves["entropy_edges"])
    return counts[1:-1] / counts.sum() / np.diff(edges), edges


def _draw_histograms(axes: Any, rows: Mapping[Row, Merged]) -> None:
    """Histograms, and the mean of each as a dashed line with its name beside."""
    for number, (row, merged) in enumerate(rows.items()):
        colour = style_of(row.method).colour
        heights, edges = density(merged)
        axes.stairs(heights, edges, color=colour, linewidth=1.5, label=short_name(row.method))
        if row.method.fusion == UFM_STAR and not row.method.full:
            axes.stairs(heights, edges, color=colour, alpha=0.15, fill=True)
        mean, counts = merged.figures["entropy"], merged.curves["entropy_counts"]
        axes.axvline(mean, color=colour, linestyle="--", linewidth=1.1)
        # Pixels below the histogram: V = 0 above all.
        below = counts[0] / sum(counts)
        remark = "" if below < 0.005 else f"\n({100 * below:.0f} % with hardly any V)"
        words = f"{short_name(row.method)}: mean {mean:.2f}{remark}"
        axes.text(1.02, 0.95 - 0.13 * number, words, color=colour, size=TICK, va="top", transform=axes.transAxes)
    axes.set_ylim(bottom=0)


def _sigma_axis(axes: Any, low: float, high: float) -> None:
    """The same axis in metres of a standard deviation, above."""
    twin = axes.secondary_xaxis("top", functions=(lambda h: h - ONE_METRE, lambda s: s + ONE_METRE))
    decades = [sigma for sigma in _DECADES if low <= math.log(sigma) + ONE_METRE <= high]
    finer = [factor * sigma for sigma in _DECADES for factor in (1, 2, 5)]
    within = [sigma for sigma in finer if low <= math.log(sigma) + ONE_METRE <= high]
    shown = decades if len(decades) > 2 else within
    twin.set_xticks([math.log(sigma) for sigma in shown], [f"σ = {sigma:g} m" for sigma in shown])
    twin.tick_params(labelsize=TICK - 1, color=FAINT, labelcolor=INK)
    twin.spines["top"].set_visible(False)


# ---- cost: time by stage, calibration against memory and time ----


def draw_latency(results: Results) -> Any | None:
    """Time per frame of every method: the network's, and what uncertainty takes; None where nothing was timed."""
    timed: list[tuple[Row, Mean, Mean]] = []
    for row in _default_rows(results):
        network, uncertainty = (mean_of(results.of(row), quantity) for quantity in (NETWORK_MS, UNCERTAINTY_MS))
        if network.sequences or uncertainty.sequences:
            timed.append((row, network, uncertainty))
    if not timed:
        return None
    figure = new_figure(7.6, 1.2 + 0.27 * len(timed), "Time per frame")
    axes = figure.subplots()
    longest = 0.0
    for y, (row, network, uncertainty) in enumerate(timed):
        n, u = (mean.value if mean.sequences else 0.0 for mean in (network, uncertainty))
        axes.barh(y, n, color=NETWORK_COLOUR, height=0.66)
        axes.barh(y, u, left=n, color=style_of(row.method).colour, height=0.66)
        words = f"  {f'{n:.1f}' if network.sequences else 'network not timed'} + {u:.1f} ms"
        axes.text(n + u, y, words, size=TICK, va="center", color=INK)
        longest = max(longest, n + u)
    axes.set(xlim=(0, 1.3 * longest), ylim=(len(timed) - 0.4, -0.6))
    axes.set_yticks(range(len(timed)), [row.method.name for row, _, _ in timed])
    finish(axes, x="network (grey) + uncertainty (coloured) [ms], mean over sequences of the median frame")
    axes.grid(visible=False, axis="y")
    return figure


def draw_stages(results: Results) -> Any | None:
    """Where UfM*'s time goes, stage by stage, as in the paper's figure; None unless ``efficiency.json`` has it."""
    staged = [row for row in (results.efficiency or {}).get("rows", ()) if row.get("stages")]
    if not staged:
        return None
    figure = new_figure(8.6, 1.5 + 0.5 * len(staged), "Where the time of UfM* goes")
    axes = figure.subplots()
    for y, row in enumerate(staged):
        times = {name: row["stages"]["stages"][name]["median_ms"] for name in STAGES if name in row["stages"]["stages"]}
        _draw_stages(axes, y, times)
    axes.set_yticks(range(len(staged)), [plain(f"{row['row']}\n{row['network']}") for row in staged])
    finish(axes, x="share of the step [%], medians of its stages")
    axes.grid(visible=False)
    axes.set(xlim=(0, 100), ylim=(len(staged) - 0.4, -0.6))
    from matplotlib.patches import Patch

    handles = [Patch(color=colour, label=name) for name, colour in STAGES.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=TICK)
    return figure


def _draw_stages(axes: Any, y: int, times: Mapping[str, float]) -> None:
    """One bar of shares, with their numbers where there is room, and the sum behind."""
    total, left = math.fsum(times.values()), 0.0
    for name, ms in times.items():
        share = 100 * ms / total
        axes.barh(y, share, left=left, color=STAGES[name], height=0.62, edgecolor="white", linewidth=0.5)
        if share >= 6:
            letters = INK if name in ("regress", "average") else "white"  # dark on the light colours
            words = {"size": TICK, "color": letters, "ha": "center", "va": "center"}
            axes.text(left + share / 2, y, f"{share:.0f} %", **words)
        left += share
    axes.text(101, y, f"{total:.1f} ms", size=TICK, color=INK, va="center")


def draw_tradeoff(results: Results, dataset: str | None = None) -> Any | None:
    """ECE_delta against the bytes that are kept between frames, and against the time per frame; None without points."""
    points = {row: mean_of(results.of(row, dataset), ECE_DELTA) for row in _default_rows(results)}
    points = {row: mean for row, mean in points.items() if mean.sequences}
    kept = {row: mean_of(results.of(row, dataset), STATE).value for row in points}
    kept = {row: 0.0 if math.isnan(x) else x for row, x in kept.items()}  # a method alone keeps nothing
    took = {row: mean_of(results.of(row, dataset), TOTAL_MS).value for row in points}
    took = {row: x for row, x in took.items() if not math.isnan(x)}
    if not any(kept.values()):
        return None
    figure = new_figure(11.0, 4.8, f"Calibration against cost on {dataset or 'all sequences'}")
    words = ("kept between frames [MB]", "time per frame [ms]")
    for axes, panel, word in zip(figure.subplots(1, 2, sharey=True), (kept, took), words, strict=True):
        for row, x in panel.items():
            mean = points[row]
            axes.errorbar(
                x, mean.value, yerr=np.nan_to_num(mean.half), color=style_of(row.method).colour, markersize=6,
                marker=_BASE_MARKERS[row.method.base], linewidth=1, elinewidth=0.5, capsize=0,
            )  # fmt: skip
        _cost_axis(axes, list(panel.values()))
        finish(axes, x=word, y="ECE_δ ↓ (bar: 95 % interval)")
        if len(points) <= MOST_NAMES:
            _name_points(axes, [(x, points[row].value, row) for row, x in panel.items()])
    if len(points) > MOST_NAMES:
        figure.legend(handles=_legend(list(points)), loc="outside right upper", frameon=False, fontsize=TICK)
    return figure


def _legend(rows: Sequence[Row]) -> list[Any]:
    """Colours are methods, marks are networks."""
    from matplotlib.lines import Line2D

    look: dict[str, Any] = {"linestyle": "", "markersize": 6}
    methods = {short_name(row.method): style_of(row.method).colour for row in rows}
    bases = dict.fromkeys(row.method.base for row in rows)
    return [
        *(Line2D([], [], marker="o", color=colour, label=name, **look) for name, colour in methods.items()),
        *(Line2D([], [], marker=_BASE_MARKERS[base], color=INK, label=BASES[base][1], **look) for base in bases),
    ]


def _cost_axis(axes: Any, values: Sequence[float]) -> None:
    """Logarithmic, with room for 0 at the left (methods alone keep nothing)."""
    positive = [value for value in values if value > 0]
    if positive and max(positive) > 8 * min(positive):
        if min(values) > 0:
            axes.set_xscale("log")
        else:
            axes.set_xscale("symlog", linthresh=min(positive) / 2, linscale=0.8)
    else:
        axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_ylim(bottom=0)


def _name_points(axes: Any, points: Sequence[tuple[float, float, Row]]) -> None:
    """Each point's name in a column right of the panel, apart from each other, with a thin line to its point."""
    height = axes.get_position().height * axes.figure.get_figheight()
    high = axes.get_ylim()[1]
    places = spread_apart([y / high for _, y, _ in points], 1.2 * TICK / 72 / height, 0, 1)
    for (x, y, row), place in zip(points, places, strict=True):
        name = f"{BASES[row.method.base][1]} {short_name(row.method)}"
        axes.annotate(
            name, (x, y), (1.04, place), textcoords="axes fraction", size=TICK, va="center",
            color=style_of(row.method).colour,
            arrowprops={"arrowstyle": "-", "color": FAINT, "linewidth": 0.4, "relpos": (0, 0.5), "shrinkB": 3},
        )  # fmt: skip
