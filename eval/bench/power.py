"""Energy from the machine's own counters, or the reason why there is none: nothing here is ever estimated.

A *rail* is one counter: a GPU, a processor package, its memory. It counts joules since some moment, so that a
window's energy is the difference of two readings. Idle power is measured in the same way while nothing is done.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from queue import Empty

GPU, CPU, DRAM, OTHER = "gpu", "cpu", "dram", "other"
PARTS = (GPU, CPU, DRAM, OTHER)
NOT_MEASURABLE = "not measurable here"
# A window lasts at least so many refreshes of its counter: a refresh missed at either end is 5 % of it.
_REFRESHES = 20
# [W] More than a rail draws. A window that is longer than its counter takes to wrap at this power may have seen it
# wrap more than once, which no difference of two readings can tell.
_MOST_WATTS = 1000.0


class SensorError(Exception):
    """A counter could not be read; the message says why."""


@dataclass(frozen=True)
class Rail:
    """One counter of energy.

    Attributes:
        name: as "gpu 0", "cpu package 0".
        part: of the machine, one of ``PARTS``; "other" counts in no column of the table.
        wraps_at: [J] where the counter starts from 0 again; None = never.

    Raises:
        ValueError: another part, or a limit that is not positive.
    """

    name: str
    part: str
    wraps_at: float | None = None

    def __post_init__(self) -> None:
        if self.part not in PARTS:
            raise ValueError(f"part must be one of {', '.join(PARTS)}, got {self.part!r}")
        if self.wraps_at is not None and not self.wraps_at > 0:
            raise ValueError(f"wraps_at must be positive joules or None, got {self.wraps_at}")


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
    """What was consumed while something ran.

    Attributes:
        seconds: how long it took [s].
        joules: by rail [J]; only what was measured.
        unusable: by rail, why its reading is none.
    """

    seconds: float
    joules: Mapping[str, float]
    unusable: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Reading:
    at: float
    joules: Mapping[str, float]
    failed: Mapping[str, str]


class PowerMeter:
    """All rails of this machine that can be read.

    Args:
        sources: of the rails.
        missing: by part of the machine, why it has no rail.
        clock: [s] that time windows are told by.

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
        there = {rail.part for rail in self.rails}
        given = dict(missing or {})
        self.missing = {p: given.get(p, "no sensor") for p in (GPU, CPU, DRAM) if p not in there}

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
        start = self._read()
        work()
        return self._between(start, self._read())

    def idle(self, seconds: float, sleep: Callable[[float], object] = time.sleep) -> dict[str, float]:
        """Power by rail [W] while this process does nothing for at least ``seconds`` [s]; {} without a sensor."""
        if not self.rails:
            return {}
        window = self.measure(lambda: sleep(max(seconds, self.shortest)))
        return {name: joules / window.seconds for name, joules in window.joules.items()}

    def _read(self) -> _Reading:
        joules: dict[str, float] = {}
        failed: dict[str, str] = {}
        at = self._clock()
        for source in self._sources:
            try:
                joules |= source.read()
            except SensorError as error:
                failed |= {rail.name: str(error) for rail in source.rails}
        return _Reading(at, joules, failed)

    def _between(self, start: _Reading, end: _Reading) -> Window:
        seconds = end.at - start.at
        joules: dict[str, float] = {}
        unusable: dict[str, str] = {**end.failed, **start.failed}
        for rail in self.rails:
            if rail.name in unusable:
                continue
            try:
                joules[rail.name] = consumed(rail, start.joules[rail.name], end.joules[rail.name], seconds)
            except SensorError as error:
                unusable[rail.name] = str(error)
        return Window(seconds, joules, unusable)


def consumed(rail: Rail, start: float, end: float, seconds: float) -> float:
    """Energy between two readings of a counter [J], also where it has wrapped in between.

    Args:
        rail: whose counter it is.
        start, end: readings [J].
        seconds: between them [s].

    Raises:
        SensorError: the counter did not move, went back, or may have wrapped more than once.
    """
    if rail.wraps_at is None:
        joules = end - start
    elif seconds * _MOST_WATTS >= rail.wraps_at:
        raise SensorError(f"a window of {seconds:.0f} s is too long for the counter of {rail.name}, which wraps")
    else:
        joules = (end - start) % rail.wraps_at
    if joules < 0:
        raise SensorError(f"the counter of {rail.name} went back")
    if joules == 0:
        raise SensorError(f"the counter of {rail.name} did not move in {seconds:.2g} s")
    return joules


# What reading a sensor may end in, beside zeus's own errors: no file, no permission, a helper that does not answer.
READING_ERRORS: tuple[type[Exception], ...] = (OSError, Empty)
