"""Energy per frame: each part of each row runs alone for seconds, in windows that take turns.

The counters are refreshed tens of times a second at best, so that a single call cannot be measured. A window repeats
one part until it is long enough; several windows per part, in alternating order, show how much they differ.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np

from ufmstar_torch.eval.bench.power import NOT_MEASURABLE, PowerMeter

# Repeats a part for at least so many seconds and returns how many frames that were.
Work = Callable[[float], int]


@dataclass(frozen=True)
class PartEnergy:
    """Of one part, on the rails of the unit that it runs on; one number per window.

    Attributes:
        joules: per frame [J], all that the rails counted.
        net: likewise, less what they count in the same time while the process is idle.
        seconds: per frame [s].
        reason: why nothing was measured; the lists are empty then.
    """

    joules: tuple[float, ...] = ()
    net: tuple[float, ...] = ()
    seconds: tuple[float, ...] = ()
    reason: str | None = None

    def minus(self, other: PartEnergy) -> PartEnergy:
        """What this part takes beyond another one, window by window."""
        if self.reason is not None or other.reason is not None:
            return PartEnergy(reason=self.reason or other.reason)
        pairs = [(self.joules, other.joules), (self.net, other.net), (self.seconds, other.seconds)]
        joules, net, seconds = (tuple(a - b for a, b in zip(x, y, strict=True)) for x, y in pairs)
        return PartEnergy(joules, net, seconds)

    def to_dict(self) -> dict[str, Any]:
        """For JSON: medians and quartiles per frame [mJ], the time that goes with them [s], and power while the part
        runs [W]; or the reason."""
        if self.reason is not None:
            return {"not_measurable": self.reason}
        told: dict[str, Any] = {}
        for name, values in (("gross", self.joules), ("net", self.net)):
            low, middle, high = (1e3 * float(v) for v in np.percentile(values, (25, 50, 75)))
            told[name] = {
                "millijoules": middle, "q1": low, "q3": high,
                "seconds": float(np.median(self.seconds)), "watts": _power(values, self.seconds),
            }  # fmt: skip
        return {**told, "windows": len(self.joules)}


def _power(joules: Sequence[float], seconds: Sequence[float]) -> float | None:
    """[W] Energy over time; None where the time that a difference leaves is not positive."""
    total = sum(seconds)
    return sum(joules) / total if total > 0 else None


def run_windows(
    meter: PowerMeter,
    work: Mapping[tuple[str, str], tuple[str, Work]],
    idle: Mapping[str, float],
    *,
    seconds: float,
    windows: int,
) -> dict[tuple[str, str], PartEnergy]:
    """Measure every part.

    Args:
        meter: the rails.
        work: by owner and part: the part of the machine whose rails count ("gpu" or "cpu"), and what to repeat.
        idle: power by rail [W].
        seconds: that a window lasts, at least [s].
        windows: per part.
    """
    results: dict[tuple[str, str], list[tuple[float, float, float]]] = {key: [] for key in work}
    reasons = {key: reason for key, (unit, _) in work.items() if (reason := _without_rails(meter, unit)) is not None}
    measured = [key for key in work if key not in reasons]
    for turn in range(windows):
        for key in measured if turn % 2 == 0 else measured[::-1]:
            unit, repeat = work[key]
            value = _one(meter, unit, repeat, idle, max(seconds, meter.shortest))
            if isinstance(value, str):
                reasons[key] = value
            else:
                results[key].append(value)
    energies: dict[tuple[str, str], PartEnergy] = {}
    for key, values in results.items():
        if key in reasons:
            energies[key] = PartEnergy(reason=reasons[key])
        else:
            joules, net, times = zip(*values, strict=True)
            energies[key] = PartEnergy(joules, net, times)
    return energies


def _without_rails(meter: PowerMeter, unit: str) -> str | None:
    if meter.names(unit):
        return None
    return meter.missing.get(unit, NOT_MEASURABLE)


def _one(
    meter: PowerMeter, unit: str, repeat: Work, idle: Mapping[str, float], seconds: float
) -> tuple[float, float, float] | str:
    """Joules, net joules and seconds per frame of one window, or why there are none."""
    frames: list[int] = []
    window = meter.measure(lambda: frames.append(repeat(seconds)))
    for name in meter.names(unit):
        if name in window.unusable:
            return window.unusable[name]
        if name not in idle:
            return f"the idle power of {name} could not be measured"
    gross = sum(window.joules[name] for name in meter.names(unit))
    resting = sum(idle[name] for name in meter.names(unit)) * window.seconds
    return gross / frames[0], (gross - resting) / frames[0], window.seconds / frames[0]


def repeated(
    calls: Sequence[Callable[[], object]],
    wait: Callable[[], None],
    clock: Callable[[], float] = time.perf_counter,
) -> Work:
    """Call after call, each waited for as in a robot's loop, over and over until the time is up.

    Args:
        calls: one per frame.
        wait: until the device has finished.
        clock: [s].

    Raises:
        ValueError: no call.
    """
    if not calls:
        raise ValueError("calls must hold at least one")

    def work(seconds: float) -> int:
        start, count = clock(), 0
        for call in cycle(calls):
            call()
            wait()
            count += 1
            if clock() - start >= seconds:
                break
        return count

    return work
