"""The style of figures: one colour and marker per kind of method, names right of the panels, no global state."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from ufmstar_torch.eval.engine.files import write_atomic
from ufmstar_torch.eval.methods.method import ALONE, RELATIVE, RHO, UFM, UFM_STAR, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.run.colours import FAINT, INK, plain, require_matplotlib

GRID = "#e6e6e6"
TITLE, LABEL, TICK = 11, 9, 8  # font sizes [pt]
DPI = 130
# Colours and markers of lines that are no methods of the paper, in order.
BY_ORDER = (("#0072B2", "o"), ("#D55E00", "s"), ("#009E73", "D"), ("#E69F00", "^"), ("#CC79A7", "v"), ("#6b6b6b", "P"))


class LineStyle(NamedTuple):
    """A line's name, colour (Okabe and Ito's, for the colour-blind) and marker (for print in grey)."""

    name: str
    colour: str
    marker: str = ""

    @property
    def line(self) -> dict[str, Any]:
        """Keyword arguments of ``Axes.plot``."""
        return {
            "label": self.name, "color": self.colour, "marker": self.marker, "linewidth": 1.6, "markersize": 4.5,
        }  # fmt: skip


def line_style(method: Method) -> LineStyle:
    """The style of a method, equal in every figure and for every network, such as "network alone", "UfM*-Full"."""
    if method.fusion == ALONE:
        return LineStyle("network alone", "#6b6b6b", "^")
    full = "-Full" if method.full else ""
    if method.fusion == UFM:
        cap = "" if method.max_points is None else f"-{method.max_points // 1000}K"
        style = ("#F0E442", "X") if full else ("#D55E00", "v") if cap else ("#E69F00", "s")
        return LineStyle(f"UfM{full}{cap}", *style)
    if method.fusion == RELATIVE:
        return LineStyle(f"σ = {RHO:g} d", "#CC79A7", "x")
    if method.fusion != UFM_STAR:
        return LineStyle(f"{method.fusion}{full}", "#56B4E9", "*")
    fixed = " fixed-param" if method.fixed_param else ""
    style = ("#009E73", "D") if full else ("#CC79A7", "P") if fixed else ("#0072B2", "o")
    return LineStyle(f"UfM*{full}{fixed}", *style)


def row_style(row: Row) -> LineStyle:
    """The style of a row: "posterior" if it has one, else its method's."""
    return LineStyle("posterior", "#1d1d1f", "P") if row.setting.posterior else line_style(row.method)


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
    """[lines, columns] invisible axes; a drawing function makes them visible."""
    axes = figure.subplots(lines, columns, squeeze=False)
    for panel in axes.flat:
        panel.set_visible(False)
    return axes


def finish(axes: Any, *, title: str = "", x: str = "", y: str = "") -> None:
    """Set title, labels and a faint grid; remove the box."""
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


def name_lines(axes: Any) -> None:
    """Add the names of the lines at the right of a panel."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=TICK)


def legend_below(figure: Any) -> None:
    """Add the names of all lines below the panels."""
    named = {label: h for axes in figure.axes for h, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    longest = 0.5 + 0.06 * max(map(len, named), default=0)  # inches: the line, and a letter in this size
    columns = max(1, int(figure.get_figwidth() / longest))
    how: dict[str, Any] = {"ncols": min(len(named), columns), "frameon": False, "fontsize": TICK}
    figure.legend(list(named.values()), list(named), loc="outside lower center", **how)


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure in the format of the suffix; the same figure gives the same bytes of .svg, .png and .jpg."""
    matplotlib = require_matplotlib()
    kind = path.suffix.removeprefix(".")
    plain = {"svg": {"Date": None}, "png": {"Software": None}}.get(kind)
    with matplotlib.rc_context({"svg.hashsalt": "ufmstar"}):
        write_atomic(path, lambda file: figure.savefig(file, format=kind, metadata=plain))
