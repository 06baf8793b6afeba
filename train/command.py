"""``ufmstar train``: its options, and what it prints."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import Field, dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from ufmstar_torch.eval.commands.options import (
    Count,
    File,
    Flag,
    Folder,
    Number,
    Repeated,
    Text,
    Texts,
    arg,
    assigned,
    one_of,
    parse,
)
from ufmstar_torch.eval.commands.terminal import UsageError

if TYPE_CHECKING:
    from ufmstar_torch.train.presets import Recipe
    from ufmstar_torch.train.settings import Job

# Section of --set -> the fields that options set instead.
_WITHOUT: dict[str, tuple[str, ...]] = {
    "network": ("members", "module"),
    "augment": (),
    "data": ("kind", "paths", "augmentation"),
    "session": ("out", "trainable", "progress", "tensorboard"),
    "": ("network", "members"),
}


@dataclass(frozen=True, kw_only=True)
class BackboneOptions:
    """A network of your own instead of a preset.

    Attributes:
        backbone: Train on this directory or hub name of a depth model of transformers.
        head: Train this head on it.
        fine_tune: Train the network too, not the head alone.
        features: The head reads the input of this part of the network (default: the last convolution).
        spec: This JSON file declares the network's kind, scale, size and alignment.
    """

    backbone: Folder = None
    head: Literal["depth-only", "aleatoric", "evidential", "mc-dropout", "ensemble", "batch-ensemble"] = "aleatoric"
    fine_tune: Flag = False
    features: Text = None
    spec: File = None


@dataclass(frozen=True, kw_only=True)
class DataOptions:
    """Images with true depth.

    Attributes:
        data: Train on NYU Depth V2, on sequences, or on rendered tours.
        root: The folder of NYU Depth V2, or of each sequence; tours need none.
        no_augmentation: Train on the frames as they are.
    """

    data: Annotated[Literal["tour", "nyu", "sequences"] | None, one_of("tour", "nyu", "sequences")] = None
    root: Texts = ()
    no_augmentation: Flag = False


@dataclass(frozen=True, kw_only=True)
class SessionOptions:
    """Start, hardware and length of the training.

    Attributes:
        seed: Draw initial weights, order and augmentation with this seed.
        init: Start from these weights: a trained .safetensors, FastDepth's .onnx, a ResNet's .pth, Monodepth2's folder,
            or the word imagenet.
        accelerator: Train on cpu or gpu; auto takes a GPU if there is one.
        devices: Use this many processes or GPUs.
        nodes: Use this many computers.
        trainable: Train only parameters whose names begin with one of these.
        max_minutes: Stop after this time (0: no limit), with a validation and the weights.
        no_progress: Show no progress bar.
        no_tensorboard: Write no logs for TensorBoard.
    """

    seed: int = 0
    init: File = None
    accelerator: str = "auto"
    devices: str = "1"
    nodes: int = 1
    trainable: Texts = ()
    max_minutes: float = 0.0
    no_progress: Flag = False
    no_tensorboard: Flag = False


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Train a depth network with an uncertainty head, or an ensemble of them.

    A preset states everything but the data; --set changes single values of it. OUT/trained.safetensors contains all
    members in the end, for `ufmstar run --model trained --weights OUT/trained.safetensors`.

    Attributes:
        list: Print the presets and stop.
        dry_run: Print all values, and how many frames and steps there are, and stop.
        preset: Train what this preset states.
        members: The ensemble or BatchEnsemble has this many members.
        out: Write all results to this folder; a training there with the same settings continues.
        overwrite: Replace the training in --out.
        threads: Use this many CPU threads (default: one for each core).
        epochs: Train for this many epochs instead of the preset's.
        max_steps: Stop each member after this many steps.
        batch_size: Each step uses this many images instead of the preset's.
        learning_rate: Start at this learning rate instead of the preset's.
        set: Set another value as NAME=VALUE: of Recipe (weight_decay), network. (NetworkSpec), augment.
            (AugmentationConfig), data. (DataConfig) or session. (FitSettings); repeatable (docs/training.md).
    """

    USAGE: ClassVar[str] = (
        "ufmstar train {--preset NAME,--backbone DIR} --data {nyu,sequences,tour} [--root DIR...] --out OUT [options]"
    )

    list: Flag = False
    dry_run: Flag = False
    preset: Text = None
    members: Count = None
    out: Folder = None
    overwrite: Flag = False
    threads: Count = None
    epochs: Count = None
    max_steps: Count = None
    batch_size: Count = None
    learning_rate: Number = None
    set: Repeated = ()
    custom: Annotated[BackboneOptions, arg(name="own-backbone")] = field(default_factory=BackboneOptions)
    source: DataOptions = field(default_factory=DataOptions)
    session: SessionOptions = field(default_factory=SessionOptions)

    def __post_init__(self) -> None:
        if self.set:
            _ = self.changes  # checks the names

    @cached_property
    def changes(self) -> dict[str, dict[str, Any]]:
        """The values that options change, by section. Raises ValueError: no such section or value."""
        named = {name: getattr(self, name) for name in ("epochs", "max_steps", "batch_size", "learning_rate")}
        changes: dict[str, dict[str, Any]] = {section: {} for section in _WITHOUT}
        changes[""] = {name: value for name, value in named.items() if value is not None}
        for name, value in assigned(self.set).items():
            section, _, inner = name.rpartition(".")
            by_name = _fields_of(section)
            if inner not in by_name:
                sections = [f"{prefix}." for prefix in _WITHOUT if prefix]
                expected = ", ".join([*by_name, *(() if section and by_name else sections)])
                within = f"{section}." if section and by_name else ""
                raise ValueError(f"--set has no {name}; expected {within}{expected}")
            if by_name[inner].default == () and not isinstance(value, list):
                value = [value]
            changes[section][inner] = tuple(value) if isinstance(value, list) else value
        return changes

    def recipe(self) -> Recipe:
        """The preset with the values that the options change. Raises ValueError: no preset, or an impossible value."""
        from ufmstar_torch.train.presets import preset

        if self.preset is None:
            raise ValueError("--preset or --backbone is missing; ufmstar train --help")
        recipe = preset(self.preset)
        network = replace(recipe.network, **self.changes["network"])
        recipe = replace(recipe, network=network, **self.changes[""])
        return recipe if self.members is None else recipe.with_members(self.members)

    def job(self) -> Job:
        """The training that the options mean. Raises ValueError: an option is missing, options contradict each other,
        or a value is impossible."""
        from ufmstar_torch.train.augment import AugmentationConfig
        from ufmstar_torch.train.data_config import DataConfig
        from ufmstar_torch.train.settings import FitSettings, Job

        d, s, chosen = self.source, self.session, self.custom
        if self.preset is not None and chosen.backbone is not None:
            raise ValueError("--preset and --backbone contradict each other")
        recipe = None if chosen.backbone is not None else self.recipe()
        if d.data is None or self.out is None:
            raise ValueError(f"--{'data' if d.data is None else 'out'} is missing; ufmstar train --help")
        if (d.data == "tour") == bool(d.root):
            raise ValueError(f"--data {d.data} {'takes no' if d.root else 'needs'} --root")
        augmentation = None if d.no_augmentation else AugmentationConfig(**self.changes["augment"])
        data = DataConfig(kind=d.data, paths=d.root, augmentation=augmentation, **self.changes["data"])
        named = {
            name: getattr(s, name) for name in ("seed", "init", "accelerator", "nodes", "trainable", "max_minutes")
        }
        named |= {"devices": int(s.devices) if s.devices.isdecimal() else s.devices}
        named |= {"progress": not s.no_progress, "tensorboard": not s.no_tensorboard, **self.changes["session"]}
        settings = FitSettings(out=self.out, **named)
        if recipe is not None:
            return Job(recipe, data, settings)
        from ufmstar_torch.train.own_network import own_job

        assert chosen.backbone is not None
        how: dict[str, Any] = {
            "fine_tune": chosen.fine_tune,
            "features": chosen.features,
            "spec": chosen.spec,
            "network": self.changes["network"],
            **self.changes[""],
        }
        return own_job(chosen.backbone, chosen.head, data, settings, members=self.members, **how)


