"""Pictures in rows with words at the left, captions above and colour bars below: every sheet and strip is one grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.report.colours import (
    DEPTH_MAP,
    ERROR_MAP,
    FAINT,
    INK,
    INVALID_GREY,
    ColourScale,
    plain,
    require_matplotlib,
    robust_range,
    save_png,
)

# (left, top, width, height) in pixels of the map.
Box = tuple[int, int, int, int]
_MARK = "#00d5ff"  # in neither depth's nor sigma's colours
# Inches.
_GAP, _MARGIN, _CAPTION, _BAR, _BARS, _TITLE = 0.06, 0.08, 0.2, 0.1, 0.62, 0.34


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
    """Pictures side by side, with a bold title and small lines at their left."""

    title: str
    lines: Sequence[str]
    panels: Sequence[Panel]

    def captioned(self, captions: Sequence[str]) -> GridRow:
        """The row with captions above its pictures."""
        panels = [replace(panel, caption=caption) for panel, caption in zip(self.panels, captions, strict=True)]
        return replace(self, panels=panels)


@dataclass(frozen=True)
class Bar:
    """A colour bar below some columns.

    Attributes:
        label: the quantity, with its unit.
        scale: the colours.
        column: the first column.
        span: number of columns.
        extend: which ends are open: "both", "min", "max" or "neither".
    """

    label: str
    scale: ColourScale
    column: int
    span: int = 1
    extend: str = "max"


def draw_grid(
    path: Path,
    rows: Sequence[GridRow],
    bars: Sequence[Bar],
    *,
    aspect: float,
    title: str = "",
    cell: float = 1.95,
    words: float = 1.5,
    dpi: int = 110,
) -> None:
    """Draw the rows below each other and write the picture (PNG), atomically.

    Args:
        path: the file; its folder must exist.
        rows: at least one.
        bars: below all rows.
        aspect: height by width of a picture.
        title: over all.
        cell: width of a picture [in].
        words: width of the words at the left [in].
        dpi: pixels per inch.

    Raises:
        ValueError: there is no row.
        ImportError: matplotlib is missing.
    """
    if not rows:
        raise ValueError("rows must hold at least one row of pictures")
    require_matplotlib()
    from matplotlib.figure import Figure

    letters = max(8, int(12 * words))
    layout = _Layout.of(rows, aspect, bool(title), cell, words, letters)
    figure = Figure(figsize=(layout.width, layout.height), dpi=dpi, facecolor="white")
    if title:
        x, y = _MARGIN / layout.width, 1 - 0.2 / layout.height
        figure.text(x, y, plain(title), size=11, weight="bold", color=INK, va="center")
    for number, row in enumerate(rows):
        _draw_words(figure, layout, number, row, letters)
        for column, panel in enumerate(row.panels):
            _draw_panel(figure.add_axes(layout.cell(number, column)), panel)
    for bar in bars:
        draw_bar(figure.add_axes(layout.bar(bar)), bar)
    _draw_legend(figure, layout)
    save_png(figure, path)


@dataclass(frozen=True)
class _Layout:
    """Positions on the sheet; lengths in inches, answers in shares of the figure."""

    columns: int
    cell_width: float
    cell_height: float
    words_width: float
    tall: tuple[float, ...]
    heads: tuple[float, ...]
    top: float

    @classmethod
    def of(
        cls, rows: Sequence[GridRow], aspect: float, title: bool, cell: float, words: float, letters: int
    ) -> _Layout:
        heads = tuple(_CAPTION if any(panel.caption for panel in row.panels) else 0.0 for row in rows)
        # Pictures of a driving car are flatter than the words beside them.
        beside = (_title_height(break_name(row.title, letters)) + 0.145 * len(row.lines) for row in rows)
        tall = tuple(max(cell * aspect, height) for height in beside)
        columns = max(len(row.panels) for row in rows)
        return cls(columns, cell, cell * aspect, words, tall, heads, _TITLE if title else _MARGIN)

    @property
    def width(self) -> float:
        return _MARGIN + self.words_width + self.columns * (self.cell_width + _GAP) - _GAP + _MARGIN

    @property
    def height(self) -> float:
        return self.top + len(self.tall) * _GAP + sum(self.tall) + sum(self.heads) + _BARS

    def cell(self, row: int, column: int) -> tuple[float, float, float, float]:
        """(left, bottom, width, height)."""
        above = self.top + sum(self.tall[:row]) + row * _GAP + sum(self.heads[: row + 1])
        return self._shares(
            self._left(column), self.height - above - self.cell_height, self.cell_width, self.cell_height
        )

    def bar(self, bar: Bar) -> tuple[float, float, float, float]:
        width = bar.span * (self.cell_width + _GAP) - _GAP
        return self._shares(self._left(bar.column) + 0.12, _BARS - 0.14 - _BAR, width - 0.24, _BAR)

    def _left(self, column: int) -> float:
        return _MARGIN + self.words_width + column * (self.cell_width + _GAP)

    def _shares(self, left: float, bottom: float, width: float, height: float) -> tuple[float, float, float, float]:
        return left / self.width, bottom / self.height, width / self.width, height / self.height


def _draw_words(figure: Any, layout: _Layout, number: int, row: GridRow, letters: int) -> None:
    _, bottom, _, height = layout.cell(number, 0)
    x, y = _MARGIN / layout.width, bottom + height
    title = break_name(row.title, letters)
    figure.text(x, y, plain(title), size=8.5, weight="bold", color=INK, va="top", linespacing=1.15)
    down = _title_height(title) / layout.height
    figure.text(x, y - down, plain("\n".join(row.lines)), size=7.5, color=FAINT, va="top", linespacing=1.3)


def _title_height(title: str) -> float:
    """Of a row's broken title with the space below it [in]."""
    return 0.16 * (title.count("\n") + 1) + 0.05


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
        axes.set_title(plain(panel.caption), size=8, color=INK, pad=2.5)
    if panel.rgb is None:
        axes.text(0.5, 0.5, panel.absent, color=FAINT, size=8, ha="center", va="center", transform=axes.transAxes)
        return
    axes.imshow(panel.rgb, aspect="auto", interpolation="antialiased")
    if panel.box is not None:
        from matplotlib.patches import Rectangle

        left, top, width, height = panel.box
        corner = (left - 0.5, top - 0.5)
        axes.add_patch(Rectangle(corner, width, height, fill=False, edgecolor=_MARK, linewidth=1.4))


