"""What an ablation changes about a row: settings of UfM*, noise on the poses, frames left out."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any


@dataclass(frozen=True)
class Setting:
    """One point of an ablation; the default is the row as the paper runs it.

    Attributes:
        overrides: of ``UfMStarConfig`` by dotted name, as {"ema_alpha": 1.0, "segment.min_pixels": 2000}.
        rotation_noise: standard deviation of each component of a rotation vector that is added to a pose [deg].
        translation_noise: the same of each component of the position [m].
        skip: images left out between two that are used; the paper's skip interval, 0 = consecutive ones.
        seed: of the noise.

    Raises:
        ValueError: a number is out of range.
    """

    overrides: Mapping[str, Any] = field(default_factory=dict)
    rotation_noise: float = 0.0
    translation_noise: float = 0.0
    skip: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("rotation_noise", "translation_noise"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name} must be a finite number of at least 0, got {value!r}")
        for name in ("skip", "seed"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 0:
                raise ValueError(f"{name} must be a whole number of at least 0, got {value!r}")
        object.__setattr__(self, "overrides", MappingProxyType(dict(sorted(self.overrides.items()))))

    def __hash__(self) -> int:
        return hash(self.slug)

    def to_dict(self) -> dict[str, Any]:
        """What differs from the default, flat: {} for the row as it is."""
        own = {name: getattr(self, name) for name in ("rotation_noise", "translation_noise", "skip")}
        changed = {name: value for name, value in own.items() if value}
        noisy = self.rotation_noise or self.translation_noise
        return {**dict(self.overrides), **changed, **({"seed": self.seed} if noisy else {})}

    @property
    def slug(self) -> str:
        """A name for files, "" for the default."""
        changed = self.to_dict()
        if not changed:
            return ""
        return hashlib.sha256(json.dumps(changed, sort_keys=True).encode()).hexdigest()[:12]


DEFAULT = Setting()
