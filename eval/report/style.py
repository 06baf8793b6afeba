"""How figures look: one colour and mark per kind of method, names at the ends of lines, no global state."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ufmstar_torch.eval.methods.method import ALONE, UFM, Method
from ufmstar_torch.eval.report.colours import FAINT, INK, plain, require_matplotlib
from ufmstar_torch.eval.results.files import write_atomic

GRID = "#e6e6e6"
TITLE, LABEL, TICK = 11, 9, 8  # sizes of letters [pt]
DPI = 130


class Style(NamedTuple):
    """A line's colour (Okabe and Ito's, which the colour-blind tell apart) and mark (for print in grey)."""

    colour: str
    marker: str

    @property
    def line(self) -> dict[str, Any]:
        """For ``Axes.plot``."""
        return {"color": self.colour, "marker": self.marker, "linewidth": 1.6, "markersize": 4.5}


ALONE_STYLE = Style("#6b6b6b", "^")


def style_of(method: Method) -> Style:
    """The same in every figure, whatever the network."""
    if method.fusion == ALONE:
        return ALONE_STYLE
    if method.fusion == UFM:
        if method.full:
            return Style("#F0E442", "X")
        return Style("#E69F00", "s") if method.max_points is None else Style("#D55E00", "v")
    if method.full:
        return Style("#009E73", "D")
    return Style("#CC79A7", "P") if method.fixed_param else Style("#0072B2", "o")


def short_name(method: Method) -> str:
    """A method's name where its network stands elsewhere: "alone", "UfM-100K", "UfM*", "UfM*-Full"."""
    if method.fusion == ALONE:
        return "alone"
    cap = "" if method.max_points is None else f"-{method.max_points // 1000}K"
    name = "UfM" if method.fusion == UFM else "UfM*"
    return f"{name}{'-Full' if method.full else ''}{cap}{' fixed-param' if method.fixed_param else ''}"


def new_figure(width: float, height: float, title: str) -> Any:
    """A figure with a title [inches]."""
    require_matplotlib()
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    layout = ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08)
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white", layout=layout)
    figure.suptitle(plain(title), size=TITLE, weight="bold", color=INK, x=0.012, ha="left")
    return figure


def hidden_panels(figure: Any, lines: int, columns: int) -> Any:
    """[lines, columns] axes that are invisible until they are drawn on."""
    axes = figure.subplots(lines, columns, squeeze=False)
    for panel in axes.flat:
        panel.set_visible(False)
    return axes


def finish(axes: Any, *, title: str = "", x: str = "", y: str = "") -> None:
    """Words, a faint grid behind, no box."""
    axes.set_title(plain(title), size=LABEL + 0.5, color=INK, loc="left")
    axes.set_xlabel(plain(x), size=LABEL, color=INK)
    axes.set_ylabel(plain(y), size=LABEL, color=INK)
    axes.tick_params(labelsize=TICK, color=FAINT, labelcolor=INK)
    axes.grid(color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(FAINT)


def spread_apart(places: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Places at least ``gap`` apart within [low, high] in the same order, each as near to its own as can be.

    Less k gaps, the places in their order must only not fall, which is isotonic regression. Where they do not fit, the
    gap is smaller.
    """
    from scipy.optimize import isotonic_regression

    if not places:
        return []
    wanted, order = np.array(places), np.argsort(places, kind="stable")
    offset = min(gap, (high - low) / max(len(places) - 1, 1)) * np.arange(len(places))
    spread = np.empty(len(places))
    nearest = isotonic_regression(wanted[order] - offset).x + offset
    spread[order] = np.maximum(np.minimum(nearest, high - offset[::-1]), low + offset)
    return [float(place) for place in spread]


def label_ends(axes: Any, ends: Sequence[tuple[float, str, str]]) -> None:
    """Names right of a panel, level with where their lines end, and apart from each other, for final limits of y; an
    end is (y of the line's end, name, colour)."""
    transform = axes.transData + axes.transAxes.inverted()
    x = axes.get_xlim()[1]
    wanted = [min(max(float(transform.transform((x, y))[1]), 0.0), 1.0) for y, _, _ in ends]
    height = axes.get_position().height * axes.figure.get_figheight()
    for place, (_, name, colour) in zip(spread_apart(wanted, 1.25 * TICK / 72 / height, 0, 1), ends, strict=True):
        axes.text(1.02, place, plain(name), transform=axes.transAxes, color=colour, size=TICK, va="center", ha="left")


def stretch(axes: Any, values: Sequence[float], factor: float, **about_zero: float) -> None:
    """A logarithmic x axis where values span ``factor`` or more, with a linear piece about 0 where 0 is among them:
    ``linthresh`` in units of the least positive value, and ``linscale``."""
    positive = [value for value in values if value > 0]
    if not positive or max(positive) < factor * min(positive):
        return
    if min(values) > 0:
        axes.set_xscale("log")
    else:
        axes.set_xscale("symlog", **about_zero | {"linthresh": about_zero["linthresh"] * min(positive)})


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure, by its suffix (.svg or .png); the same figure gives the same bytes."""
    matplotlib = require_matplotlib()
    kind = path.suffix.removeprefix(".")
    plain = {"Date": None} if kind == "svg" else {"Software": None}
    with matplotlib.rc_context({"svg.hashsalt": "ufmstar"}):
        write_atomic(path, lambda file: figure.savefig(file, format=kind, metadata=plain))
