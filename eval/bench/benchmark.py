"""``ufmstar bench``: times of the stages and of the whole UfM* step beside two networks' forward passes.

Nothing here passes or fails: absolute times depend on the machine and on what else it does. See
docs/results/benchmark.md for what each figure means.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ufmstar_torch import UfMStarConfig
from ufmstar_torch.eval.bench.timing import most_threads, pinned_threads

if TYPE_CHECKING:
    from ufmstar_torch.eval.bench.frames import FrameSource

# Milliseconds and ratios at 224 x 224, bytes and ratios for one room; the tracker's mean processor time for 300 corners
# at 640 x 480. For information.
_TARGETS = {
    "spgf_ms": 1.5,
    "step_ms": 10.0,
    "step/resnet50": 1 / 3,
    "components_bytes": 30_000.0,
    "long_run_ratio": 1.2,
    "tracker_cpu_ms": 3.0,
}
_TARGET_SIZE, _TARGET_CORNERS = 224, 300
_WARM_UP, _TORCH_ROUNDS = 3, 3
_PARTS = ("compilation", "long_run", "anchors", "peer", "against", "rates", "device")  # None where not measured


@dataclass(frozen=True, kw_only=True)
class BenchSettings:
    """Times of the stages and of the whole UfM* step beside the forward passes of two networks.

    Nothing passes or fails: absolute times depend on the machine and on its other load. docs/results/benchmark.md
    explains each figure.

    Attributes:
        sequence: recorded sequence instead of a rendered room
        weights: FastDepth's weights instead of random ones; with --sequence it then predicts the depth
        runtime: of the networks; auto: the one that is faster here
        peer: another program, timed on the same frames: whole processes, and the frames for which it prints
            {"ms": TIME} on a line; they lie in the folder that UFMSTAR_BENCH_FRAMES names
        against: an earlier report of the same machine, with which this one is compared
        sizes: sizes of the square images [px]
        backends: kernels that are timed
        frames: number of timed frames (the torch backend: at most 3)
        in_view: number of components in view from which on frames are timed
        history: number of frames before that at most
        boxes: number of boxes in the rendered room
        threads: number of threads of torch and numba; default: the cores of this process
        seed: of the rendered room
        long: also time this many frames of each world (1000 without a number)
        world: of the long runs: one room (or the sequence); a building of twenty rooms, each seen for 50 frames, then
            again; a drive straight on, 2 m a frame
        merge: limits of merging (UfMStarConfig.merge) of the long runs, which are run with each; 0 = off
        max_components: likewise limits of the components in memory, the others in a temporary folder; 0 = all in memory
        anchors: also time the tracker of this many corners at 640 x 480 and the step with as many anchors, both on one
            thread (300 without a number; needs OpenCV)
        skip_compile: do not time compilation (some tens of seconds)
        device: time steps of 1, 64 and 256 streams on this GPU instead (cuda)
        json: file for the report
    """

    sequence: Path | None = None
    weights: Path | None = None
    runtime: str = field(default="auto", metadata={"choices": ("auto", "torch", "onnx")})
    peer: str | None = None
    against: Path | None = None
    sizes: tuple[int, ...] = (224, 518)
    backends: tuple[str, ...] = field(default=("numba", "torch"), metadata={"choices": ("numba", "torch")})
    frames: int = 40
    in_view: int = 100
    history: int = 400
    boxes: int = 40
    threads: int | None = None
    seed: int = 0
    long: int | None = field(default=None, metadata={"const": 1000})
    world: tuple[str, ...] = field(default=("room",), metadata={"choices": ("room", "building", "drive")})
    merge: tuple[float, ...] = (0.0,)
    max_components: tuple[int, ...] = (0,)
    anchors: int | None = field(default=None, metadata={"const": _TARGET_CORNERS})
    skip_compile: bool = False
    device: str = "cpu"
    json: Path | None = None

    def __post_init__(self) -> None:
        for name in ("frames", "boxes", "history", "in_view", "anchors", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"--{name.replace('_', '-')} must be at least 1, got {value}")
        if not self.merge or min(self.merge) < 0:
            raise ValueError(f"--merge must be limits of at least 0, got {list(self.merge)}")
        if not self.max_components or min(self.max_components) < 0:
            raise ValueError(f"--max-components must be limits of at least 0, got {list(self.max_components)}")
        if min(self.sizes) < 16:
            raise ValueError(f"--sizes must be at least 16 pixels, got {list(self.sizes)}")


def run_benchmark(options: BenchSettings, progress: Callable[[str], object] = lambda text: None) -> dict[str, Any]:
    """Measure what the options ask for.

    Args:
        options: see :class:`BenchSettings`.
        progress: is called with a description of what is measured next.

    Returns:
        The report: settings, versions, hardware, "results" per size and backend, "rates" of the machine, "compilation",
        "long_run", "growth" (a long run for each world, limit of merging and limit of components), "anchors", "device",
        "peer" and "against" where asked for, and "targets".

    Raises:
        ValueError: an option is out of range.
        FileNotFoundError, ModuleNotFoundError: a file or a package is missing.
    """
    from ufmstar_torch.eval.bench.compare import compare
    from ufmstar_torch.eval.results import machine

    if options.against is not None and not options.against.is_file():
        raise FileNotFoundError(f"--against {options.against} does not exist")
    report: dict[str, Any] = {**dict.fromkeys(_PARTS), "growth": [], "results": []}
    load = {"before": machine.load_average()}
    threads = most_threads() if options.threads is None else options.threads
    report |= {
        "schema": 1,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": machine.versions(),
        "hardware": machine.hardware(),
        "settings": {"threads": threads, "seed": options.seed, "config": UfMStarConfig().to_dict()},
    }
    if options.device == "cpu":
        report |= _on_cpu(options, threads, report["settings"], progress)
        report["targets"] = targets(report)
    else:
        from ufmstar_torch.eval.bench.device import measure_device

        measured = measure_device(options.device, options.sizes, options.frames, options.seed, progress)
        report |= {"device": measured, "targets": []}
    report["load_average"] = {**load, "after": machine.load_average()}
    if options.against is not None and options.device == "cpu":
        report["against"] = compare(report, options.against)
    return report


def _on_cpu(
    options: BenchSettings, threads: int, settings: dict[str, Any], progress: Callable[[str], object]
) -> dict[str, Any]:
    """The parts of the report that are measured here; "source" is added to the settings."""
    from ufmstar_torch.eval.bench.compare import measure_peer
    from ufmstar_torch.eval.bench.floors import machine_rates
    from ufmstar_torch.eval.bench.step import measure_compilation

    parts: dict[str, Any] = {}
    if "numba" in options.backends and not options.skip_compile:
        progress("compilation")
        parts["compilation"] = measure_compilation()
    config = UfMStarConfig()
    with pinned_threads(threads):
        parts["rates"] = machine_rates()
        fastdepth, source = _inputs(options)
        settings["source"] = source.describe()
        parts["results"] = _results(options, config, fastdepth, source, parts["rates"], progress)
        if options.peer is not None:
            progress("the peer")
            parts["peer"] = measure_peer(options.peer, source.frames(options.sizes[0], options.frames))
        if options.long is not None:
            parts["growth"] = _growth(options, config, source, progress)
            parts["long_run"] = next((run for run in parts["growth"] if run["world"] == "room"), None)
        if options.anchors is not None:
            parts["anchors"] = _anchors(options, config, source, progress)
    return parts


def _growth(
    options: BenchSettings, config: UfMStarConfig, source: FrameSource, progress: Callable[[str], object]
) -> list[dict[str, Any]]:
    """The long runs."""
    from ufmstar_torch.eval.bench.frames import RenderedBuilding, RenderedStreet
    from ufmstar_torch.eval.bench.growth import measure_growth

    assert options.long is not None
    config = config.replace(backend=options.backends[0])
    building, street = RenderedBuilding(boxes=options.boxes, seed=options.seed), RenderedStreet(seed=options.seed)
    far = config.replace(segment=replace(config.segment, max_depth=street.max_depth))
    worlds = {"room": (source, config), "building": (building, config), "drive": (street, far)}
    chosen = {name: worlds[name] for name in options.world}
    return measure_growth(
        chosen, options.merge, options.max_components, size=_TARGET_SIZE, frames=options.long, progress=progress
    )


def _inputs(options: BenchSettings) -> tuple[Any, Any]:
    """FastDepth, with random weights of the pruned network's shape if none are given, and the frames' source."""
    from ufmstar_torch.eval.bench.frames import RecordedSequence, RenderedRoom
    from ufmstar_torch.models import FastDepth, FastDepthWidths, load_network

    if options.weights is None:
        fastdepth = FastDepth(FastDepthWidths.pruned()).eval()
    else:
        loaded = load_network("fastdepth", options.weights)
        assert isinstance(loaded, FastDepth)
        fastdepth = loaded
    if options.sequence is None:
        return fastdepth, RenderedRoom(boxes=options.boxes, seed=options.seed)
    if not options.sequence.exists():
        raise FileNotFoundError(f"--sequence {options.sequence} does not exist")
    return fastdepth, RecordedSequence(options.sequence, None if options.weights is None else fastdepth)


def _results(
    options: BenchSettings,
    config: Any,
    fastdepth: Any,
    source: Any,
    rates: dict[str, float],
    progress: Callable[[str], object],
) -> list[dict[str, Any]]:
    from ufmstar_torch.eval.bench.step import build_up, measure_step, reference_networks

    results = []
    for size in options.sizes:
        progress(f"{size} x {size}, building up the mixture")
        networks, about = reference_networks(size, fastdepth, options.runtime)
        built, frames, history = build_up(
            source, config, size=size, in_view=options.in_view, history=options.history,
            rounds=_WARM_UP + options.frames,
        )  # fmt: skip
        for backend in options.backends:
            progress(f"{size} x {size}, {backend}")
            warm_up, timed = _WARM_UP, options.frames
            if backend == "torch":
                warm_up, timed = 1, min(timed, _TORCH_ROUNDS)
            result = measure_step(
                built, frames[: warm_up + timed], networks, backend=backend, warm_up=warm_up, rates=rates
            )
            results.append({**result, "history": history, "networks_about": about})
    return results


def _anchors(options: BenchSettings, config: Any, source: Any, progress: Callable[[str], object]) -> dict[str, Any]:
    from ufmstar_torch.eval.bench.anchors import measure_anchors

    assert options.anchors is not None
    progress(f"{options.anchors} corners and anchors")
    return measure_anchors(
        source, config.replace(backend=options.backends[0]), points=options.anchors, frames=options.frames,
        history=options.history, in_view=options.in_view, step_size=_TARGET_SIZE,
    )  # fmt: skip


def targets(report: dict[str, Any]) -> list[dict[str, Any]]:
    """The figures that have a target, for information: name, value (None = not measured), target, met."""
    expected = (r for r in report["results"] if r["size"] == _TARGET_SIZE and r["backend"] == "numba")
    result, long_run, anchors = next(expected, None), report["long_run"], report["anchors"]
    values: dict[str, float | None] = dict.fromkeys(_TARGETS)
    if result is not None:
        values["spgf_ms"] = result["kernels"]["spgf"]["median_ms"]
        values["step_ms"] = result["step"]["median_ms"]
        values["components_bytes"] = result["memory"]["in_use"]
        if "step/resnet50" in result["ratios"]:
            values["step/resnet50"] = result["ratios"]["step/resnet50"]["median"]
    if long_run is not None:
        values["long_run_ratio"] = long_run["ratio"]
        values["components_bytes"] = long_run["memory"]["in_use"]
    if anchors is not None and anchors["points"] == _TARGET_CORNERS:
        values["tracker_cpu_ms"] = anchors["tracker"]["update"]["cpu_mean_ms"]
    return [
        {"name": name, "value": value, "target": target, "met": None if value is None else value <= target}
        for (name, value), target in zip(values.items(), _TARGETS.values(), strict=True)
    ]
