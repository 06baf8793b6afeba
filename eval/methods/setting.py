"""The settings of a row: those of UfM*, preprocessing, noise on poses, skipped frames, anchors.

A setting's values have flat names: the fields of ``Setting``, and those of ``UfMStarConfig``, as "segment.min_pixels".
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any

from ufmstar_torch.anchors.names import CORNERS, DENSE, FILE_TYPES
from ufmstar_torch.config import AnchorConfig, MergeConfig, PosteriorConfig, UfMStarConfig
from ufmstar_torch.runtime.checked import Checked, choice, flat, number

TRUTH = "truth"
DEFAULTS, PAPER = "default", "paper"
# Preprocessing of an image to the network's input.
OF_NETWORK, RESIZE, CROP = "network", "resize", "crop"
_OF_POSES = ("rotation_noise", "translation_noise", "rotation_drift", "translation_drift")


@dataclass(frozen=True)
class Setting(Checked):
    """One point of an ablation; the default is the row with UfM*'s defaults and the network's preprocessing.

    Attributes:
        ufm_preset: initial settings of UfM*: "default", or "paper" (``UfMStarConfig.paper``).
        preprocess: of an image to the network's input: "network", as its weights declare; "resize", the whole frame,
            each axis by a separate factor, as in the paper's loader of ScanNet; "crop", the centre as in NYU's
            validation. The input's size, colours and range stay the network's.
        overrides: of ``UfMStarConfig`` by dotted name, as {"ema_alpha": 1.0, "segment.min_pixels": 2000}.
        rotation_noise: standard deviation of each component of a rotation vector that is added to a pose [deg].
        translation_noise: standard deviation of each component of the position [m].
        rotation_drift: of a random walk of the orientation, see ``perturb.Drift`` [deg per square root of frames].
        translation_drift: of a random walk of the position [m per square root of frames].
        skip: number of skipped images between two used ones; the paper's skip interval, 0 = use all.
        seed: of all random numbers: noise, and the choice of anchors.
        anchors: source of UfM*'s anchors (``UfMStarConfig.anchors`` follows): "" none; "corners" of the images, tracked
            and triangulated with the row's poses; "dense" evidence, likewise; "truth", ground truth at random pixels,
            the upper bound; or a file of landmarks in the folder of each sequence, see
            ``ufmstar_torch.anchors.LandmarkMap.read``.
        anchor_count: largest number of anchors of a frame, chosen at random; None = all tracked ones, or 100 of ground
            truth.
        track_noise: standard deviation of noise on tracked positions [px of the image]; see ``engine.anchors``.
        posterior: True to evaluate the posterior's depth and variance (``UfMStarConfig.posterior`` follows).

    Raises:
        ValueError: a value is out of range, or values contradict each other.
    """

    overrides: Mapping[str, Any] = field(default_factory=dict)
    ufm_preset: str = choice(DEFAULTS, PAPER)
    preprocess: str = choice(OF_NETWORK, RESIZE, CROP)
    rotation_noise: float = number(0.0, "", "deg", 0.0, open_high=True)
    translation_noise: float = number(0.0, "", "m", 0.0, open_high=True)
    rotation_drift: float = number(0.0, "", "deg", 0.0, open_high=True)
    translation_drift: float = number(0.0, "", "m", 0.0, open_high=True)
    skip: int = number(0, "", "1", 0)
    seed: int = number(0, "", "1", 0)
    anchors: str = ""
    anchor_count: int | None = number(None, "", "1", 0)
    track_noise: float = number(0.0, "", "px", 0.0, open_high=True)
    posterior: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.anchors not in ("", CORNERS, DENSE, TRUTH) and not str(self.anchors).lower().endswith(FILE_TYPES):
            allowed = f"{CORNERS!r}, {DENSE!r}, {TRUTH!r} or a file {', '.join(FILE_TYPES)}"
            raise ValueError(f"Setting.anchors must be {allowed}, got {self.anchors!r}")
        count = self.anchor_count
        if count is not None and not isinstance(count, int):
            raise ValueError(f"Setting.anchor_count must be a whole number, got {count!r}")
        if not self.anchors and (count is not None or self.posterior):
            raise ValueError("anchor_count and posterior go with anchors")
        if self.track_noise and self.anchors != CORNERS:
            raise ValueError('track_noise goes with anchors = "corners"')
        for group in ("anchors", "posterior"):
            if not getattr(self, group) and any(name.startswith(f"{group}.") for name in self.overrides):
                raise ValueError(f"{group}. settings go with {group}: set {group} as well")
        object.__setattr__(self, "overrides", MappingProxyType(dict(sorted(self.overrides.items()))))

    def __hash__(self) -> int:
        return hash(self.slug)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the overrides as a dict, because a mapping proxy cannot be pickled."""
        return Setting, (dict(self.overrides), *(getattr(self, name) for name in _OWN))

    def to_dict(self) -> dict[str, Any]:
        """The values that differ from the default, flat; {} for the default."""
        defaults = {f.name: f.default for f in fields(self) if f.name not in ("overrides", "seed")}
        changed = {name: getattr(self, name) for name, plain in defaults.items() if getattr(self, name) != plain}
        return {**dict(self.overrides), **changed, **({"seed": self.seed} if self.draws else {})}

    @property
    def chosen(self) -> Setting:
        """The setting with this one's preset and preprocessing, which are no ablations, and defaults otherwise."""
        return Setting(ufm_preset=self.ufm_preset, preprocess=self.preprocess)

    @property
    def plain(self) -> bool:
        """True if no ablation changes a value."""
        return self == self.chosen

    @property
    def of_ufm_star(self) -> tuple[str, ...]:
        """Names of the changed values that apply to UfM* alone."""
        names = ("ufm_preset", "anchors")
        return (*self.overrides, *(name for name in names if getattr(self, name) != getattr(DEFAULT, name)))

    @property
    def draws(self) -> bool:
        """True if the setting uses random numbers, so that the seed matters."""
        noisy = bool(self.pose_noise or self.track_noise)
        return noisy or self.anchors == TRUTH or self.anchor_count is not None

    @property
    def pose_noise(self) -> tuple[float, ...]:
        """The size of each kind of noise on the poses, and the seed; () without noise."""
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

    Values equal to those of the preset are omitted, so that such a row is the plain one.

    Raises:
        ValueError: an unknown name or an invalid value.
    """
    direct = {name: value for name, value in values.items() if name in _OWN}
    overrides = {name: value for name, value in values.items() if name not in _OWN}
    preset = direct.get("ufm_preset", DEFAULTS)
    changed = {name: value for name, value in overrides.items() if value != default_of(name, preset)}
    setting = Setting(overrides=changed, **direct)
    configured(setting)
    return setting


def default_of(name: str, preset: str = DEFAULTS) -> Any:
    """The default value of a setting; None in a section that is off.

    Args:
        name: of the setting.
        preset: of UfM*'s settings.

    Raises:
        ValueError: no such setting or preset.
    """
    if name in _OWN:
        return getattr(DEFAULT, name)
    # The row's ``anchors`` and ``posterior`` switch their sections on; the paper's preset switches merging off.
    on = started(preset, anchors=True, posterior=True).replace(confidence=True)
    off = dict.fromkeys(flat(MergeConfig().to_dict(), "merge.")) if on.merge is None else {}
    values = flat(on.to_dict()) | off
    if inner := [other for other in values if other.startswith(f"{name}.")]:
        raise ValueError(f"setting {name!r} is a group: name one of its values, as {inner[0]}")
    if name in values:
        return values[name]
    expected = [field_ for field_ in _OWN if field_ != "seed"]
    similar = get_close_matches(name, [*expected, *values], n=1)
    meant = f"; did you mean {similar[0]}?" if similar else ""
    raise ValueError(
        f"no setting is called {name!r}: expected {', '.join(expected)}, or UfM*'s own, as ema_alpha{meant}"
    )


def configured(setting: Setting) -> UfMStarConfig:
    """UfM*'s configuration under a setting. Raises ValueError: an unknown name or an invalid value."""
    config = started(setting.ufm_preset, anchors=bool(setting.anchors), posterior=setting.posterior)
    for name in setting.overrides:
        default_of(name)
    return config.with_values(setting.overrides)


def started(preset: str, *, anchors: bool, posterior: bool) -> UfMStarConfig:
    """UfM*'s settings of a preset, with these extensions. Raises ValueError: no such preset."""
    if preset not in (DEFAULTS, PAPER):
        raise ValueError(f"ufm_preset must be {DEFAULTS} or {PAPER}, got {preset!r}")
    start = UfMStarConfig.paper() if preset == PAPER else UfMStarConfig()
    sections = {"anchors": AnchorConfig() if anchors else None, "posterior": PosteriorConfig() if posterior else None}
    return start.replace(**sections)
