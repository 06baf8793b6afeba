"""Energy from the machine's own counters, or the reason why there is none: nothing here is ever estimated.

A *rail* is one counter: a GPU, a processor package, its memory. It counts joules since some moment, so that a
window's energy is the difference of two readings. Idle power is measured in the same way while nothing is done.

Counters are refreshed tens of times a second at best, so that a single call cannot be measured. A window repeats one
part until it is long enough; several windows per part, in alternating order, show how much they differ.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from queue import Empty
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

GPU, CPU, DRAM, OTHER = "gpu", "cpu", "dram", "other"
NOT_MEASURABLE = "not measurable here"
# A window lasts at least so many refreshes of its counter: a refresh missed at either end is 5 % of it.
_REFRESHES = 20
# [W] More than a rail draws. A window that is longer than its counter takes to wrap at this power may have seen it
# wrap more than once, which no difference of two readings can tell.
_MOST_WATTS = 1000.0
# What reading a sensor may end in, beside zeus's own errors: no file, no permission, a helper that does not answer.
READING_ERRORS: tuple[type[Exception], ...] = (OSError, Empty)

# Repeats a part for at least so many seconds and returns how many frames that were.
Work = Callable[[float], int]
Key = TypeVar("Key", bound=Hashable)


class SensorError(Exception):
    """A counter could not be read; the message is the reason."""


Reading = float | SensorError  # of a rail [J]


@dataclass(frozen=True)
class Rail:
    """One counter of energy.

    Attributes:
        name: as "gpu 0", "cpu package 0".
        part: of the machine, "gpu", "cpu" or "dram"; "other" counts in no column of the table.
        wraps_at: [J] where the counter starts from 0 again; None = never.
    """

    name: str
    part: str
    wraps_at: float | None = None


@dataclass(frozen=True)
class Source:
    """Rails that are read together.

    Attributes:
        rails: whose names the readings have.
        read: joules by rail's name since any moment; raises ``SensorError`` where it cannot.
        period: [s] between two refreshes of its values.
    """

    rails: tuple[Rail, ...]
    read: Callable[[], Mapping[str, float]]
    period: float


@dataclass(frozen=True)
class Window:
    """What was consumed while something ran: [s], [J] by rail, and why other rails have no reading."""

    seconds: float
    joules: Mapping[str, float]
    unusable: Mapping[str, str] = field(default_factory=dict)


class PowerMeter:
    """All rails of this machine that can be read.

    Args:
        sources: of the rails.
        missing: by part of the machine, why it has no rail.
        clock: [s] of the windows.

    Raises:
        ValueError: two rails of one name.
    """

    def __init__(
        self,
        sources: Sequence[Source],
        missing: Mapping[str, str] | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._sources = tuple(sources)
        self._clock = clock
        self.rails = tuple(rail for source in self._sources for rail in source.rails)
        names = [rail.name for rail in self.rails]
        if len(set(names)) != len(names):
            raise ValueError(f"rails must have names of their own, got {names}")
        measured = {rail.part for rail in self.rails}
        given = dict(missing or {})
        self.missing = {p: given.get(p, "no sensor") for p in (GPU, CPU, DRAM) if p not in measured}

    @classmethod
    def open(cls, gpu: int | None = None) -> PowerMeter:
        """The sensors that zeus finds here.

        Args:
            gpu: index of the GPU as torch counts; None = none is used.
        """
        from ufmstar_torch.eval.bench.sensors import find_sources

        return cls(*find_sources(gpu))

    @property
    def shortest(self) -> float:
        """[s] A window must last at least so long, for its counters' refreshes not to matter; 0 without a sensor."""
        return _REFRESHES * max((source.period for source in self._sources), default=0.0)

    def names(self, part: str) -> tuple[str, ...]:
        """The rails of a part of the machine."""
        return tuple(rail.name for rail in self.rails if rail.part == part)

    def measure(self, work: Callable[[], object]) -> Window:
        """What ``work()`` consumes; it must have finished on every device when it returns."""
        began, before = self._read()
        work()
        ended, after = self._read()
        joules: dict[str, float] = {}
        unusable: dict[str, str] = {}
        for rail in self.rails:
            try:
                joules[rail.name] = consumed(rail, before[rail.name], after[rail.name], ended - began)
            except SensorError as error:
                unusable[rail.name] = str(error)
        return Window(ended - began, joules, unusable)

    def idle(self, seconds: float, sleep: Callable[[float], object] = time.sleep) -> dict[str, float]:
        """Power by rail [W] while this process does nothing for at least ``seconds`` [s]; {} without a sensor."""
        if not self.rails:
            return {}
        window = self.measure(lambda: sleep(max(seconds, self.shortest)))
        return {name: joules / window.seconds for name, joules in window.joules.items()}

    def _read(self) -> tuple[float, dict[str, Reading]]:
        """The time, and the readings by rail."""
        readings: dict[str, Reading] = {}
        at = self._clock()
        for source in self._sources:
            try:
                readings |= source.read()
            except SensorError as error:
                readings |= dict.fromkeys((rail.name for rail in source.rails), error)
        return at, readings


