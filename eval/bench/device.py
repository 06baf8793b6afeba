"""Times of a UfM* step on a GPU: many streams, launches, and how far from what the memory's bandwidth allows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import cycle, islice
from typing import Any

import torch
from torch import Tensor, nn

from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.capture import Captured
from ufmstar_torch.eval.bench.frames import PosedDepth, RenderedRoom
from ufmstar_torch.eval.bench.settings import BenchSettings
from ufmstar_torch.output import UfMStarOutput

STREAMS = (1, 64, 256)
_ROOMS = 4  # that are rendered; more streams repeat them
_FRAMES = 16  # that are kept on the device, and run to and fro
_WARM_UP = 32
_SLOTS = 1024  # of the mixture, fixed
_COPIED = 2**30  # bytes copied to measure the bandwidth
_LAUNCHES = ("LaunchKernel", "MemcpyAsync", "MemsetAsync", "GraphLaunch")  # in the names of runtime and driver calls


def measure_device(options: BenchSettings, progress: Callable[[str], object]) -> dict[str, Any]:
    """Time steps of :data:`STREAMS` streams, and networks of one image, on a GPU ("cuda" or "cuda:N").

    Args:
        options: of the benchmark.
        progress: is called with a description of what is measured next.

    Returns:
        "name" of the device, "bandwidth" of a copy [B/s], "networks" [ms] by size and name, and "results": per size and
        number of streams "step_ms" and "graph_ms" [ms], "frames_per_second", "launches" of a step, "floor_ms", the time
        that its inputs, outputs and state take at that bandwidth, and "state_bytes" of a stream.

    Raises:
        ValueError: torch sees no such device.
    """
    if not torch.cuda.is_available():
        raise ValueError(f"--device {options.device} needs a CUDA device, torch sees none")
    chosen = torch.device(options.device)
    bandwidth = _bandwidth(chosen)
    results, networks = [], {}
    for size in options.sizes:
        progress(f"{size} x {size}, networks")
        networks[str(size)] = {name: _time(run, options.frames) for name, run in _networks(size, chosen)}
        rooms = [list(RenderedRoom(seed=options.seed + room).frames(size, _FRAMES)) for room in range(_ROOMS)]
        for streams in STREAMS:
            progress(f"{size} x {size}, {streams} streams")
            given = [_batch([room[i] for room in rooms], streams, chosen) for i in range(_FRAMES)]
            results.append(_measure(given, options.frames, bandwidth))
    name = torch.cuda.get_device_name(chosen)
    return {"name": name, "bandwidth": bandwidth, "networks": networks, "results": results}


def device_text(report: Mapping[str, Any]) -> list[str]:
    """The lines of what :func:`measure_device` returns."""
    lines = [f"{report['name']}, copies move {report['bandwidth'] / 1e12:.2f} TB/s"]
    for size, times in report["networks"].items():
        lines.append(f"{size} x {size}: " + ", ".join(f"{name} {ms:.2f} ms" for name, ms in times.items()))
    columns = ("size", "streams", "step_ms", "graph_ms", "frames_per_second", "launches", "floor_ms", "state_bytes")
    lines.append("".join(f"{name:>18}" for name in columns))
    return lines + ["".join(f"{row[name]:>18.5g}" for name in columns) for row in report["results"]]


def touched_bytes(depth: Tensor, out: UfMStarOutput, ufm: UfMStar) -> int:
    """What a step cannot but read and write: the depth, the maps that it returns, and the state twice [bytes]."""
    maps = (depth, out.variance, out.disagreement, out.measured)
    return sum(v.nbytes for v in maps) + 2 * sum(v.nbytes for v in ufm.state.tensors().values())


def _measure(given: list[PosedDepth], frames: int, bandwidth: float) -> dict[str, Any]:
    config = UfMStarConfig(on_bad_frame="skip", initial_capacity=_SLOTS, max_components=_SLOTS)
    ufm = UfMStar(config)
    streams, _, size = given[0].depth.shape
    turn = cycle([*given, *reversed(given)])
    for frame in islice(turn, _WARM_UP):
        out = ufm(*frame)
    launches = _launches(lambda: ufm(*next(turn)))
    step = _time(lambda: ufm(*next(turn)), frames)
    captured = Captured(ufm, *given[0])
    graph = _time(lambda: captured(*next(turn)), frames)
    components = sum(v.nbytes for v in ufm.mixture.tensors().values())
    return {
        "size": size,
        "streams": streams,
        "step_ms": step,
        "graph_ms": graph,
        "frames_per_second": 1e3 * streams / min(step, graph),
        "launches": launches,
        "floor_ms": 1e3 * touched_bytes(given[0].depth, out, ufm) / bandwidth,
        "state_bytes": components / streams,
    }


def _batch(frames: list[PosedDepth], streams: int, device: torch.device) -> PosedDepth:
    """``streams`` streams that repeat the frames of different rooms."""
    some = list(islice(cycle(frames), streams))
    depth = torch.cat([frame.depth for frame in some]).to(device)
    return PosedDepth(depth, *(torch.stack(v).to(device) for v in zip(*(f[1:] for f in some), strict=True)))


def _time(run: Callable[[], object], frames: int) -> float:
    """Mean time of a call [ms], queued one after the other."""
    start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    for _ in range(3):
        run()
    start.record()
    for _ in range(frames):
        run()
    end.record()
    end.synchronize()
    return start.elapsed_time(end) / frames


def _launches(run: Callable[[], object]) -> int:
    """Kernels, copies and fills that a call queues."""
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiler:
        run()
        torch.cuda.synchronize()
    return sum(e.count for e in profiler.key_averages() if any(name in e.key for name in _LAUNCHES))


def _bandwidth(device: torch.device) -> float:
    """Bytes read and written in a second by a copy."""
    source = torch.empty(_COPIED, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    return 2 * _COPIED / (1e-3 * _time(lambda: target.copy_(source), 20))


def _networks(size: int, device: torch.device) -> Iterator[tuple[str, Callable[[], object]]]:
    """Forward passes of one image, with random weights."""
    from torchvision.models import resnet50
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation

    from ufmstar_torch.models import FastDepth, FastDepthWidths

    def forward(network: nn.Module, side: int) -> Callable[[], object]:
        network, image = network.eval().to(device), torch.zeros(1, 3, side, side, device=device)

        def run() -> object:
            with torch.inference_mode():
                return network(image)

        return run

    yield "FastDepth", forward(FastDepth(FastDepthWidths.pruned()), size // 32 * 32)
    yield "ResNet50", forward(resnet50(weights=None), size)
    small = DepthAnythingConfig()  # its defaults are the small network
    yield "Depth Anything V2 small", forward(DepthAnythingForDepthEstimation(small), size // 14 * 14)
