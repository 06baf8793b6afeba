"""The pictures of a report: choice of frames and rows, drawing, and captions."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from hashlib import sha256
from itertools import groupby, zip_longest
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ufmstar_torch.eval.methods.method import ALONE, UFM, UFM_STAR, Method
from ufmstar_torch.eval.methods.row import Row, plain_rows
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.examples import PARTS, Example, RowMaps, find_examples
from ufmstar_torch.eval.report.quantities import row_labels
from ufmstar_torch.eval.run.colours import DEPTH_MAP, ERROR_MAP, ColourScale, robust_range, striped
from ufmstar_torch.eval.run.panels import Bar, GridRow, Panel, draw_grid

OVERVIEW, STRIP, BREAKDOWN, COMPARE = "overview", "strip", "breakdown", "compare"
MOST_FRAMES = 4  # keeps a report of a hundred sequences readable and small
_BREAKDOWN_BASES = ("ensemble", "aleatoric")
# [nats] One scale for all strips, so that they can be compared. 6 is an error of about 3.5 sigma (for sigma = .3 m); a
# larger range would reduce the contrast of the rest. The map differs from those of depth and lengths, and has no grey.
NLL_SCALE = ColourScale(-2.0, 6.0, "plasma")
DIFFERENCE_MAP = "RdBu_r"


class Picture(NamedTuple):
    """One picture with its title and caption."""

    file: str  # name within the figures' folder
    title: str
    caption: str
    rows: tuple[str, ...] = ()  # labels of the displayed rows


Drawing = tuple[str, Callable[[], Picture]]


def pictures_of(results: Results, folder: Path) -> Iterator[Drawing]:
    """Yield name and function of strips, breakdowns and comparisons of the example frames. The function writes
    the picture into ``folder``. Raises ValueError: an example cannot be read; the message names the file.
    """
    labels = {row.slug: label for row, label in row_labels(results.rows).items()}
    examples = [e for key in results.sequences() for e in find_examples(results.folder(*key), *key, labels)]
    chosen = choose(examples, MOST_FRAMES)
    yield from _overview(results, folder, chosen)
    for e in chosen:
        yield from _of_frame(results, folder, e)


def file_name(*parts: str) -> str:
    """A file name for a PNG from arbitrary names; some digits of a digest keep it unique."""
    short = re.sub(r"[^A-Za-z0-9.-]+", "-", "_".join(parts).replace("*", "star"))[:100].strip("-.")
    return f"{short}_{sha256(repr(parts).encode()).hexdigest()[:6]}.png"


# ---- choice of frames and rows ----


def choose(examples: Sequence[Example], most: int) -> list[Example]:
    """Frames of as many sequences as possible, the last frame of each first: by then most surfaces were seen twice."""
    groups = [list(of)[::-1] for _, of in groupby(examples, key=lambda e: (e.dataset, e.sequence))]
    first = [example for turn in zip_longest(*groups) for example in turn if example is not None][:most]
    return [example for group in groups for example in group if example in first]


def strip_rows(rows: Sequence[Row], base: str) -> list[Row]:
    """A base's rows for a strip as in the paper, with default settings: alone, UfM (pruned if possible), UfM*."""
    of_base = [row for row in plain_rows(rows) if row.method.base == base]
    default = [row for row in of_base if not (row.method.full or row.method.fixed_param)]
    points = sorted((r for r in default if r.method.fusion == UFM), key=lambda r: r.method.max_points is None)
    alone, star = ([row for row in default if row.method.fusion == fusion] for fusion in (ALONE, UFM_STAR))
    return [*alone, *points[:1], *star]


def _overview(results: Results, folder: Path, examples: Sequence[Example]) -> Iterator[Drawing]:
    """The overview of the last frame of the first sequence, if a base has UfM* alone and with a posterior."""
    first = [e for e in examples if (e.dataset, e.sequence) == (examples[0].dataset, examples[0].sequence)]
    for e in first[-1:]:
        shown = [row for row in results.rows if row.slug in e.rows and row.method.fusion == UFM_STAR]
        for corrected in (row for row in shown if row.setting.posterior):
            alone = next((row for row in shown if row.method == corrected.method and row.setting.plain), None)
            if alone is not None:
                yield f"{e.title}: overview", partial(draw_overview, folder, e, alone.slug, corrected.slug)
                return


