"""The options of ``ufmstar train``: what a user can say, and what it means."""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, fields, replace
from functools import reduce
from operator import or_
from pathlib import Path
from typing import TYPE_CHECKING, Any, Union, get_args, get_origin, get_type_hints

from ufmstar_torch.models.spec import NetworkSpec
from ufmstar_torch.train.presets import PRESETS, Recipe, preset
from ufmstar_torch.train.settings import FitSettings

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser

    from ufmstar_torch.train.member import Job

_USAGE = "ufmstar train --preset NAME --data {nyu,sequences,tour} [--root DIR...] --out OUT [options]"
_DESCRIPTION = """Train a depth network with an uncertainty head, or an ensemble of them.

A preset says everything but the data; options change single values of it. OUT/trained.safetensors holds all members
in the end, for `ufmstar run --model trained --weights OUT/trained.safetensors`."""
KINDS = ("nyu", "sequences", "tour")
# Fields that other options or the recipe fill in.
_TAKEN = ("kind", "paths", "batch_size", "seed", "augmentation")
_SETTINGS_HELP = {
    "seed": "of the training; member n has 1000 seed + n, so that trainings with different seeds share none",
    "init": "weights to start from: a trained .safetensors, FastDepth's .onnx, a ResNet's .pth or the word imagenet",
    "trainable": "train only parameters whose names begin so",
    "accelerator": "cpu, gpu or auto",
    "devices": "number of processes or GPUs, as Lightning takes it",
    "nodes": "computers",
    "strategy": "Lightning's name of how they work together: auto, ddp, ...",
    "precision": "32-true, bf16-mixed or 16-mixed; the loss is in float32 always",
    "member_processes": "members that are trained at the same time",
    "checkpoint_every": "steps between checkpoints within an epoch, 0 = at the end of epochs only",
    "log_every": "steps between rows of steps.csv",
    "sync_batchnorm": "whether batch norm uses the batches of all processes (GPUs only)",
    "examples": "validation images in each epoch's picture, 0 = no pictures",
    "max_minutes": "after which this session stops in good order, all members together; --resume goes on",
}


def train_parser() -> ArgumentParser:
    """The parser of ``ufmstar train``; it raises ``ArgumentError`` instead of ending the program."""
    from jsonargparse import ActionConfigFile, ArgumentParser

    from ufmstar_torch.train.augment import AugmentationConfig
    from ufmstar_torch.train.data import DataConfig

    parser = ArgumentParser(prog="ufmstar train", usage=_USAGE, description=_DESCRIPTION, exit_on_error=False)
    parser.add_argument("--config", action=ActionConfigFile, help="JSON or YAML file with any of these options")
    parser.add_argument("--list", action="store_true", help="show the presets and stop")
    parser.add_argument("--preset", choices=tuple(PRESETS), default=None, help="what is trained and how")
    parser.add_argument("--members", type=int, default=None, help="of the ensemble or BatchEnsemble")
    recipe = parser.add_argument_group("instead of the preset's")
    _add_fields(recipe, Recipe, "", ("network", "members"), unset=True)
    _add_fields(recipe, NetworkSpec, "network.", ("members",), unset=True)
    data = parser.add_argument_group("data")
    data.add_argument("--data", choices=KINDS, default=None, help="what --root holds; tours need none")
    data.add_argument("--root", nargs="+", default=[], help="folder of NYU Depth V2, or sequences")
    _add_fields(data, DataConfig, "", _TAKEN)
    data.add_argument("--no-augmentation", action="store_true", help="train on the frames as they are")
    _add_fields(data, AugmentationConfig, "augment.", ())
    run = parser.add_argument_group("run")
    run.add_argument("--out", type=str, default=None, help="folder for everything that is written")
    run.add_argument("--resume", action="store_true", help="go on with the training in --out")
    run.add_argument("--overwrite", action="store_true", help="replace the training in --out")
    run.add_argument("--threads", type=int, default=None, help="CPU threads; default: as many as there are")
    run.add_argument("--debug", action="store_true", help="show tracebacks")
    _add_fields(run, FitSettings, "", ("out", "trainable", "progress", "tensorboard"))
    run.add_argument("--trainable", nargs="+", default=[], help=_SETTINGS_HELP["trainable"])
    run.add_argument("--no-progress", action="store_true", help="no progress bar")
    run.add_argument("--no-tensorboard", action="store_true", help="no logs for TensorBoard")
    return parser


