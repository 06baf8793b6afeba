"""Pictures in rows, with words at the left, captions above and colour bars below."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.report.colours import INVALID_GREY, ColourScale, require_matplotlib
from ufmstar_torch.eval.report.plots import FAINT, INK
from ufmstar_torch.eval.results.files import write_atomic

# (left, top, width, height) in pixels of the map.
Box = tuple[int, int, int, int]
_MARK = "#00d5ff"  # in neither depth's nor sigma's colours
# Inches.
_CELL, _GAP, _WORDS, _MARGIN, _CAPTION, _BAR, _BARS, _TITLE = 1.95, 0.06, 1.5, 0.08, 0.2, 0.1, 0.62, 0.34


@dataclass(frozen=True, eq=False)
class Panel:
    """One picture.

    Attributes:
        rgb: [h, w, 3] uint8; None leaves a place with the words ``absent``.
        caption: above it.
        box: outlined in it.
        absent: why there is no picture.
    """

    rgb: NDArray[np.uint8] | None
    caption: str = ""
    box: Box | None = None
    absent: str = ""


@dataclass(frozen=True, eq=False)
class GridRow:
    """Pictures side by side.

    Attributes:
        title: at the left, bold.
        lines: below it, small.
        panels: from left to right.
    """

    title: str
    lines: Sequence[str]
    panels: Sequence[Panel]


@dataclass(frozen=True)
class Bar:
    """A colour bar below some columns.

    Attributes:
        label: what is coloured, with its unit.
        scale: the colours.
        column: where it stands.
        span: how many columns wide.
        extend: which ends are open: "both", "min", "max" or "neither".
    """

    label: str
    scale: ColourScale
    column: int
    span: int = 1
    extend: str = "max"


def draw_grid(
    path: Path, rows: Sequence[GridRow], bars: Sequence[Bar], *, aspect: float, title: str = "", dpi: int = 110
) -> None:
    """Draw the rows below each other and write the picture (PNG), atomically.

    Args:
        path: the file; its folder must exist.
        rows: at least one.
        bars: below all rows.
        aspect: height by width of a picture.
        title: over all.
        dpi: pixels per inch.

    Raises:
        ValueError: there is no row.
        ImportError: matplotlib is missing.
    """
    if not rows:
        raise ValueError("rows must hold at least one row of pictures")
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    place = _Places.of(rows, aspect, title=bool(title))
    figure = Figure(figsize=(place.width, place.height), dpi=dpi, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    if title:
        figure.text(
            _MARGIN / place.width, 1 - 0.2 / place.height, title, size=11, weight="bold", color=INK, va="center"
        )
    for number, row in enumerate(rows):
        _draw_words(figure, place, number, row)
        for column, panel in enumerate(row.panels):
            _draw_panel(figure.add_axes(place.cell(number, column)), panel)
    for bar in bars:
        _draw_bar(figure.add_axes(place.bar(bar)), bar)
    _draw_legend(figure, place)
    write_atomic(path, lambda file: canvas.print_png(file))


@dataclass(frozen=True)
class _Places:
    """Where things stand; lengths in inches, answers in shares of the figure."""

    columns: int
    cell_height: float
    tall: tuple[float, ...]
    heads: tuple[float, ...]
    top: float

    @classmethod
    def of(cls, rows: Sequence[GridRow], aspect: float, *, title: bool) -> _Places:
        heads = tuple(_CAPTION if any(panel.caption for panel in row.panels) else 0.0 for row in rows)
        # Pictures of a driving car are flatter than the words beside them.
        tall = tuple(max(_CELL * aspect, _words_height(row)) for row in rows)
        return cls(max(len(row.panels) for row in rows), _CELL * aspect, tall, heads, _TITLE if title else _MARGIN)

    @property
    def width(self) -> float:
        return _MARGIN + _WORDS + self.columns * (_CELL + _GAP) - _GAP + _MARGIN

    @property
    def height(self) -> float:
        return self.top + len(self.tall) * _GAP + sum(self.tall) + sum(self.heads) + _BARS

    def cell(self, row: int, column: int) -> tuple[float, float, float, float]:
        """(left, bottom, width, height)."""
        left = _MARGIN + _WORDS + column * (_CELL + _GAP)
        above = self.top + sum(self.tall[:row]) + row * _GAP + sum(self.heads[: row + 1])
        bottom = self.height - above - self.cell_height
        return self._shares(left, bottom, _CELL, self.cell_height)

    def words(self, row: int) -> tuple[float, float]:
        """(left, top) of the words of a row."""
        _, bottom, _, height = self.cell(row, 0)
        return _MARGIN / self.width, bottom + height

    def bar(self, bar: Bar) -> tuple[float, float, float, float]:
        left = _MARGIN + _WORDS + bar.column * (_CELL + _GAP)
        width = bar.span * (_CELL + _GAP) - _GAP
        return self._shares(left + 0.12, _BARS - 0.14 - _BAR, width - 0.24, _BAR)

    def _shares(self, left: float, bottom: float, width: float, height: float) -> tuple[float, float, float, float]:
        return left / self.width, bottom / self.height, width / self.width, height / self.height


def _draw_words(figure: Any, place: _Places, number: int, row: GridRow) -> None:
    x, y = place.words(number)
    title = break_name(row.title)
    figure.text(x, y, title, size=8.5, weight="bold", color=INK, va="top", linespacing=1.15)
    down = _title_height(title) / place.height
    figure.text(x, y - down, "\n".join(row.lines), size=7.5, color=FAINT, va="top", linespacing=1.3)


def _title_height(title: str) -> float:
    """Of a row's broken title with the space below it [in]."""
    return 0.16 * (title.count("\n") + 1) + 0.05


