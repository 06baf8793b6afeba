"""Times UfM* on batches of streams."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from itertools import islice
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.bench.measure import Plan
from ufmstar_torch.eval.bench.networks import DEPTH, TimedNetwork
from ufmstar_torch.eval.bench.timing import pinned_threads, spread
from ufmstar_torch.eval.engine.clock import synchronize
from ufmstar_torch.eval.sequences.frame import Frame, FrameSequence
from ufmstar_torch.runtime.capture import Captured
from ufmstar_torch.ufmstar import UfMStar

_SLOTS = 1024  # a CUDA graph needs a fixed capacity
StepInputs = tuple[Tensor, Tensor, Tensor]


def time_streams(
    network: TimedNetwork, sequence: FrameSequence, counts: Sequence[int], *, device: torch.device, plan: Plan
) -> list[dict[str, Any]]:
    """Time UfM*, of at most 1,024 components, on batches of copies of one stream.

    Args:
        network: predicts the depth.
        sequence: with images.
        counts: numbers of streams.
        device: of the network and of UfM*.
        plan: as for ``measure.measure``, with threads.

    Returns:
        For every count "streams", "step" and, on CUDA, "graph" (:class:`~ufmstar_torch.runtime.capture.Captured`):
        times [ms] of one frame of all streams.
    """
    config = UfMStarConfig(on_bad_frame="skip", initial_capacity=_SLOTS, max_components=_SLOTS)
    lines = []
    with pinned_threads(plan.threads or 1):
        wanted = None if plan.frames is None else plan.warm_up + plan.frames
        readable = islice(sequence.readable(lambda error: None), wanted)
        frames = [_step_inputs(network, frame, device) for frame in readable]
        for count in counts:
            steps: dict[str, Callable[..., Any]] = {"step": UfMStar(config)}
            if device.type == "cuda":
                steps["graph"] = Captured(UfMStar(config), *_copies(frames[0], count))
            times: dict[str, list[float]] = {name: [] for name in steps}
            for frame in frames:
                batch = _copies(frame, count)
                for name, step in steps.items():
                    synchronize(device)
                    started = time.perf_counter()
                    step(*batch)
                    synchronize(device)
                    times[name].append(1e3 * (time.perf_counter() - started))
            lines.append({"streams": count, **{name: spread(ms[plan.warm_up :]) for name, ms in times.items()}})
    return lines


def _step_inputs(network: TimedNetwork, frame: Frame, device: torch.device) -> StepInputs:
    """Depth [1, H, W], pose [1, 4, 4] and intrinsics [1, 3, 3] of a frame; the camera stays on the CPU."""
    x, K = network.prepare(frame, device)
    return network.predict(DEPTH, x, K).depth.clone(), torch.from_numpy(frame.T_world_cam)[None], K.cpu().double()


def _copies(inputs: StepInputs, count: int) -> list[Tensor]:
    return [value.expand(count, *value.shape[1:]).contiguous() for value in inputs]
