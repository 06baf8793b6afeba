"""The report of an evaluation: tables, figures, pictures, the page and the tidy results, in its folder."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from ufmstar_torch.eval.engine.files import remove_temporaries
from ufmstar_torch.eval.engine.progress import Progress
from ufmstar_torch.eval.report import efficiency, figures_calibration, figures_error, figures_sweep
from ufmstar_torch.eval.report.data import Results, load_results
from ufmstar_torch.eval.report.page import write_page
from ufmstar_torch.eval.report.pictures import Picture, pictures_of
from ufmstar_torch.eval.report.style import save_figure
from ufmstar_torch.eval.report.tables import all_tables, write_tables, write_tidy
from ufmstar_torch.eval.suite.folder import EVALUATION

# Errors of drawing, after which a report continues without the picture.
_DRAWING_ERRORS = (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError)


class Report(NamedTuple):
    """The files of a report in the order of writing, and by figure why it could not be drawn."""

    files: list[Path]
    undrawn: Mapping[str, str]


def write_report(out: Path, *, figures: bool = True, progress: Callable[[Progress], object] = lambda _: None) -> Report:
    """Write the report of an evaluation, finished or not, into its folder.

    ``figures=False`` writes tables and results alone, without a page, and needs no matplotlib. The page names figures
    that cannot be drawn. ``progress`` is called before the first figure and after each.

    Raises:
        ResultsError: the folder is no evaluation, or its records are inconsistent.
        FolderError: a file to write is a symbolic link.
        ValueError: an example's file cannot be read.
        ImportError: matplotlib, Pillow or Jinja2 is missing.
    """
    results = load_results(out, with_sums=figures)
    EVALUATION.require_no_links(out)
    # Temporary files of a killed report; those of eval.json and the records belong to `ufmstar eval`.
    for pattern in ("tables/.*.tmp", "figures/.*.tmp", ".results.*.tmp", ".report.*.tmp"):
        remove_temporaries(out.glob(pattern))
    tables = all_tables(results)
    files, undrawn = [write_tidy(results), *write_tables(out / "tables", tables)], dict[str, str]()
    if figures:
        drawn, pictures = _draw(results, undrawn, progress)
        page = write_page(results, tables, drawn, pictures, undrawn)
        files += [*drawn, *(out / "figures" / picture.file for picture in pictures), page]
    return Report(files, undrawn)


def figures_of(results: Results) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield name (its first word is the kind) and function of every figure; the function returns None without data."""
    for dataset in results.datasets:
        yield f"calibration {dataset}", partial(figures_calibration.draw_calibration, results, dataset)
        for base in results.bases:
            name = f"calibration sequences {dataset} {base}"
            yield name, partial(figures_calibration.draw_sequence_calibration, results, dataset, base)
        yield f"gates {dataset}", partial(figures_error.draw_gates, results, dataset)
        yield f"error {dataset}", partial(figures_error.draw_error, results, dataset)
    for base in results.bases:
        yield f"entropy {base}", partial(figures_error.draw_entropy, results, base)
    for base, name in figures_sweep.sweeps(results):
        yield f"sweep {base} {name}", partial(figures_sweep.draw_sweep, results, base, name)
    yield "latency stages", partial(efficiency.draw_stages, results)


def _draw(
    results: Results, undrawn: dict[str, str], progress: Callable[[Progress], object]
) -> tuple[list[Path], list[Picture]]:
    """Draw figures and pictures into ``figures/``; add the reasons for failures to ``undrawn``."""
    folder = results.out / "figures"
    folder.mkdir(exist_ok=True)
    figures: list[Path] = []
    pictures: list[Picture] = []
    named = [*figures_of(results), *pictures_of(results, folder)]
    progress(Progress("figures", 0, len(named)))
    for number, (name, draw) in enumerate(named, 1):
        try:
            drawn = draw()
            if isinstance(drawn, Picture):
                pictures.append(drawn)
            elif drawn is not None:
                path = folder / f"{re.sub(r'[^A-Za-z0-9.-]+', '-', name.replace('/', '_'))}.svg"
                save_figure(drawn, path)
                figures.append(path)
        except _DRAWING_ERRORS as error:
            undrawn[name] = " ".join(str(error).split()) or type(error).__name__
        progress(Progress("figures", number, len(named)))
    return figures, pictures
