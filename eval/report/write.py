"""The report of an evaluation: tables, figures, pictures, the page and the tidy results, in its folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ufmstar_torch.eval.report.data import load_results
from ufmstar_torch.eval.report.tables import write_tables, write_tidy
from ufmstar_torch.eval.results.files import remove_temporaries


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
    results = load_results(out, with_sums=figures)
    # What a killed report has left; eval.json and the records are those of `ufmstar eval`.
    for pattern in ("tables/.*.tmp", "figures/.*.tmp", ".results.*.tmp", ".table.*.tmp", ".report.*.tmp"):
        remove_temporaries(out.glob(pattern))
    files = [*write_tidy(results), *write_tables(results)]
    undrawn: dict[str, str] = {}
    if figures:
        from ufmstar_torch.eval.report.figures import write_figures
        from ufmstar_torch.eval.report.page import write_page
        from ufmstar_torch.eval.report.pictures import INDEX, write_pictures

        drawn = write_figures(results, pictures, undrawn)
        shown = write_pictures(results, undrawn)
        names = [*(picture.file for picture in shown), *([INDEX] if shown else [])]
        files += [*drawn, *(out / "figures" / name for name in names)]
        files.append(write_page(results, drawn, shown, undrawn))
    return Report(files, undrawn)
