"""All pictures of a report: which frames, which rows, and the words that go with them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

from ufmstar_torch.eval.methods.method import ALONE, UFM, UFM_STAR, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import DEFAULT
from ufmstar_torch.eval.report.compare import draw_comparison
from ufmstar_torch.eval.report.example import Example, find_examples
from ufmstar_torch.eval.report.load import Results
from ufmstar_torch.eval.report.names import row_label
from ufmstar_torch.eval.report.picture import BREAKDOWN, COMPARE, ROOM, STRIP, Picture, file_name, write_index
from ufmstar_torch.eval.report.rooms import choose_times, draw_room, find_rooms
from ufmstar_torch.eval.report.strips import draw_breakdown, draw_strip, mean_nll
from ufmstar_torch.eval.results.worklist import WorkItem

# So that a report of a hundred sequences stays one that can be read, and mailed.
MOST_FRAMES, MOST_ROOMS = 4, 3
_BREAKDOWN_BASES = ("ensemble", "aleatoric")


def write_pictures(results: Results, out: Path) -> list[Path]:
    """Draw strips, breakdowns, comparisons and rooms of the example frames into ``OUT/figures``.

    Args:
        results: of the evaluation.
        out: its folder.

    Returns:
        The files, the index of pictures last; none where no example was kept.

    Raises:
        ValueError: an example cannot be read; the message names the file.
        ImportError: matplotlib is missing.
        OSError: a file cannot be written.
    """
    folder = out / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    rows = {row.slug: row for row in results.rows}
    pictures = list(_of_frames(results, folder, rows)) + list(_of_rooms(results, folder, rows))
    if not pictures:
        return []
    return [*(folder / picture.file for picture in pictures), write_index(folder, pictures)]


def choose(examples: Sequence[Example], most: int) -> list[Example]:
    """Frames of as many sequences as there can be: the last of each first, since by then most has been seen twice."""
    turns: list[tuple[int, int, Example]] = []
    for number, (_, group) in enumerate(groupby(examples, key=lambda e: (e.dataset, e.sequence))):
        turns += [(turn, number, example) for turn, example in enumerate(reversed(list(group)))]
    first = sorted(turns, key=lambda entry: entry[:2])[:most]
    return [example for _, _, example in sorted(first, key=lambda entry: (entry[1], entry[0]))]


def strip_rows(rows: Sequence[Row], base: str) -> list[Row]:
    """A base's rows for a strip, as the paper's: alone, UfM (pruned if there is such), UfM*; of default settings."""
    of_base = [row for row in rows if row.method.base == base and row.setting == DEFAULT and not row.method.full]
    plain = [row for row in of_base if not row.method.fixed_param]
    by_fusion = {fusion: [row for row in plain if row.method.fusion == fusion] for fusion in (ALONE, UFM, UFM_STAR)}
    pruned = [row for row in by_fusion[UFM] if row.method.max_points is not None]
    return [*by_fusion[ALONE], *(pruned or by_fusion[UFM])[:1], *by_fusion[UFM_STAR]]


def _of_frames(results: Results, folder: Path, rows: dict[str, Row]) -> Iterator[Picture]:
    labels = {slug: row_label(row) for slug, row in rows.items()}
    examples = [
        replace(example, dataset=dataset, sequence=sequence)
        for dataset, sequence in results.sequences()
        for example in find_examples(_place(results, dataset, sequence), labels)
    ]
    for example in choose(examples, MOST_FRAMES):
        there = [row for slug, row in rows.items() if slug in example.rows]
        bases = dict.fromkeys(row.method.base for row in there)
        for base in bases:
            of_base = strip_rows(there, base)
            if of_base:
                yield _strip(folder, example, of_base, base)
        parts = [row for base in _BREAKDOWN_BASES for row in strip_rows(there, base) if row.method.fusion != UFM]
        if any(row.method.fusion == UFM_STAR for row in parts):
            yield _breakdown(folder, example, parts)
        for base in bases:
            pair = [row for row in strip_rows(there, base) if row.method.fusion != ALONE]
            if len(pair) == 2:
                yield _comparison(folder, example, *pair)


def _of_rooms(results: Results, folder: Path, rows: dict[str, Row]) -> Iterator[Picture]:
    drawn = 0
    for dataset, sequence in results.sequences():
        rooms = find_rooms(_place(results, dataset, sequence))
        # One row of each room is enough: the suite's first UfM* with its default settings.
        slug = next((s for s, row in rows.items() if s in rooms and row.setting == DEFAULT), None)
        if slug is None or drawn == MOST_ROOMS:
            continue
        snapshots = choose_times(rooms[slug])
        if not any(len(snapshot.mean) for snapshot in snapshots):
            continue
        drawn += 1
        label = row_label(rows[slug])
        name = file_name(ROOM, dataset, sequence, slug)
        scale = draw_room(folder / name, snapshots, f"{label}, {sequence}")
        counts = [len(snapshot.mean) for snapshot in snapshots]
        times = f"{len(snapshots)} times" if len(snapshots) > 1 else "one time"
        yield Picture(
            name,
            ROOM,
            f"{sequence}: the Gaussians of {label} at {times}",
            "Each Gaussian is an ellipse as large as the patch it stands for, painted from far to near; what lies "
            "above the camera (the ceiling) is left out. Black: seen from one view only, or with no disagreement. "
            "Blue: the camera, its path and where it looks.",
            f"The room of {sequence} from above and obliquely, {' then '.join(map(str, counts))} Gaussians, coloured "
            f"by disagreement from 0 to {scale.high:.2g} m.",
        )


def _place(results: Results, dataset: str, sequence: str) -> Path:
    """The folder of a sequence, whose name need not be fit for one."""
    return results.out / "records" / WorkItem(dataset, sequence, path="", layout="").folder


def _strip(folder: Path, example: Example, rows: Sequence[Row], base: str) -> Picture:
    slugs = [row.slug for row in rows]
    name = file_name(STRIP, example.dataset, example.sequence, example.frame, base)
    draw_strip(folder / name, example, slugs)
    return Picture(
        name,
        STRIP,
        f"{example.sequence}, frame {example.frame}: {Method(base).name}",
        "A good standard deviation σ looks like the error beside it. NLL is bright where a row was too sure of itself; "
        "its colours are the same in all strips. Lengths share one scale.",
        f"Depth, error, standard deviation and NLL of {_told(example, slugs)}.",
    )


def _breakdown(folder: Path, example: Example, rows: Sequence[Row]) -> Picture:
    slugs = [row.slug for row in rows]
    name = file_name(BREAKDOWN, example.dataset, example.sequence, example.frame)
    draw_breakdown(folder / name, example, slugs)
    return Picture(
        name,
        BREAKDOWN,
        f"{example.sequence}, frame {example.frame}: what the variance is made of",
        "The parts add up as variances, V = A + E + M; shown are their square roots, in metres, on one scale with the "
        "error. A and E are the network's own, M is what the views disagree by.",
        f"Aleatoric, epistemic and multiview parts of {_told(example, slugs)}.",
    )


def _comparison(folder: Path, example: Example, ufm: Row, ufm_star: Row) -> Picture:
    name = file_name(COMPARE, example.dataset, example.sequence, example.frame, ufm_star.method.base)
    draw_comparison(folder / name, example, ufm.slug, ufm_star.slug)
    return Picture(
        name,
        COMPARE,
        f"{example.sequence}, frame {example.frame}: {row_label(ufm_star)} against {row_label(ufm)}",
        "Red: UfM* is the less sure of the two; blue: the surer. The blue box marks where they differ most on average, "
        "enlarged below.",
        f"Standard deviations and their difference, of {_told(example, [ufm.slug, ufm_star.slug])}.",
    )


def _told(example: Example, slugs: Sequence[str]) -> str:
    """Rows with their mean NLL, for those who cannot see the picture."""
    found = ((slug, mean_nll(example, slug)) for slug in slugs)
    return ", ".join(
        f"{example.label(slug)} ({'no NLL' if nll is None else f'mean NLL {nll:.2f}'})" for slug, nll in found
    )
