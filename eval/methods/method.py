"""The methods of the paper's tables: the network, its number of inferences per image, and the fusion of views.

A method has the paper's name: "Ensemble", "UfM-MCD-100K", "UfM*-Aleatoric", "UfM*-FullBatchEnsemble",
"UfM*-DepthOnly-fixed-param".
"""

from __future__ import annotations

import re
from dataclasses import dataclass

# The kinds of networks: name alone, and name after "UfM-" or "UfM*-".
BASES = {
    "ensemble": ("Ensemble", "Ensemble"),
    "mc_dropout": ("MC-Dropout", "MCD"),
    "batch_ensemble": ("BatchEnsemble", "BatchEnsemble"),
    "evidential": ("Evidential", "Evidential"),
    "aleatoric": ("Aleatoric", "Aleatoric"),
    "depth_only": ("DepthOnly", "DepthOnly"),
}
# The network that a base needs.
NETWORKS = {
    "ensemble": "several networks that predict an aleatoric variance",
    "mc_dropout": "a network with dropout in its decoder that predicts an aleatoric variance",
    "batch_ensemble": "a BatchEnsemble that predicts an aleatoric variance",
    "evidential": "a network with an evidential head",
    "aleatoric": "a network that predicts an aleatoric variance",
    "depth_only": "a depth network",
}
# Bases with several different passes on an image.
MANY = ("ensemble", "mc_dropout", "batch_ensemble")
# RELATIVE is a baseline that compares no views: sigma is the share RHO of the depth.
ALONE, UFM, UFM_STAR, RELATIVE = "alone", "ufm", "ufm_star", "relative"
FUSIONS = (ALONE, UFM, UFM_STAR, RELATIVE)
RHO = 0.2
_PREFIXES = {UFM: "UfM", UFM_STAR: "UfM*", RELATIVE: "Relative"}
# Name of a user's method (``sequences.plugins``).
_OWN = r"[a-z][a-z0-9_]*"
_NAME = re.compile(
    rf"(?P<fusion>UfM\*?|Relative|{_OWN})-(?P<full>Full)?(?P<base>[A-Za-z]+)(-(?P<cap>\d+)K)?(?P<fixed>-fixed-param)?"
)


@dataclass(frozen=True)
class Method:
    """A method of a row.

    Raises:
        ValueError: the fields contradict each other.
    """

    base: str  # a key of ``BASES``
    fusion: str = ALONE  # "alone" (the network's variance), "ufm", "ufm_star", "relative", or a user's method
    # With UfM or UfM*: run all members (or samples) on every image instead of alternating.
    full: bool = False
    max_points: int | None = None  # of UfM; None = unpruned
    # With UfM*: thresholds of the segmentation in pixels as at 224 x 224, for every size of image.
    fixed_param: bool = False

    def __post_init__(self) -> None:
        if self.base not in BASES:
            raise ValueError(f"base must be one of {', '.join(BASES)}, got {self.base!r}")
        if not re.fullmatch(_OWN, self.fusion):
            raise ValueError(
                f"fusion must be one of {', '.join(FUSIONS)} or a name in small letters, got {self.fusion!r}"
            )
        if self.full and (self.fusion == ALONE or self.base not in MANY):
            raise ValueError(f"full goes with UfM or UfM* behind one of {', '.join(MANY)}")
        if self.max_points is not None and (self.fusion != UFM or self.max_points < 1000 or self.max_points % 1000):
            raise ValueError(f"max_points goes with UfM and is a multiple of 1000, got {self.max_points}")
        if self.fixed_param and self.fusion != UFM_STAR:
            raise ValueError("fixed_param goes with UfM*")

    @property
    def name(self) -> str:
        """The name in the paper."""
        alone, behind = BASES[self.base]
        if self.fusion == ALONE:
            return alone
        cap = "" if self.max_points is None else f"-{self.max_points // 1000}K"
        prefix = _PREFIXES.get(self.fusion, self.fusion)
        return f"{prefix}-{'Full' if self.full else ''}{behind}{cap}{'-fixed-param' if self.fixed_param else ''}"

    @property
    def every_member(self) -> bool:
        """True if all members (or samples) run on every image instead of alternating."""
        return self.base in MANY and (self.full or self.fusion == ALONE)

    @property
    def uses_aleatoric(self) -> bool:
        """True if the network's variance is used; "DepthOnly" ignores it."""
        return self.base != "depth_only"

    @classmethod
    def parse(cls, name: str) -> Method:
        """The method of that name. Raises ValueError: no method has that name."""
        by_alone = {alone: base for base, (alone, _) in BASES.items()}
        if name in by_alone:
            return cls(by_alone[name])
        by_behind = {behind: base for base, (_, behind) in BASES.items()}
        match = _NAME.fullmatch(name)
        if match is None or match["base"] not in by_behind or match["fusion"] in FUSIONS:
            names = f"{', '.join(by_alone)}, or UfM-, UfM*-, UfM*-Full, Relative- with {', '.join(by_behind)}"
            raise ValueError(
                f"no method is called {name!r}; there are {names}, UfM's with -100K, UfM*'s with -fixed-param, "
                "and NAME- of a plug-in's"
            )
        return cls(
            base=by_behind[match["base"]],
            fusion={prefix: fusion for fusion, prefix in _PREFIXES.items()}.get(match["fusion"], match["fusion"]),
            full=match["full"] is not None,
            max_points=None if match["cap"] is None else 1000 * int(match["cap"]),
            fixed_param=match["fixed"] is not None,
        )
