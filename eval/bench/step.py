"""Times of a UfM* step: beside the networks that it accompanies, and when compiling."""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from itertools import islice
from typing import Any

import torch

from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.camera import relative_pose
from ufmstar_torch.correspond import candidates
from ufmstar_torch.eval.bench.floors import stage_floors
from ufmstar_torch.eval.bench.frames import FrameSource, PosedDepth, RenderedRoom
from ufmstar_torch.eval.bench.memory import state_memory, step_allocations
from ufmstar_torch.eval.bench.runtimes import fastest
from ufmstar_torch.eval.bench.timing import StagedStep, TimedCalls, spread_of_counts
from ufmstar_torch.eval.methods.ufm import UfM, UfMConfig
from ufmstar_torch.models import FastDepth, MonodepthResNet
from ufmstar_torch.models.fastdepth import MULTIPLE
from ufmstar_torch.output import FrameStatistics

_RECENT = 20  # frames over which the components in view are averaged
POINTS = 100_000  # of UfM
_PIXELS = 1000  # of the image average
_COMPILED_STEPS = 3  # the kernels of the fusion meet a mixture from the second on
_FIRST_STEPS = "import json; from ufmstar_torch.eval.bench.step import first_steps; print(json.dumps(first_steps({})))"


def build_up(
    source: FrameSource, config: UfMStarConfig, *, size: int, in_view: int, history: int, rounds: int
) -> tuple[UfMStar, list[PosedDepth], int]:
    """Run until ``in_view`` components are in view (mean of the last 20 frames), at most ``history`` frames.

    Compiled kernels run where they are available, also for a state on which the torch reference is then timed: the two
    agree to rounding.

    Returns:
        The module, the ``rounds`` frames that follow, and the number of frames before them.

    Raises:
        ValueError: the source has not more than ``rounds`` frames.
    """
    if source.available is not None and source.available <= rounds:
        raise ValueError(f"{rounds} frames are timed and some must come before them, there are {source.available}")
    history = history if source.available is None else min(history, source.available - rounds)
    ufm = UfMStar(config.replace(backend="auto"))
    frames = source.frames(size, history + rounds)
    recent: deque[int] = deque(maxlen=_RECENT)
    seen = 0
    for frame in islice(frames, history):
        ufm(*frame)
        recent.append(components_in_view(ufm, frame))
        seen += 1
        if len(recent) == _RECENT and sum(recent) >= in_view * _RECENT:
            break
    return ufm, list(islice(frames, rounds)), seen


def measure_step(
    built: UfMStar,
    frames: Sequence[PosedDepth],
    networks: dict[str, Callable[..., Any]],
    *,
    backend: str,
    warm_up: int,
    rates: Mapping[str, float],
) -> dict[str, Any]:
    """Time the whole step, its stages, the image average, UfM and the networks, one after the other per frame.

    The whole step, the stages and the average run on copies of one state, so that timing the stages cannot slow the
    whole. All of them get the same frames, and each follows a network as in use (caches and threads are as the network
    left them).

    Args:
        built: the state to start from; not modified.
        frames: of which the first ``warm_up`` are not counted.
        networks: forward passes by name, on the arguments of a step; may be empty.
        backend: "numba" or "torch".
        warm_up: see ``frames``; three of them at 224 x 224 fill UfM's points.
        rates: of the machine (``machine_rates``), for the floors.
    """
    whole, staging, average = (copy.deepcopy(built) for _ in range(3))
    for module in (whole, staging, average):
        module.config = built.config.replace(backend=backend)
    staged, size = StagedStep(staging), frames[0].depth.shape[-1]
    pixels = min(_PIXELS, size**2)
    calls: dict[str, Callable[..., Any]] = {
        "step": whole,
        "staged": staged,
        "mean_uncertainty": partial(average.mean_uncertainty, pixels=pixels),
        **({} if backend == "torch" else {"ufm": UfM(UfMConfig(max_points=POINTS))}),
    }
    timed = TimedCalls(before=networks)
    counts: list[dict[str, int]] = []
    for frame in timed.frames(frames, warm_up=warm_up):
        counts.append(frame_counts(timed.call(calls, *frame)["step"].statistics, whole, frame))
    times = timed.times
    pairs = [*(("step", name) for name in (*networks, "ufm") if name in times.wall), ("mean_uncertainty", "step")]
    spreads = {name: spread_of_counts([count[name] for count in counts[warm_up:]]) for name in counts[0]}
    return {
        "size": size,
        "backend": backend,
        "frames": {"warm_up": warm_up, "timed": len(frames) - warm_up},
        "counts": spreads,
        "step": times.spread("step"),
        "staged_step": times.spread("staged"),
        **staged.summary(warm_up=warm_up),
        "mean_uncertainty": {"pixels": pixels, **times.spread("mean_uncertainty")},
        "networks": {name: times.spread(name) for name in networks},
        "ufm": {"points": POINTS, **times.spread("ufm")} if "ufm" in calls else None,
        "floors": stage_floors(size, spreads, rates),
        "allocations": step_allocations(lambda: average(*frames[-1])),
        "memory": state_memory(whole),
        "ratios": {f"{a}/{b}": times.ratio(a, b) for a, b in pairs},
    }


