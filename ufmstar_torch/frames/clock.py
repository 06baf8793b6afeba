"""Stamps and poses of a live stream: single wrong stamps are recognised, and a clock that jumps is followed."""

from __future__ import annotations

import math
import sys
from bisect import bisect_left
from enum import Enum

import numpy as np

from ufmstar_torch.frames.warnings import LOGGER
from ufmstar_torch.gaussians.trajectory import SAME_TIME, Trajectory, interpolate_pose

# [s] A stamp farther from the stream's last one than this, and than the time since that arrived, is doubted.
JUMP = 2.0
_STEPS = 3.0  # a stream of few frames may also advance by so many of its last steps
_CONFIRMED = 3  # number of consecutive doubtful stamps that agree with each other and become the clock
_DOUBTFUL = 64  # most poses with doubtful stamps that wait for others
_MOST_POSES = 4096  # in a buffer: 4 s of an inertial filter at 1 kHz


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


class PoseBuffer:
    """The last poses of a stream [4, 4], by their stamps, which may come in any order within two seconds."""

    def __init__(self) -> None:
        self._times: list[float] = []  # increasing
        self._poses: list[np.ndarray] = []
        self._clock = StreamClock()
        self._doubtful: list[tuple[float, np.ndarray]] = []  # poses whose stamps nothing has confirmed

    @property
    def latest(self) -> float:
        """The last stamp [s]; -inf without poses."""
        return self._times[-1] if self._times else -math.inf

    @property
    def span(self) -> str:
        """The range of the stamps, in words."""
        return f"{self._times[0]:.3f} to {self._times[-1]:.3f} s" if self._times else "none"

    def at(self, stamp: float, max_gap: float) -> np.ndarray | None:
        """The pose [4, 4] at a moment [s]; NaN or None as ``interpolate_pose``."""
        index = bisect_left(self._times, stamp)
        around = slice(max(index - 1, 0), index + 1)
        if not self._times[around]:
            return None
        trajectory = Trajectory(np.array(self._times[around]), np.stack(self._poses[around]))
        return interpolate_pose(trajectory, stamp, max_gap)

    def add(self, stamp: float, pose: np.ndarray, now: float, other: float | None) -> int:
        """Add a pose, instead of the one with the same stamp, or after a jump of the clock instead of all others.

        Args:
            stamp: [s].
            pose: [4, 4].
            now, other: as :meth:`StreamClock.judge`.

        Returns:
            The number of poses that were dropped for their stamps.
        """
        index = bisect_left(self._times, stamp)
        if index < len(self._times) and self._times[index] == stamp:
            self._poses[index] = pose
            return 0
        before = self._clock.latest
        verdict = self._clock.judge(stamp, now, other)
        if verdict == Verdict.WAIT:
            self._doubtful.append((stamp, pose))
            dropped = max(len(self._doubtful) - _DOUBTFUL, 0)
            del self._doubtful[:-_DOUBTFUL]
            return dropped
        new = [(stamp, pose)]
        if verdict == Verdict.JUMPED:
            LOGGER.warning("the poses' clock jumped from %.3f s to %.3f s", before, stamp)
            new = [one for one in self._doubtful if abs(one[0] - stamp) <= JUMP] + new
            self._times, self._poses = [], []
        dropped = len(self._doubtful) - (len(new) - 1)
        self._doubtful = []
        for time, T in new:
            index = bisect_left(self._times, time)
            self._times.insert(index, time)
            self._poses.insert(index, T)
        del self._times[:-_MOST_POSES], self._poses[:-_MOST_POSES]
        return dropped


def require_stamp(stamp: float) -> float:
    """The stamp as a float. Raises TypeError, ValueError: not a finite number in seconds, exact to 1 ms."""
    if isinstance(stamp, bool) or not isinstance(stamp, float | int | np.floating | np.integer):
        raise TypeError(f"stamp must be a number of seconds, got {type(stamp).__name__}")
    exact = stamp.item() if isinstance(stamp, np.generic) else stamp
    if not abs(exact) < sys.float_info.max:
        raise ValueError(f"stamp must be finite [s], got {stamp}")
    step = float(np.spacing(abs(stamp))) if isinstance(stamp, np.floating) else math.ulp(exact)
    if step > SAME_TIME:
        raise ValueError(f"stamp must be in seconds and exact to 1 ms, got {stamp}, which is exact to {step:g} s")
    return float(stamp)