@dataclass(frozen=True, kw_only=True)
class _Command(TrainOptions):
    """The options and the words that they were read from, for the summary."""

    words: Sequence[str]


def _fields_of(section: str) -> dict[str, Field[Any]]:
    """The fields that ``--set`` changes in a section, by name; {} without such a section."""
    from ufmstar_torch.models.spec import NetworkSpec
    from ufmstar_torch.train.augment import AugmentationConfig
    from ufmstar_torch.train.data_config import DataConfig
    from ufmstar_torch.train.presets import Recipe
    from ufmstar_torch.train.settings import FitSettings

    kinds: dict[str, Any] = {"network": NetworkSpec, "augment": AugmentationConfig, "data": DataConfig}
    kinds |= {"session": FitSettings, "": Recipe}
    without = _WITHOUT.get(section, ())
    return {f.name: f for f in fields(kinds[section]) if f.name not in without} if section in kinds else {}


def read(words: Sequence[str]) -> _Command:
    """The options of a command line; errors as :func:`parse`."""
    options = parse(TrainOptions, words, "ufmstar train")
    return _Command(**{f.name: getattr(options, f.name) for f in fields(options)}, words=words)


def main(options: _Command) -> int:
    """Train, and print the results; the exit code."""
    if options.list:
        from ufmstar_torch.train.presets import table

        print(table())
        return 0
    try:
        job = options.job()
    except (ImportError, OSError, ValueError) as error:
        raise UsageError(error) from error
    from lightning.pytorch.utilities import rank_zero_only

    from ufmstar_torch.eval.sequences.frame import FrameError
    from ufmstar_torch.train.fit import fit, plan, report
    from ufmstar_torch.train.start import missing_start

    if options.dry_run:
        print(plan(job))
        return 0
    process: Any = rank_zero_only
    remark = missing_start(job.recipe.network, job.settings.init)
    if remark and process.rank == 0:
        print(f"ufmstar train: {remark}", file=sys.stderr)
    try:
        command = ["ufmstar", "train", *options.words]
        summary = fit(job, overwrite=options.overwrite, command=command)
    except KeyboardInterrupt:
        print("ufmstar train: interrupted; the same command goes on with the last whole epoch", file=sys.stderr)
        return 130
    except FrameError as error:
        raise ValueError(f"{error} (--set data.on_bad_file=skip leaves such files out)") from error
    if not summary:
        return 0  # a further process of a distributed training: the first one reports
    print(report(summary))
    print(f"{job.settings.out}: trained.safetensors, summary.json, member_*/, tensorboard/")
    if summary["stopped"] is None:
        return 0
    print(f"ufmstar train: {summary['stopped']}; the same command goes on", file=sys.stderr)
    return 130
