"""``ufmstar bench``: times UfM*, plain, anchored and with the posterior, and a network on the same frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Set
from datetime import UTC, datetime
from typing import Any

import torch
from torch import Tensor, nn

from ufmstar_torch.eval.bench.measure import Plan, measure
from ufmstar_torch.eval.bench.networks import ONCE, TimedNetwork
from ufmstar_torch.eval.bench.overlap import time_overlap
from ufmstar_torch.eval.bench.parts import MULTIVIEW
from ufmstar_torch.eval.bench.settings import ARCHITECTURES, TOUR, BenchSettings
from ufmstar_torch.eval.bench.timing import most_threads
from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.eval.methods.method import BASES, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.run.machine import require_device
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.frame import Frame, FrameError
from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.models import FastDepth, FastDepthWidths, MonodepthResNet, Preprocess
from ufmstar_torch.models.inference import Inference
from ufmstar_torch.models.network import DepthNetwork

_ERROR, _GRID = 0.03, 4  # [1] standard deviation of a network's smooth relative error, and its nodes per side
Progress = Callable[[str], object]


def run_benchmark(options: BenchSettings, progress: Progress = lambda text: None) -> dict[str, Any]:
    """Run the benchmark. Returns "schema", "date", "options" and, for every size, the "results" of ``measure``.

    Raises:
        ValueError: an option is out of range, or the sequence has too few frames.
        FileNotFoundError, ModuleNotFoundError: a file or a package is missing.
    """
    device = torch.device(require_device(options.device))
    threads = options.threads or most_threads()
    plan = Plan(
        frames=options.frames, warm_up=options.history, threads=threads, windows=1, clock=options.clock, samples=True
    )
    networks = (
        [_loaded(options, threads, device)] if options.weights else (_random(options, s, device) for s in options.sizes)
    )
    results = []
    for network in networks:
        height, width = network.preprocess.size or (0, 0)
        progress(f"{network.label} {height} x {width}, {options.history + options.frames} frames")
        name = f"{TOUR}?frames={options.history + options.frames}&size={height}x{width}"
        sequence = open_sequence(name if options.sequence == TOUR else options.sequence)
        rows = [Row(Method.parse(name), setting) for name, setting in _rows(network.base, options.backends)]
        devices: dict[str, Any] = {"device": device, "multiview_device": device, "plan": plan}
        result = measure(rows, {network.base: network}, sequence, **devices)
        result["overlapped"] = (
            None if isinstance(network, _Random) else time_overlap(network, sequence, device=device, plan=plan)
        )
        result["ratios"] = _ratios(result, {row.label for row in rows if not row.setting.overrides})
        results.append(result)
    used = {name: str(value) for name, value in vars(options).items() if value is not None}
    return {"schema": 2, "date": datetime.now(UTC).isoformat(timespec="seconds"), "options": used, "results": results}


def _rows(base: str, backends: tuple[str, ...]) -> list[tuple[str, Setting]]:
    """Methods and settings: UfM; for every backend UfM*, UfM* with corners, and the posterior with dense anchors."""
    alone = BASES[base][1]
    rows = [(f"UfM-{alone}-100K", Setting())]
    for backend in backends:
        overrides = {} if backend == "auto" else {"backend": backend}
        kinds: tuple[dict[str, Any], ...] = ({}, {"anchors": "corners"}, {"anchors": "dense", "posterior": True})
        rows += [(f"UfM*-{alone}", Setting(overrides=overrides, **kind)) for kind in kinds]
    return rows


def _ratios(result: Mapping[str, Any], labels: Set[str]) -> dict[str, float]:
    """The figures of the rows of UfM* with these ``labels`` to compare between machines and versions: medians of ratios
    within one frame."""
    ratios = {}
    for row in result["rows"]:
        if row["row"] not in labels or row["method"].startswith("UfM-"):
            continue
        kind = {"": "step", "corners": "step with corners", "dense": "default"}[row["setting"].get("anchors", "")]
        ratios[f"{kind} / network"] = row["ratios_to_depth"][MULTIVIEW]["median"]
        if row["sample"] is not None:
            ratios["mean of 1,000 pixels / step"] = row["sample"]["ratio_to_step"]["median"]
            ratios["check and average / step"] = row["stages"]["beyond_the_paper"]["median"]
    if result["overlapped"] is not None:
        name = "default, network and UfM* in two threads (wall time) / network"
        ratios[name] = result["overlapped"]["ratio_to_network"]["median"]
    return ratios


class _Random(TimedNetwork):
    """An architecture with random weights, to be timed. Its depth is the sequence's, with smooth errors of 3 %."""

    def prepare(self, frame: Frame, device: torch.device) -> tuple[Tensor, Tensor]:
        """See :class:`TimedNetwork`. Raises FrameError: no depth at the image's pixels."""
        x, K = super().prepare(frame, device)
        if frame.depth is None or frame.depth_intrinsics is not None:
            raise FrameError(frame.name, "has no depth at the image's pixels: predict depth with --weights")
        depth = self.preprocess.apply_depth(torch.from_numpy(frame.depth)[None])
        noise = torch.randn(1, 1, _GRID, _GRID, generator=torch.Generator().manual_seed(frame.index))
        smooth = nn.functional.interpolate(_ERROR * noise, depth.shape[-2:], mode="bicubic", align_corners=True)[0]
        self._depth = (depth * (1 + smooth)).to(device)
        return x, K

    def predict(self, part: str, x: Tensor, intrinsics: Tensor, *, turn: int = 0) -> DepthPrediction:
        super().predict(part, x, intrinsics, turn=turn)
        return DepthPrediction(self._depth)


