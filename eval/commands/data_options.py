"""The options of ``ufmstar data check``: those of ``open_sequence``, as words of a command line."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from ufmstar_torch.eval.commands.run_options import parse_intrinsics

_DESCRIPTION = """What a sequence holds, and whether its poses, depth and images fit together.

Depth is warped between neighbouring frames with the poses as given, inverted, with other axes and at other depth
scales; what fits is told with the option that makes it so. Exit code: 0 fine, 1 problems, 2 wrong usage."""
_WORDS = {"intrinsics", "depth_intrinsics"}


def data_parser() -> argparse.ArgumentParser:
    """The parser; it ends the program with code 2 on wrong usage."""
    parser = argparse.ArgumentParser(
        prog="ufmstar data", description=_DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="check")
    check = commands.add_parser(
        "check", help="layout, counts, sizes, and whether everything fits", description=_DESCRIPTION
    )
    check.formatter_class = argparse.RawDescriptionHelpFormatter
    check.add_argument("path", help="a sequence, or a folder below which there are some")
    check.add_argument("--pairs", type=int, default=8, help="pairs of frames that are compared; default: 8")
    check.add_argument("--json", action="store_true", help="print JSON instead of text")
    group = check.add_argument_group("how the sequence is opened")
    for name, kind, text in (
        ("layout", str, "auto (the default), tum, 7scenes, scannet, sens, tartanair, kitti360, nyu or generic"),
        ("intrinsics", None, "of the images: a file, or fx fy cx cy [px]"),
        ("depth-intrinsics", None, "of the depth maps: a file, or fx fy cx cy [px]"),
        ("trajectory", str, "file with poses in TUM or KITTI format"),
        ("poses", str, "how they are written: camera-to-world (the default), world-to-camera, ned or opengl"),
        ("images", str, "folder of images, or video file"),
        ("depth", str, "folder of depth maps"),
        ("depth-scale", float, "metres per unit of the depth maps"),
        ("max-time-difference", float, "between paired colour and depth images [s]"),
        ("max-pose-gap", float, "between the poses that are interpolated [s]"),
        ("fps", float, "frames per second of images without timestamps"),
        ("time-offset", float, "added to the images' times [s]"),
        ("T-color-depth", str, "file with the 4x4 matrix from the depth camera into the colour camera (7-Scenes)"),
        ("drive", str, "name or number of a drive below the root of KITTI-360"),
        ("scans", int, "laser scans before and after a frame's own that are added to it (KITTI-360)"),
    ):
        how: dict[str, Any] = {"nargs": "+"} if kind is None else {"type": kind}
        group.add_argument(f"--{name}", default=argparse.SUPPRESS, help=text, **how)
    text = "leave 7-Scenes' depth in its own camera"
    group.add_argument("--no-register", dest="register", action="store_false", default=argparse.SUPPRESS, help=text)
    return parser


def parse_data(arguments: Sequence[str]) -> tuple[argparse.Namespace, dict[str, Any]]:
    """The command's own options, and those that were given for ``open_sequence``.

    Raises:
        ValueError: intrinsics are neither a file nor four numbers, or the matrix file is malformed.
        OSError: the matrix file cannot be read.
        SystemExit: other wrong usage, or help was asked for.
    """
    from ufmstar_torch.eval.sequences.poses import read_pose

    options = vars(data_parser().parse_args(list(arguments)))
    own = argparse.Namespace(**{name: options.pop(name) for name in ("command", "path", "pairs", "json")})
    for name in _WORDS & set(options):
        options[name] = parse_intrinsics(options[name], f"--{name.replace('_', '-')}")
    if "T_color_depth" in options:
        options["T_color_depth"] = read_pose(options["T_color_depth"])
    return own, options
