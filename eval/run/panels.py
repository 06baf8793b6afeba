"""Grids of pictures with text at the left, captions above and colour bars below, for all sheets and strips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.run import colours
from ufmstar_torch.eval.run.colours import FAINT, INK, ColourScale
from ufmstar_torch.steps.regress import HALF

# Inches.
_GAP, _MARGIN, _CAPTION, _BAR, _BARS, _TITLE = 0.06, 0.08, 0.2, 0.1, 0.62, 0.34


class Panel(NamedTuple):
    """One picture [h, w, 3] uint8 with a caption above; None shows the text ``absent`` instead."""

    rgb: NDArray[np.uint8] | None
    caption: str = ""
    absent: str = ""


class GridRow(NamedTuple):
    """Pictures side by side, with a bold title and small lines at their left."""

    title: str
    lines: Sequence[str]
    panels: Sequence[Panel]

    def captioned(self, captions: Sequence[str]) -> GridRow:
        """The row with captions above its pictures."""
        panels = [panel._replace(caption=caption) for panel, caption in zip(self.panels, captions, strict=True)]
        return self._replace(panels=panels)


class Bar(NamedTuple):
    """A colour bar below ``span`` columns, named by its quantity and unit."""

    label: str
    scale: ColourScale
    column: int
    span: int = 1


def draw_grid(
    path: Path,
    rows: Sequence[GridRow],
    bars: Sequence[Bar],
    *,
    aspect: float,
    title: str = "",
    cell: float = 1.95,
    words: float = 1.5,
) -> None:
    """Draw the rows below each other and write the picture (PNG), atomically. ``aspect`` is height by width of a
    picture, ``cell`` and ``words`` the widths of a picture and of the text at the left [in]."""
    names = [break_name(row.title, max(8, int(12 * words))) for row in rows]
    named = [0.16 * (name.count("\n") + 1) + 0.05 for name in names]
    heads = [_CAPTION if any(panel.caption for panel in row.panels) else 0.0 for row in rows]
    # Wide pictures, as of a driving car, are flatter than the text at their left.
    tall = [max(cell * aspect, above + 0.145 * len(row.lines)) for above, row in zip(named, rows, strict=True)]
    step = cell + _GAP
    width = _MARGIN + words + max(len(row.panels) for row in rows) * step - _GAP + _MARGIN
    top = (_TITLE if title else _MARGIN) + len(rows) * _GAP + sum(tall) + sum(heads) + _BARS
    figure = new_sheet(width, top, title)
    top -= _TITLE if title else _MARGIN
    for row, name, above, head, height in zip(rows, names, named, heads, tall, strict=True):
        top -= head
        say(figure, _MARGIN, top, name, size=8.5, weight="bold", color=INK, va="top", linespacing=1.15)
        lines = "\n".join(row.lines)
        say(figure, _MARGIN, top - above, lines, size=7.5, color=FAINT, va="top", linespacing=1.3)
        for column, panel in enumerate(row.panels):
            left = _MARGIN + words + column * step
            _draw_panel(axes_at(figure, left, top - cell * aspect, cell, cell * aspect), panel)
        top -= height + _GAP
    bottom = _BARS - 0.14 - _BAR
    for bar in bars:
        left = _MARGIN + words + bar.column * step + 0.12
        draw_bar(axes_at(figure, left, bottom, bar.span * step - _GAP - 0.24, _BAR), bar)
    from matplotlib.patches import Rectangle

    grey = (colours.INVALID_GREY / 255,) * 3
    figure.add_artist(Rectangle((_MARGIN, bottom), 0.12, _BAR, color=grey, transform=figure.dpi_scale_trans))
    legend = "no value, no truth;\nstripes: not compared"
    say(figure, _MARGIN + 0.18, bottom + _BAR / 2, legend, size=7.5, color=FAINT, va="center", linespacing=1.2)
    colours.save_png(figure, path)


def new_sheet(width: float, height: float, title: str) -> Any:
    """An empty figure with a title [in]."""
    colours.require_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=110, facecolor="white")
    say(figure, _MARGIN, height - 0.2, title, size=11, weight="bold", color=INK, va="center")
    return figure


def say(figure: Any, x: float, y: float, words: str, **how: Any) -> None:
    """Draw text at a position of a sheet [in]."""
    figure.text(x, y, colours.plain(words), transform=figure.dpi_scale_trans, **how)


def axes_at(figure: Any, left: float, bottom: float, width: float, height: float) -> Any:
    """Axes at a position of a sheet [in]."""
    wide, high = figure.get_size_inches()
    return figure.add_axes((left / wide, bottom / high, width / wide, height / high))


def break_name(name: str, letters: int) -> str:
    """The name on lines of at most ``letters``, broken after hyphens, underscores and blanks if possible, else after a
    point."""
    lines, rest = [], name
    while len(rest) > letters:
        end = max(rest.rfind(mark, 1, letters) for mark in "-_ ")
        end = rest.rfind(".", 1, letters) if end < 1 else end
        end = letters - 1 if end < 1 else end
        lines.append(rest[: end + 1].rstrip())
        rest = rest[end + 1 :]
    return "\n".join([*lines, rest])


def _draw_panel(axes: Any, panel: Panel) -> None:
    axes.set_axis_off()
    if panel.caption:
        axes.set_title(colours.plain(panel.caption), size=8, color=INK, pad=2.5)
    if panel.rgb is None:
        axes.text(0.5, 0.5, panel.absent, color=FAINT, size=8, ha="center", va="center", transform=axes.transAxes)
        return
    axes.imshow(panel.rgb, aspect="auto", interpolation="antialiased")


def draw_bar(axes: Any, bar: Bar) -> None:
    """Draw a horizontal colour bar with its label in the axes, with an arrow at each end unless it is 0."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm, Normalize
    from matplotlib.ticker import LogLocator, MaxNLocator, StrMethodFormatter

    scale = LogNorm if bar.scale.logarithmic else Normalize
    linear = MaxNLocator(5 * bar.span, steps=[1, 2, 5, 10])
    drawn = axes.figure.colorbar(
        ScalarMappable(scale(bar.scale.low, bar.scale.high), bar.scale.colour_map),
        cax=axes,
        orientation="horizontal",
        extend="max" if bar.scale.low == 0 else "both",
        extendfrac=0.03,
        ticks=LogLocator(subs=(1, 2, 5)) if bar.scale.logarithmic else linear,
        format=StrMethodFormatter("{x:g}") if bar.scale.logarithmic else None,
    )
    drawn.ax.minorticks_off()
    drawn.ax.tick_params(labelsize=7.5, length=2.5, pad=2, color=INK, labelcolor=INK)
    drawn.outline.set_linewidth(0.5)
    drawn.set_label(bar.label, size=7.5, color=INK, labelpad=1)


