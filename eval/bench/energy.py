"""Energy per frame as zeus measures it, or the reason why it cannot; nothing is estimated.

Counters are refreshed tens of times a second at best, so that a single call cannot be measured. A window repeats one
part until it is long enough; several windows per part, in alternating order, show how much they differ.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

GPU, CPU = "gpu", "cpu"
NOT_MEASURABLE = "not measurable here"
NO_ZEUS = "zeus, which reads the meters, is not installed: pip install 'ufmstar-torch[energy]'"
NO_GPU = "nothing runs on a GPU"
_NO_METER = {
    GPU: "zeus finds no meter of the GPU (NVML, AMD SMI or a system on a chip)",
    CPU: "zeus finds no meter of the processor that this user may read (RAPL needs root or zeusd)",
}
# Fields of zeus's measurement of a system on a chip (Jetson, Apple) [mJ].
_CHIP = {GPU: ("gpu_energy_mj", "gpu_mj"), CPU: ("cpu_energy_mj", "cpu_total_mj")}
_TRIAL = 0.2  # [s] A window that only shows which meters there are.
Key = TypeVar("Key")


class EnergyError(Exception):
    """A unit has no meter, or the meter did not move; the message is the reason."""


class EnergyMeter:
    """The energy of the GPU and of the processor.

    Args:
        gpu: index of the GPU as torch counts; None = none is used.
        monitor: of zeus; None = one for this machine, where zeus is installed.

    Attributes:
        missing: by unit, "gpu" or "cpu", why it has no meter.
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
        """Seconds, and joules by unit, of ``work()``; it must have finished on every device when it returns."""
        self._monitor.begin_window("ufmstar", restart=True)
        work()
        window = self._monitor.end_window("ufmstar")
        joules: dict[str, float] = {}
        for unit, own in ((GPU, window.gpu_energy), (CPU, window.cpu_energy)):
            chip = [getattr(window.soc_energy, name, None) for name in _CHIP[unit]]
            if own:
                joules[unit] = float(sum(own.values()))
            elif known := [value for value in chip if value is not None]:
                joules[unit] = 1e-3 * known[0]
        return window.time, joules

    def idle(self, seconds: float) -> dict[str, float]:
        """Power by unit [W] while this process does nothing; {} without a meter."""
        if {GPU, CPU} <= self.missing.keys():
            return {}
        passed, joules = self.measure(lambda: time.sleep(seconds))
        return {unit: spent / passed for unit, spent in joules.items() if unit not in self.missing}


def _open(gpu: int | None) -> Any:
    """zeus's monitor of this machine; None where zeus is not installed."""
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


@dataclass(frozen=True, eq=False)
class PartEnergy:
    """Of one part, on the unit that it runs on.

    Attributes:
        windows: [N, 3] per window and frame: all that the meter counted [J]; the same, less what it counts in the same
            time while the process is idle [J]; and the time [s].
        reason: why nothing was measured; there are no windows then.
    """

    windows: NDArray[np.float64]
    reason: str | None = None

    def minus(self, other: PartEnergy) -> PartEnergy:
        """What this part takes beyond another one, window by window."""
        reason = self.reason or other.reason
        return PartEnergy(np.empty((0, 3)), reason) if reason else PartEnergy(self.windows - other.windows)

    def to_dict(self) -> dict[str, Any]:
        """For JSON: medians and quartiles per frame [mJ], the time that goes with them [s], and power while the part
        runs [W]; or the reason."""
        if self.reason is not None:
            return {"not_measurable": self.reason}
        low, middle, high = np.percentile(self.windows, (25, 50, 75), axis=0).tolist()
        *joules, seconds = self.windows.sum(0).tolist()
        figures: dict[str, Any] = {"windows": len(self.windows)}
        for column, name in enumerate(("gross", "net")):
            figures[name] = {
                "millijoules": 1e3 * middle[column], "q1": 1e3 * low[column], "q3": 1e3 * high[column],
                # The time of a difference may be negative: there is no power then.
                "seconds": middle[2], "watts": joules[column] / seconds if seconds > 0 else None,
            }  # fmt: skip
        return figures


def measure_energy(
    meter: EnergyMeter,
    work: Mapping[Key, tuple[str, Sequence[Callable[[], object]]]],
    idle: Mapping[str, float],
    *,
    seconds: float,
    windows: int,
) -> dict[Key, PartEnergy]:
    """Measure every part.

    Args:
        meter: of this machine.
        work: by part: the unit whose meter counts ("gpu" or "cpu"), and a call for each frame, which returns when its
            device has finished; a window makes them over and over.
        idle: power by unit [W].
        seconds: that a window lasts, at least [s].
        windows: per part.
    """
    results: dict[Key, list[list[float]]] = {key: [] for key in work}
    reasons: dict[Key, str] = {}
    for turn in range(windows):
        for key in list(work)[:: 1 if turn % 2 == 0 else -1]:
            try:
                results[key].append(_window(meter, *work[key], idle, seconds))
            except EnergyError as error:
                reasons[key] = str(error)
    return {key: PartEnergy(np.array(rows).reshape(-1, 3), reasons.get(key)) for key, rows in results.items()}


def _window(
    meter: EnergyMeter, unit: str, calls: Sequence[Callable[[], object]], idle: Mapping[str, float], seconds: float
) -> list[float]:
    """Joules, net joules and seconds per frame of one window. Raises EnergyError: there are none."""
    if unit in meter.missing:
        raise EnergyError(meter.missing[unit])
    frames = 0

    def work() -> None:
        nonlocal frames
        start = time.perf_counter()
        while not frames or time.perf_counter() - start < seconds:
            calls[frames % len(calls)]()
            frames += 1

    passed, joules = meter.measure(work)
    if joules.get(unit, 0) <= 0:
        raise EnergyError(f"the meter of the {unit} did not move in {passed:.2g} s")
    return [joules[unit] / frames, (joules[unit] - idle[unit] * passed) / frames, passed / frames]
