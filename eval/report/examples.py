"""The example frames that an evaluation keeps: image, ground truth, and the maps of every row."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch import unmeasured
from ufmstar_torch.array_files import read_npz_whole
from ufmstar_torch.eval.run.colours import known_where, striped

Map = NDArray[np.float32]
_SCENE = ("image", "truth", "K")


@dataclass(frozen=True, eq=False)
class RowMaps:
    """One row's maps of a frame, [h, w] float32: depth [m], variance V [m^2], and its parts [m^2] where the row has
    them: the network's own A, the spread of members or samples E, and the disagreement between the views M;
    ``measured`` is the share of M that rests on two views or more.
    """

    depth: Map
    variance: Map
    aleatoric: Map | None = None
    epistemic: Map | None = None
    disagreement: Map | None = None
    measured: Map | None = None

    @property
    def valid(self) -> NDArray[np.bool_]:
        """[h, w] bool, True where depth and variance can be used."""
        with np.errstate(invalid="ignore"):
            return np.isfinite(self.depth) & (self.depth > 0) & np.isfinite(self.variance) & (self.variance >= 0)

    @property
    def known_depth(self) -> Map:
        """[h, w] depth [m], NaN where invalid."""
        return known_where(self.valid, self.depth)

    def root(self, part: Map) -> Map:
        """[h, w] square root of the variance or a part of it [m], NaN where invalid."""
        usable = self.valid & np.isfinite(part) & (part >= 0)
        return known_where(usable, np.sqrt(np.where(usable, part, 0)))

    @property
    def sigma(self) -> Map:
        """[h, w] standard deviation [m], NaN where invalid."""
        return self.root(self.variance)

    def striped(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A picture [h, w, 3] of M or sigma, striped where M was not measured."""
        return rgb if self.measured is None else striped(rgb, self.measured < unmeasured.HALF)


_MAPS = tuple(f.name for f in fields(RowMaps))


@dataclass(frozen=True, eq=False)
class Example:
    """A frame of a sequence of a data set.

    Attributes:
        image: [H, W, 3] uint8.
        truth: [h, w] ground truth [m], 0 = none.
        K: [3, 3] intrinsics of the maps [px].
        rows: maps by the row's file name.
        labels: rows' names for people, by file name.
    """

    dataset: str
    sequence: str
    frame: str
    image: NDArray[np.uint8]
    truth: Map
    K: NDArray[np.float64]
    rows: Mapping[str, RowMaps]
    labels: Mapping[str, str] = field(default_factory=dict)

    def label(self, row: str) -> str:
        """The row's name for people."""
        return self.labels.get(row, row)

    @property
    def aspect(self) -> float:
        """Height by width of what the maps show: networks that take squares squeeze wide images."""
        height, width = self.truth.shape
        return float((height / self.K[1, 1]) / (width / self.K[0, 0]))

    @property
    def known_truth(self) -> Map:
        """[h, w] ground truth [m], NaN where there is none."""
        return known_where(self.truth > 0, self.truth)

    def error(self, row: str) -> Map:
        """[h, w] |depth - truth| [m], NaN where there is no truth or no prediction."""
        maps = self.rows[row]
        known = (self.truth > 0) & np.isfinite(self.truth) & maps.valid
        return known_where(known, np.abs(maps.depth - self.truth))

    def nll(self, row: str) -> NDArray[np.float64]:
        """[h, w] (g - d)^2 / (2 v) + 0.5 ln(2 pi v) [nats], NaN where there is no truth or v = 0."""
        maps = self.rows[row]
        usable = np.isfinite(self.error(row)) & (maps.variance > 0)
        v = np.where(usable, maps.variance, 1.0).astype(np.float64)
        error = np.where(usable, maps.depth.astype(np.float64) - self.truth.astype(np.float64), 0.0)
        return np.where(usable, error**2 / (2 * v) + 0.5 * np.log(2 * math.pi * v), np.nan)


def find_examples(folder: Path, labels: Mapping[str, str] | None = None) -> list[Example]:
    """The examples of one sequence, ``OUT/records/DATASET/SEQUENCE``, in the order of their frames.

    Rows whose maps show the frame with another camera (a network of another size) make an example of their own. Rows
    without a variance and frames without any row are left out. Raises ValueError: a file cannot be read or its maps do
    not fit; the message names it.
    """
    stems = {file.stem: file for file in sorted((folder / "examples").glob("*.npz"))}
    # A frame's name may hold an "@", as a setting's does: a row's file is one whose frame has a file of its own.
    rows: dict[str, dict[str, Path]] = {}
    for stem, file in stems.items():
        cuts = [at for at, letter in enumerate(stem) if letter == "@" and stem[:at] in stems]
        if cuts:
            rows.setdefault(stem[: cuts[0]], {})[stem[cuts[0] + 1 :]] = file
    about = folder.parent.name, folder.name
    return [
        Example(*about, frame, **scene, rows=maps, labels=labels or {})
        for frame, row_files in sorted(rows.items())
        for scene, maps in _cameras(stems[frame], row_files)
    ]


def load_arrays(file: Path, names: Sequence[str]) -> dict[str, NDArray]:
    """The arrays of an npz file. Raises ValueError: it is none, or broken, or one of ``names`` is missing."""
    arrays = read_npz_whole(file)
    missing = [name for name in names if name not in arrays]
    if missing:
        raise ValueError(f"{file} must hold {', '.join(names)}; {', '.join(missing)} is missing")
    return arrays


def _cameras(file: Path, row_files: Mapping[str, Path]) -> Iterable[tuple[dict[str, Any], dict[str, RowMaps]]]:
    """Image, truth and K of each camera that the rows of a frame have, and their maps."""
    common = load_arrays(file, _SCENE)
    cameras: dict[bytes, tuple[dict[str, Any], dict[str, RowMaps]]] = {}
    for row, row_file in row_files.items():
        stored = load_arrays(row_file, ("depth",))
        scene = {name: stored.get(name, common[name]) for name in _SCENE}
        maps = {name: stored[name] for name in _MAPS if name in stored}
        wrong = [name for name, value in maps.items() if value.shape != scene["truth"].shape]
        if wrong:
            raise ValueError(f"{row_file}: {', '.join(wrong)} must have the truth's shape {scene['truth'].shape}")
        if "variance" in maps:
            camera = scene["K"].astype(np.float64).tobytes() + repr(scene["truth"].shape).encode()
            cameras.setdefault(camera, (scene, {}))[1][row] = RowMaps(**maps)
    return cameras.values()
