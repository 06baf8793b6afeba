"""The pictures of a report: which frames and rows, how they are drawn, and the words that go with them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from hashlib import sha256
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ufmstar_torch.eval.methods.method import ALONE, UFM, UFM_STAR, Method
from ufmstar_torch.eval.methods.row import Row, plain_rows
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.examples import Example, find_examples
from ufmstar_torch.eval.report.names import row_labels
from ufmstar_torch.eval.report.rooms import Snapshot, choose_times, draw_room, find_rooms
from ufmstar_torch.eval.run.colours import DEPTH_MAP, ERROR_MAP, ColourScale, robust_range
from ufmstar_torch.eval.run.panels import Bar, GridRow, Panel, draw_grid
from ufmstar_torch.eval.suite.work_items import WorkItem

STRIP, BREAKDOWN, COMPARE, ROOM = "strip", "breakdown", "compare", "room"
# So that a report of a hundred sequences stays one that can be read, and mailed.
MOST_FRAMES, MOST_ROOMS = 4, 3
_BREAKDOWN_BASES = ("ensemble", "aleatoric")
# [nats] The same in all strips, so that they can be compared. 6 is an error of some 3.5 sigma (of sigma = .3 m): beyond
# it a row is simply wrong there, and how much more so would only flatten the rest of the map. Its map is neither
# depth's nor that of lengths, and has no grey.
NLL_SCALE = ColourScale(-2.0, 6.0, "plasma")
DIFFERENCE_MAP = "RdBu_r"


class Picture(NamedTuple):
    """One picture and its words."""

    file: str  # name within the figures' folder
    title: str
    caption: str  # how to read it
    alt: str  # for a reader who cannot see it


def pictures_of(results: Results, folder: Path) -> Iterator[tuple[str, Callable[[], Picture]]]:
    """Name and function of strips, breakdowns, comparisons and rooms of the example frames; the function writes the
    picture into ``folder``. Raises ValueError: an example cannot be read; the message names the file.
    """
    yield from _of_frames(results, folder)
    yield from _of_rooms(results, folder)


def file_name(*parts: str) -> str:
    """A name for a PNG from names of users; a few letters of a digest keep names apart that would look alike."""
    short = re.sub(r"[^A-Za-z0-9.-]+", "-", "_".join(parts).replace("*", "star"))[:100].strip("-.")
    return f"{short}_{sha256(repr(parts).encode()).hexdigest()[:6]}.png"


# ---- which frames and rows ----

Drawing = tuple[str, Callable[[], Picture]]


def choose(examples: Sequence[Example], most: int) -> list[Example]:
    """Frames of as many sequences as possible: the last of each first, since by then most has been seen twice."""
    turns = [
        (turn, number, example)
        for number, (_, group) in enumerate(groupby(examples, key=lambda e: (e.dataset, e.sequence)))
        for turn, example in enumerate(reversed(list(group)))
    ]
    first = sorted(turns, key=lambda entry: entry[:2])[:most]
    return [example for _, _, example in sorted(first, key=lambda entry: (entry[1], entry[0]))]


def strip_rows(rows: Sequence[Row], base: str) -> list[Row]:
    """A base's rows for a strip, as the paper's: alone, UfM (pruned if there is such), UfM*; of default settings."""
    of_base = [row for row in plain_rows(rows) if row.method.base == base and not row.method.full]
    default = [row for row in of_base if not row.method.fixed_param]
    by_fusion = {fusion: [row for row in default if row.method.fusion == fusion] for fusion in (ALONE, UFM, UFM_STAR)}
    pruned = [row for row in by_fusion[UFM] if row.method.max_points is not None]
    return [*by_fusion[ALONE], *(pruned or by_fusion[UFM])[:1], *by_fusion[UFM_STAR]]


def _of_frames(results: Results, folder: Path) -> Iterator[Drawing]:
    labels = {row.slug: label for row, label in row_labels(results.rows).items()}
    examples = [
        replace(example, dataset=dataset, sequence=sequence)
        for dataset, sequence in results.sequences()
        for example in find_examples(_folder_of(results, dataset, sequence), labels)
    ]
    for e in choose(examples, MOST_FRAMES):
        shown = [row for row in results.rows if row.slug in e.rows]
        bases = dict.fromkeys(row.method.base for row in shown)
        strips = {base: strip_rows(shown, base) for base in bases}
        frame = f"{e.sequence}, frame {e.frame}"
        for base, strip in strips.items():
            corrected = [row for row in shown if row.method.base == base and row.setting.posterior]
            if of_base := [row.slug for row in (*strip, *corrected)]:
                yield f"{frame}: strip of {base}", partial(draw_strip, folder, e, of_base, base)
        parts = [row for base in _BREAKDOWN_BASES for row in strips.get(base, ()) if row.method.fusion != UFM]
        if any(row.method.fusion == UFM_STAR for row in parts):
            yield f"{frame}: breakdown", partial(draw_breakdown, folder, e, [row.slug for row in parts])
        for base, strip in strips.items():
            pair = [row.slug for row in strip if row.method.fusion != ALONE]
            if len(pair) == 2:
                yield f"{frame}: comparison of {base}", partial(draw_comparison, folder, e, pair, base)


def _of_rooms(results: Results, folder: Path) -> Iterator[Drawing]:
    drawn = 0
    for dataset, sequence in results.sequences():
        rooms = find_rooms(_folder_of(results, dataset, sequence))
        # One row of each room is enough: the suite's first UfM* with its default settings.
        row = next((row for row in results.rows if row.slug in rooms and row.setting.plain), None)
        if row is None or drawn == MOST_ROOMS:
            continue
        snapshots = choose_times(rooms[row.slug])
        if any(len(snapshot.mean) for snapshot in snapshots):
            drawn += 1
            path = folder / file_name(ROOM, dataset, sequence, row.slug)
            yield f"{sequence}: room", partial(_room, path, row_labels([row])[row], sequence, snapshots)


def _folder_of(results: Results, dataset: str, sequence: str) -> Path:
    """The folder of a sequence, whose name need not be fit for one."""
    return results.out / "records" / WorkItem(dataset, sequence, path="", layout="").folder


# ---- drawing: each writes its PNG into the folder and returns its words ----


def _picture(
    folder: Path,
    example: Example,
    rows: Sequence[str],
    kind: str,
    base: str,
    words: tuple[str, str],
    grid: Sequence[GridRow],
    bars: Sequence[Bar],
) -> Picture:
    """Draw a grid; its ``words`` are title and caption. Rows are listed with their mean NLL for those who cannot see
    it."""
    means = ((example.label(row), mean_nll(example, row)) for row in rows)
    listed = ", ".join(f"{label} ({'no NLL' if nll is None else f'mean NLL {nll:.2f}'})" for label, nll in means)
    name = file_name(kind, example.dataset, example.sequence, example.frame, *filter(None, (base,)))
    draw_grid(folder / name, grid, bars, aspect=example.aspect)
    title = f"{example.sequence}, frame {example.frame}: {words[0]}"
    return Picture(name, title, words[1], f"{title}; {listed}")


def _room(path: Path, label: str, sequence: str, snapshots: Sequence[Snapshot]) -> Picture:
    scale = draw_room(path, snapshots, f"{label}, {sequence}")
    counts = " then ".join(str(len(snapshot.mean)) for snapshot in snapshots)
    caption = (
        "Each Gaussian is an ellipse as large as the patch it stands for. What lies above the camera (the ceiling) is "
        "left out. Grey: seen from one view only. Black: no disagreement. Blue: the camera's path."
    )
    title = f"{sequence}: the Gaussians of {label}"
    alt = f"{title}: {counts} Gaussians, coloured by disagreement from 0 to {scale.high:.2g} m"
    return Picture(path.name, title, caption, alt)


class PanelScales(NamedTuple):
    """The colour scales of a frame's pictures: of depth, and of sigma and error together."""

    depth: ColourScale
    length: ColourScale


