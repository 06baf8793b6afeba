"""The paper's figure of binned error against NLL, over the pixels of which a reference method is confident."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ufmstar_torch.eval.methods.method import ALONE, BASES, UFM_STAR, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import DEFAULT
from ufmstar_torch.eval.report.figure_style import finish, label_ends, new_figure, short_name, style_of
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.sums import BY_ERROR

_Curves = Mapping[Row, Sequence[float]]


def draw_error(results: Results, dataset: str) -> Any | None:
    """A line of panels per network, a panel per reference; None where no row was judged so."""
    panels = {base: found for base in _bases(results) if (found := _panels(results, dataset, base))}
    if not panels:
        return None
    columns = max(map(len, panels.values()))
    title = f"NLL by size of the error on {dataset}"
    figure = new_figure(0.6 + 4.3 * columns, 0.5 + 3.1 * len(panels), title)
    axes = figure.subplots(len(panels), columns, squeeze=False)
    for place in axes.flat:
        place.set_visible(False)
    for line, (base, found) in zip(axes, panels.items(), strict=True):
        for place, (reference, curves) in zip(line, found.items(), strict=False):
            _draw(place, f"{BASES[base][0]}: where {_spoken(reference)} is confident", curves)
    return figure


def _draw(axes: Any, title: str, curves: _Curves) -> None:
    """The mean NLL of each tenth of the pixels, from the smallest errors to the largest."""
    axes.set_visible(True)
    for row, values in sorted(curves.items(), key=lambda item: item[0].method.fusion == UFM_STAR):
        y = np.array(values, float)
        x = (np.arange(len(y)) + 0.5) * 100 / len(y)
        axes.plot(x, y, label=row.method.name, **style_of(row.method).line)
    axes.set_xlim(0, 100)
    axes.set_xticks([0, 25, 50, 75, 100])
    finish(axes, title=title, x="percentile of the row's error", y="mean NLL [nats]")
    label_ends(axes, [(_last(v), short_name(r.method), style_of(r.method).colour) for r, v in curves.items()])


def _panels(results: Results, dataset: str, base: str) -> dict[str, _Curves]:
    """Curves by row, by reference: the base alone first, then UfM."""
    found: dict[str, dict[Row, Sequence[float]]] = {}
    for row in results.rows:
        merged = results.merged.get((dataset, row))
        if row.method.base != base or row.setting != DEFAULT or merged is None:
            continue
        for name, values in merged.curves.items():
            reference = name.removeprefix(BY_ERROR)
            if reference != name and np.isfinite(values).any():
                found.setdefault(reference, {})[row] = values
    own = {name: curves for name, curves in found.items() if Method.parse(name).base == base}
    return {name: own[name] for name in sorted(own, key=lambda name: (name.startswith("UfM"), name))}


def _spoken(reference: str) -> str:
    """A reference beside the name of its base: "it" alone, "UfM-100K"."""
    method = Method.parse(reference)
    return "it" if method.fusion == ALONE else short_name(method)


def _bases(results: Results) -> list[str]:
    return list(dict.fromkeys(row.method.base for row in results.rows))


def _last(values: Sequence[float]) -> float:
    """The last group that had a pixel."""
    return next(value for value in reversed(values) if value == value)
