"""``ufmstar data check``: its options, and one sequence, or all below a folder, as text or JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from ufmstar_torch.eval.commands.opening import Recording
from ufmstar_torch.eval.commands.options import Flag, Positional, arg, reader
from ufmstar_torch.eval.commands.terminal import usage_errors

# With one of these options the path is one sequence, whatever is below its folder.
_OF_ONE = ("trajectory", "images", "drive")


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """Report a sequence's content, and check whether its poses, depth and images fit together.

    Depth is warped between neighbouring frames with the poses as given, inverted, with other axes and at other depth
    scales; if something else fits, the option that corrects it is printed. Exit code: 0 fine, 1 problems, 2 wrong
    usage.

    Attributes:
        command: The check is the only command.
        path: A sequence, or a folder below which there are sequences.
        pairs: Compare this many pairs of frames.
        json: Print JSON instead of text.
    """

    USAGE: ClassVar[str] = "ufmstar data check PATH [options]"

    command: Positional[Literal["check"]]
    path: Annotated[Positional[str], arg(metavar="PATH")]
    pairs: int = 8
    json: Flag = False
    opening: Recording


read = reader(CheckOptions, "ufmstar data")


def main(options: CheckOptions) -> int:
    """Check, and print the reports. Returns the exit code."""
    from ufmstar_torch.eval.check.data_check import lines, page
    from ufmstar_torch.eval.engine.files import to_json

    with usage_errors(OSError, ValueError):
        reports, several = _check(options)
    if options.json:
        plain = [{"ok": report.ok, "compared": report.compared, **to_json(report)} for report in reports]
        print(json.dumps(plain, indent=2))
    else:
        print(lines(reports) if several else page(reports[0]))
    return 0 if all(report.ok for report in reports) else 1


def _check(options: CheckOptions) -> tuple[list, bool]:
    """The reports, and whether they are of a folder of sequences.

    Raises:
        OSError: no such path.
        ValueError: an option out of range, or nothing below the folder has a known layout.
    """
    from ufmstar_torch.eval.check.data_check import check_data
    from ufmstar_torch.eval.sequences.layout import find_sequences, layout_of, layouts_of, parts_of, require_layout

    path, opening = options.path, options.opening.changed()
    require_layout(options.opening.layout, options.opening.plugin)
    one = path.startswith("tour:") or any(name in opening for name in _OF_ONE)
    if not one:  # a folder that fits several layouts is one sequence, and check_data asks for its layout
        fitting = layouts_of(Path(path), options.opening.plugin)
        one = len(fitting) > 1 or (len(fitting) == 1 and len(parts_of(Path(path), fitting[0])) == 1)
    result = [] if one else find_sequences(path, layout=options.opening.layout, plugin=options.opening.plugin)
    if not one and not result and options.opening.layout == "auto":
        layout_of("auto", Path(path), plugin=options.opening.plugin)  # raises, with what was expected
    if one or not result:  # check_data's error names the files of the layout
        return [check_data(path, pairs=options.pairs, **opening)], False
    return [
        check_data(item.path, item.name, options.pairs, **{**opening, "layout": item.layout}) for item in result
    ], True
