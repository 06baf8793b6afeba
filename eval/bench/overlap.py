"""Times the default with network and UfM* in two threads (``UncertainDepth.stream``)."""

from __future__ import annotations

import time
from contextlib import closing
from itertools import islice
from typing import Any

import torch

from ufmstar_torch import UncertainDepth
from ufmstar_torch.eval.bench.measure import Plan
from ufmstar_torch.eval.bench.networks import DEPTH, TimedNetwork
from ufmstar_torch.eval.bench.timing import paired_ratio, pinned_threads, spread
from ufmstar_torch.eval.sequences.frame import FrameSequence
from ufmstar_torch.eval.sequences.images import image_tensor


def time_overlap(
    network: TimedNetwork, sequence: FrameSequence, *, device: torch.device, plan: Plan
) -> dict[str, Any] | None:
    """Time the frames of a stream, each followed by the network alone on the same frame, in wall time.

    Args:
        network: predicts the depth.
        sequence: with images.
        device: of the network and of UfM*.
        plan: as for ``measure.measure``, with threads: those of the network, and as many of UfM*.

    Returns:
        "latency": time of a frame of the stream [ms]; "ratio_to_network": over that of the network alone. None if only
        one frame follows the warm-up, since nothing overlaps the last one.
    """
    wanted = None if plan.frames is None else plan.warm_up + plan.frames
    frames = list(islice(sequence.readable(lambda error: None), wanted))
    if len(frames) < plan.warm_up + 2:
        return None
    whole, alone = list[float](), list[float]()
    with pinned_threads(plan.threads or 1):
        model = UncertainDepth(network.members, preprocess=network.preprocess, check_poses=0)
        images = ((image_tensor(frame).to(device), frame.T_world_cam, frame.intrinsics) for frame in frames)
        with closing(model.stream(images)) as results:
            for frame in frames[:-1]:
                started = time.perf_counter()
                next(results)
                whole.append(1e3 * (time.perf_counter() - started))
                x, K = network.prepare(frame, device)
                started = time.perf_counter()
                network.predict(DEPTH, x, K)
                alone.append(1e3 * (time.perf_counter() - started))
    counted = slice(plan.warm_up, None)
    return {"latency": spread(whole[counted]), "ratio_to_network": paired_ratio(whole[counted], alone[counted])}