def draw_bar(axes: Any, bar: Bar) -> None:
    """A horizontal colour bar with its label in the axes; an open end has an arrow."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.ticker import MaxNLocator

    drawn = axes.figure.colorbar(
        ScalarMappable(Normalize(bar.scale.low, bar.scale.high), bar.scale.colour_map),
        cax=axes,
        orientation="horizontal",
        extend=bar.extend,
        extendfrac=0.03,
        ticks=MaxNLocator(5 * bar.span, steps=[1, 2, 5, 10]),
    )
    drawn.ax.tick_params(labelsize=7.5, length=2.5, pad=2, color=INK, labelcolor=INK)
    drawn.outline.set_linewidth(0.5)
    drawn.set_label(bar.label, size=7.5, color=INK, labelpad=1)


def _draw_legend(figure: Any, layout: _Layout) -> None:
    """What grey means, left of the bars."""
    from matplotlib.patches import Rectangle

    left, bottom = _MARGIN / layout.width, (_BARS - 0.14 - _BAR) / layout.height
    size = (0.12 / layout.width, _BAR / layout.height)
    grey = (INVALID_GREY / 255,) * 3
    figure.add_artist(Rectangle((left, bottom), *size, color=grey, transform=figure.transFigure))
    x, y = left + 0.18 / layout.width, bottom + size[1] / 2
    figure.text(x, y, "no value, no truth", size=7.5, color=FAINT, va="center")


# ---- the contact sheet: image | depth | sigma | error, one row per frame ----


@dataclass(frozen=True)
class FramePanel:
    """One frame to be shown.

    Attributes:
        name: of the frame.
        image: [H, W, 3] uint8 RGB; may have another size than the maps.
        depth: [h, w] [m].
        sigma: [h, w] standard deviation [m].
        error: [h, w] |depth - ground truth| [m], NaN where there is none; or None for no ground truth at all.
        valid: [h, w] bool, True where depth and sigma hold; None = everywhere finite.
        note: a short line beside the name, "K = 31" say.
        anchored: [h, w] the part of sigma that is due to anchors, sqrt(B) [m]; None of a run without.
        posterior, posterior_sigma, posterior_error: [h, w] the same three of the posterior [m]; None of a run without.

    Raises:
        ValueError: shapes or types disagree.
    """

    name: str
    image: NDArray[np.uint8]
    depth: NDArray[Any]
    sigma: NDArray[Any]
    error: NDArray[Any] | None = None
    valid: NDArray[np.bool_] | None = None
    note: str = ""
    anchored: NDArray[Any] | None = None
    posterior: NDArray[Any] | None = None
    posterior_sigma: NDArray[Any] | None = None
    posterior_error: NDArray[Any] | None = None

    def __post_init__(self) -> None:
        if self.image.ndim != 3 or self.image.shape[-1] != 3 or self.image.dtype != np.uint8:
            raise ValueError(f"image must be uint8 [H, W, 3], got {self.image.dtype} {self.image.shape}")
        of_posterior = ("posterior", "posterior_sigma", "posterior_error")
        for label in ("sigma", "error", "valid", "anchored", *of_posterior):
            value = getattr(self, label)
            if value is not None and value.shape != self.depth.shape:
                raise ValueError(f"{label} must have the depth's shape {self.depth.shape}, got {value.shape}")


# Maps that share the scale of sigma and error.
_LENGTHS = ("sigma", "error", "posterior_sigma", "posterior_error")


@dataclass(frozen=True)
class PanelScales:
    """The colour scales that all frames of a sheet or a video share: of depth, and of sigma and error together."""

    depth: ColourScale
    length: ColourScale


@dataclass(frozen=True)
class MapColumn:
    """One kind of map: its name, its scale, and the field of ``FramePanel`` that holds it."""

    label: str
    scale: ColourScale
    field: str

    def rgb(self, panel: FramePanel) -> NDArray[np.uint8] | None:
        """[h, w, 3] the coloured map, None if the panel has none."""
        values = getattr(panel, self.field)
        return None if values is None else self.scale.rgb(values, panel.valid)


def fit_scales(panels: Sequence[FramePanel]) -> PanelScales:
    """Scales over all panels: depths between their 1st and 99th percentile; sigma and error share one, from 0.

    That one ends at the larger of their 99th percentiles, so that a sigma as large as the error has its colour.
    """
    corrected = [(p.posterior, p.valid) for p in panels if p.posterior is not None]
    depth = robust_range([*((p.depth, p.valid) for p in panels), *corrected], from_zero=False)
    maps = ([(getattr(p, name), p.valid) for p in panels] for name in _LENGTHS)
    ranges = [robust_range(known, from_zero=True) for of in maps if (known := [m for m in of if m[0] is not None])]
    return PanelScales(ColourScale(*depth, DEPTH_MAP), ColourScale(0.0, max(high for _, high in ranges), ERROR_MAP))


def map_columns(
    scales: PanelScales,
    *,
    with_error: bool,
    with_anchored: bool = False,
    with_posterior: bool = False,
) -> list[MapColumn]:
    """The columns right of the image: depth, sigma, what anchors add, the error; with a
    posterior depth, sigma and error before and after."""
    columns = [MapColumn("depth", scales.depth, "depth")]
    if with_posterior:
        columns += [MapColumn("posterior", scales.depth, "posterior"), MapColumn("σ", scales.length, "sigma")]
        columns += [MapColumn("|error|", scales.length, "error")] if with_error else []
        columns += [MapColumn("σ, posterior", scales.length, "posterior_sigma")]
        return columns + ([MapColumn("|error|, posterior", scales.length, "posterior_error")] if with_error else [])
    columns += [MapColumn("σ", scales.length, "sigma")]
    columns += [MapColumn("√B", scales.length, "anchored")] if with_anchored else []
    return columns + ([MapColumn("|error|", scales.length, "error")] if with_error else [])


def contact_sheet(
    panels: Sequence[FramePanel],
    path: str | Path,
    *,
    title: str = "",
    scales: PanelScales | None = None,
    columns: Sequence[MapColumn] | None = None,
    dpi: int = 110,
) -> PanelScales:
    """Draw the frames below each other and write the picture (PNG), atomically.

    Neighbouring columns of one scale share a colour bar; invalid pixels are grey.

    Args:
        panels: at least one; three to six rows read well.
        path: the file; its folder must exist.
        title: over the sheet.
        scales: None = ``fit_scales(panels)``.
        columns: right of the image; None = all maps that some panel has.
        dpi: pixels per inch.

    Returns:
        The scales that were used.

    Raises:
        ValueError: there is no panel.
        ImportError: matplotlib is missing.
    """
    if not panels:
        raise ValueError("panels must hold at least one frame")
    require_matplotlib()
    used = fit_scales(panels) if scales is None else scales
    if columns is None:
        fields = ("error", "anchored", "posterior")
        has = {name: any(getattr(p, name) is not None for p in panels) for name in fields}
        columns = map_columns(used, **{f"with_{name}": shown for name, shown in has.items()})
    rows = [
        GridRow(p.name, p.note.split(", ") if p.note else [], [Panel(p.image), *(_map_panel(c, p) for c in columns)])
        for p in panels
    ]
    rows[0] = rows[0].captioned(["image", *(column.label for column in columns)])
    bars, position = [], 1
    for scale, of_scale in groupby(columns, key=lambda column: column.scale):
        labels = [column.label for column in of_scale]
        words = f"{', '.join(labels) if len(labels) < 3 else 'σ and |error|'} [m]"
        bars.append(Bar(words, scale, position, len(labels), "max" if scale.low == 0 else "both"))
        position += len(labels)
    height, width = panels[0].depth.shape
    draw_grid(Path(path), rows, bars, aspect=height / width, title=title, cell=2.4, words=1.2, dpi=dpi)
    return used


def _map_panel(column: MapColumn, panel: FramePanel) -> Panel:
    return Panel(column.rgb(panel), absent="no ground truth" if column.field == "error" else "none")