def fit_strip_scales(example: Example, rows: Sequence[str]) -> PanelScales:
    """Scales over the truth and these rows of a frame: depth between percentiles 1 and 99, lengths from 0 to 99."""
    depths = [example.known_truth, *(example.rows[row].known_depth for row in rows)]
    lengths = [value for row in rows for value in (example.error(row), example.rows[row].sigma)]
    depth, length = robust_range(depths, from_zero=False), robust_range(lengths, from_zero=True)
    return PanelScales(ColourScale(*depth, DEPTH_MAP), ColourScale(*length, ERROR_MAP))


def draw_strip(folder: Path, example: Example, rows: Sequence[str], base: str) -> Picture:
    """Image and truth, then depth, error, standard deviation and NLL of each row of a base, on common scales."""
    scales = fit_strip_scales(example, rows)
    truth = Panel(scales.depth.rgb(example.known_truth), "ground truth")
    head = GridRow(example.sequence, [f"frame {example.frame}"], [Panel(example.image, "image"), truth])
    body = []
    for row in rows:
        depth = Panel(scales.depth.rgb(example.rows[row].known_depth))
        body.append(GridRow(example.label(row), figures_of(example, row), [depth, *_judged(example, row, scales)]))
    body[0] = body[0].captioned(("predicted depth", "|error|", "σ = √V", "NLL"))
    bars = [
        Bar("depth [m]", scales.depth, 0),
        Bar("|error| and σ [m]", scales.length, 1, span=2),
        Bar("NLL [nats]", NLL_SCALE, 3),
    ]
    caption = (
        "A good standard deviation σ looks like the error beside it. NLL is bright where a row is overconfident; its "
        "colours are the same in all strips. Lengths share one scale."
    )
    return _picture(folder, example, rows, STRIP, base, (Method(base).name, caption), [head, *body], bars)


