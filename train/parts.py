"""A contiguous part of a sequence, as text: ``0:70%``, ``75%:``, ``100:400``."""

from __future__ import annotations

import re
from dataclasses import dataclass

_EDGE = re.compile(r"\s*(\d+(?:\.\d+)?)\s*(%?)\s*")


@dataclass(frozen=True)
class Part:
    """From one edge up to, not including, another one.

    Held-back frames must not stand beside training frames in time: neighbours in a video show the same thing. So a
    sequence is divided in contiguous parts, best with a gap between them (``0:70%`` and ``75%:``), never
    at random.

    Attributes:
        start, stop: a number of frames, or a share of them where ``start_share`` / ``stop_share``.
    """

    start: float
    stop: float
    start_share: bool
    stop_share: bool

    @classmethod
    def parse(cls, text: str) -> Part:
        """``START:STOP``, each a frame number or a percentage of the frames; left out: the first, the end.

        Raises:
            ValueError: anything else, a share above 100 %, or an empty part.
        """
        edges = text.split(":")
        if len(edges) != 2:
            raise ValueError(f"a part must be START:STOP, such as 0:70% or 75%:, got {text!r}")
        (start, start_share), (stop, stop_share) = _edge(edges[0], "0", text), _edge(edges[1], "100%", text)
        if start_share == stop_share and start >= stop:
            raise ValueError(f"a part must end behind its start, got {text!r}")
        return cls(start, stop, start_share, stop_share)

    def frames(self, length: int) -> range:
        """The frame numbers of a sequence of that many.

        Raises:
            ValueError: none is left.
        """
        found = range(
            min(length, _position(self.start, self.start_share, length)),
            min(length, _position(self.stop, self.stop_share, length)),
        )
        if not found:
            raise ValueError(f"the part {self} of {length} frames is empty")
        return found

    def __str__(self) -> str:
        return f"{self.start:g}{'%' * self.start_share}:{self.stop:g}{'%' * self.stop_share}"


def _edge(text: str, default: str, whole: str) -> tuple[float, bool]:
    found = _EDGE.fullmatch(text if text.strip() else default)
    if found is None or (found[2] and float(found[1]) > 100) or (not found[2] and "." in found[1]):
        raise ValueError(f"a part must be START:STOP in frames or percent (0:70%, 100:400), got {whole!r}")
    return float(found[1]), bool(found[2])


def _position(value: float, share: bool, length: int) -> int:
    # Rounded to 1e-6 first: 70 % of 10 is 7, and not what 0.7 * 10 makes of it.
    return int(round(value * length / 100, 6)) if share else int(value)
