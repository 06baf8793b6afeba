"""Source and loading of the training data, as plain values."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from ufmstar_torch.eval.tour.style import style_of
from ufmstar_torch.runtime.checked import Checked, choice, number
from ufmstar_torch.runtime.kinds import check_fields
from ufmstar_torch.train.augment import AugmentationConfig

_PART = re.compile(r"(\d+(?:\.\d+)?)\s*(%?):(\d+(?:\.\d+)?)\s*(%?)")


@dataclass(frozen=True)
class Part:
    """A contiguous part of a sequence, without its end: ``0:70%``, ``75%:``.

    Neighbouring frames of a video show the same scene, so validation frames must not be close in time to training
    frames. Therefore a sequence is split into contiguous parts, preferably with a gap (``0:70%`` and ``75%:``), never
    at random.
    """

    start: tuple[float, str]  # a number of frames, or of percent of them with the unit "%"
    stop: tuple[float, str]

    @classmethod
    def parse(cls, text: str) -> Part:
        """Parse ``START:STOP``, each a frame number or a percentage of the frames; default: the first, the end. Raises
        ValueError: another form, a share above 100 %, or an empty part."""
        start, colon, stop = text.partition(":")
        found = _PART.fullmatch(f"{start.strip() or '0'}:{stop.strip() or '100%'}") if colon else None
        edges = [] if found is None else [(float(found[1]), found[2]), (float(found[3]), found[4])]
        if not edges or any(value > 100 if unit else value % 1 for value, unit in edges):
            raise ValueError(f"a part must be START:STOP in frames or percent (0:70%, 100:400), got {text!r}")
        if edges[0][1] == edges[1][1] and edges[0] >= edges[1]:
            raise ValueError(f"a part must end after its start, got {text!r}")
        return cls(*edges)

    def frames(self, length: int) -> range:
        """The frame numbers of a sequence of that length. Raises ValueError: the part has no frame."""
        # Rounded to 1e-6 first, so that 70 % of 10 is 7 despite rounding errors.
        first, end = (
            int(round(value * length / 100, 6)) if unit else int(value) for value, unit in (self.start, self.stop)
        )
        part = range(min(length, first), min(length, end))
        if not part:
            raise ValueError(f"the part {self} of {length} frames is empty")
        return part

    def __str__(self) -> str:
        return ":".join(f"{value:g}{unit}" for value, unit in (self.start, self.stop))


@dataclass(frozen=True)
class DataConfig(Checked):
    """Training and validation data.

    Attributes:
        kind: "nyu" (FastDepth's h5 layout), "sequences" (the layouts of ``open_sequence``, and folders of images and
            depth maps without poses), or "tour" (rendered rooms).
        paths: nyu: the folder with ``train`` and ``val``; sequences: one or more; tour: none.
        validation_paths: sequences to validate on; empty = the held-back part of ``paths``.
        part: part of each sequence to train on, ``START:STOP`` in frames or percent.
        validation_part: part of each sequence that is held back. A gap after ``part`` keeps frames that show the
            same thing out of both.
        tours: number of rendered tours to train on.
        validation_tours: number of other tours to validate on.
        first_tour: seed of the first tour, the others follow; the default leaves the small numbers, which users
            try, to tours that training has never seen.
        tour_frames: frames of each tour.
        tour_stride: steps of the walk between two frames; a step is about 12 cm or 5 degrees.
        tour_style: "home", "hall", "mixed", "blank" or "scales".
        tour_size: (height, width) [px] of the rendered frames.
        tour_fov: horizontal field of view [degrees].
        cache: folder for rendered tours; empty = the user's cache folder.
        render_workers: processes that render.
        workers: processes that load frames; 0 = the training's own.
        augmentation: of the training part, or None.
        on_bad_file: "raise" or "skip", see ``SampleDataset``.

    Raises:
        ValueError: a value is impossible; the message names the field.
    """

    kind: str = choice("tour", "nyu", "sequences")
    paths: tuple[str, ...] = ()
    validation_paths: tuple[str, ...] = ()
    part: str = "0:80%"
    validation_part: str = "85%:100%"
    tours: int = number(100, "N", "tours", 1)
    validation_tours: int = number(8, "N", "tours", 1)
    first_tour: int = number(10_000, "seed", "1", 0)
    tour_frames: int = number(40, "N", "frames", 1)
    tour_stride: int = number(6, "N", "steps", 1)
    tour_style: str = "home"
    tour_size: tuple[int, int] = (160, 224)
    tour_fov: float = number(70.0, "fov", "degrees", 20, 120)
    cache: str = ""
    render_workers: int = number(1, "N", "processes", 1)
    workers: int = number(0, "N", "processes", 0)
    augmentation: AugmentationConfig | None = field(default_factory=AugmentationConfig)
    on_bad_file: str = choice("raise", "skip")

    def __post_init__(self) -> None:
        check_fields(self)
        super().__post_init__()
        count = len(self.paths)
        fits = {"nyu": count == 1, "sequences": count > 0, "tour": count == 0}[self.kind]
        if not fits:
            expected = {"nyu": "one folder", "sequences": "at least one sequence", "tour": "nothing"}[self.kind]
            raise ValueError(f"DataConfig.paths must name {expected} where kind is {self.kind!r}, got {self.paths}")
        if self.validation_paths and self.kind != "sequences":
            raise ValueError(f"DataConfig.validation_paths is for kind 'sequences', got kind {self.kind!r}")
        if len(self.tour_size) != 2 or min(self.tour_size) < 8:
            raise ValueError(
                f"DataConfig.tour_size must be (height, width) of at least 8 px each, got {self.tour_size}"
            )
        style_of(self.tour_style)
        for name in ("part", "validation_part"):
            try:
                Part.parse(getattr(self, name))
            except ValueError as error:
                raise ValueError(f"DataConfig.{name}: {error}") from error
