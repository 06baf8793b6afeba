"""The options of ``ufmstar eval``: what a user can say, before anything heavy is imported."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ufmstar_torch.eval.sequences.frame import parse_slice

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser

    from ufmstar_torch.eval.methods.suite import Suite
    from ufmstar_torch.eval.results.run_suite import EvalJob

_USAGE = (
    "ufmstar eval --suite NAME --root [DATASET=]DIR ... --network BASE=MODEL:FILE[,FILE...] ... --out OUT [options]"
)
_DESCRIPTION = """The rows of a table or figure of the paper, on sequences of your own.

Every sequence is finished for itself: whatever ends the program, --resume computes what is missing. Several processes
may share the work: --processes on one computer, torchrun or --slurm on several, --shard by hand."""
_MANY = "repeatable"
# Those of ``open_sequence``; what is not given stays as the layout has it.
_OPENING = ("trajectory", "poses", "depth_scale", "fps", "time_offset", "max_pose_gap", "scans")
_GROUPS: dict[str, tuple[tuple[str, Any, Any, str], ...]] = {
    "what": (
        ("--suite", str, None, "name of a suite (see --list), or a TOML file of your own"),
        (
            "--base",
            str,
            None,
            "the network that a figure or ablation is about, instead of the paper's: depth_only, ...",
        ),
        ("--network", _MANY, [], "BASE=MODEL:FILE[,FILE...], one for every base; rows without one are left out"),
        ("--samples", int, None, "passes of MC-Dropout where a row asks for all; default: 10"),
        ("--list", bool, False, "show the suites and stop"),
    ),
    "on what": (
        ("--root", _MANY, [], "[DATASET=]DIR with sequences at or below it, or tour:SEED; DATASET: else the layout"),
        ("--sequences", int, None, "of each data set, only so many, drawn at random (the paper: 100)"),
        ("--seed", int, 0, "of the draw"),
        ("--sequence-list", str, None, "file with the names of the sequences to take, one a line"),
        ("--frames", str, None, "START:STOP:STEP, which frames of a sequence, counted from 0 as Python does"),
    ),
    "how the sequences are opened, all of them alike": (
        ("--trajectory", str, None, "poses of another program (TUM or KITTI format): a file in each sequence's folder"),
        ("--poses", str, None, "how they are written: camera-to-world (default), world-to-camera, ned or opengl"),
        ("--depth-scale", float, None, "metres per unit of the depth maps"),
        ("--fps", float, None, "frames per second of images without timestamps"),
        ("--time-offset", float, None, "added to the images' times [s]"),
        ("--max-pose-gap", float, None, "between the poses that are interpolated [s]; default: 0.1"),
        ("--scans", int, None, "laser scans before and after a frame's own that are added to it (KITTI-360)"),
    ),
    "output": (
        ("--out", str, None, "folder for everything that is written"),
        (
            "--resume",
            bool,
            False,
            "go on with the evaluation in --out: what is missing, rows and sequences added since",
        ),
        ("--overwrite", bool, False, "replace the evaluation in --out; predictions in its cache are kept"),
        ("--cache", str, None, "folder of the networks' predictions; default: OUT/cache"),
        ("--examples", int, 3, "of each data set, sequences of which some frames are kept for pictures"),
        ("--confident", float, 0.5, "share of a frame's pixels of which a method counts as confident"),
        ("--no-report", bool, False, "no tables and figures at the end; ufmstar report OUT makes them"),
    ),
    "how": (
        ("--device", str, "cpu", "cpu or cuda; of several processes, each takes a GPU of its own in turn"),
        ("--threads", int, None, "CPU threads of each process; default: all, divided among --processes"),
        ("--processes", int, 1, "processes on this computer"),
        ("--shard", str, None, "i/n: only the i-th of n parts of the sequences, 1/n to n/n"),
        ("--slurm", _MANY, [], "KEY=VALUE for submitit, as partition=gpu; jobs=N is their number"),
        ("--dry-run", bool, False, "show rows, sequences and the size of the cache, and stop"),
        ("--debug", bool, False, "show tracebacks"),
    ),
}


def eval_parser() -> ArgumentParser:
    """The parser of ``ufmstar eval``; it raises ``ArgumentError`` instead of ending the program."""
    from jsonargparse import ActionConfigFile, ArgumentParser

    parser = ArgumentParser(prog="ufmstar eval", usage=_USAGE, description=_DESCRIPTION, exit_on_error=False)
    parser.add_argument("--config", action=ActionConfigFile, help="JSON or YAML file with any of these options")
    for title, options in _GROUPS.items():
        group = parser.add_argument_group(title)
        for name, kind, default, text in options:
            if kind is bool:
                group.add_argument(name, action="store_true", help=text)
            elif kind == _MANY:
                group.add_argument(name, action="extend", nargs="+", type=str, default=default, help=f"{text}; {_MANY}")
            else:
                group.add_argument(name, type=kind, default=default, help=text)
    return parser


def parse_eval(parser: ArgumentParser, arguments: Sequence[str]) -> dict[str, Any]:
    """The options as plain values.

    Raises:
        ArgumentError: an unknown option, or a value of the wrong kind.
        SystemExit: help was asked for.
    """
    plain: dict[str, Any] = parser.parse_args(list(arguments)).as_dict()
    plain.pop("config")
    return plain


def check_options(options: Mapping[str, Any]) -> None:
    """What can be said of the options before anything is opened.

    Raises:
        ValueError: one is missing or out of its range, or two contradict each other.
    """
    for name in ("suite", "root", "network", "out"):
        if not options[name]:
            raise ValueError(f"--{name} is missing; ufmstar eval --help, and --list for the suites")
    parse_slice(options["frames"])
    for name, least in (("processes", 1), ("examples", 0), ("threads", 1), ("seed", 0), ("samples", 2)):
        if options[name] is not None and options[name] < least:
            raise ValueError(f"--{name} must be at least {least}, got {options[name]}")
    if not 0 < options["confident"] <= 1:
        raise ValueError(f"--confident must be a share in (0, 1], got {options['confident']}")
    if options["resume"] and options["overwrite"]:
        raise ValueError("--resume and --overwrite contradict each other")
    several = [n for n in ("shard", "slurm") if options[n]] + (["processes"] if options["processes"] > 1 else [])
    if len(several) > 1:
        raise ValueError(f"--{several[0]} and --{several[1]} contradict each other")
    if options["shard"] and options["overwrite"]:
        raise ValueError("--overwrite goes without --shard: another part may have begun")


def suite_from(options: Mapping[str, Any]) -> Suite:
    """The suite that the options name.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no such suite, or a file that is none.
    """
    from ufmstar_torch.eval.methods.suite_file import suite_from_file
    from ufmstar_torch.eval.methods.suites import suite_named

    name = options["suite"]
    if not name.endswith(".toml"):
        return suite_named(name, options["base"])
    if options["base"] is not None:
        raise ValueError("--base goes with suites by name: a file names its own")
    return suite_from_file(Path(name))


def job_from(options: Mapping[str, Any]) -> EvalJob:
    """What the options mean; nothing is opened but folders.

    Raises:
        FileNotFoundError: something that was named does not exist.
        ValueError: options that do not go together, a base given twice, no row with a network, no sequence.
    """
    from ufmstar_torch.eval.engine.load import NetworkChoice
    from ufmstar_torch.eval.results.run_suite import EvalJob
    from ufmstar_torch.eval.results.worklist import find_work, read_names

    check_options(options)
    suite = suite_from(options)
    choices = [NetworkChoice.parse(text) for text in options["network"]]
    networks = {choice.base: choice for choice in choices}
    if len(networks) < len(choices):
        raise ValueError(f"--network: every base once, got {', '.join(choice.base for choice in choices)}")
    opening = _opening(options)
    names = options["sequence_list"]
    items = find_work(
        options["root"],
        sample=options["sequences"],
        seed=options["seed"],
        only=None if names is None else read_names(Path(names)),
    )
    return EvalJob(
        suite=suite.with_bases(networks),
        networks=networks,
        items=tuple(replace(item, opening=opening) for item in items),
        out=Path(options["out"]),
        missing_bases=tuple(base for base in suite.bases if base not in networks),
        frames=parse_slice(options["frames"]),
        cache=None if options["cache"] is None else Path(options["cache"]),
        device=options["device"],
        confident=options["confident"],
        examples=options["examples"],
        samples=options["samples"],
    )


def _opening(options: Mapping[str, Any]) -> tuple[tuple[str, Any], ...]:
    """What was given of how sequences are opened.

    Raises:
        ValueError: a value out of range.
    """
    from ufmstar_torch.eval.sequences.conventions import CONVENTIONS, OURS
    from ufmstar_torch.eval.sequences.options import Options

    given = {name: options[name] for name in _OPENING if options[name] is not None}
    if given.get("poses", OURS) not in CONVENTIONS:
        raise ValueError(f"--poses must be one of {', '.join(CONVENTIONS)}, got {given['poses']!r}")
    Options(**{name: value for name, value in given.items() if name != "poses"})
    return tuple(given.items())
