"""The contact sheet: image | depth | sigma | error, one row per frame, on common scales with units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.report.colours import (
    DEPTH_MAP,
    ERROR_MAP,
    INVALID_GREY,
    PERCENTILES,
    ColourScale,
    require_matplotlib,
    robust_range,
)
from ufmstar_torch.eval.results.files import write_atomic


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

    def __post_init__(self) -> None:
        if self.image.ndim != 3 or self.image.shape[-1] != 3 or self.image.dtype != np.uint8:
            raise ValueError(f"image must be uint8 [H, W, 3], got {self.image.dtype} {self.image.shape}")
        for label in ("sigma", "error", "valid", "anchored"):
            value = getattr(self, label)
            if value is not None and value.shape != self.depth.shape:
                raise ValueError(f"{label} must have the depth's shape {self.depth.shape}, got {value.shape}")


@dataclass(frozen=True)
class PanelScales:
    """The colour scales that all frames of a sheet or a video share."""

    depth: ColourScale
    sigma: ColourScale
    error: ColourScale


@dataclass(frozen=True)
class Column:
    """One kind of map: what it is called, its scale, and its pixels in a panel."""

    label: str
    scale: ColourScale
    field: str

    def rgb(self, panel: FramePanel) -> NDArray[np.uint8] | None:
        """[h, w, 3] the coloured map, None if the panel has none."""
        values = getattr(panel, self.field)
        return None if values is None else self.scale.rgb(values, panel.valid)


def fit_scales(panels: Sequence[FramePanel]) -> PanelScales:
    """Scales over all panels: depth between its 1st and 99th percentile, sigma and error from 0 to theirs."""
    depth = robust_range([(p.depth, p.valid) for p in panels], from_zero=False)
    sigma = robust_range([(p.sigma, p.valid) for p in panels], from_zero=True)
    error = robust_range([(p.error, p.valid) for p in panels if p.error is not None], from_zero=True)
    return PanelScales(ColourScale(*depth, DEPTH_MAP), ColourScale(*sigma, ERROR_MAP), ColourScale(*error, ERROR_MAP))


def map_columns(scales: PanelScales, *, with_error: bool, with_anchored: bool = False) -> list[Column]:
    """The columns right of the image; what anchors add is on the scale of sigma."""
    columns = [Column("depth", scales.depth, "depth"), Column("σ", scales.sigma, "sigma")]
    columns += [Column("√B", scales.sigma, "anchored")] if with_anchored else []
    return [*columns, Column("|error|", scales.error, "error")] if with_error else columns


# Inches.
CELL_WIDTH, GAP, LEFT, RIGHT, TOP, BAR, BOTTOM = 2.6, 0.06, 0.34, 0.2, 0.66, 0.11, 0.72
INK, FAINT = "#1a1a1a", "#6b6b6b"


def contact_sheet(
    panels: Sequence[FramePanel],
    path: str | Path,
    *,
    title: str = "",
    scales: PanelScales | None = None,
    columns: Sequence[Column] | None = None,
    dpi: int = 110,
) -> PanelScales:
    """Draw the frames below each other and write the picture (PNG), atomically.

    Every column has one colour scale for all rows, drawn below it with its unit; invalid pixels are
    grey. Matplotlib's global state is left alone.

    Args:
        panels: at least one; some six rows read well.
        path: the file; its folder must exist.
        title: over the sheet.
        scales: None = ``fit_scales(panels)``.
        columns: right of the image; None = depth, sigma and, where a panel has one, sqrt(B) and the error.
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
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    used = fit_scales(panels) if scales is None else scales
    if columns is None:
        with_error, with_anchored = (
            any(getattr(p, name) is not None for p in panels) for name in ("error", "anchored")
        )
        columns = map_columns(used, with_error=with_error, with_anchored=with_anchored)
    grid = _Grid.of(panels, columns=1 + len(columns), title=bool(title))
    figure = Figure(figsize=(grid.width, grid.height), dpi=dpi, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    if title:
        figure.text(LEFT / grid.width, 1 - 0.2 / grid.height, title, size=12, weight="bold", color=INK, va="center")
    for column, label in enumerate(["image", *(c.label for c in columns)]):
        x, y = grid.head(column)
        figure.text(x, y, label, size=10, color=INK, ha="center", va="bottom")
    for row, panel in enumerate(panels):
        _draw_row(figure, grid, row, panel, columns)
    for number, column_ in enumerate(columns, start=1):
        _draw_bar(figure, grid.bar(number), column_)
    _draw_footnote(figure, grid)
    write_atomic(Path(path), lambda file: canvas.print_png(file))
    return used


_Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class _Grid:
    """Where things stand on the sheet; lengths in inches, answers in shares of the figure."""

    rows: int
    columns: int
    cell_height: float
    top: float

    @classmethod
    def of(cls, panels: Sequence[FramePanel], *, columns: int, title: bool) -> _Grid:
        height, width = panels[0].depth.shape
        return cls(len(panels), columns, CELL_WIDTH * height / width, TOP if title else TOP - 0.34)

    @property
    def width(self) -> float:
        return LEFT + self.columns * CELL_WIDTH + (self.columns - 1) * GAP + RIGHT

    @property
    def height(self) -> float:
        return self.top + self.rows * (self.cell_height + GAP) + BOTTOM

    def cell(self, row: int, column: int) -> _Box:
        """(left, bottom, width, height)."""
        left = LEFT + column * (CELL_WIDTH + GAP)
        bottom = self.height - self.top - (row + 1) * self.cell_height - row * GAP
        return self._shares(left, bottom, CELL_WIDTH, self.cell_height)

    def bar(self, column: int) -> _Box:
        left = LEFT + column * (CELL_WIDTH + GAP)
        return self._shares(left + 0.1, BOTTOM - 0.08 - BAR, CELL_WIDTH - 0.2, BAR)

    def head(self, column: int) -> tuple[float, float]:
        left, bottom, width, height = self.cell(0, column)
        return left + width / 2, bottom + height + 0.04 / self.height

    def _shares(self, left: float, bottom: float, width: float, height: float) -> _Box:
        return left / self.width, bottom / self.height, width / self.width, height / self.height


def _draw_row(figure: Any, grid: _Grid, row: int, panel: FramePanel, columns: Sequence[Column]) -> None:
    """The image and the maps of one frame, its name upright at the left."""
    for column, picture in enumerate([panel.image, *(c.rgb(panel) for c in columns)]):
        axes = figure.add_axes(grid.cell(row, column))
        axes.set_axis_off()
        if picture is None:
            axes.text(0.5, 0.5, "no ground truth", color=FAINT, size=9, ha="center", va="center")
        else:
            axes.imshow(picture, aspect="auto", interpolation="antialiased")
    _, bottom, _, height = grid.cell(row, 0)
    # A letter of size 8 is .066 inches wide; flat images (driving) leave room for the name or the note alone.
    gap = "   " if 0.066 * (len(panel.name) + len(panel.note) + 3) < grid.cell_height else "\n"
    label = f"{panel.name}{gap}{panel.note}".strip()
    figure.text(
        (LEFT - 0.06) / grid.width,
        bottom + height / 2,
        label,
        size=8,
        color=FAINT,
        rotation=90,
        ha="right",
        va="center",
        multialignment="center",
        linespacing=1.1,
    )


def _draw_bar(figure: Any, place: _Box, column: Column) -> None:
    """A colour bar with the unit; its ends are open because values beyond get the same colour."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.ticker import MaxNLocator

    scale = column.scale
    extend = "max" if scale.low == 0 else "both"
    bar = figure.colorbar(
        ScalarMappable(Normalize(scale.low, scale.high), scale.colour_map),
        cax=figure.add_axes(place),
        orientation="horizontal",
        extend=extend,
        extendfrac=0.03,
        ticks=MaxNLocator(5, steps=[1, 2, 5, 10]),
    )
    bar.ax.tick_params(labelsize=8, length=2.5, pad=2, color=INK, labelcolor=INK)
    bar.outline.set_linewidth(0.5)
    bar.set_label(f"{column.label} [m]", size=8, color=INK, labelpad=1)


def _draw_footnote(figure: Any, grid: _Grid) -> None:
    """What the reader must know to read the colours, below the images."""
    from matplotlib.patches import Rectangle

    left, _, _, _ = grid.cell(0, 0)
    low, high = PERCENTILES
    lines = [f"depth: percentile {low:g} to {high:g} of all rows", f"σ, |error|: 0 to percentile {high:g}", "invalid"]
    for number, line in enumerate(lines):
        indent = 0.16 if line == "invalid" else 0.0
        y = (BOTTOM - 0.14 - 0.16 * number) / grid.height
        figure.text(left + indent / grid.width, y, line, size=7.5, color=FAINT, va="center")
    swatch = Rectangle(
        (left, y - 0.05 / grid.height),
        0.11 / grid.width,
        0.1 / grid.height,
        color=(INVALID_GREY / 255,) * 3,
        transform=figure.transFigure,
    )
    figure.add_artist(swatch)
