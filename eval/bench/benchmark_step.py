"""One UfM* step beside the networks it is meant to accompany, measured in turns."""

from __future__ import annotations

import copy
import itertools
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.camera import focal_and_centre, relative_pose
from ufmstar_torch.eval.bench.benchmark_frames import FrameSource, PosedDepth
from ufmstar_torch.eval.bench.benchmark_timing import StageClock
from ufmstar_torch.eval.engine.clock import CallTimes
from ufmstar_torch.models import FastDepth
from ufmstar_torch.models.fastdepth import MULTIPLE

Call = Callable[[PosedDepth], Any]


@dataclass(frozen=True)
class Plan:
    """How much is measured at one size with one backend.

    Attributes:
        size: image height and width [px].
        backend: "numba" or "torch".
        warm_up: rounds of every contestant that are not counted.
        rounds: rounds that are.
        pixels: of the image average.
    """

    size: int
    backend: str
    warm_up: int
    rounds: int
    pixels: int = 1000


def build_up(
    source: FrameSource, config: UfMStarConfig, *, size: int, in_view: int, history: int, rounds: int
) -> tuple[UfMStar, list[PosedDepth], int]:
    """Run until ``in_view`` components are in view (mean of the last 20 frames), at most ``history`` frames.

    Compiled kernels serve where there are any, also for a state that the torch reference is then timed on:
    the two agree to rounding.

    Returns:
        The module, the ``rounds`` frames that follow, and how many it has seen.

    Raises:
        ValueError: the source has not more than ``rounds`` frames.
    """
    if source.available is not None and source.available <= rounds:
        raise ValueError(f"{rounds} frames are timed and some must come before them, there are {source.available}")
    history = history if source.available is None else min(history, source.available - rounds)
    ufm = UfMStar(config.replace(backend="auto"))
    frames = source.frames(size, history + rounds)
    recent: deque[int] = deque(maxlen=20)
    seen = 0
    for frame in itertools.islice(frames, history):
        ufm(frame.depth, frame.T_world_cam, frame.intrinsics)
        recent.append(components_in_view(ufm, frame))
        seen += 1
        if len(recent) == recent.maxlen and sum(recent) >= in_view * len(recent):
            break
    return ufm, list(itertools.islice(frames, rounds)), seen


def measure_step(plan: Plan, built: UfMStar, frames: Sequence[PosedDepth], networks: dict[str, Call]) -> dict[str, Any]:
    """Time the whole step, its stages, the image average and the networks, one after the other per frame.

    The total, the stages and the average run on copies of one state, so timing the stages cannot slow the
    total. All of them see the same frames, and each follows a network as it does in use (caches and threads
    are as the network left them).

    Args:
        built: the state to start from; not modified.
        frames: at least ``plan.warm_up + plan.rounds``.
        networks: forward passes by name; may be empty.
    """
    start = copy.deepcopy(built)
    start.config = built.config.replace(backend=plan.backend)
    whole, staged, average = copy.deepcopy(start), _Staged(copy.deepcopy(start)), copy.deepcopy(start)
    pixels = min(plan.pixels, plan.size**2)
    ufm: dict[str, Call] = {
        "step": lambda f: whole(f.depth, f.T_world_cam, f.intrinsics),
        "staged": staged,
        "mean_uncertainty": lambda f: average.mean_uncertainty(f.depth, f.T_world_cam, f.intrinsics, pixels=pixels),
    }
    watch = CallTimes()
    counts = _take_turns(frames[: plan.warm_up + plan.rounds], ufm, networks, watch, whole)
    watch.drop(plan.warm_up)
    staged.clock.drop(plan.warm_up)
    result: dict[str, Any] = {
        "size": plan.size,
        "backend": plan.backend,
        "frames": {"warm_up": plan.warm_up, "timed": plan.rounds},
        "counts": {name: _range(values[plan.warm_up :]) for name, values in counts.items()},
        "step": watch.spread("step"),
        "staged_step": watch.spread("staged"),
        **staged.clock.summary(),
        "mean_uncertainty": {"pixels": pixels, **watch.spread("mean_uncertainty")},
        "networks": {name: watch.spread(name) for name in networks},
        "memory": memory(whole),
    }
    pairs = [("step", name) for name in networks] + [("mean_uncertainty", "step")]
    result["ratios"] = {f"{a}/{b}": watch.ratio(a, b) for a, b in pairs}
    return result


