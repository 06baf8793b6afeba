"""Real-time figures of a live model: latencies, drops, the network's share, and the memory of the process."""

from __future__ import annotations

from array import array
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any

import numpy as np

from ufmstar_torch.live import LiveResult, LiveStatistics
from ufmstar_torch.uncertain_depth import UncertainDepth

_SETTLED = 60  # results before the memory is first read, when all buffers and threads exist
_STATM = Path("/proc/self/statm")


class RealTime:
    """Times of the results of one ``LiveDepth``. The time after the last inference of its ``model`` on an image counts
    as UfM*'s."""

    def __init__(self, model: UncertainDepth) -> None:
        self.latency = array("d")  # [s]
        # Times of each result [s]: begin, end of the last inference, and end.
        self.started, self.predicted, self.finished = array("d"), array("d"), array("d")
        self.processor = array("d")  # [s] CPU time of the worker's thread between two results
        self._predicted = 0.0
        self._thread: float | None = None
        self._memory: int | None = None
        self._first = self._last = 0.0
        for network in model.networks:
            network.register_forward_hook(self._note)

    def _note(self, *_: object) -> None:
        self._predicted = perf_counter()

    def take(self, result: LiveResult) -> None:
        """Add a result; call it in ``on_result``."""
        self._first, self._last = self._first or result.received, result.finished
        self.latency.append(result.latency)
        self.started.append(result.started)
        self.predicted.append(self._predicted)
        self.finished.append(result.finished)
        if self._thread is not None:
            self.processor.append(thread_time() - self._thread)
        self._thread = thread_time()
        if len(self.latency) == _SETTLED:
            self._memory = resident_bytes()

    def summary(self, statistics: LiveStatistics) -> dict[str, Any]:
        """Plain values: counts, results per second, latencies and times [ms], and memory [bytes]; None where nothing
        was measured."""
        compute = np.array(self.finished) - np.array(self.started)
        network = np.array(self.predicted) - np.array(self.started)
        memory, seconds = resident_bytes(), self._last - self._first
        lost = sum(statistics.dropped.values()) + sum(statistics.skipped.values())
        return {
            "images": statistics.images,
            "results": statistics.results,
            "dropped": dict(statistics.dropped),
            "skipped": dict(statistics.skipped),
            "restarts": statistics.restarts,
            "lost_share": lost / statistics.images if statistics.images else None,
            "seconds": seconds,
            "per_second": (len(compute) - 1) / seconds if len(compute) > 1 else None,
            "latency_ms": _quantiles(np.array(self.latency)),
            "network_ms": _quantiles(network),
            "ours_ms": _quantiles(compute - network),
            "processor_ms": _quantiles(np.array(self.processor)),
            "ours_share": float(1 - network.sum() / compute.sum()) if len(compute) else None,
            "memory_bytes": memory,
            "memory_growth_bytes": None if self._memory is None or memory is None else memory - self._memory,
        }


def _quantiles(seconds: np.ndarray) -> dict[str, float] | None:
    """The median, the 99th percentile and the maximum [ms]; None without values."""
    if not seconds.size:
        return None
    values = np.quantile(1000 * seconds, [0.5, 0.99, 1])
    return dict(zip(("p50", "p99", "max"), values.tolist(), strict=True))


def resident_bytes() -> int | None:
    """The resident memory of this process [bytes]; None without /proc (on systems other than Linux)."""
    import resource

    return int(_STATM.read_text().split()[1]) * resource.getpagesize() if _STATM.exists() else None


def figures_of(result: LiveResult, counts: LiveStatistics) -> dict[str, float]:
    """The figures of an image, and the counts so far."""
    depth, std = result.out.depth, result.out.std
    return {
        "stamp": round(result.stamp, 6),
        "latency_ms": round(1000 * result.latency, 2),
        "depth_m": round(float(depth.nanmedian()), 3),
        "sigma_m": round(float(std.nanmedian()), 3),
        "components": int(result.out.statistics.components[0]),
        "dropped": sum(counts.dropped.values()),
        "skipped": sum(counts.skipped.values()),
    }
