"""``ufmstar demo``: the main job with nothing but the installed package.

A camera walks through rendered rooms. Small depth networks that come with the package, trained on other rooms of
the same kind, predict depth; the last room looks and measures like none of them, so there is an uncertainty to find.
UfM and UfM* judge the same predictions; the table shows how well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from importlib.resources import as_file, files
from pathlib import Path
from statistics import median
from threading import Event
from time import perf_counter
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.landmarks import DENSE
from ufmstar_torch.camera import unproject
from ufmstar_torch.config import AnchorConfig, PosteriorConfig, UfMStarConfig
from ufmstar_torch.eval.commands.demo_command import DemoOptions
from ufmstar_torch.eval.engine.anchors import AnchorSource, Tracks, landmarks_of
from ufmstar_torch.eval.engine.estimators import Alone, Gaussians, Pointwise
from ufmstar_torch.eval.engine.judge import RegionMetrics
from ufmstar_torch.eval.engine.load import sha256
from ufmstar_torch.eval.engine.networks import NetworkSource
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.engine.progress import Progress, ProgressSink
from ufmstar_torch.eval.engine.rows import RowFrame, RowRunner
from ufmstar_torch.eval.engine.stream import FrameResult, FrameSink, FrameStream
from ufmstar_torch.eval.engine.warm_up import warm_up_command
from ufmstar_torch.eval.methods.method import UFM, UFM_STAR
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.methods.ufm import UfMConfig
from ufmstar_torch.eval.report.outputs import DEMO_FILES, ENSEMBLE, NETWORK, POSTERIOR, panel, write_pictures
from ufmstar_torch.eval.report.text import demo_names
from ufmstar_torch.eval.run.files import to_json, write_json_atomic
from ufmstar_torch.eval.run.folder import FolderKind, OutputFolder, remover
from ufmstar_torch.eval.run.panels import FramePanel
from ufmstar_torch.eval.run.summary import versions
from ufmstar_torch.eval.sequences.frame import Frame, FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import resample_nearest
from ufmstar_torch.eval.tour import Tour, make_tour, tour_sequence
from ufmstar_torch.models.trained import load_trained, read_info
from ufmstar_torch.pipeline import NetworksInTurn

# Of "mixed" tours: what the networks were trained on, and what they never saw.
KINDS = {"home": "familiar", "hall": "unfamiliar"}
STYLE = "mixed"
SHEET_ROWS = 6
_POSTERIOR = UfMStarConfig(anchors=AnchorConfig(), posterior=PosteriorConfig())
_WEIGHTS = ("weights", "demo.safetensors")
SUMMARY = "summary.json"
DEMO = FolderKind(program="ufmstar demo", noun="demo", manifest=SUMMARY, clear=remover(*DEMO_FILES))


def run_demo(options: DemoOptions, progress: Callable[[Progress], None] = lambda _: None) -> dict[str, Any]:
    """Walk through the tour and leave pictures, mixture and summary in a folder; what summary.json holds. ``progress``
    is called at the start of each stage and after every step of it.

    Raises:
        FolderError: the folder contains other files, or an earlier demo and ``overwrite`` is off.
        FileNotFoundError, CheckpointError: the networks cannot be loaded.
        ValueError: the networks state no variance.
        OSError: the results cannot be written.
    """
    started = perf_counter()
    device = torch.zeros((), device=options.device).device
    with _weights(options.weights) as file:
        info, members = read_info(file), load_trained(file)
        digest = sha256(file)
    OutputFolder.open(options.out, DEMO, {}, overwrite=options.overwrite).close()
    size = info.spec.size
    tour = tour_sequence(options.seed, frames=options.frames, size=size, style=STYLE, device=device)
    sequence = _rendered(tour, device, progress)
    source = NetworkSource(NetworksInTurn(members, preprocess=members[0].preprocess), device, {}, seeding=None)
    rows, metrics, walk = _walk(sequence, source, device, make_tour(options.seed, STYLE), progress)
    summary = {
        "program": DEMO.program,
        "out": str(options.out),
        "settings": options.settings(),
        "tour": {"seed": options.seed, "style": STYLE, "frames": len(sequence), "size": info.spec.size},
        "network": {
            "file": info.path.name,
            "sha256": digest,
            "members": len(members),
            "spec": info.spec.to_dict(),
            "training": info.info,
        },
        "methods": _methods(rows, metrics, walk),
        "surfaces": metrics.by_region(),
        "components": int(rows[2].estimator.memory()["count"]),
        "points": int(rows[1].estimator.memory()["count"]),
        "versions": versions(),
    }
    progress(Progress("pictures", 0, 1))
    shown = demo_names(len(members))
    overall = {shown[method].strip(): values for method, values in metrics.overall().items()}
    title = f"ufmstar demo: {len(sequence)} frames, seed {options.seed}"
    gaussians = rows[2].estimator
    assert isinstance(gaussians, Gaussians)
    outputs = write_pictures(options.out, walk.panels, overall, gaussians.ufm, title)
    summary |= {"outputs": outputs, "seconds": perf_counter() - started}
    write_json_atomic(options.out / SUMMARY, summary)
    progress(Progress("pictures", 1, 1))
    plain: dict[str, Any] = to_json(summary)
    return plain


def surface_kinds(tour: Tour, frame: Frame) -> NDArray[np.int64]:
    """[H, W] at every pixel, whether what it shows stands in a familiar room (0) or the unfamiliar one (1).

    By what is seen, not by where the camera is: through a door it looks into the next room.
    """
    assert frame.depth is not None
    K, T = torch.from_numpy(frame.intrinsics)[None], torch.from_numpy(frame.T_world_cam)
    points = unproject(torch.from_numpy(frame.depth).double()[None], K)[0] @ T[:3, :3].T + T[:3, 3]
    names = list(KINDS)
    of_room = torch.tensor([names.index(style) for style in tour.room_styles])
    numbers: NDArray[np.int64] = of_room[tour.room_at(points)].numpy()
    return numbers


def sheet_rows(unfamiliar: list[bool], rows: int = SHEET_ROWS) -> list[int]:
    """At most ``rows`` frames to show, given of every frame whether most of it shows an unfamiliar room: half of them
    in each kind of room, spread evenly, familiar ones first. Not the very first frame: nothing has been compared by
    then."""
    groups = [[i for i, is_new in enumerate(unfamiliar) if is_new == expected and i > 0] for expected in (False, True)]
    present = [group for group in groups if group]
    chosen: list[int] = []
    for group in present:
        spread = np.linspace(0, len(group) - 1, rows // len(present) + 1).round().astype(int)[1:]
        chosen += [group[position] for position in sorted(set(spread.tolist()))]
    return chosen


def demo_rows(source: DepthSource, device: torch.device) -> list[RowRunner]:
    """The rows of the table, at the start. The first four judge one prediction, of the member in turn; the last one
    is all members on every image, which is what alternation saves. A single network is no ensemble."""
    dense = AnchorSource(Setting(anchors=DENSE, posterior=True), Tracks(landmarks_of(DENSE, None)))
    rows = [
        RowRunner(NETWORK, source, Alone(), device=device),
        RowRunner(UFM, source, Pointwise(UfMConfig(), device), device=device),
        RowRunner(UFM_STAR, source, Gaussians(UfMStarConfig(), device), device=device),
        RowRunner(POSTERIOR, source, Gaussians(_POSTERIOR, device, posterior=True), anchors=dense, device=device),
    ]
    several = [RowRunner(ENSEMBLE, source, Alone(), every=True, device=device)]
    return rows + (several if source.passes > 1 else [])


class _RequireVariances(FrameSink):
    """Raises ValueError where a row has no variance: the network states none."""

    def take(self, result: FrameResult) -> None:
        if any(row.estimate.variance is None for row in result.rows.values()):
            raise ValueError("the demo needs networks with a variance of their own (an aleatoric or evidential head)")


class _Walk(FrameSink):
    """Collects the rows of the contact sheet and the times of every frame by row and stage [ms]; ``unfamiliar``: of
    every frame, whether most of it shows an unfamiliar room."""

    def __init__(self, unfamiliar: list[bool]) -> None:
        self._unfamiliar = unfamiliar
        self._rows = sheet_rows(unfamiliar)
        self._panels: dict[int, FramePanel] = {}
        self.ms: dict[str, list[Mapping[str, float]]] = {}

    @property
    def panels(self) -> list[FramePanel]:
        """The rows of the sheet, in its order."""
        return [self._panels[index] for index in self._rows]

    def take(self, result: FrameResult) -> None:
        for key, row in result.rows.items():
            self.ms.setdefault(key, []).append(row.ms)
        if result.index in self._rows:
            note = list(KINDS.values())[self._unfamiliar[result.index]]
            self._panels[result.index] = panel(f"frame {result.index}", note, result)

    def median_ms(self, key: str, *stages: str) -> float:
        """Of the typical frame, for those of the stages that the row has [ms]."""
        return median(sum(ms.get(stage, 0.0) for stage in stages) for ms in self.ms[key])


def _walk(
    sequence: FrameSequence, source: DepthSource, device: torch.device, tour: Tour, progress: Callable[[Progress], None]
) -> tuple[list[RowRunner], RegionMetrics, _Walk]:
    """All frames through all rows, with their figures by kind of room. Raises ValueError: a network states no variance
    of its own."""
    # Libraries set themselves up at the first call, which does not count.
    FrameStream(sequence, range(1), demo_rows(source, device), device=device).drive([_RequireVariances()])
    rows, kinds = demo_rows(source, device), [surface_kinds(tour, frame) for frame in sequence]

    def kind_of(result: FrameResult, row: RowFrame) -> Tensor:
        assert result.frame is not None
        K, size = row.prediction.intrinsics.numpy(), row.prediction.size
        return torch.from_numpy(resample_nearest(kinds[result.index], result.frame.intrinsics, K, size))

    metrics = RegionMetrics([row.key for row in rows], list(KINDS.values()), kind_of)
    walk = _Walk([bool(kind.mean() > 0.5) for kind in kinds])
    sinks = [metrics, walk, ProgressSink(progress)]
    FrameStream(sequence, range(len(sequence)), rows, device=device).drive(sinks)
    return rows, metrics, walk


def _rendered(sequence: FrameSequence, device: torch.device, progress: Callable[[Progress], None]) -> FrameSequence:
    """All frames in memory. Meanwhile UfM*'s kernels are compiled, which takes some twenty seconds on the very first
    run."""
    frames, rendered = [], Event()

    def compiling(done: int, total: int) -> None:
        if rendered.is_set():
            progress(Progress("kernels", done, total))

    progress(Progress("rooms", 0, len(sequence)))
    with ThreadPoolExecutor(1) as beside:
        compiled = beside.submit(warm_up_command, _POSTERIOR, device, compiling, dense=True)
        for index in range(len(sequence)):
            frames.append(sequence[index])
            progress(Progress("rooms", index + 1, len(sequence)))
        progress(Progress("kernels", 0, 1))
        rendered.set()
        compiled.result()
    progress(Progress("kernels", 1, 1))
    entries = [
        replace(entry, load_image=partial(np.asarray, frame.image), load_depth=partial(np.asarray, frame.depth))
        for entry, frame in zip(sequence.entries, frames, strict=True)
    ]
    return replace(sequence, entries=tuple(entries))


def _methods(rows: list[RowRunner], metrics: RegionMetrics, walk: _Walk) -> dict[str, Any]:
    """The rows of the table: figures, times, and the bytes on which the next frame depends, but for the map kept for
    smoothing."""
    overall, methods = metrics.overall(), {}
    for row in rows:
        kept = row.estimator.memory()
        evidence = {} if row.anchors is None or row.anchors.tracks is None else row.anchors.tracks.state()
        methods[row.key] = {
            "figures": overall[row.key].compute(),
            "network_ms": walk.median_ms(row.key, "network"),
            "uncertainty_ms": walk.median_ms(row.key, "anchors", "uncertainty") if kept else None,
            "state_bytes": int(kept.get("bytes", 0)) + sum(value.nbytes for value in evidence.values()),
        }
    return methods


@contextmanager
def _weights(path: Path | None) -> Iterator[Path]:
    """The file with the networks: the user's, or the package's own wherever that is installed. Raises
    FileNotFoundError: it is not there."""
    if path is not None:
        if not path.is_file():
            raise FileNotFoundError(f"--weights: no such file: {path}")
        yield path
        return
    own = files("ufmstar_torch.models").joinpath(*_WEIGHTS)
    if not own.is_file():
        raise FileNotFoundError(f"the package was installed without {'/'.join(_WEIGHTS)}; --weights FILE names another")
    with as_file(own) as file:
        yield file
