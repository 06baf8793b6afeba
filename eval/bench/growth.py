"""Time and memory of a step over a long run: in one room, through a building, along a street."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np

from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.eval.bench.frames import FrameSource
from ufmstar_torch.eval.bench.memory import state_memory
from ufmstar_torch.eval.bench.step import frame_counts
from ufmstar_torch.eval.bench.timing import TimedCalls

_MEANS = ("in_view", "segments", "matched", "new")


def measure_long_run(
    source: FrameSource, config: UfMStarConfig, *, size: int, frames: int, window: int = 100
) -> dict[str, Any]:
    """Run ``frames`` steps; compare a window of early ones, around frame ``window``, with the last ones.

    Args:
        source: of the frames.
        config: of UfM*.
        size: of the depth maps [px].
        frames: in all.
        window: frames per window; in the rendered rooms whole turns of the camera, so that both windows contain all of
            a room.

    Returns:
        "ratio" and "cpu_ratio": median time of the last ``window`` steps over the median of the early ones; and a row
        per ``window`` frames with times and numbers of components.

    Raises:
        ValueError: the early and the last window would overlap, or the source has fewer frames.
    """
    start = window - window // 2
    if frames < start + 2 * window:
        raise ValueError(f"a long run needs at least {start + 2 * window} frames for two windows, got {frames}")
    if source.available is not None and source.available < frames:
        raise ValueError(f"a long run of {frames} frames was asked for, there are {source.available}")
    ufm, timed = UfMStar(config), TimedCalls()
    counts: list[dict[str, int]] = []
    kept = []
    for frame in timed.frames(source.frames(size, frames)):
        counts.append(frame_counts(timed.call({"step": ufm}, *frame)["step"].statistics, ufm, frame))
        kept.append(int(ufm.mixture.components))
    wall, cpu = timed.times.wall["step"], timed.times.cpu["step"]

    def at(low: int) -> dict[str, Any]:
        part, end = slice(low, low + window), low + window - 1
        return {
            "frames": [low + 1, low + window],
            "step_median_ms": float(np.median(wall[part])),
            "step_cpu_median_ms": float(np.median(cpu[part])),
            "components": kept[end],
            **{f"{name}_mean": float(np.mean([count[name] for count in counts[part]])) for name in _MEANS},
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
        "most_components": max(kept),
        "memory": state_memory(ufm),
        "rows": [at(low) for low in range(0, frames - window + 1, window)],
    }


def measure_growth(
    worlds: dict[str, tuple[FrameSource, UfMStarConfig]],
    merge: tuple[float, ...],
    limits: tuple[int, ...],
    *,
    size: int,
    frames: int,
    window: int = 100,
    progress: Callable[[str], object] = lambda text: None,
) -> list[dict[str, Any]]:
    """Long runs in every world, with every limit of merging and every one of the components in memory.

    Args:
        worlds: frames and config by name.
        merge: values of ``MergeConfig.loss``; 0 = no merging.
        limits: values of ``max_components``; 0 = no limit.
        size, frames, window: see :func:`measure_long_run`.
        progress: is called with a description of what is measured next.

    Returns:
        Of each run "world", "merge", "max_components" and what :func:`measure_long_run` returns.
    """
    runs = []
    for (world, (source, config)), limit, most in product(worlds.items(), merge, limits):
        progress(f"long run, {world}, {frames} frames, merge {limit:g}, at most {most or 'all'} components in memory")
        merging = config.with_values({"merge.loss": limit}) if limit else config.replace(merge=None)
        settings = merging.replace(max_components=most or None)
        run = measure_long_run(source, settings, size=size, frames=frames, window=window)
        runs.append({"world": world, "merge": limit, "max_components": most or None, **run})
    return runs
