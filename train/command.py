"""``ufmstar train``: its options, and what it prints."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar

from ufmstar_torch.eval.commands.options import UsageError, fields_of, option, parse
from ufmstar_torch.models.spec import NetworkSpec
from ufmstar_torch.train.augment import AugmentationConfig
from ufmstar_torch.train.data_config import KINDS, DataConfig
from ufmstar_torch.train.presets import METHOD_ROWS, PRESETS, Recipe, preset, table
from ufmstar_torch.train.settings import FitSettings, Job


@dataclass(frozen=True, kw_only=True)
class RecipeOptions:
    """Instead of the preset's values."""

    recipe: dict[str, Any] = fields_of(Recipe, without=("network", "members"), unset=True)
    network: dict[str, Any] = fields_of(NetworkSpec, "network.", without=("members", "module"), unset=True)


@dataclass(frozen=True, kw_only=True)
class BackboneOptions:
    """A network of your own instead of a preset.

    Attributes:
        backbone: directory or hub name of a depth model of transformers.
        head: what is trained on it.
        fine_tune: train the network too, not the head alone.
        features: part of the network whose input the head reads; default: the last convolution.
        spec: JSON with declarations about the network: kind, scale, size, alignment.
    """

    backbone: Path | None = None
    head: str = option("aleatoric", choices=tuple(METHOD_ROWS))
    fine_tune: bool = False
    features: str | None = None
    spec: Path | None = None


@dataclass(frozen=True, kw_only=True)
class DataOptions:
    """Data.

    Attributes:
        data: what --root contains; tours need none.
        root: folder of NYU Depth V2, or sequences.
        no_augmentation: train on the frames as they are.
    """

    data: str | None = option(None, choices=KINDS)
    root: tuple[str, ...] = ()
    config: dict[str, Any] = fields_of(DataConfig, without=("kind", "paths", "augmentation"))
    no_augmentation: bool = False
    augment: dict[str, Any] = fields_of(AugmentationConfig, "augment.")


@dataclass(frozen=True, kw_only=True)
class SessionOptions:
    """Session.

    Attributes:
        trainable: train only parameters whose names begin with one of these.
        no_progress: no progress bar.
        no_tensorboard: no logs for TensorBoard.
    """

    settings: dict[str, Any] = fields_of(FitSettings, without=("out", "trainable", "progress", "tensorboard"))
    trainable: tuple[str, ...] = ()
    no_progress: bool = False
    no_tensorboard: bool = False


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Train a depth network with an uncertainty head, or an ensemble of them.

    A preset states everything but the data; options change single values of it. OUT/trained.safetensors contains all
    members in the end, for `ufmstar run --model trained --weights OUT/trained.safetensors`.

    Attributes:
        list: print the presets and stop.
        preset: what is trained and how.
        members: number of members of the ensemble or BatchEnsemble.
        out: folder for all results.
        resume: go on with the training in --out.
        overwrite: replace the training in --out.
        threads: CPU threads; default: one for each core.
    """

    USAGE: ClassVar[str] = (
        "ufmstar train {--preset NAME,--backbone DIR} --data {nyu,sequences,tour} [--root DIR...] --out OUT [options]"
    )

    list: bool = False
    preset: str | None = option(None, choices=tuple(PRESETS))
    members: int | None = None
    out: Path | None = None
    resume: bool = False
    overwrite: bool = False
    threads: int | None = None
    backbone_options: BackboneOptions = field(default_factory=BackboneOptions)
    changes: RecipeOptions = field(default_factory=RecipeOptions)
    source: DataOptions = field(default_factory=DataOptions)
    session: SessionOptions = field(default_factory=SessionOptions)

    def recipe(self) -> Recipe:
        """The preset with the values that the options change. Raises ValueError: no preset, or an impossible value."""
        if self.preset is None:
            raise ValueError("--preset or --backbone is missing; ufmstar train --help")
        recipe = preset(self.preset)
        network = replace(recipe.network, **self.changes.network)
        recipe = replace(recipe, network=network, **self.changes.recipe)
        return recipe if self.members is None else recipe.with_members(self.members)

    def job(self) -> Job:
        """The training that the options mean. Raises ValueError: an option is missing, options contradict each other,
        or a value is impossible."""
        d, s, chosen = self.source, self.session, self.backbone_options
        if self.preset is not None and chosen.backbone is not None:
            raise ValueError("--preset and --backbone contradict each other")
        recipe = None if chosen.backbone is not None else self.recipe()
        if d.data is None or self.out is None:
            raise ValueError(f"--{'data' if d.data is None else 'out'} is missing; ufmstar train --help")
        if self.resume and self.overwrite:
            raise ValueError("--resume and --overwrite contradict each other")
        if (d.data == "tour") == bool(d.root):
            raise ValueError(f"--data {d.data} {'takes no' if d.root else 'needs'} --root")
        augmentation = None if d.no_augmentation else AugmentationConfig(**d.augment)
        data = DataConfig(kind=d.data, paths=d.root, augmentation=augmentation, **d.config)
        settings = FitSettings(
            out=self.out,
            trainable=s.trainable,
            progress=not s.no_progress,
            tensorboard=not s.no_tensorboard,
            **s.settings,
        )
        if recipe is not None:
            return Job(recipe, data, settings)
        from ufmstar_torch.train.own_network import own_job

        assert chosen.backbone is not None
        how: dict[str, Any] = {
            "fine_tune": chosen.fine_tune,
            "features": chosen.features,
            "spec": chosen.spec,
            "network": self.changes.network,
        }
        return own_job(chosen.backbone, chosen.head, data, settings, members=self.members, **how, **self.changes.recipe)


@dataclass(frozen=True, kw_only=True)
class _Command(TrainOptions):
    """The options and the words that they were read from, for the summary."""

    words: Sequence[str]


def read(words: Sequence[str]) -> _Command:
    """The options of a command line; errors as :func:`parse`."""
    options = parse(TrainOptions, words, "ufmstar train")
    return _Command(**{f.name: getattr(options, f.name) for f in fields(options)}, words=words)


def main(options: _Command) -> int:
    """Train, and print the results; the exit code."""
    if options.list:
        print(table())
        return 0
    try:
        job = options.job()
    except (ImportError, OSError, ValueError) as error:
        raise UsageError(error) from error
    from lightning.pytorch.utilities import rank_zero_only

    from ufmstar_torch.eval.commands.terminal import stop_signals
    from ufmstar_torch.eval.sequences.frame import FrameError
    from ufmstar_torch.train.fit import fit, report
    from ufmstar_torch.train.start import missing_start

    process: Any = rank_zero_only
    remark = missing_start(job.recipe.network, job.settings.init)
    if remark and process.rank == 0:
        print(f"ufmstar train: {remark}", file=sys.stderr)
    command = ["ufmstar", "train", *options.words]
    with stop_signals(lambda text: print(text, file=sys.stderr), "step") as stop:
        try:
            summary = fit(job, resume=options.resume, overwrite=options.overwrite, asked=stop, command=command)
        except FrameError as error:
            raise ValueError(f"{error} (--on-bad-file skip leaves such files out)") from error
    if "members" not in summary:
        return 0  # a further process of a distributed training: the first one reports
    print(report(summary))
    print(f"{job.settings.out}: trained.safetensors, summary.json, member_*/, tensorboard/")
    if summary["stopped"] is None:
        return 0
    print(f"ufmstar train: {summary['stopped']}; --resume goes on", file=sys.stderr)
    return 130
