"""The options of ``ufmstar report``; importing this is cheap, so that help comes at once."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

_DESCRIPTION = (
    "Draws tables (Markdown and LaTeX), figures, one page (report.html) and tidy results (JSON and CSV) from what "
    "`ufmstar eval` has left in OUT, finished or not, and prints the main table."
)


def parse_report(arguments: Sequence[str]) -> argparse.Namespace:
    """The options from arguments without the program's name.

    Raises:
        SystemExit: help was asked for, or an argument does not fit (2).
    """
    parser = argparse.ArgumentParser(prog="ufmstar report", description=_DESCRIPTION)
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of `ufmstar eval`")
    parser.add_argument("--no-figures", action="store_true", help="tables and results alone (needs no matplotlib)")
    parser.add_argument("--format", choices=("svg", "png"), default="svg", help="of the figures (default: svg)")
    parser.add_argument("--debug", action="store_true", help="show tracebacks")
    return parser.parse_args(list(arguments))