def job_from(options: Mapping[str, Any]) -> Job:
    """What the options mean.

    Raises:
        ValueError: an option is missing, impossible, or contradicts another.
    """
    from ufmstar_torch.train.augment import AugmentationConfig
    from ufmstar_torch.train.data import DataConfig
    from ufmstar_torch.train.member import Job

    for name in ("preset", "data", "out"):
        if options[name] is None:
            raise ValueError(f"--{name} is missing; ufmstar train --help")
    if options["resume"] and options["overwrite"]:
        raise ValueError("--resume and --overwrite contradict each other")
    if (options["data"] == "tour") == bool(options["root"]):
        raise ValueError(f"--data {options['data']} {'takes no' if options['root'] else 'needs'} --root")
    augmentation = None if options["no_augmentation"] else AugmentationConfig(**options["augment"])
    named = {f.name: options[f.name] for f in fields(DataConfig) if f.name not in _TAKEN}
    data = DataConfig(kind=options["data"], paths=tuple(options["root"]), augmentation=augmentation, **named)
    names = [f.name for f in fields(FitSettings) if f.name not in ("out", "trainable", "progress", "tensorboard")]
    settings = FitSettings(
        out=Path(options["out"]),
        trainable=tuple(options["trainable"]),
        progress=not options["no_progress"],
        tensorboard=not options["no_tensorboard"],
        **{name: options[name] for name in names},
    )
    return Job(recipe_from(options), data, settings)


def recipe_from(options: Mapping[str, Any]) -> Recipe:
    """The preset with the values that the options change.

    Raises:
        ValueError: a value is impossible.
    """
    recipe = preset(options["preset"])
    network = {k: v for k, v in options["network"].items() if v is not None}
    own = {f.name: options[f.name] for f in fields(Recipe) if f.name not in ("network", "members")}
    recipe = replace(
        recipe, network=replace(recipe.network, **network), **{k: v for k, v in own.items() if v is not None}
    )
    return recipe if options["members"] is None else recipe.with_members(options["members"])


def parse_train(parser: ArgumentParser, words: Sequence[str]) -> dict[str, Any]:
    """The options as plain values.

    Raises:
        ArgumentError: an unknown option, or a value of the wrong kind.
        SystemExit: help was asked for.
    """
    plain: dict[str, Any] = parser.parse_args(list(words)).as_dict()
    plain["config"] = [str(file) for file in plain["config"] or []]
    return plain


def _add_fields(group: Any, config: type, prefix: str, without: Sequence[str], *, unset: bool = False) -> None:
    """An option for every field of a config class; ``unset``: None where it is not given."""
    hints = get_type_hints(config)
    for f in fields(config):
        if f.name in without:
            continue
        kind = hints[f.name]
        default = None if unset else _default(f)
        told = _SETTINGS_HELP.get(f.name, f"{config.__name__}.{f.name}")
        if kind is bool and not unset:
            group.add_argument(f"--{_dashes(prefix + f.name)}", type=bool, default=default, help=told)
            continue
        parts = get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)
        # Text takes every word, so it comes last.
        parts = tuple(sorted(dict.fromkeys((*parts, *((type(None),) if unset else ()))), key=lambda part: part is str))
        kind = reduce(or_, parts)
        group.add_argument(f"--{_dashes(prefix + f.name)}", type=kind, default=default, help=told)


def _dashes(name: str) -> str:
    """Option names have dashes; those of a nested config keep the field's own name."""
    return name if "." in name else name.replace("_", "-")


def _default(f: Field[Any]) -> Any:
    if f.default is not MISSING:
        return f.default
    return f.default_factory() if f.default_factory is not MISSING else None
