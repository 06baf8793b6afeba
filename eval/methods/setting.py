"""What an ablation changes about a row: settings of UfM*, noise on the poses, frames left out, anchors.

A setting's values have flat names: ``Setting``'s own fields, and those of ``UfMStarConfig``, as "segment.min_pixels".
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from types import MappingProxyType
from typing import Any

from ufmstar_torch.checked import Checked, choice, number
from ufmstar_torch.config import UfMStarConfig

TRACKED, TRUTH = "tracked", "truth"
_OF_POSES = ("rotation_noise", "translation_noise", "rotation_drift", "translation_drift")


@dataclass(frozen=True)
class Setting(Checked):
    """One point of an ablation; the default is the row as the paper runs it.

    Attributes:
        overrides: of ``UfMStarConfig`` by dotted name, as {"ema_alpha": 1.0, "segment.min_pixels": 2000}.
        rotation_noise: standard deviation of each component of a rotation vector that is added to a pose [deg].
        translation_noise: the same of each component of the position [m].
        rotation_drift: of a random walk of the orientation, see ``perturb.Drift`` [deg per square root of frames].
        translation_drift: the same of the position [m per square root of frames].
        skip: images left out between two that are used; the paper's skip interval, 0 = consecutive ones.
        seed: of everything that is drawn: noise, and which anchors are taken.
        anchors: what UfM* is anchored by (``UfMStarConfig.anchored`` follows): "" nothing; "tracked": corners of the
            images, triangulated with the row's poses; "truth": ground truth at pixels drawn at random, the upper bound.
        anchor_count: anchors of a frame at most, drawn at random; None = all that are tracked, 100 of ground truth.
        track_noise: standard deviation of noise on tracked positions [px of the image]; see ``engine.anchors``.
        corrected: judge the depth corrected by the anchors' bias, and the variance that remains.
        posterior: judge the posterior's depth and variance (``UfMStarConfig.posterior`` follows).

    Raises:
        ValueError: a value is out of range, or they do not go together.
    """

    overrides: Mapping[str, Any] = field(default_factory=dict)
    rotation_noise: float = number(0.0, "", "deg", 0.0, open_high=True)
    translation_noise: float = number(0.0, "", "m", 0.0, open_high=True)
    rotation_drift: float = number(0.0, "", "deg", 0.0, open_high=True)
    translation_drift: float = number(0.0, "", "m", 0.0, open_high=True)
    skip: int = number(0, "", "1", 0)
    seed: int = number(0, "", "1", 0)
    anchors: str = choice("", TRACKED, TRUTH)
    anchor_count: int | None = number(None, "", "1", 0)
    track_noise: float = number(0.0, "", "px", 0.0, open_high=True)
    corrected: bool = False
    posterior: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        count = self.anchor_count
        if count is not None and not isinstance(count, int):
            raise ValueError(f"Setting.anchor_count must be a whole number, got {count!r}")
        if not self.anchors and (count is not None or self.corrected or self.posterior):
            raise ValueError("anchor_count, corrected and posterior go with anchors")
        if self.corrected and self.posterior:
            raise ValueError("corrected and posterior contradict each other")
        if self.track_noise and self.anchors != TRACKED:
            raise ValueError('track_noise goes with anchors = "tracked"')
        if "anchored" in self.overrides:
            raise ValueError('anchored follows from anchors: set anchors = "tracked" or "truth"')
        object.__setattr__(self, "overrides", MappingProxyType(dict(sorted(self.overrides.items()))))

    def __hash__(self) -> int:
        return hash(self.slug)

    def to_dict(self) -> dict[str, Any]:
        """What differs from the default, flat: {} for the row as it is."""
        own = {f.name: f.default for f in fields(self) if f.name not in ("overrides", "seed")}
        changed = {name: getattr(self, name) for name, plain in own.items() if getattr(self, name) != plain}
        return {**dict(self.overrides), **changed, **({"seed": self.seed} if self.draws else {})}

    @property
    def draws(self) -> bool:
        """Whether anything is drawn at random, so that the seed matters."""
        noisy = bool(self.pose_noise or self.track_noise)
        return noisy or self.anchors == TRUTH or self.anchor_count is not None

    @property
    def pose_noise(self) -> tuple[float, ...]:
        """What decides how poses are disturbed: the size of each kind of noise, and the seed; () where they are not."""
        sizes = tuple(getattr(self, name) for name in _OF_POSES)
        return (*sizes, self.seed) if any(sizes) else ()

    @property
    def slug(self) -> str:
        """A name for files, "" for the default."""
        changed = self.to_dict()
        if not changed:
            return ""
        return hashlib.sha256(json.dumps(changed, sort_keys=True).encode()).hexdigest()[:12]


DEFAULT = Setting()
_OWN = tuple(f.name for f in fields(Setting) if f.name != "overrides")


def setting_from(values: Mapping[str, Any]) -> Setting:
    """A setting from the flat form of ``Setting.to_dict``.

    Values that UfM* has anyway are left out, so that such a row is the default one.

    Raises:
        ValueError: an unknown name, or a value that it does not take.
    """
    own = {name: value for name, value in values.items() if name in _OWN}
    overrides = {name: value for name, value in values.items() if name not in _OWN}
    changed = {name: value for name, value in overrides.items() if value != default_of(name)}
    setting = Setting(overrides=changed, **own)
    configured(setting)
    return setting


def value_of(setting: Mapping[str, Any], name: str) -> Any:
    """The value that a setting (``Setting.to_dict``, as in a record) gives a name, UfM*'s own if it has none.

    Raises:
        ValueError: an unknown name.
    """
    return setting[name] if name in setting else default_of(name)


def default_of(name: str) -> Any:
    """The value that a row has as the paper runs it.

    Raises:
        ValueError: no setting has the name.
    """
    if name in _OWN:
        return getattr(DEFAULT, name)
    value: Any = UfMStarConfig()
    for part in name.split("."):
        if not is_dataclass(value) or part not in {f.name for f in fields(value)}:
            known = ", ".join(own for own in _OWN if own != "seed")
            raise ValueError(f"no setting is called {name!r}: expected {known}, or UfM*'s own, as ema_alpha")
        value = getattr(value, part)
    if is_dataclass(value):
        raise ValueError(f"setting {name!r} is a group: name one of its values, as {name}.min_pixels")
    return value


def configured(setting: Setting) -> UfMStarConfig:
    """UfM*'s configuration under a setting.

    Raises:
        ValueError: an unknown name, or a value that it does not take.
    """
    nested: dict[str, Any] = {}
    for name, value in setting.overrides.items():
        default_of(name)
        group, _, field = name.rpartition(".")
        (nested.setdefault(group, {}) if group else nested)[field] = value
    config = UfMStarConfig(anchored=bool(setting.anchors), posterior=setting.posterior)
    groups = {group: replace(getattr(config, group), **values) for group, values in nested.items() if _group(values)}
    return config.replace(**{name: value for name, value in nested.items() if not _group(value)}, **groups)


def _group(value: Any) -> bool:
    return isinstance(value, dict)