def _of_frame(results: Results, folder: Path, e: Example) -> Iterator[Drawing]:
    shown = [row for row in results.rows if row.slug in e.rows]
    strips = {base: strip_rows(shown, base) for base in dict.fromkeys(row.method.base for row in shown)}
    for base, strip in strips.items():
        corrected = [row for row in shown if row.method.base == base and row.setting.posterior]
        if slugs := [row.slug for row in (*strip, *corrected)]:
            yield f"{e.title}: strip of {base}", partial(draw_strip, folder, e, slugs, base)
    parts = [row for base in _BREAKDOWN_BASES for row in strips.get(base, ()) if row.method.fusion != UFM]
    if any(row.method.fusion == UFM_STAR for row in parts):
        yield f"{e.title}: breakdown", partial(draw_breakdown, folder, e, [row.slug for row in parts])
    for base, strip in strips.items():
        pair = [row.slug for row in strip if row.method.fusion != ALONE]
        if len(pair) == 2:
            yield f"{e.title}: comparison of {base}", partial(draw_comparison, folder, e, pair, base)


# ---- drawing: each function writes its PNG into the folder and returns the Picture ----


def fit_strip_scales(example: Example, rows: Sequence[str]) -> tuple[ColourScale, ColourScale]:
    """Scales over the truth and these rows of a frame: of depth from the 1st to the 99th percentile, of sigma and error
    together from 0 to the 99th."""
    shown = [example.rows[row] for row in rows]
    depth = robust_range([example.truth, *(maps.depth for maps in shown)], from_zero=False)
    length = robust_range([m for maps in shown for m in (maps.error, maps.sigma)], from_zero=True)
    return ColourScale(*depth, DEPTH_MAP), ColourScale(*length, ERROR_MAP)


def draw_overview(folder: Path, example: Example, plain: str, corrected: str) -> Picture:
    """The image above the truth; depth, standard deviation and error of UfM* alone above those of the posterior."""
    rows = (plain, corrected)
    depth, length = fit_strip_scales(example, rows)
    body = []
    first = (Panel(example.image, "image"), Panel(depth.rgb(example.truth), "true depth"))
    for row, panel, title in zip(rows, first, ("UfM* alone", "posterior"), strict=True):
        maps = example.rows[row]
        panels = (depth.rgb(maps.depth), _sigma(maps, length), length.rgb(maps.error))
        captions = ("depth", "standard deviation σ", "true error")
        body.append(GridRow(title, figures_of(maps), [panel, *map(Panel, panels, captions)]))
    bars = [Bar("depth [m]", depth, 0, span=2), Bar("σ and error [m]", length, 2, span=2)]
    name = file_name(OVERVIEW, example.dataset, example.sequence, example.frame)
    draw_grid(folder / name, body, bars, aspect=example.aspect)
    caption = "A good standard deviation looks like the error beside it. Above: the network's depth; below: corrected."
    return Picture(name, f"{example.title}: UfM* alone and with the posterior", caption)


def draw_strip(folder: Path, example: Example, rows: Sequence[str], base: str) -> Picture:
    """Image and truth, then depth, error, standard deviation and NLL of each row of a base, on common scales."""
    depth, length = fit_strip_scales(example, rows)
    truth = Panel(depth.rgb(example.truth), "ground truth")
    body = []
    for row in rows:
        maps = example.rows[row]
        panels = (depth.rgb(maps.depth), length.rgb(maps.error), _sigma(maps, length), NLL_SCALE.rgb(maps.nll))
        body.append(GridRow(example.labels[row], figures_of(maps), [Panel(rgb) for rgb in panels]))
    body[0] = body[0].captioned(("predicted depth", "|error|", "σ = √V", "NLL"))
    head = GridRow(example.sequence, [f"frame {example.frame}"], [Panel(example.image, "image"), truth])
    bars = [Bar("depth [m]", depth, 0), Bar("|error| and σ [m]", length, 1, span=2), Bar("NLL [nats]", NLL_SCALE, 3)]
    name = file_name(STRIP, example.dataset, example.sequence, example.frame, base)
    draw_grid(folder / name, [head, *body], bars, aspect=example.aspect)
    caption = (
        "A good standard deviation σ looks like the error beside it. NLL is bright where a row is overconfident; its "
        "colours are the same in all strips. Lengths share one scale."
    )
    return Picture(name, f"{example.title}: {Method(base).name}", caption, tuple(example.labels[row] for row in rows))


