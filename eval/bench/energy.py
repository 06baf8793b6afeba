"""Measures energy per frame with zeus, or gives the reason why it cannot be measured. Nothing is estimated.

Counters are refreshed tens of times a second at best, so a single call cannot be measured. A window runs one part on
all its frames, and again until it is long enough. Several windows per part, in alternating order, show the spread.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

GPU, CPU = "gpu", "cpu"
NO_ZEUS = "zeus, which reads the meters, is not installed: pip install 'ufmstar-torch[energy]'"
NO_GPU = "nothing runs on a GPU"
_NO_METER = {
    GPU: "zeus finds no meter of the GPU (NVML, AMD SMI or a system on a chip)",
    CPU: "zeus finds no meter of the processor that this user may read (RAPL needs root or zeusd)",
}
# Fields of zeus's measurement of a system on a chip (Jetson, Apple) [mJ].
_CHIP = {GPU: ("gpu_energy_mj", "gpu_mj"), CPU: ("cpu_energy_mj", "cpu_total_mj")}
_TRIAL = 0.2  # [s] length of the window that detects the meters
Key = TypeVar("Key")
# [N, 2] energy [J] of a part on its unit's meter and time [s], one row per window, per frame; or why it is missing.
Energy = NDArray[np.float64] | str


class EnergyMeter:
    """Measures the energy of GPU and processor with zeus.

    Args:
        gpu: torch's index of the GPU; None = no GPU is used.
        monitor: zeus's monitor; None = one for this machine, if zeus is installed.

    Attributes:
        missing: by unit, "gpu" or "cpu", the reason why its energy cannot be measured.
    """

    def __init__(self, gpu: int | None = None, monitor: Any = None) -> None:
        self._monitor = _open(gpu) if monitor is None else monitor
        self.missing = dict.fromkeys((GPU, CPU), NO_ZEUS)
        if self._monitor is not None:
            _, joules = self.measure(lambda: time.sleep(_TRIAL))
            self.missing = {unit: reason for unit, reason in _NO_METER.items() if unit not in joules}
        if gpu is None:
            self.missing[GPU] = NO_GPU

    def measure(self, work: Callable[[], object]) -> tuple[float, dict[str, float]]:
        """Seconds, and joules by unit, of ``work()``, which must finish on every device before it returns."""
        self._monitor.begin_window("ufmstar", restart=True)
        work()
        window = self._monitor.end_window("ufmstar")
        joules: dict[str, float] = {}
        for unit, by_device in ((GPU, window.gpu_energy), (CPU, window.cpu_energy)):
            chip = [getattr(window.soc_energy, name, None) for name in _CHIP[unit]]
            if by_device:
                joules[unit] = float(sum(by_device.values()))
            elif readings := [value for value in chip if value is not None]:
                joules[unit] = 1e-3 * readings[0]
        return window.time, joules


def _open(gpu: int | None) -> Any:
    """zeus's monitor of this machine; None if zeus is not installed."""
    if find_spec("zeus") is None:
        return None
    from zeus.device import get_gpus
    from zeus.device.gpu.common import ZeusGPUInitError
    from zeus.monitor import ZeusMonitor

    try:
        gpus = len(get_gpus())
    except ZeusGPUInitError:
        gpus = 0
    return ZeusMonitor(gpu_indices=[gpu] if gpu is not None and gpu < gpus else [])


def difference(part: Energy, other: Energy) -> Energy:
    """``part`` minus ``other``, window by window; the reason if one of them is missing."""
    return part if isinstance(part, str) else other if isinstance(other, str) else part - other


def summary(energy: Energy) -> dict[str, Any]:
    """For JSON: median and quartiles per frame [mJ], and the median time per frame [s]; or why it is missing."""
    if isinstance(energy, str):
        return {"not_measurable": energy}
    low, middle, high = np.percentile(energy, (25, 50, 75), axis=0).tolist()
    joules = {"millijoules": 1e3 * middle[0], "q1": 1e3 * low[0], "q3": 1e3 * high[0]}
    return {"gross": {**joules, "seconds": middle[1]}, "windows": len(energy)}


def measure_energy(
    meter: EnergyMeter,
    work: Mapping[Key, tuple[str, Sequence[Callable[[], object]]]],
    *,
    seconds: float,
    windows: int,
) -> dict[Key, Energy]:
    """Measure the energy of every part.

    Args:
        meter: reads the counters.
        work: by part, the unit whose meter counts ("gpu" or "cpu"), and one call per frame, which returns when its
            device has finished.
        seconds: shortest window [s]; a window makes all calls once, and all of them again until it is long enough.
        windows: number of windows per part.
    """
    results: dict[Key, list[list[float]]] = {key: [] for key in work}
    reasons = {key: meter.missing[unit] for key, (unit, _) in work.items() if unit in meter.missing}
    for turn in range(windows):
        for key in [key for key in work if key not in reasons][:: 1 if turn % 2 == 0 else -1]:
            unit, calls = work[key]
            frames, (passed, joules) = _window(meter, calls, seconds)
            if joules.get(unit, 0) <= 0:
                reasons[key] = f"the meter of the {unit} did not move in {passed:.2g} s"
            else:
                results[key].append([joules[unit] / frames, passed / frames])
    return {key: reasons.get(key) or np.array(rows) for key, rows in results.items()}


def _window(meter: EnergyMeter, calls: Sequence[Callable[[], object]], seconds: float) -> tuple[int, Any]:
    """The number of frames of one window, and the result of ``meter.measure``."""
    frames = 0

    def work() -> None:
        nonlocal frames
        start = time.perf_counter()
        while frames % len(calls) or not frames or time.perf_counter() - start < seconds:
            calls[frames % len(calls)]()
            frames += 1

    measured = meter.measure(work)
    return frames, measured
