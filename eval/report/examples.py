"""The example frames of an evaluation: image, ground truth, and the maps of every row."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.run.colours import known_where
from ufmstar_torch.files.read import read_npz_whole
from ufmstar_torch.steps.regress import HALF

Map = NDArray[np.float32]
_SCENE = ("image", "truth", "K")
# The network's A, the spread of members or samples E, and the disagreement between the views M.
PARTS = ("aleatoric", "epistemic", "disagreement")


@dataclass(frozen=True, eq=False)
class RowMaps:
    """One row's maps of a frame, [h, w] float32, NaN where unknown.

    Attributes:
        depth: [m].
        error: |depth - truth| [m].
        sigma: standard deviation [m].
        nll: (g - d)^2 / (2 v) + 0.5 ln(2 pi v) [nats], NaN also where v = 0; float64.
        roots: square roots of the parts of the variance that the row has, by their names in ``PARTS`` [m].
        unmeasured: bool, True where M has one view only; None if the row has no M.
        assumed: bool, True where sigma has no evidence: that of a posterior before the first anchor, else where M is
            unmeasured; None if the row has neither.
    """

    depth: Map
    error: Map
    sigma: Map
    nll: NDArray[np.float64]
    roots: Mapping[str, Map]
    unmeasured: NDArray[np.bool_] | None
    assumed: NDArray[np.bool_] | None

    @classmethod
    def of(cls, stored: Mapping[str, NDArray], truth: Map) -> RowMaps:
        """The maps from stored ones (``suite.examples``) and the ground truth [h, w] [m], 0 or NaN = none."""
        depth, variance = stored["depth"], stored["variance"]
        with np.errstate(invalid="ignore"):
            valid = np.isfinite(depth) & (depth > 0) & np.isfinite(variance) & (variance >= 0)
            judged = valid & (truth > 0) & np.isfinite(truth)
            v = np.where(judged & (variance > 0), variance, np.nan).astype(np.float64)
            error = known_where(judged, np.abs(depth - truth))
        unmeasured = stored["measured"] < HALF if "measured" in stored else None
        exact = np.where(judged, depth, 0).astype(np.float64) - np.where(judged, truth, 0)
        return cls(
            depth=known_where(valid, depth),
            error=error,
            sigma=_root(variance, valid),
            nll=exact**2 / (2 * v) + 0.5 * np.log(2 * math.pi * v),
            roots={name: _root(stored[name], valid) for name in PARTS if name in stored},
            unmeasured=unmeasured,
            assumed=np.isnan(stored["posterior_outlier"]) if "posterior_outlier" in stored else unmeasured,
        )

    @property
    def mean_nll(self) -> float | None:
        """The mean NLL [nats]; None if no pixel has an NLL."""
        judged = self.nll[np.isfinite(self.nll)]
        return float(judged.mean()) if judged.size else None


def _root(variance: Map, valid: NDArray[np.bool_]) -> Map:
    """Standard deviation [m], NaN where invalid."""
    usable = valid & np.isfinite(variance) & (variance >= 0)
    return known_where(usable, np.sqrt(np.where(usable, variance, 0)))


@dataclass(frozen=True, eq=False)
class Example:
    """A frame of a sequence of a data set.

    Attributes:
        image: [H, W, 3] uint8.
        truth: [h, w] ground truth [m], NaN = none.
        aspect: height by width of the maps' field of view; networks with square inputs squeeze wide images.
        rows: maps by the row's file name.
        labels: displayed names of rows, by file name.
    """

    dataset: str
    sequence: str
    frame: str
    image: NDArray[np.uint8]
    truth: Map
    aspect: float
    rows: Mapping[str, RowMaps]
    labels: Mapping[str, str]

    @property
    def title(self) -> str:
        """Sequence and frame."""
        return f"{self.sequence}, frame {self.frame}"


def find_examples(folder: Path, dataset: str, sequence: str, labels: Mapping[str, str]) -> list[Example]:
    """The examples of one sequence, ``OUT/records/DATASET/SEQUENCE``, in the order of their frames.

    Rows whose maps have another camera (a network of another size) are a separate example. Rows without a variance and
    frames without rows are omitted. Raises ValueError: a file cannot be read or its maps do not fit; the message names
    the file.
    """
    stems = {file.stem: file for file in sorted((folder / "examples").glob("*.npz"))}
    # Names of frames and settings may contain "@": a file is a row's if the part before an "@" is a frame's file.
    rows: dict[str, dict[str, Path]] = {}
    for stem, file in stems.items():
        cuts = [at for at, letter in enumerate(stem) if letter == "@" and stem[:at] in stems]
        if cuts:
            rows.setdefault(stem[: cuts[0]], {})[stem[cuts[0] + 1 :]] = file
    return [
        Example(dataset, sequence, frame, *scene, rows=maps, labels=labels)
        for frame, row_files in sorted(rows.items())
        for scene, maps in _cameras(stems[frame], row_files)
    ]


def load_arrays(file: Path, names: Sequence[str]) -> dict[str, NDArray]:
    """The arrays of an npz file. Raises ValueError: the file is no npz or damaged, or one of ``names`` is missing."""
    arrays = read_npz_whole(file)
    missing = [name for name in names if name not in arrays]
    if missing:
        raise ValueError(f"{file} must hold {', '.join(names)}; {', '.join(missing)} is missing")
    return arrays


def _cameras(
    file: Path, row_files: Mapping[str, Path]
) -> Iterable[tuple[tuple[NDArray, Map, float], dict[str, RowMaps]]]:
    """Image, truth and aspect of each camera of a frame's rows, and the rows' maps."""
    common = load_arrays(file, _SCENE)
    cameras: dict[tuple[bytes, tuple[int, ...]], tuple[tuple[NDArray, Map, float], dict[str, RowMaps]]] = {}
    for row, row_file in row_files.items():
        stored = load_arrays(row_file, ("depth",))
        image, truth, K = (stored.get(name, common[name]) for name in _SCENE)
        wrong = [name for name in ("depth", "variance", *PARTS) if stored.get(name, truth).shape != truth.shape]
        if wrong:
            raise ValueError(f"{row_file}: {', '.join(wrong)} must have the truth's shape {truth.shape}")
        if "variance" in stored:
            height, width = truth.shape
            scene = image, known_where(truth > 0, truth), float((height / K[1, 1]) / (width / K[0, 0]))
            camera = K.astype(np.float64).tobytes(), truth.shape
            cameras.setdefault(camera, (scene, {}))[1][row] = RowMaps.of(stored, truth)
    return cameras.values()
