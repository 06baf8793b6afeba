"""Stamps of a live stream: single wrong ones are recognised, and a clock that jumps is followed."""

from __future__ import annotations

from enum import Enum

# [s] A stamp farther from the stream's last one than this, and than the time since that arrived, is doubted.
JUMP = 2.0
_STEPS = 3.0  # a stream of few frames may also advance by so many of its last steps
_CONFIRMED = 3  # number of consecutive doubtful stamps that agree with each other and become the clock


class Verdict(Enum):
    """The decision about a stamp."""

    USE = 0
    WAIT = 1  # doubtful: nothing after it has confirmed it
    JUMPED = 2  # the last of the stamps that confirm each other: the clock has jumped


class StreamClock:
    """The clock of one stream of stamps [s].

    A stamp is doubtful if it is far from the last one in either direction. The third of consecutive doubtful stamps
    that follow each other as the stream's stamps do is a jump of the clock, unless the newest stamp of another stream
    with the same clock is closer to the old time.
    """

    def __init__(self) -> None:
        self.latest: float | None = None  # the newest stamp that is not doubtful
        self.newest: float | None = None  # the last stamp, doubtful or not
        self._received, self._step = 0.0, 0.0
        self._doubtful: list[float] = []

    def judge(self, stamp: float, now: float, other: float | None = None) -> Verdict:
        """Judge the next stamp.

        Args:
            stamp: [s].
            now: time of its arrival, in seconds of any clock that does not jump.
            other: newest stamp of another stream; None = there is none.
        """
        self.newest = stamp
        if self.latest is None:
            return self._follow(stamp, now, Verdict.USE)
        ahead, reach = stamp - self.latest, JUMP + _STEPS * self._step
        if -JUMP <= ahead <= reach + max(now - self._received, 0.0):
            return self._follow(max(stamp, self.latest), now, Verdict.USE)
        last = self._doubtful[-1] if self._doubtful else stamp
        # a stream of few frames has steps as long as the first one
        continues = 0 < stamp - last <= max(reach, 2 * (last - self.latest))
        self._doubtful = [*self._doubtful, stamp] if continues else [stamp]
        agrees = other is None or abs(other - stamp) < abs(other - self.latest)
        if len(self._doubtful) < _CONFIRMED or not agrees:
            return Verdict.WAIT
        self.latest = last  # the step is that of the new clock
        return self._follow(stamp, now, Verdict.JUMPED)

    def _follow(self, stamp: float, now: float, verdict: Verdict) -> Verdict:
        self._step = 0.0 if self.latest is None else stamp - self.latest
        self.latest, self._received, self._doubtful = stamp, now, []
        return verdict
