"""Settings of UfM, the pointwise baseline: frozen and checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class UfMConfig:
    """Everything UfM can be told.

    The modes of the paper differ only in what a network hands over. "Aleatoric": depth and A. "Ensemble" and
    "MC-dropout": the members in turn, or one stochastic pass. "Depth only": no variance, s^2 = 0. "Full": mean
    depth, A and E of several inferences.

    Attributes:
        max_points: points kept per stream; the paper's 100,000 at 224 x 224, 300,000 at 518 x 518. None = all.
            With fewer than an image has pixels, points are dropped before they are seen again.
        add_aleatoric: let A, where it is given, be part of s^2, the variance of a single observation.
        add_epistemic: likewise E.
        rotation_tolerance: max |R^T R - I| of a pose; less is removed by projection onto SO(3), more is a fault.
        on_bad_frame: "raise" or "skip" (counted, NaN returned) for unusable poses and intrinsics.

    Raises:
        ValueError: an impossible value.
        TypeError: an unknown name.
    """

    max_points: int | None = 100_000
    add_aleatoric: bool = True
    add_epistemic: bool = True
    rotation_tolerance: float = 0.01
    on_bad_frame: str = "raise"

    def __post_init__(self) -> None:
        whole = isinstance(self.max_points, int) and not isinstance(self.max_points, bool) and self.max_points > 0
        if self.max_points is not None and not whole:
            raise ValueError(f"UfMConfig.max_points must be None or a positive whole number, got {self.max_points!r}")
        for name in ("add_aleatoric", "add_epistemic"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"UfMConfig.{name} must be True or False, got {getattr(self, name)!r}")
        tolerance = self.rotation_tolerance
        if isinstance(tolerance, bool) or not isinstance(tolerance, int | float) or not 0 <= tolerance <= 0.1:
            raise ValueError(f"UfMConfig.rotation_tolerance must lie in [0, 0.1], got {tolerance!r}")
        if self.on_bad_frame not in ("raise", "skip"):
            raise ValueError(f"UfMConfig.on_bad_frame must be 'raise' or 'skip', got {self.on_bad_frame!r}")

    def to_dict(self) -> dict[str, Any]:
        """The config as plain values."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> UfMConfig:
        """Rebuild a config from :meth:`to_dict`; an unknown key is a ``TypeError``."""
        return cls(**values)