def draw_breakdown(folder: Path, example: Example, rows: Sequence[str]) -> Picture:
    """The parts of each row's variance: sqrt of A, E, M and V, with the error and the NLL."""
    _, length = fit_strip_scales(example, rows)
    body = []
    for row in rows:
        maps = example.rows[row]
        a, e, m = (length.rgb(maps.roots[part]) if part in maps.roots else None for part in PARTS)
        parts = [Panel(rgb, absent="none") for rgb in (a, e, None if m is None else striped(m, maps.unmeasured))]
        judged = (_sigma(maps, length), length.rgb(maps.error), NLL_SCALE.rgb(maps.nll))
        body.append(GridRow(example.labels[row], figures_of(maps), [*parts, *map(Panel, judged)]))
    captions = ("√A, aleatoric", "√E, epistemic", "√M, between views", "σ = √V, V = A + E + M", "|error|", "NLL")
    body[0] = body[0].captioned(captions)
    bars = [Bar("√A, √E, √M, σ and |error| [m]", length, 0, span=5), Bar("NLL [nats]", NLL_SCALE, 5)]
    name = file_name(BREAKDOWN, example.dataset, example.sequence, example.frame)
    draw_grid(folder / name, body, bars, aspect=example.aspect)
    caption = (
        "The parts add up as variances, V = A + E + M; shown are their square roots, in metres, on one scale with the "
        "error. A and E are the network's own, M is the disagreement between the views."
    )
    return Picture(name, f"{example.title}: parts of the variance", caption)


def draw_comparison(folder: Path, example: Example, pair: Sequence[str], base: str) -> Picture:
    """Image, error, sigma by UfM and by UfM*, and UfM* minus UfM."""
    _, length = fit_strip_scales(example, pair)
    old, new = (example.rows[row] for row in pair)
    name_old, name_new = (example.labels[row] for row in pair)
    limit = robust_range([np.abs(new.sigma - old.sigma)], from_zero=True)[1]
    signed = ColourScale(-limit, limit, DIFFERENCE_MAP)
    panels = [
        Panel(example.image, "image"),
        Panel(length.rgb(new.error), "|error| of UfM*"),
        Panel(_sigma(old, length), "σ of UfM"),
        Panel(_sigma(new, length), "σ of UfM*"),
        Panel(signed.rgb(new.sigma - old.sigma), "difference of σ"),
    ]
    lines = [f"frame {example.frame}", "UfM:", *figures_of(old), "UfM*:", *figures_of(new)]
    bars = [Bar("|error| and σ [m]", length, 1, span=3), Bar("UfM* minus UfM [m]", signed, 4)]
    name = file_name(COMPARE, example.dataset, example.sequence, example.frame, base)
    draw_grid(folder / name, [GridRow(example.sequence, lines, panels)], bars, aspect=example.aspect)
    caption = "Red: UfM* has the larger standard deviation; blue: the smaller."
    return Picture(name, f"{example.title}: {name_new} against {name_old}", caption)


def _sigma(maps: RowMaps, scale: ColourScale) -> np.ndarray:
    return striped(scale.rgb(maps.sigma), maps.assumed)


def figures_of(maps: RowMaps) -> list[str]:
    """A row's figures on a frame, one line each: mean NLL, RMSE, and the expected RMSE."""
    judged = np.isfinite(maps.error)
    if not judged.any():
        return ["no ground truth"]
    rmse, rms_sigma = (np.sqrt(np.square(m[judged], dtype=np.float64).mean()) for m in (maps.error, maps.sigma))
    nll = "no NLL: V = 0" if maps.mean_nll is None else f"mean NLL {maps.mean_nll:.2f}"
    return [nll, f"RMSE {rmse:.2f} m", f"rms σ {rms_sigma:.2f} m"]