# ---- the contact sheet: image | depth | sigma | error, one row per frame ----

# The maps of a frame, in the order of their columns: label, and name of their shared scale.
MAPS = {
    "network_depth": ("depth, network", "depth"),
    "depth": ("depth", "depth"),
    "sigma": ("σ", "length"),
    "anchored": ("√B", "length"),
    "error": ("|error|", "length"),
    "ufm_sigma": ("σ, UfM*", "length"),
    "network_error": ("|error|, network", "length"),
}
DECADES = 2  # range of the logarithmic scale of errors: a linear one would show the posterior's errors as black


@dataclass(frozen=True, eq=False)
class FramePanel:
    """One displayed frame: its image [H, W, 3] uint8 RGB of any size, and its maps [h, w] [m], NaN where unknown.

    ``maps`` has names of ``MAPS``, "depth" and "sigma" always, and "measured", the share of the disagreement from two
    views or more, which draws stripes on the sigma of UfM*. ``note`` ("31 components") is next to the name.
    """

    name: str
    image: NDArray[np.uint8]
    maps: Mapping[str, NDArray[Any]]
    note: str = ""

    @property
    def shape(self) -> tuple[int, ...]:
        """(h, w) of the maps."""
        return self.maps["depth"].shape


class MapColumn(NamedTuple):
    """One kind of map: its label, its scale, and its name in ``MAPS``."""

    label: str
    scale: ColourScale
    field: str

    def rgb(self, panel: FramePanel) -> NDArray[np.uint8] | None:
        """[h, w, 3] the coloured map, the sigma of UfM* striped where no two views were compared; None if the panel has
        none."""
        if self.field not in panel.maps:
            return None
        rgb = self.scale.rgb(panel.maps[self.field])
        of_ufm = "ufm_sigma" if "ufm_sigma" in panel.maps else "sigma"
        measured = panel.maps.get("measured") if self.field == of_ufm else None
        return colours.striped(rgb, None if measured is None else measured < HALF)


def map_columns(panels: Sequence[FramePanel]) -> list[MapColumn]:
    """The columns right of the image, one per map in any panel, with scales for all panels: depths from their 1st to
    their 99th percentile; sigmas and errors share a logarithmic scale up to the largest of their 99th percentiles, so
    that equal sigma and error have the same colour."""
    maps_by_name = {name: [panel.maps[name] for panel in panels if name in panel.maps] for name in MAPS}
    depth = colours.robust_range([*maps_by_name["depth"], *maps_by_name["network_depth"]], from_zero=False)
    lengths = [maps_by_name[name] for name in ("sigma", "error", "ufm_sigma", "network_error") if maps_by_name[name]]
    high = max(colours.robust_range(maps, from_zero=True)[1] for maps in lengths)
    length = ColourScale(high / 10**DECADES, high, colours.ERROR_MAP, logarithmic=True)
    scales = {"depth": ColourScale(*depth, colours.DEPTH_MAP), "length": length}
    return [MapColumn(label, scales[scale], name) for name, (label, scale) in MAPS.items() if maps_by_name[name]]


def contact_sheet(
    panels: Sequence[FramePanel], path: str | Path, *, title: str = "", columns: Sequence[MapColumn] | None = None
) -> None:
    """Draw the frames below each other and write the picture (PNG), atomically. Adjacent ``columns`` (None = all maps)
    with the same scale share a colour bar. Raises ImportError: matplotlib is missing."""
    colours.require_matplotlib()
    columns = map_columns(panels) if columns is None else columns
    absent = ["no ground truth" if column.field == "error" else "none" for column in columns]
    rows = []
    for p in panels:
        maps = [Panel(column.rgb(p), absent=words) for column, words in zip(columns, absent, strict=True)]
        rows.append(GridRow(p.name, p.note.split(", ") if p.note else [], [Panel(p.image), *maps]))
    rows[0] = rows[0].captioned(["image", *(column.label for column in columns)])
    bars: list[Bar] = []
    position = 1
    for scale, of_scale in groupby(columns, key=lambda column: column.scale):
        labels = [column.label for column in of_scale]
        names = dict.fromkeys(label.partition(", ")[0] for label in labels)
        bars.append(Bar(f"{', '.join(names)} [m]", scale, position, len(labels)))
        position += len(labels)
    height, width = panels[0].shape
    draw_grid(Path(path), rows, bars, aspect=height / width, title=title, cell=2.4, words=1.2)
