"""Calibration curves: is the depth within 25 % as often as said, and below its quantiles as often as they say."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ufmstar_torch.eval.methods.method import BASES, UFM_STAR
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import DEFAULT
from ufmstar_torch.eval.report.means import value_of
from ufmstar_torch.eval.report.figure_style import counted, finish, label_ends, new_figure, short_name, style_of
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.plots import FAINT
from ufmstar_torch.eval.results.record import Record

PER_LINE = 3
MOST_SEQUENCES = 12
Curves = Mapping[str, Sequence[float]]


def draw_calibration(results: Results, dataset: str) -> Any | None:
    """Both curves over all pixels of a data set, a column per network; None where no row has a variance."""
    bases = {base: curves for base, curves in _by_base(results, dataset).items() if curves}
    if not bases:
        return None
    columns = min(len(bases), PER_LINE)
    lines = -(-len(bases) // columns)
    title = f"Calibration on {dataset}, all pixels of {counted(len(results.sequences(dataset)))}"
    figure = new_figure(0.5 + 3.4 * columns, 0.4 + 6.0 * lines, title)
    axes = figure.subplots(2 * lines, columns, squeeze=False)
    for place in axes.flat:
        place.set_visible(False)
    for number, (base, curves) in enumerate(bases.items()):
        line, column = divmod(number, columns)
        draw_delta(axes[2 * line][column], curves, title=BASES[base][0], ends=True)
        draw_quantiles(axes[2 * line + 1][column], curves, ends=True)
    return figure


def draw_sequence_calibration(results: Results, dataset: str, base: str) -> Any | None:
    """Both curves of single sequences, from the one on which UfM* is best to that on which it is worst."""
    names = chosen_sequences(results, dataset, base)
    if not names:
        return None
    columns = min(len(names), 4)
    lines = -(-len(names) // columns)
    title = f"Calibration on single sequences of {dataset}, {BASES[base][0]}; errors alone → UfM*, from best to worst"
    figure = new_figure(0.4 + 2.45 * columns, 0.7 + 4.9 * lines, title)
    axes = figure.subplots(2 * lines, columns, squeeze=False)
    for place in axes.flat:
        place.set_visible(False)
    for number, name in enumerate(names):
        line, column = divmod(number, columns)
        of = {row: [r for r in results.of(row, dataset) if r.sequence == name] for row in _rows(results, base)}
        shown = {row: found[0] for row, found in of.items() if found and _has_curves(found[0].curves)}
        curves = {row: record.curves for row, record in shown.items()}
        left = column == 0
        draw_delta(axes[2 * line][column], curves, title=f"{name}\n{_errors(shown, 'ece_delta', 'δ')}", named=left)
        draw_quantiles(axes[2 * line + 1][column], curves, title=_errors(shown, "ece_q", "q"), named=left)
    rows = {short_name(row.method): row for row in _rows(results, base)}
    handles = [_handle(name, row) for name, row in rows.items() if any(_has_curves(r.curves) for r in results.of(row))]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=8)
    return figure


def chosen_sequences(results: Results, dataset: str, base: str) -> list[str]:
    """At most ``MOST_SEQUENCES``, evenly over the order of the ECE_delta of a base's UfM* (or last row)."""
    rows = [row for row in _rows(results, base) if any(_has_curves(r.curves) for r in results.of(row, dataset))]
    if not rows:
        return []
    judge = next((row for row in rows if row.method.fusion == UFM_STAR and not row.method.full), rows[-1])
    found = [r for r in results.of(judge, dataset) if _has_curves(r.curves)]
    names = [r.sequence for r in sorted(found, key=lambda r: (value_of(r, "ece_delta"), r.sequence))]
    if len(names) <= MOST_SEQUENCES:
        return names
    return [names[i] for i in np.linspace(0, len(names) - 1, MOST_SEQUENCES).round().astype(int)]


def draw_delta(
    axes: Any, curves: Mapping[Row, Curves], *, title: str = "", named: bool = True, ends: bool = False
) -> None:
    """Confidence that the depth is within 25 %, and how often it is; bins with hardly a pixel are left out.

    Args:
        axes: the panel.
        curves: of each row.
        title: of the panel.
        named: with a word at the y axis.
        ends: with the rows' names at the right.
    """
    lines = []
    for row, values in _drawn(curves):
        x, y, pixels = (np.array(values[f"ece_delta_{what}"], float) for what in ("confidence", "accuracy", "pixels"))
        shown = pixels > 0.001 * pixels.sum()
        lines.append((row, x[shown], y[shown]))
    _draw(axes, lines, title, ("predicted share within 25 %", "true share" if named else ""), ends)


def draw_quantiles(
    axes: Any, curves: Mapping[Row, Curves], *, title: str = "", named: bool = True, ends: bool = False
) -> None:
    """Predicted quantiles of the depth, and the share of the truth below them; arguments as of ``draw_delta``."""
    lines = [(row, np.array(v["ece_q_levels"]), np.array(v["ece_q_observed"])) for row, v in _drawn(curves)]
    _draw(axes, lines, title, ("predicted quantile", "share of truth below" if named else ""), ends)


def _draw(axes: Any, lines: Sequence[tuple[Row, Any, Any]], title: str, words: tuple[str, str], ends: bool) -> None:
    axes.set_visible(True)
    axes.plot([0, 1], [0, 1], linestyle="--", linewidth=1.0, color=FAINT)
    for row, x, y in lines:
        axes.plot(x, y, label=short_name(row.method), clip_on=False, **style_of(row.method).line)
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    axes.set_xticks([0, 0.5, 1])
    axes.set_yticks([0, 0.5, 1])
    finish(axes, title=title, x=words[0], y=words[1])
    if ends:
        last = [(y[-1], short_name(row.method), style_of(row.method).colour) for row, _, y in lines if len(y)]
        label_ends(axes, [*last, (1.0, "exactly right", FAINT)])


def _drawn(curves: Mapping[Row, Curves]) -> Iterator[tuple[Row, Curves]]:
    """UfM* last, on top."""
    yield from sorted(curves.items(), key=lambda item: (item[0].method.fusion == UFM_STAR, item[0].method.full))


def _rows(results: Results, base: str) -> list[Row]:
    return [row for row in results.rows if row.method.base == base and row.setting == DEFAULT]


def _by_base(results: Results, dataset: str) -> dict[str, dict[Row, Curves]]:
    bases = dict.fromkeys(row.method.base for row in results.rows)
    merged = {base: {row: results.merged.get((dataset, row)) for row in _rows(results, base)} for base in bases}
    return {
        base: {row: found.curves for row, found in rows.items() if found is not None and _has_curves(found.curves)}
        for base, rows in merged.items()
    }


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


def _handle(name: str, row: Row) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], label=name, **style_of(row.method).line)
