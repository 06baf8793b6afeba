"""``ufmstar bench``: times of the stages and of the whole UfM* step beside two networks' forward passes.

Nothing here passes or fails: absolute times depend on the machine and on what else it does. See
docs/results/benchmark.md for what each figure means.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from ufmstar_torch import UfMStarConfig
from ufmstar_torch.eval.bench.anchors import measure_anchors
from ufmstar_torch.eval.bench.compare import compare, measure_peer
from ufmstar_torch.eval.bench.device import measure_device
from ufmstar_torch.eval.bench.floors import machine_rates
from ufmstar_torch.eval.bench.frames import (
    FrameSource,
    RecordedSequence,
    RenderedBuilding,
    RenderedRoom,
    RenderedStreet,
)
from ufmstar_torch.eval.bench.growth import measure_growth
from ufmstar_torch.eval.bench.settings import CORNERS, BenchSettings
from ufmstar_torch.eval.bench.step import build_up, measure_compilation, measure_step, reference_networks
from ufmstar_torch.eval.bench.timing import most_threads, pinned_threads
from ufmstar_torch.eval.run import machine
from ufmstar_torch.models import FastDepth, FastDepthWidths, load_network

# Milliseconds and ratios at 224 x 224, bytes and ratios for one room; the tracker's mean processor time for 300 corners
# at 640 x 480. For information.
_TARGETS = {
    "spgf_ms": 0.5,
    "step_ms": 3.6,
    "step/fastdepth": 0.3,
    "step/resnet50": 0.03,
    "components_bytes": 30_000.0,
    "long_run_ratio": 1.2,
    "tracker_cpu_ms": 3.0,
}
_TARGET_SIZE = 224
_WARM_UP, _TORCH_ROUNDS = 3, 3
_PARTS = ("compilation", "long_run", "anchors", "peer", "against", "rates", "device")  # None where not measured
Progress = Callable[[str], object]


def run_benchmark(options: BenchSettings, progress: Progress = lambda text: None) -> dict[str, Any]:
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
    if options.against is not None and not options.against.is_file():
        raise FileNotFoundError(f"--against {options.against} does not exist")
    load = machine.load_average()
    threads = most_threads() if options.threads is None else options.threads
    report: dict[str, Any] = {
        **dict.fromkeys(_PARTS),
        "growth": [],
        "results": [],
        "schema": 1,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": machine.versions(),
        "hardware": machine.hardware(),
        "settings": {"threads": threads, "seed": options.seed, "config": UfMStarConfig().to_dict()},
    }
    if options.device == "cpu":
        if "numba" in options.backends and not options.skip_compile:
            progress("compilation")
            report["compilation"] = measure_compilation()
        with pinned_threads(threads):
            _on_cpu(options, report, progress)
        report["targets"] = targets(report)
    else:
        report["device"] = measure_device(options, progress)
        report["targets"] = []
    report["load_average"] = {"before": load, "after": machine.load_average()}
    if options.against is not None and options.device == "cpu":
        report["against"] = compare(report, options.against)
    return report


def _on_cpu(options: BenchSettings, report: dict[str, Any], progress: Progress) -> None:
    """Add to the report what is measured with a fixed number of threads, and the frames' source to its settings."""
    config = UfMStarConfig()
    report["rates"] = machine_rates()
    fastdepth, source = _inputs(options)
    report["settings"]["source"] = source.describe()
    for size in options.sizes:
        report["results"] += _results(options, config, fastdepth, source, size, report["rates"], progress)
    config = config.replace(backend=options.backends[0])
    if options.peer is not None:
        progress("the peer")
        report["peer"] = measure_peer(options.peer, source.frames(options.sizes[0], options.frames))
    if options.long is not None:
        building, street = RenderedBuilding(boxes=options.boxes, seed=options.seed), RenderedStreet(seed=options.seed)
        far = config.replace(segment=replace(config.segment, max_depth=street.max_depth))
        worlds = {"room": (source, config), "building": (building, config), "drive": (street, far)}
        report["growth"] = measure_growth(
            {name: worlds[name] for name in options.world}, options.merge, options.max_components, size=_TARGET_SIZE,
            frames=options.long, progress=progress,
        )  # fmt: skip
        report["long_run"] = next((run for run in report["growth"] if run["world"] == "room"), None)
    if options.anchors is not None:
        progress(f"{options.anchors} corners and anchors")
        report["anchors"] = measure_anchors(options, source, config, _TARGET_SIZE)


def _inputs(options: BenchSettings) -> tuple[FastDepth, FrameSource]:
    """FastDepth, with random weights of the pruned network's shape if none are given, and the frames' source."""
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
    options: BenchSettings, config: UfMStarConfig, fastdepth: FastDepth, source: FrameSource, size: int,
    rates: dict[str, float], progress: Progress,
) -> list[dict[str, Any]]:  # fmt: skip
    """The steps of one size, by every backend."""
    progress(f"{size} x {size}, building up the mixture")
    networks, about = reference_networks(size, fastdepth, options.runtime)
    built, frames, history = build_up(
        source, config, size=size, in_view=options.in_view, history=options.history, rounds=_WARM_UP + options.frames
    )
    results = []
    for backend in options.backends:
        progress(f"{size} x {size}, {backend}")
        warm_up, timed = _WARM_UP, options.frames
        if backend == "torch":
            warm_up, timed = 1, min(timed, _TORCH_ROUNDS)
        result = measure_step(built, frames[: warm_up + timed], networks, backend=backend, warm_up=warm_up, rates=rates)
        results.append({**result, "history": history, "networks_about": about})
    return results


def targets(report: dict[str, Any]) -> list[dict[str, Any]]:
    """The figures that have a target, for information: name, value (None = not measured), target, met."""
    values: dict[str, float] = {}
    for result in report["results"]:
        if (result["size"], result["backend"]) == (_TARGET_SIZE, "numba"):
            values["spgf_ms"] = result["kernels"]["spgf"]["median_ms"]
            values["step_ms"] = result["step"]["median_ms"]
            values["components_bytes"] = result["memory"]["in_use"]
            values |= {name: ratio["median"] for name, ratio in result["ratios"].items() if name in _TARGETS}
    if (run := report["long_run"]) is not None:
        values |= {"long_run_ratio": run["ratio"], "components_bytes": run["memory"]["in_use"]}
    if (anchors := report["anchors"]) is not None and anchors["points"] == CORNERS:
        values["tracker_cpu_ms"] = anchors["tracker"]["update"]["cpu_mean_ms"]
    return [
        {"name": name, "value": value, "target": target, "met": None if value is None else value <= target}
        for name, target in _TARGETS.items()
        for value in (values.get(name),)
    ]
