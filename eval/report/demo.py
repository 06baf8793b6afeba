"""The demo's figures by kind of room, and its files: the sheet, calibration curves and the mixture."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch.camera import unproject
from ufmstar_torch.eval.engine.estimators import Gaussians
from ufmstar_torch.eval.engine.rows import RowResult
from ufmstar_torch.eval.engine.stream import FrameResult, FrameSink, FrameStream
from ufmstar_torch.eval.methods.method import UFM, UFM_STAR
from ufmstar_torch.eval.report.figures_curves import write_curves
from ufmstar_torch.eval.run.files import write_json_atomic
from ufmstar_torch.eval.run.panels import FramePanel, contact_sheet
from ufmstar_torch.eval.run.pictures import ELLIPSOIDS, NPZ, PLY, SHEET, mixture_writers, panel_of
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.sequences.ground_truth import resample_nearest
from ufmstar_torch.eval.tour import Tour
from ufmstar_torch.ufmstar import UfMStar

# The rows in the order of the suite: the member in turn alone, with UfM, UfM*, its posterior, and all members on every
# image.
NETWORK, POSTERIOR, ENSEMBLE = "network", "posterior", "ensemble"
ROWS = (NETWORK, UFM, UFM_STAR, POSTERIOR, ENSEMBLE)
# By style of a "mixed" tour: the networks were trained on the first.
KINDS = {"home": "familiar", "hall": "unfamiliar"}
CURVES = "calibration.png"
DEMO_FILES = (SHEET, CURVES, PLY, ELLIPSOIDS, NPZ, "curves.json")
SHEET_ROWS = 6


class DemoFrames(FrameSink):
    """RMSE and mean variance of every row by kind of room, and the panels of the sheet.

    Args:
        names: a name of ``ROWS`` for each row's key.
        kinds: [H, W] of every frame, see :func:`surface_kinds`.
    """

    def __init__(self, names: Mapping[str, str], kinds: Sequence[NDArray[np.int64]]) -> None:
        self._names, self._kinds = names, kinds
        self._unfamiliar = [bool(kind.mean() > 0.5) for kind in kinds]
        self._shown = sheet_rows(self._unfamiliar)
        self._panels: dict[int, FramePanel] = {}
        # Sums of the squared error [m^2], of the variance [m^2] and of 1, by kind and row.
        self._sums = {(kind, name): np.zeros(3) for kind in KINDS.values() for name in names.values()}

    def begin(self, stream: FrameStream) -> None:
        self._runners = {self._names[runner.key]: runner for runner in stream.rows}

    def take(self, result: FrameResult) -> None:
        """Add a frame."""
        rows = {self._names[slug]: row for slug, row in result.rows.items()}
        for name, row in rows.items():
            self._add(name, row, result)
        if result.index in self._shown:
            note = list(KINDS.values())[self._unfamiliar[result.index]]
            assert result.frame is not None
            shown = panel_of(f"frame {result.index}", note, result.frame, rows[UFM_STAR], rows[POSTERIOR])
            self._panels[result.index] = shown

    def _add(self, name: str, row: RowResult, result: FrameResult) -> None:
        assert row.variance is not None
        assert result.frame is not None
        assert row.truth is not None
        K, size = row.intrinsics, row.size
        kinds = resample_nearest(self._kinds[result.index], result.frame.intrinsics, K, size)
        error = np.square(row.depth.double().numpy() - row.truth)
        maps = np.stack([error, row.variance.double().numpy(), np.ones(size)])
        for number, kind in enumerate(KINDS.values()):
            use = (kinds == number) & (row.truth > 0) & row.valid.numpy()
            self._sums[kind, name] += maps[:, use].sum(1)

    @property
    def panels(self) -> list[FramePanel]:
        """The rows of the sheet, in its order."""
        return [self._panels[index] for index in self._shown]

    def by_kind(self) -> dict[str, dict[str, dict[str, float]]]:
        """By kind of room and row: "rmse" [m] and "rms_sigma", the root of the mean variance [m]; NaN for no pixel."""
        figures: dict[str, dict[str, dict[str, float]]] = {kind: {} for kind in KINDS.values()}
        for (kind, name), (error, variance, pixels) in self._sums.items():
            count = pixels or np.nan
            figures[kind][name] = {"rmse": (error / count) ** 0.5, "rms_sigma": (variance / count) ** 0.5}
        return figures

    def state_bytes(self, name: str) -> int:
        """Bytes of a row on which its next frame depends, but for the map kept for smoothing."""
        runner = self._runners[name]
        evidence = {} if runner.anchors is None or runner.anchors.tracks is None else runner.anchors.tracks.state()
        return int(runner.estimator.memory().get("bytes", 0)) + sum(value.nbytes for value in evidence.values())

    def count(self, name: str) -> int:
        """Points or components that a row keeps."""
        return int(self._runners[name].estimator.memory().get("count", 0))

    @property
    def ufm_star(self) -> UfMStar:
        """After the last frame."""
        estimator = self._runners[UFM_STAR].estimator
        assert isinstance(estimator, Gaussians)
        return estimator.ufm


def surface_kinds(tour: Tour, frame: Frame) -> NDArray[np.int64]:
    """[H, W] at every pixel, whether the visible surface stands in a familiar room (0) or in the unfamiliar one (1).
    The camera may look through a door into another room than its own."""
    assert frame.depth is not None
    K, T = torch.from_numpy(frame.intrinsics)[None], torch.from_numpy(frame.T_world_cam)
    points = unproject(torch.from_numpy(frame.depth).double()[None], K)[0] @ T[:3, :3].T + T[:3, 3]
    names = list(KINDS)
    of_room = torch.tensor([names.index(style) for style in tour.room_styles])
    numbers: NDArray[np.int64] = of_room[tour.room_at(points)].numpy()
    return numbers


def sheet_rows(unfamiliar: list[bool], rows: int = SHEET_ROWS) -> list[int]:
    """At most ``rows`` frames to show, given of every frame whether most of it shows an unfamiliar room: half of them
    in each kind of room, spread evenly, familiar ones first. Frame 0 is not shown: it was compared with nothing."""
    groups = [[i for i, is_new in enumerate(unfamiliar) if is_new == expected and i > 0] for expected in (False, True)]
    present = [group for group in groups if group]
    chosen: list[int] = []
    for group in present:
        spread = np.linspace(0, len(group) - 1, rows // len(present) + 1).round().astype(int)[1:]
        chosen += [group[position] for position in sorted(set(spread.tolist()))]
    return chosen


def write_pictures(
    out: Path, panels: Sequence[FramePanel], curves: Mapping[str, Any], ufm_star: UfMStar, title: str
) -> dict[str, str | None]:
    """Write all of :data:`DEMO_FILES` into an existing folder: the sheet of the panels, the curves by name
    (``SequenceMetrics.curves``), and the mixture. By file: None if it was written, else why not (an optional package is
    missing)."""
    todo: dict[str, Callable[[Path], object]] = {
        SHEET: lambda path: contact_sheet(panels, path, title=title),
        CURVES: lambda path: write_curves(path, curves, title=title),
        **mixture_writers(ufm_star),
        "curves.json": lambda path: write_json_atomic(path, curves),
    }
    made: dict[str, str | None] = {}
    for name, write in todo.items():
        try:
            write(out / name)
            made[name] = None
        except ImportError as error:  # the demo's figures need no pictures
            made[name] = str(error)
    return made
