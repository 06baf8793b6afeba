"""What a step costs, and how many components there are, after a long time in one room."""

from __future__ import annotations

from typing import Any

import numpy as np

from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.eval.bench.benchmark_frames import FrameSource
from ufmstar_torch.eval.bench.benchmark_step import components_in_view, memory
from ufmstar_torch.eval.engine.clock import CallTimes


def measure_long_run(
    source: FrameSource, config: UfMStarConfig, *, size: int, frames: int, early: int = 100, window: int = 100
) -> dict[str, Any]:
    """Run ``frames`` steps; compare those around frame ``early`` with the last ones.

    Args:
        early: the centre of the early window, counted from 1.
        window: frames per window; a whole turn of the camera, so that both see all of the room.

    Returns:
        "ratio" and "cpu_ratio": median time of the last ``window`` steps over the median of the early ones;
        and a row per ``window`` frames with times and numbers of components.

    Raises:
        ValueError: the early and the last window would overlap, or the source has fewer frames.
    """
    start = max(0, early - window // 2)
    if frames < start + 2 * window:
        raise ValueError(f"a long run needs at least {start + 2 * window} frames for two windows, got {frames}")
    if source.available is not None and source.available < frames:
        raise ValueError(f"a long run of {frames} frames was asked for, there are {source.available}")
    ufm, watch = UfMStar(config), CallTimes()
    counts: dict[str, list[int]] = {"components": [], "in_view": [], "segments": [], "matched": [], "new": []}
    for frame in source.frames(size, frames):
        statistics = watch.time("step", ufm, frame.depth, frame.T_world_cam, frame.intrinsics).statistics
        for name in ("components", "segments", "matched", "new"):
            counts[name].append(int(getattr(statistics, name)))
        counts["in_view"].append(components_in_view(ufm, frame))
    wall, cpu = np.array(watch.wall["step"]), np.array(watch.cpu["step"])

    def at(low: int) -> dict[str, Any]:
        part = slice(low, low + window)
        means = {name: float(np.mean(counts[name][part])) for name in ("in_view", "segments", "matched", "new")}
        return {
            "frames": [low + 1, low + window],
            "step_median_ms": float(np.median(wall[part])),
            "step_cpu_median_ms": float(np.median(cpu[part])),
            "components": counts["components"][min(low + window, frames) - 1],
            **{f"{name}_mean": value for name, value in means.items()},
        }

    first, last = at(start), at(frames - window)
    return {
        "size": size,
        "backend": config.backend,
        "frames": frames,
        "early": first,
        "late": last,
        "ratio": last["step_median_ms"] / first["step_median_ms"],
        "cpu_ratio": last["step_cpu_median_ms"] / first["step_cpu_median_ms"],
        "memory": memory(ufm),
        "rows": [at(low) for low in range(0, frames - window + 1, window)],
    }