def _words_height(row: GridRow) -> float:
    """Of title and lines [in]."""
    return _title_height(break_name(row.title)) + 0.145 * len(row.lines)


def break_name(name: str, letters: int = 20) -> str:
    """The name on as many lines as it needs, broken behind hyphens, underscores and blanks where it can be."""
    lines, rest = [], name
    while len(rest) > letters:
        at = max(rest.rfind(mark, 1, letters) for mark in "-_ ")
        at = letters - 1 if at < 1 else at
        lines.append(rest[: at + 1].rstrip())
        rest = rest[at + 1 :]
    return "\n".join([*lines, rest])


def _draw_panel(axes: Any, panel: Panel) -> None:
    axes.set_axis_off()
    if panel.caption:
        axes.set_title(panel.caption, size=8, color=INK, pad=2.5)
    if panel.rgb is None:
        axes.text(0.5, 0.5, panel.absent, color=FAINT, size=8, ha="center", va="center", transform=axes.transAxes)
        return
    axes.imshow(panel.rgb, aspect="auto", interpolation="antialiased")
    if panel.box is not None:
        from matplotlib.patches import Rectangle

        left, top, width, height = panel.box
        corner = (left - 0.5, top - 0.5)
        axes.add_patch(Rectangle(corner, width, height, fill=False, edgecolor=_MARK, linewidth=1.4))


def _draw_bar(axes: Any, bar: Bar) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.ticker import MaxNLocator

    scale = bar.scale
    drawn = axes.figure.colorbar(
        ScalarMappable(Normalize(scale.low, scale.high), scale.colour_map),
        cax=axes,
        orientation="horizontal",
        extend=bar.extend,
        extendfrac=0.03,
        ticks=MaxNLocator(5 * bar.span, steps=[1, 2, 5, 10]),
    )
    drawn.ax.tick_params(labelsize=7.5, length=2.5, pad=2, color=INK, labelcolor=INK)
    drawn.outline.set_linewidth(0.5)
    drawn.set_label(bar.label, size=7.5, color=INK, labelpad=1)


def _draw_legend(figure: Any, place: _Places) -> None:
    """What grey means, left of the bars."""
    from matplotlib.patches import Rectangle

    left, bottom = _MARGIN / place.width, (_BARS - 0.14 - _BAR) / place.height
    size = (0.12 / place.width, _BAR / place.height)
    grey = (INVALID_GREY / 255,) * 3
    figure.add_artist(Rectangle((left, bottom), *size, color=grey, transform=figure.transFigure))
    x, y = left + 0.18 / place.width, bottom + size[1] / 2
    figure.text(x, y, "no value, no truth", size=7.5, color=FAINT, va="center")
