"""The report of an evaluation: tables, figures, pictures, the page and the tidy results, in its folder."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

from ufmstar_torch.eval.report.data import Results, load_results
from ufmstar_torch.eval.report.tables import write_tables, write_tidy
from ufmstar_torch.eval.results.files import remove_temporaries, write_json_atomic

INDEX = "pictures.json"
KINDS = ("svg", "png")
# Errors of drawing, after which a report goes on without the picture.
_DRAWING_ERRORS = (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError)


@dataclass(frozen=True)
class Report:
    """A written report.

    Attributes:
        files: in the order in which they were written.
        undrawn: reasons by name of the figures that could not be drawn.
    """

    files: list[Path]
    undrawn: Mapping[str, str] = field(default_factory=dict)


def write_report(out: Path, *, figures: bool = True, pictures: str = "svg") -> Report:
    """Write the report of an evaluation, finished or not.

    A figure that cannot be drawn is left out, and named on the page and in ``Report.undrawn``.

    Args:
        out: the folder of ``ufmstar eval``.
        figures: False = tables and results alone, without a page; needs no matplotlib.
        pictures: kind of the figures, "svg" or "png".

    Raises:
        ResultsError: the folder is no evaluation, or its records do not belong together.
        ValueError: another kind of figures, or a file with an example that cannot be read.
        ImportError: matplotlib, Pillow or Jinja2 is missing.
        OSError: a file cannot be written.
    """
    if pictures not in KINDS:
        raise ValueError(f"figures must be {' or '.join(KINDS)}, got {pictures!r}")
    results = load_results(out, with_sums=figures)
    # What a killed report has left; eval.json and the records are those of `ufmstar eval`.
    for pattern in ("tables/.*.tmp", "figures/.*.tmp", ".results.*.tmp", ".table.*.tmp", ".report.*.tmp"):
        remove_temporaries(out.glob(pattern))
    files = [*write_tidy(results), *write_tables(results)]
    undrawn: dict[str, str] = {}
    if figures:
        files += _draw(results, pictures, undrawn)
    return Report(files, undrawn)


def _draw(results: Results, kind: str, undrawn: dict[str, str]) -> list[Path]:
    """Draw figures and pictures into ``figures/``, with an index of the pictures, and write the page; their paths."""
    from ufmstar_torch.eval.report.figures import figures_of
    from ufmstar_torch.eval.report.page import write_page
    from ufmstar_torch.eval.report.pictures import Picture, pictures_of
    from ufmstar_torch.eval.report.style import save_figure

    folder = results.out / "figures"
    folder.mkdir(exist_ok=True)
    figures: list[Path] = []
    pictures: list[Picture] = []
    for name, draw in [*figures_of(results), *pictures_of(results, folder)]:
        try:
            drawn = draw()
            if isinstance(drawn, Picture):
                pictures.append(drawn)
            elif drawn is not None:
                path = folder / f"{re.sub(r'[^A-Za-z0-9.-]+', '-', name.replace('/', '_'))}.{kind}"
                save_figure(drawn, path)
                figures.append(path)
        except _DRAWING_ERRORS as error:
            undrawn[name] = " ".join(str(error).split()) or type(error).__name__
    written = [*figures, *(folder / picture.file for picture in pictures)]
    if pictures:
        write_json_atomic(folder / INDEX, {"pictures": [asdict(picture) for picture in pictures]})
        written.append(folder / INDEX)
    return [*written, write_page(results, figures, pictures, undrawn)]