def _take_turns(
    frames: Sequence[PosedDepth],
    ufm: dict[str, Call],
    networks: dict[str, Call],
    watch: CallTimes,
    whole: UfMStar,
) -> dict[str, list[int]]:
    """A B A B: per frame each of ``ufm`` in turn, a network before each; every network once per frame is timed."""
    counts: dict[str, list[int]] = {"in_view": [], "components": [], "segments": [], "new": []}
    names = list(networks)
    for frame in frames:
        timed: set[str] = set()
        for name, before in zip(ufm, itertools.cycle(names or [None]), strict=False):
            if before is not None and before not in timed:
                watch.time(before, networks[before], frame)
                timed.add(before)
            elif before is not None:
                networks[before](frame)
            result = watch.time(name, ufm[name], frame)
            if name == "step":
                counts["components"].append(int(result.statistics.components))
                counts["segments"].append(int(result.statistics.segments))
                counts["new"].append(int(result.statistics.new))
        counts["in_view"].append(components_in_view(whole, frame))
    return counts


class _Staged:
    """The module with a clock at every stage of its step."""

    def __init__(self, module: UfMStar) -> None:
        self.module, self.clock = module, StageClock()
        module.observer = self.clock

    def __call__(self, frame: PosedDepth) -> None:
        self.clock.start()
        self.module(frame.depth, frame.T_world_cam, frame.intrinsics)


def components_in_view(ufm: UfMStar, frame: PosedDepth) -> int:
    """Components beyond the near plane whose mean projects inside the frame: the candidates for a match."""
    mixture = ufm.mixture
    R, t = relative_pose(ufm.T_world_first, frame.T_world_cam[None])
    mean = mixture.mean.double() @ R.mT + t[:, None]
    fx, fy, cx, cy = focal_and_centre(frame.intrinsics)
    x, y, z = mean.unbind(-1)
    seen = mixture.valid & (z > ufm.config.near_plane)
    u, v = fx * x / z + cx, fy * y / z + cy
    height, width = frame.depth.shape[-2:]
    return int((seen & (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)).sum())


def memory(ufm: UfMStar) -> dict[str, int]:
    """Bytes of the components in use, of the slots allocated, and of the moving average's map."""
    mixture = ufm.mixture
    each = mixture.bytes_per_component()
    return {
        "bytes_per_component": each,
        "components": int(mixture.components.sum()),
        "in_use": each * int(mixture.components.sum()),
        "allocated": each * mixture.streams * mixture.capacity,
        "moving_average": ufm.smoothed.nelement() * ufm.smoothed.element_size(),
    }


def reference_networks(size: int, fastdepth: FastDepth) -> tuple[dict[str, Call], dict[str, Any]]:
    """Forward passes to compare with, on a fixed random image, and what they are.

    FastDepth with its batch norms folded, at the nearest size it takes (multiples of 32); torchvision's
    ResNet50 up to and including layer4, with random weights, where torchvision is installed.
    """
    side = max(MULTIPLE, MULTIPLE * round(size / MULTIPLE))
    calls = {"fastdepth": _forward(fastdepth.folded(), side)}
    about: dict[str, Any] = {"fastdepth": {"size": side, "parameters": _parameters(fastdepth)}, "resnet50": None}
    if find_spec("torchvision") is not None:
        from torchvision.models import resnet50

        encoder = torch.nn.Sequential(*list(resnet50(weights=None).children())[:-2]).eval()
        calls["resnet50"] = _forward(encoder, size)
        about["resnet50"] = {"size": size, "parameters": _parameters(encoder)}
    return calls, about


def _forward(network: torch.nn.Module, size: int) -> Call:
    image = torch.rand(1, 3, size, size, generator=torch.Generator().manual_seed(0))

    def call(_: PosedDepth) -> Any:
        with torch.inference_mode():
            return network(image)

    return call


def _parameters(network: torch.nn.Module) -> int:
    return sum(p.nelement() for p in network.parameters())


def _range(values: Sequence[int] | Tensor) -> dict[str, float]:
    low, middle, high = np.percentile(np.asarray(values, np.float64), (0, 50, 100))
    return {"median": float(middle), "min": float(low), "max": float(high), "mean": float(np.mean(values))}