def consumed(rail: Rail, start: Reading, end: Reading, seconds: float) -> float:
    """Energy between two readings of a rail's counter [J], ``seconds`` apart [s], also where it has wrapped in between.

    Raises:
        SensorError: a reading failed; the counter did not move, went back, or may have wrapped more than once.
    """
    if isinstance(start, SensorError):
        raise start
    if isinstance(end, SensorError):
        raise end
    joules = end - start
    if rail.wraps_at is not None:
        if seconds * _MOST_WATTS >= rail.wraps_at:
            raise SensorError(f"a window of {seconds:.0f} s is too long for the counter of {rail.name}, which wraps")
        joules %= rail.wraps_at
    if joules < 0:
        raise SensorError(f"the counter of {rail.name} went back")
    if joules == 0:
        raise SensorError(f"the counter of {rail.name} did not move in {seconds:.2g} s")
    return joules


# ---- energy per frame ----


@dataclass(frozen=True, eq=False)
class PartEnergy:
    """Of one part, on the rails of the unit that it runs on.

    Attributes:
        windows: [N, 3] per window and frame: all that the rails counted [J]; the same, less what they count in the same
            time while the process is idle [J]; and the time [s].
        reason: why nothing was measured; there are no windows then.
    """

    windows: NDArray[np.float64]
    reason: str | None = None

    def minus(self, other: PartEnergy) -> PartEnergy:
        """What this part takes beyond another one, window by window."""
        if reason := self.reason or other.reason:
            return unmeasured(reason)
        return PartEnergy(self.windows - other.windows)

    def to_dict(self) -> dict[str, Any]:
        """For JSON: medians and quartiles per frame [mJ], the time that goes with them [s], and power while the part
        runs [W]; or the reason."""
        if self.reason is not None:
            return {"not_measurable": self.reason}
        low, middle, high = np.percentile(self.windows, (25, 50, 75), axis=0).tolist()
        *joules, seconds = self.windows.sum(0).tolist()
        figures: dict[str, Any] = {}
        for column, name in enumerate(("gross", "net")):
            figures[name] = {
                "millijoules": 1e3 * middle[column], "q1": 1e3 * low[column], "q3": 1e3 * high[column],
                # The time of a difference may be negative: there is no power then.
                "seconds": middle[2], "watts": joules[column] / seconds if seconds > 0 else None,
            }  # fmt: skip
        return {**figures, "windows": len(self.windows)}


def unmeasured(reason: str) -> PartEnergy:
    """The energy of a part that could not be measured."""
    return PartEnergy(np.zeros((0, 3)), reason)


def run_windows(
    meter: PowerMeter,
    work: Mapping[Key, tuple[str, Work]],
    idle: Mapping[str, float],
    *,
    seconds: float,
    windows: int,
) -> dict[Key, PartEnergy]:
    """Measure every part.

    Args:
        meter: the rails.
        work: by part: the unit of the machine whose rails count ("gpu" or "cpu"), and what to repeat.
        idle: power by rail [W].
        seconds: that a window lasts, at least [s].
        windows: per part.
    """
    results: dict[Key, list[list[float]]] = {key: [] for key in work}
    reasons: dict[Key, str] = {}
    for turn in range(windows):
        for key in list(work)[:: 1 if turn % 2 == 0 else -1]:
            try:
                results[key].append(_one(meter, *work[key], idle, max(seconds, meter.shortest)))
            except SensorError as error:
                reasons[key] = str(error)
    return {key: unmeasured(reasons[key]) if key in reasons else PartEnergy(np.array(results[key])) for key in work}


def _one(meter: PowerMeter, unit: str, repeat: Work, idle: Mapping[str, float], seconds: float) -> list[float]:
    """Joules, net joules and seconds per frame of one window. Raises SensorError: there are none."""
    names = meter.names(unit)
    if not names:
        raise SensorError(meter.missing.get(unit, NOT_MEASURABLE))
    frames: list[int] = []
    window = meter.measure(lambda: frames.append(repeat(seconds)))
    for name in names:
        if name in window.unusable:
            raise SensorError(window.unusable[name])
        if name not in idle:
            raise SensorError(f"the idle power of {name} could not be measured")
    gross = sum(window.joules[name] for name in names)
    resting = sum(idle[name] for name in names) * window.seconds
    return [gross / frames[0], (gross - resting) / frames[0], window.seconds / frames[0]]


def repeated(
    calls: Sequence[Callable[[], object]], wait: Callable[[], None], clock: Callable[[], float] = time.perf_counter
) -> Work:
    """Call after call (one per frame), each followed by ``wait`` until the device has finished, as in a robot's loop,
    over and over until the time is up; no call raises ValueError.
    """
    if not calls:
        raise ValueError("calls must hold at least one")

    def work(seconds: float) -> int:
        start, count = clock(), 0
        while not count or clock() - start < seconds:
            calls[count % len(calls)]()
            wait()
            count += 1
        return count

    return work
