"""The options of ``ufmstar run``: what a user can say, before anything heavy is imported."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, fields
from typing import TYPE_CHECKING, Any

from ufmstar_torch.config import SPGFConfig, UfMStarConfig
from ufmstar_torch.eval.sequences.frame import parse_size

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser

LAYOUTS = ("auto", "tum", "7scenes", "scannet", "sens", "tartanair", "kitti360", "generic")
PRESETS = ("tum", "tartanair_indoor", "tartanair_outdoor")
OWN_DEPTH = ("self", "ground-truth")

_DESCRIPTION = """Depth with a variance for every pixel of a sequence of posed images.

The depth comes from a network (--model, --weights), from maps that another program predicted (--depth DIR), or
from the sequence itself (--depth self)."""
_TYPES = {"float": float, "int": int, "bool": bool, "str": str, "int | None": int | None}
_USAGE = "ufmstar run SEQUENCE (--model NAME --weights FILE... | --depth DIR) --out OUT [options]"
_WORDS = "several words"
# (option, type, default, help) by group; all of them may also stand in the file given as --config.
_GROUPS: dict[str, tuple[tuple[str, Any, Any, str], ...]] = {
    "sequence": (
        ("--layout", LAYOUTS, "auto", "of the sequence's folder"),
        ("--frames", str, None, "START:STOP:STEP, which frames, counted from 0 as Python does"),
        ("--intrinsics", _WORDS, [], "of the images: a file, or fx fy cx cy [px], instead of the layout's own"),
        ("--trajectory", str, None, "trajectory file (TUM or KITTI format) instead of the layout's own"),
        ("--images", str, None, "folder of images, or video file, of a generic sequence"),
        ("--fps", float, None, "frames per second of images without timestamps"),
        ("--time-offset", float, 0.0, "added to the images' times [s]"),
        ("--max-pose-gap", float, 0.1, "poses are interpolated between samples at most this far apart [s]"),
        ("--truth", str, None, "folder of ground-truth depth of a generic sequence"),
        ("--truth-scale", float, None, "metres per unit of the sequence's own depth, instead of the layout's"),
        ("--depth-intrinsics", _WORDS, [], "of the sequence's own depth: a file, or fx fy cx cy [px]"),
    ),
    "depth from networks": (
        (
            "--model",
            str,
            None,
            "fastdepth, monodepth2, trained, depth_anything, huggingface, onnx, torchscript, exported",
        ),
        ("--weights", _WORDS, [], "file (depth_anything, huggingface: directory); several are an ensemble's members"),
        ("--mode", ("alternate", "full"), "alternate", "ensemble: one member per image in turn, or all on every image"),
        ("--samples", int, None, "passes per image of an mc_dropout network in mode full; default: 10"),
        ("--offload", bool, False, "trained: keep the weights in host memory, only the member in turn on the device"),
        ("--spec", str, None, "JSON file that declares what the weights do not say: inputs, outputs, an alignment"),
    ),
    "depth that is there": (
        ("--depth", str, None, "folder of predicted maps (16-bit PNG, EXR, npy); 'self': the sequence's own depth"),
        ("--variance", str, None, "folder of variance maps [m^2] that belong to them"),
        ("--depth-scale", float, None, "metres per unit of the maps in the folder"),
        (
            "--map-intrinsics",
            _WORDS,
            [],
            "of the maps, if they do not show the whole image: a file, or fx fy cx cy [px]",
        ),
        ("--size", str, None, "HxW, to which the maps are brought"),
    ),
    "run": (
        ("--resume", bool, False, "go on with the run in --out"),
        ("--overwrite", bool, False, "replace the run in --out"),
        ("--no-video", bool, False, "leave preview.mp4 out"),
        ("--no-sheet", bool, False, "leave contact_sheet.png out"),
        ("--device", str, "cpu", "cpu or cuda"),
        ("--threads", int, None, "CPU threads; default: as many as there are"),
        ("--debug", bool, False, "show tracebacks"),
    ),
}
_OTHER_DEFAULTS = {"on_bad_frame": "skip"}


def run_parser() -> ArgumentParser:
    """The parser of ``ufmstar run``; it raises ``ArgumentError`` instead of ending the program."""
    from jsonargparse import ActionConfigFile, ArgumentParser

    parser = ArgumentParser(prog="ufmstar run", usage=_USAGE, description=_DESCRIPTION, exit_on_error=False)
    parser.add_argument("sequence", type=str, help="folder of the sequence, or a video file")
    parser.add_argument("--out", type=str, required=True, help="folder for everything that is written")
    parser.add_argument("--config", action=ActionConfigFile, help="JSON or YAML file with any of these options")
    for title, options in _GROUPS.items():
        group = parser.add_argument_group(title)
        for name, kind, default, text in options:
            group.add_argument(name, default=default, help=text, **_kind(kind))
    group = parser.add_argument_group("UfM*")
    text = "upstream's segmentation thresholds; single --ufm.segment.* go before them"
    group.add_argument("--preset", choices=PRESETS, default=None, help=text)
    text = "track corners of the images: their depths show the error on which all views agree (docs/anchors.md)"
    group.add_argument("--anchors", action="store_true", help=text)
    _add_config(group, UfMStarConfig, "ufm", _OTHER_DEFAULTS)
    return parser


def _kind(kind: Any) -> dict[str, Any]:
    """What argparse wants to know of an option's type."""
    if kind is bool:
        return {"action": "store_true"}
    if kind == _WORDS:
        return {"nargs": "+"}
    return {"choices": kind} if isinstance(kind, tuple) else {"type": kind}