def _random(options: BenchSettings, side: int, device: torch.device) -> TimedNetwork:
    """One of the paper's architectures with random weights, in its fastest form in torch."""
    size = (side, side)
    network: DepthNetwork = MonodepthResNet(size=size)
    if options.model == ARCHITECTURES[0]:
        network = FastDepth(FastDepthWidths.pruned(), size=size).eval().folded()
    network.preprocess = Preprocess(resize_height=side, crop=size, size=size)
    return _Random("depth_only", [network.eval().to(device).to(memory_format=torch.channels_last)], options.model)


def _loaded(options: BenchSettings, threads: int, device: torch.device) -> TimedNetwork:
    """The network of the options, loaded as by ``ufmstar run``."""
    inference = Inference(runtime=options.runtime, threads=threads)
    spec = None if options.spec is None else str(options.spec)
    choice = NetworkChoice("", options.model, (str(options.weights),), spec, options.trust_code)
    members = [member.to(device) for member in choice.members(device, inference=inference)]
    return TimedNetwork("ensemble" if len(members) > 1 else "depth_only", members, options.model)


def format_report(report: Mapping[str, Any]) -> str:
    """The machine, and a table for every size."""
    return "\n\n".join("\n".join(_lines(result)) for result in report["results"])


def _lines(result: Mapping[str, Any]) -> list[str]:
    machine, ((base, network),) = result["machine"], result["networks"].items()
    hardware, load = machine["hardware"], machine["load"]
    processor = hardware["cpu"] if machine["gpu"] is None else machine["gpu"]
    versions = ", ".join(f"{name} {value}" for name, value in machine["versions"].items() if value)
    lines = [
        f"{processor}, {hardware['cores']} cores, {result['plan']['threads']} threads; {versions}",
        f"{result['sequence']['name']}, {result['plan']['frames']} frames of {result['map']}"
        + (f"; load average {load:.1f}" if load else ""),
        f"{'[ms]':52}{'median':>9}{'IQR':>8}{'minimum':>9}{'x network':>11}{'state':>11}",
    ]
    rows = [(f"{network['label']} ({base})", network["latency"][ONCE], None, None)]
    for row in result["rows"]:
        ratio, state_bytes = row["ratios_to_depth"][MULTIVIEW]["median"], row["memory"]["multiview"]["bytes_end"]
        rows.append((row["row"], row["latency"][MULTIVIEW], ratio, state_bytes))
    for name, times, ratio, state_bytes in rows:
        tail = "" if ratio is None else f"{ratio:11.3f}{state_bytes / 1e3:8.1f} kB"
        lines.append(f"{name:52}{times['median_ms']:9.2f}{times['iqr_ms']:8.2f}{times['min_ms']:9.2f}{tail}")
    for row in result["rows"]:
        if row["stages"] is not None:
            stages = row["stages"]["stages"].items()
            lines.append(f"stages of {row['row']}: " + ", ".join(f"{n} {t['median_ms']:.2f}" for n, t in stages))
    lines += [f"{name}: {ratio:.3f}" for name, ratio in result["ratios"].items()]
    return [*lines, *(f"no energy of the {unit}: {why}" for unit, why in result["power"]["missing"].items())]
