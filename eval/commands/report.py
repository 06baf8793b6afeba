"""``ufmstar report``: its options and printed output."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from ufmstar_torch.eval.commands.options import Flag, Positional, arg, reader
from ufmstar_torch.eval.commands.terminal import Bars, usage_errors


@dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """Tables, figures and a page from the results of an evaluation.

    Draws tables (LaTeX), figures, one page (report.html) and tidy results (CSV) from what `ufmstar eval` has left in a
    folder, finished or not, and prints the main table.

    Attributes:
        out: The folder of `ufmstar eval`.
        no_figures: Make tables and results alone, which needs no matplotlib.
    """

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    no_figures: Flag = False


read = reader(ReportOptions, "ufmstar report")


def main(options: ReportOptions) -> int:
    """Draw the report, and print the main table; the exit code."""
    from ufmstar_torch.eval.engine.record import ResultsError
    from ufmstar_torch.eval.report.data import load_results
    from ufmstar_torch.eval.report.text import summary, written
    from ufmstar_torch.eval.report.write import write_report

    with usage_errors(ResultsError), Bars() as bars:
        print(summary(load_results(options.out, with_sums=False)))
        report = write_report(options.out, figures=not options.no_figures, progress=bars.show)
    print(written(options.out, report))
    return 0