def parse_run(parser: ArgumentParser, arguments: Sequence[str]) -> dict[str, Any]:
    """The options as plain values, "ufm" being what ``UfMStarConfig.from_dict`` takes.

    Raises:
        ArgumentError: an unknown option, or a value of the wrong kind.
        SystemExit: help was asked for.
    """
    words = list(arguments)
    options = parser.parse_args(words)
    if options.preset is not None:
        preset = SPGFConfig.preset(options.preset).to_dict()
        parser.set_defaults({f"ufm.segment.{name}": value for name, value in preset.items()})
        options = parser.parse_args(words)
    plain: dict[str, Any] = options.as_dict()
    plain["config"] = [str(file) for file in plain["config"] or []]
    if plain["anchors"]:
        plain["ufm"]["anchored"] = True
    return plain


def check_options(options: Mapping[str, Any]) -> None:
    """What can be said of the options before anything is opened.

    Raises:
        ValueError: two contradict each other, one needs another, or a value is out of its range.
    """
    UfMStarConfig.from_dict(options["ufm"])
    parse_slice(options["frames"])
    parse_size(options["size"])
    for name in ("intrinsics", "depth_intrinsics", "map_intrinsics"):
        parse_intrinsics(options[name], f"--{name.replace('_', '-')}")
    model, depth = options["model"], options["depth"]
    if (model is None) == (depth is None):
        wanted = "--model NAME --weights FILE for a network, or --depth DIR for maps that are already predicted"
        raise ValueError(f"the depth must come from one place: give {wanted}" + (", not both" if model else ""))
    if model is not None and not options["weights"]:
        raise ValueError(f"--model {model} needs --weights FILE")
    of_folder = [name for name in ("variance", "depth_scale", "map_intrinsics") if options[name] not in (None, [])]
    needs_model = [name for name in ("weights", "spec", "samples", "offload") if options[name] and model is None]
    needs_trained = [name for name in ("samples", "offload") if options[name] and model != "trained"]
    needs_depth = [*of_folder, *(["size"] if options["size"] is not None else [])] if depth is None else []
    needs_folder = of_folder if depth in OWN_DEPTH else []
    wrong = ((needs_model, "--model"), (needs_trained, "--model trained"))
    for names, missing in (*wrong, (needs_depth, "--depth"), (needs_folder, "--depth DIR")):
        if names:
            raise ValueError(f"--{names[0].replace('_', '-')} goes with {missing} only")
    if options["mode"] == "full" and len(options["weights"]) < 2 and model != "trained":
        raise ValueError("--mode full needs several --weights")
    if options["samples"] is not None and (options["samples"] < 2 or options["mode"] != "full"):
        raise ValueError(f"--samples must be at least 2 and goes with --mode full, got {options['samples']}")
    if options["ufm"].get("anchored") and not options["anchors"]:
        raise ValueError("--ufm.anchored needs anchors: give --anchors instead")
    if options["resume"] and options["overwrite"]:
        raise ValueError("--resume and --overwrite contradict each other")


def parse_slice(text: str | None) -> slice:
    """START:STOP:STEP as a slice, any part of it left out.

    Raises:
        ValueError: another form, or a step below 1.
    """
    parts = (text or ":").split(":")
    try:
        numbers = [int(part) if part.strip() else None for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or (len(numbers) == 3 and numbers[2] is not None and numbers[2] < 1):
        raise ValueError(f"--frames must be START:STOP or START:STOP:STEP with STEP at least 1, got {text!r}")
    return slice(*numbers)


def parse_intrinsics(words: Sequence[str], option: str) -> str | list[float] | None:
    """A file's name, or fx, fy, cx, cy [px]; None for no words.

    Raises:
        ValueError: neither.
    """
    if len(words) <= 1:
        return words[0] if words else None
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != 4:
        raise ValueError(f"{option} must be a file, or the four numbers fx fy cx cy, got {' '.join(words)!r}")
    return numbers


def _add_config(parser: Any, config: type, prefix: str, changed: dict[str, Any]) -> None:
    """An option for every field of a config class, and of the config classes in it."""
    for f in fields(config):
        if f.default is MISSING:
            _add_config(parser, SPGFConfig, f"{prefix}.{f.name}", {})
            continue
        choices = f.metadata.get("choices")
        kind = {"choices": choices} if choices else {"type": _TYPES[str(f.type)]}
        parser.add_argument(f"--{prefix}.{f.name}", default=changed.get(f.name, f.default), help=_help(f), **kind)


def _help(f: Field[Any]) -> str:
    """The paper's symbol, the unit and the range."""
    if "range" not in f.metadata:
        return "one word" if "choices" in f.metadata else "true or false"
    low, high, open_low = f.metadata["range"]
    return f"{f.metadata['symbol']} [{f.metadata['unit']}], {'(' if open_low else '['}{low:g}, {high:g}]"