def draw_breakdown(folder: Path, example: Example, rows: Sequence[str]) -> Picture:
    """The parts of each row's variance: sqrt of A, E, M and V beside the error and the NLL."""
    scales = fit_strip_scales(example, rows)
    body = []
    for row in rows:
        maps = example.rows[row]
        parts = (maps.aleatoric, maps.epistemic, maps.disagreement)
        a, e, m = (None if part is None else scales.length.rgb(maps.root(part)) for part in parts)
        panels = [Panel(rgb, absent="none") for rgb in (a, e, None if m is None else maps.striped(m))]
        error, sigma, nll = _judged(example, row, scales)
        body.append(GridRow(example.label(row), figures_of(example, row), [*panels, sigma, error, nll]))
    captions = ("√A, aleatoric", "√E, epistemic", "√M, between views", "σ = √V, V = A + E + M", "|error|", "NLL")
    body[0] = body[0].captioned(captions)
    bars = [Bar("√A, √E, √M, σ and |error| [m]", scales.length, 0, span=5), Bar("NLL [nats]", NLL_SCALE, 5)]
    caption = (
        "The parts add up as variances, V = A + E + M; shown are their square roots, in metres, on one scale with the "
        "error. A and E are the network's own, M is the disagreement between the views."
    )
    return _picture(folder, example, rows, BREAKDOWN, "", ("parts of the variance", caption), body, bars)


def draw_comparison(folder: Path, example: Example, pair: Sequence[str], base: str) -> Picture:
    """Image, error, sigma by UfM and by UfM*, and UfM* minus UfM."""
    scales, (ufm, ufm_star) = fit_strip_scales(example, pair), pair
    old, new = example.rows[ufm].sigma, example.rows[ufm_star].sigma
    difference = new - old
    reach = robust_range([np.abs(difference)], from_zero=True)[1]
    signed = ColourScale(-reach, reach, DIFFERENCE_MAP)
    maps = {
        "image": example.image,
        f"|error| of {example.label(ufm_star)}": scales.length.rgb(example.error(ufm_star)),
        f"σ, {example.label(ufm)}": example.rows[ufm].striped(scales.length.rgb(old)),
        f"σ, {example.label(ufm_star)}": example.rows[ufm_star].striped(scales.length.rgb(new)),
        "difference of σ": signed.rgb(difference),
    }
    lines = [line for row in pair for line in (f"{example.label(row)}:", *figures_of(example, row))]
    panels = [Panel(picture, name) for name, picture in maps.items()]
    grid = [GridRow(example.sequence, [f"frame {example.frame}", *lines], panels)]
    bars = [Bar("|error| and σ [m]", scales.length, 1, span=3), Bar("UfM* minus UfM [m]", signed, 4)]
    title = f"{example.label(ufm_star)} against {example.label(ufm)}"
    caption = "Red: UfM* has the larger standard deviation; blue: the smaller."
    return _picture(folder, example, pair, COMPARE, base, (title, caption), grid, bars)


def _judged(example: Example, row: str, scales: PanelScales) -> tuple[Panel, Panel, Panel]:
    """|error|, sigma and NLL of a row."""
    maps = example.rows[row]
    error, sigma = scales.length.rgb(example.error(row)), maps.striped(scales.length.rgb(maps.sigma))
    return Panel(error), Panel(sigma), Panel(NLL_SCALE.rgb(example.nll(row)))


def figures_of(example: Example, row: str) -> list[str]:
    """The row's figures on this frame, a line each: mean NLL, root mean square error, and the expected one."""
    error, sigma = example.error(row).astype(np.float64), example.rows[row].sigma
    known = np.isfinite(error)
    if not known.any():
        return ["no ground truth"]
    rms_sigma = np.sqrt(np.mean(np.square(sigma[known], dtype=np.float64)))
    nll = mean_nll(example, row)
    nll_words = "no NLL: V = 0" if nll is None else f"mean NLL {nll:.2f}"
    return [nll_words, f"RMSE {np.sqrt(np.mean(error[known] ** 2)):.2f} m", f"rms σ {rms_sigma:.2f} m"]


def mean_nll(example: Example, row: str) -> float | None:
    """The row's mean NLL on this frame [nats]; None without a pixel that has one."""
    nll = example.nll(row)
    judged = np.isfinite(nll)
    return float(nll[judged].mean()) if judged.any() else None
