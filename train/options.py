"""The options of ``ufmstar train``."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

from ufmstar_torch.eval.commands.options import fields_of, option
from ufmstar_torch.models.spec import NetworkSpec
from ufmstar_torch.train.augment import AugmentationConfig
from ufmstar_torch.train.data_config import KINDS, DataConfig
from ufmstar_torch.train.presets import PRESETS, Recipe, preset
from ufmstar_torch.train.settings import FitSettings, Job


@dataclass(frozen=True, kw_only=True)
class RecipeOptions:
    """Changes of the preset.

    Attributes:
        recipe: of its training.
        network: of its network.
    """

    recipe: dict[str, Any] = fields_of(Recipe, without=("network", "members"), unset=True)
    network: dict[str, Any] = fields_of(NetworkSpec, "network.", without=("members",), unset=True)


@dataclass(frozen=True, kw_only=True)
class DataOptions:
    """Data.

    Attributes:
        data: what --root contains; tours need none.
        root: folder of NYU Depth V2, or sequences.
        config: of the data.
        no_augmentation: train on the frames as they are.
        augment: of the augmentation.
    """

    data: str | None = option(None, choices=KINDS)
    root: tuple[str, ...] = ()
    config: dict[str, Any] = fields_of(DataConfig, without=("kind", "paths", "batch_size", "seed", "augmentation"))
    no_augmentation: bool = False
    augment: dict[str, Any] = fields_of(AugmentationConfig, "augment.")

    def build(self) -> DataConfig:
        """The configuration of the data.

        Raises:
            ValueError: an option is missing, or a value is impossible.
        """
        if self.data is None:
            raise ValueError("--data is missing; ufmstar train --help")
        if (self.data == "tour") == bool(self.root):
            raise ValueError(f"--data {self.data} {'takes no' if self.root else 'needs'} --root")
        augmentation = None if self.no_augmentation else AugmentationConfig(**self.augment)
        return DataConfig(kind=self.data, paths=self.root, augmentation=augmentation, **self.config)


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Run.

    Attributes:
        out: output folder.
        resume: go on with the training in --out.
        overwrite: replace the training in --out.
        threads: CPU threads; default: one for each core.
        debug: show tracebacks.
        settings: of the session.
        trainable: train only parameters whose names begin with one of these.
        no_progress: no progress bar.
        no_tensorboard: no logs for TensorBoard.
    """

    out: Path | None = None
    resume: bool = False
    overwrite: bool = False
    threads: int | None = None
    debug: bool = False
    settings: dict[str, Any] = fields_of(FitSettings, without=("out", "trainable", "progress", "tensorboard"))
    trainable: tuple[str, ...] = ()
    no_progress: bool = False
    no_tensorboard: bool = False

    def build(self) -> FitSettings:
        """The settings of the session.

        Raises:
            ValueError: an option is missing, or a value is impossible.
        """
        if self.out is None:
            raise ValueError("--out is missing; ufmstar train --help")
        if self.resume and self.overwrite:
            raise ValueError("--resume and --overwrite contradict each other")
        shown = {"progress": not self.no_progress, "tensorboard": not self.no_tensorboard}
        return FitSettings(out=self.out, trainable=self.trainable, **shown, **self.settings)


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Train a depth network with an uncertainty head, or an ensemble of them.

    A preset states everything but the data; options change single values of it. OUT/trained.safetensors contains all
    members in the end, for `ufmstar run --model trained --weights OUT/trained.safetensors`.

    Attributes:
        list: print the presets and stop.
        preset: what is trained and how.
        members: number of members of the ensemble or BatchEnsemble.
    """

    USAGE: ClassVar[str] = "ufmstar train --preset NAME --data {nyu,sequences,tour} [--root DIR...] --out OUT [options]"

    list: bool = False
    preset: str | None = option(None, choices=tuple(PRESETS))
    members: int | None = None
    changes: RecipeOptions = field(default_factory=RecipeOptions)
    data: DataOptions = field(default_factory=DataOptions)
    run: RunOptions = field(default_factory=RunOptions)

    def recipe(self) -> Recipe:
        """The preset with the values that the options change.

        Raises:
            ValueError: no preset, or an impossible value.
        """
        if self.preset is None:
            raise ValueError("--preset is missing; ufmstar train --help")
        recipe = preset(self.preset)
        network = replace(recipe.network, **self.changes.network)
        recipe = replace(recipe, network=network, **self.changes.recipe)
        return recipe if self.members is None else recipe.with_members(self.members)

    def job(self) -> Job:
        """The training that the options mean; errors as :meth:`recipe`."""
        return Job(self.recipe(), self.data.build(), self.run.build())
