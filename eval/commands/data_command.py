"""The work of ``ufmstar data check``: one sequence, or all below a folder, as text or JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.check.data_check import check_data
from ufmstar_torch.eval.commands.data_report import lines, page
from ufmstar_torch.eval.sequences.conventions import CONVENTIONS, OURS
from ufmstar_torch.eval.sequences.find import find_sequences
from ufmstar_torch.eval.sequences.layout import LAYOUTS, layouts_of, parts_of
from ufmstar_torch.eval.sequences.options import Options

# With one of these the user means one sequence, whatever lies below its folder.
_OF_ONE = ("trajectory", "images", "drive")


def check(path: str, pairs: int, as_json: bool, options: Mapping[str, Any]) -> tuple[str, bool]:
    """What to print, and whether all is fine.

    Args:
        path: a sequence, or a folder below which there are some.
        pairs: of frames that are compared.
        as_json: a list of reports instead of text.
        options: of ``open_sequence``.

    Raises:
        FileNotFoundError: no such path.
        ValueError: an option out of range, or nothing below the folder has a known layout.
    """
    layout = options.get("layout", "auto")
    _check_options(options)
    one = path.startswith("tour:") or any(name in options for name in _OF_ONE) or _is_one(Path(path))
    found = [] if one else find_sequences(path, layout=layout)
    if not one and not found and layout == "auto":
        raise ValueError(f"{path} has no known layout, and nothing below it has; see docs/data.md, or --layout")
    if one or not found:  # that nothing has the layout asked for is told with what was looked for
        reports = [check_data(path, pairs=pairs, **options)]
    else:
        reports = [check_data(item.path, item.name, pairs, **{**options, "layout": item.layout}) for item in found]
    if as_json:
        text = json.dumps([report.to_dict() for report in reports], indent=2)
    else:
        text = lines(reports) if found else page(reports[0])
    return text, all(report.ok for report in reports)


def _is_one(path: Path) -> bool:
    """Whether the folder is a single sequence (or fits several layouts, of which one must be named)."""
    fitting = layouts_of(path)
    return len(fitting) > 1 or (len(fitting) == 1 and len(parts_of(path, fitting[0])) == 1)


def _check_options(options: Mapping[str, Any]) -> None:
    """Raises ValueError for what is wrong with any data."""
    layout, poses = options.get("layout", "auto"), options.get("poses", OURS)
    if layout not in LAYOUTS:
        raise ValueError(f"layout must be one of {', '.join(LAYOUTS)}, got {layout!r}")
    if poses not in CONVENTIONS:
        raise ValueError(f"poses must be one of {', '.join(CONVENTIONS)}, got {poses!r}")
    Options(**{name: value for name, value in options.items() if name not in ("layout", "poses")})
