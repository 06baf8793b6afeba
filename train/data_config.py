"""Where training data come from and how they are served, as plain values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from ufmstar_torch.train.augment import AugmentationConfig
from ufmstar_torch.train.parts import Part

KINDS = ("nyu", "sequences", "tour")


@dataclass(frozen=True)
class DataConfig:
    """Training and validation data.

    Attributes:
        kind: "nyu" (FastDepth's h5 layout), "sequences" (whatever ``open_sequence`` reads, and folders of
            images and depth maps without poses), or "tour" (rendered rooms).
        paths: nyu: the folder with ``train`` and ``val``; sequences: one or more; tour: none.
        validation_paths: sequences to validate on; empty = the held-back part of ``paths``.
        part: what of each sequence is trained on, ``START:STOP`` in frames or percent.
        validation_part: what of each sequence is held back. A gap behind ``part`` keeps frames that show the
            same thing out of both.
        tours: number of rendered tours to train on.
        validation_tours: to validate on; others than those.
        first_tour: seed of the first one, the others follow; the default leaves the small numbers, which a
            user tries, to tours that training has never seen.
        tour_frames: of each tour.
        tour_stride: every how many steps of the walk a frame is taken; a step is about 12 cm or 5 degrees.
        tour_style: "home", "hall" or "mixed".
        tour_size: (height, width) [px] of the rendered frames.
        tour_fov: horizontal field of view [degrees].
        cache: folder for rendered tours; empty = the user's cache folder.
        render_workers: processes that render, at least 1.
        batch_size: frames per step and process.
        workers: processes that load frames; 0 = none but the training's own.
        seed: of the order and the augmentation.
        augmentation: of the training part, or None.
        on_bad_file: "raise" or "skip", see ``SampleDataset``.

    Raises:
        ValueError: a value is impossible; the message names the field.
    """

    kind: str = "tour"
    paths: tuple[str, ...] = ()
    validation_paths: tuple[str, ...] = ()
    part: str = "0:80%"
    validation_part: str = "85%:100%"
    tours: int = 100
    validation_tours: int = 8
    first_tour: int = 10_000
    tour_frames: int = 40
    tour_stride: int = 6
    tour_style: str = "home"
    tour_size: tuple[int, int] = (160, 224)
    tour_fov: float = 70.0
    cache: str = ""
    render_workers: int = 1
    batch_size: int = 8
    workers: int = 0
    seed: int = 0
    augmentation: AugmentationConfig | None = field(default_factory=AugmentationConfig)
    on_bad_file: str = "raise"

    def __post_init__(self) -> None:
        lowest = {"tours": 1, "validation_tours": 1, "first_tour": 0, "tour_frames": 1, "tour_stride": 1}
        for name, low in {**lowest, "render_workers": 1, "batch_size": 1, "workers": 0, "seed": 0}.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < low:
                raise ValueError(f"DataConfig.{name} must be a whole number of at least {low}, got {value!r}")
        for name, words in {"kind": KINDS, "on_bad_file": ("raise", "skip")}.items():
            if getattr(self, name) not in words:
                raise ValueError(f"DataConfig.{name} must be one of {', '.join(words)}, got {getattr(self, name)!r}")
        wanted = {"nyu": "one folder", "sequences": "at least one sequence", "tour": "nothing"}[self.kind]
        found = len(self.paths)
        if not {"nyu": found == 1, "sequences": found >= 1, "tour": found == 0}[self.kind]:
            raise ValueError(f"DataConfig.paths must name {wanted} where kind is {self.kind!r}, got {self.paths}")
        if self.validation_paths and self.kind != "sequences":
            raise ValueError(f"DataConfig.validation_paths is for kind 'sequences', got kind {self.kind!r}")
        for name in ("part", "validation_part"):
            try:
                Part.parse(getattr(self, name))
            except ValueError as error:
                raise ValueError(f"DataConfig.{name}: {error}") from error

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> DataConfig:
        """From JSON: lists become tuples, a mapping the augmentation.

        Raises:
            ValueError: an unknown key, or an impossible value.
        """
        known = {f.name for f in fields(cls)}
        if unknown := sorted(set(values) - known):
            raise ValueError(f"DataConfig has no {unknown}; it has {sorted(known)}")
        plain: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        if isinstance(plain.get("augmentation"), Mapping):
            plain["augmentation"] = AugmentationConfig.from_dict(plain["augmentation"])
        return cls(**plain)

    def to_dict(self) -> dict[str, Any]:
        """The fields as plain values."""
        return asdict(self)