def measure_compilation(size: int = 64) -> dict[str, float]:
    """Seconds of the first steps in a new process: "cold_s" compiles, "warm_s" loads the compiled code from disk.

    "cold_s" and "warm_s" include the first use of torch, which "steady_s", the last step, does not.

    Raises:
        subprocess.CalledProcessError: the process failed; its messages are on standard error.
    """

    def fresh_process(cache: str) -> list[float]:
        command = [sys.executable, "-c", _FIRST_STEPS.format(size)]
        environment = os.environ | {"NUMBA_CACHE_DIR": cache}
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
        return json.loads(done.stdout)

    with tempfile.TemporaryDirectory() as folder:
        cold, warm = fresh_process(folder), fresh_process(folder)
    return {"cold_s": sum(cold[:-1]), "warm_s": sum(warm[:-1]), "steady_s": warm[-1]}


def first_steps(size: int) -> list[float]:
    """Times of the first steps of this process [s]."""
    ufm, timed = UfMStar(), TimedCalls()
    for frame in timed.frames(RenderedRoom().frames(size, _COMPILED_STEPS)):
        timed.call({"step": ufm}, *frame)
    return [1e-3 * ms for ms in timed.times.wall["step"]]


def frame_counts(statistics: FrameStatistics, ufm: UfMStar, frame: PosedDepth) -> dict[str, int]:
    """Statistics of one step, and "in_view", the components in view after it."""
    counts = {name: int(getattr(statistics, name)) for name in ("components", "segments", "matched", "new")}
    return {**counts, "in_view": components_in_view(ufm, frame)}


def components_in_view(ufm: UfMStar, frame: PosedDepth) -> int:
    """Components beyond the near plane whose mean projects inside the frame: the candidates for a match."""
    pose = relative_pose(ufm.T_world_first, frame.T_world_cam[None])
    height, width = frame.depth.shape[-2:]
    in_camera = ufm.mixture.to(torch.float64).rigid(*pose)
    seen, _, _ = candidates(in_camera, frame.intrinsics[None], (height, width), ufm.config.near_plane)
    return int(seen.sum())


def reference_networks(
    size: int, fastdepth: FastDepth, runtime: str = "auto"
) -> tuple[dict[str, Callable[..., Any]], dict[str, Any]]:
    """Forward passes on images of ``size`` [px] to compare with, each in the runtime that is fastest here (see
    ``fastest``), and what they are.

    FastDepth with its batch norms folded, and "resnet50", ResNet50-Monodepth2 with random weights, where torchvision is
    installed; both at the nearest size that they take (multiples of 32, Monodepth2 from 64 on).
    """
    side = max(MULTIPLE, MULTIPLE * round(size / MULTIPLE))
    networks: dict[str, tuple[torch.nn.Module, int]] = {"fastdepth": (fastdepth.folded(), side)}
    about: dict[str, Any] = {"resnet50": None}
    if find_spec("torchvision") is not None:
        networks["resnet50"] = (MonodepthResNet().eval(), max(2 * MULTIPLE, side))
    calls = {}
    for name, (network, side) in networks.items():
        calls[name], facts = fastest(network, side, runtime=runtime)
        whole = fastdepth if name == "fastdepth" else network  # with the batch norms that are folded
        about[name] = {"size": side, "parameters": sum(p.nelement() for p in whole.parameters()), **facts}
    return calls, about
