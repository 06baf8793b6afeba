"""A trainable network as plain values: what is written beside its weights, and what builds it again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from ufmstar_torch.models.batch_ensemble import INIT_STD, BatchEnsemble
from ufmstar_torch.models.heads import HEADS, UncertaintyNetwork, with_head
from ufmstar_torch.models.network import Backbone
from ufmstar_torch.models.preprocess import Preprocess

ARCHITECTURES = ("fastdepth", "monodepth2")
METHODS = ("depth", "aleatoric", "evidential", "mc_dropout", "batch_ensemble")
_MULTIPLE = 32  # [px] both architectures halve the image five times
_SMALLEST = {"fastdepth": 32, "monodepth2": 64}  # [px]
_CHOICES = {
    "architecture": ARCHITECTURES,
    "method": METHODS,
    "layers": (18, 34, 50),
    "strides": ("v1", "v1.5"),
    "preprocess": ("nyu", "resize"),
    "positive": ("relu", "softplus"),
}
# Fields that say something of one architecture only; elsewhere they must keep their defaults, so that
# two specs of the same network are equal.
_ONLY = {"widths": "fastdepth", "norm": "fastdepth", "positive": "fastdepth"}
_ONLY |= {"layers": "monodepth2", "strides": "monodepth2"}


@dataclass(frozen=True)
class NetworkSpec:
    """Everything that decides what :func:`build_network` builds, apart from the weights.

    An ensemble is several "aleatoric" networks of one spec; how many, its files say.

    Attributes:
        architecture: "fastdepth" or "monodepth2".
        method: "depth" (no variance), "aleatoric", "evidential", "mc_dropout" (aleatoric, sampled by its
            decoder's dropout) or "batch_ensemble" (aleatoric, ``members`` in one).
        widths: of FastDepth: "full", "pruned", or a multiple of the full ones.
        norm: whether FastDepth has its batch norms, or has them folded into its convolutions.
        positive: how FastDepth's depth is kept from being negative: "relu" as published, or "softplus",
            which leaves no pixel without depth and gradient.
        layers: of monodepth2's ResNet.
        strides: of monodepth2's ResNet: "v1" (in a bottleneck's first convolution) or "v1.5" (in its second).
        dropout: [1] share of the decoder's features that are dropped in training (and where "mc_dropout" samples).
        members: of "batch_ensemble"; 1 for every other method.
        size: (height, width) [px] of the input, multiples of 32.
        preprocess: how a camera image comes to that size: "nyu" (the centre crop of NYU's validation)
            or "resize" (the whole image, each axis by its own factor).

    Raises:
        ValueError: a value that cannot be, or fields that contradict each other.
    """

    architecture: str = "fastdepth"
    method: str = "aleatoric"
    widths: str | float = "full"
    norm: bool = True
    positive: str = "relu"
    layers: int = 50
    strides: str = "v1.5"
    dropout: float = 0.0
    members: int = 1
    size: tuple[int, int] = (224, 224)
    preprocess: str = "nyu"

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise ValueError(f"NetworkSpec.{name} must be one of {list(choices)}, got {getattr(self, name)!r}")
        if not _is_width(self.widths):
            raise ValueError(f"NetworkSpec.widths must be 'full', 'pruned' or a positive number, got {self.widths!r}")
        if type(self.norm) is not bool:
            raise ValueError(f"NetworkSpec.norm must be true or false, got {self.norm!r}")
        if not _is_number(self.dropout) or not 0 <= self.dropout < 1:
            raise ValueError(f"NetworkSpec.dropout must lie in [0, 1), got {self.dropout!r}")
        if self.method == "mc_dropout" and not self.dropout:
            raise ValueError("NetworkSpec.dropout must be positive for 'mc_dropout', which samples by it")
        several = self.method == "batch_ensemble"
        if type(self.members) is not int or (self.members < 2 if several else self.members != 1):
            wanted = "at least 2 for 'batch_ensemble'" if several else f"1 for {self.method!r}"
            raise ValueError(f"NetworkSpec.members must be {wanted}, got {self.members!r}")
        size = self.size
        smallest = _SMALLEST[self.architecture]
        if type(size) is not tuple or len(size) != 2 or not all(_is_side(side, smallest) for side in size):
            wanted = f"multiples of {_MULTIPLE} px from {smallest} px on"
            raise ValueError(f"NetworkSpec.size must be (height, width) in {wanted}, got {size!r}")
        for f in fields(self):
            if _ONLY.get(f.name, self.architecture) != self.architecture and getattr(self, f.name) != f.default:
                raise ValueError(f"NetworkSpec.{f.name} is of {_ONLY[f.name]!r} only, not of {self.architecture!r}")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> NetworkSpec:
        """From JSON: lists become tuples, what is missing takes its default.

        Raises:
            ValueError: an unknown key, or a value that cannot be.
        """
        known = [f.name for f in fields(cls)]
        if unknown := sorted(set(values) - set(known)):
            raise ValueError(f"NetworkSpec has no {unknown}; it has {known}")
        plain: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return cls(**plain)

    def to_dict(self) -> dict[str, Any]:
        """The fields as plain values for JSON."""
        return {**asdict(self), "size": list(self.size)}

    def input(self) -> Preprocess:
        """What brings a camera image to the network's input."""
        statistics: dict[str, Any] = {}
        if self.architecture == "monodepth2":
            from ufmstar_torch.models.monodepth2 import IMAGENET_MEAN, IMAGENET_STD

            statistics = {"mean": IMAGENET_MEAN, "std": IMAGENET_STD}
        nyu = self.preprocess == "nyu"
        return Preprocess.nyu(self.size, **statistics) if nyu else Preprocess(size=self.size, **statistics)


def build_backbone(spec: NetworkSpec) -> Backbone:
    """The encoder and decoder of ``spec``, with random weights from torch's generator."""
    backbone: Backbone
    if spec.architecture == "fastdepth":
        from ufmstar_torch.models.fastdepth import FastDepth, FastDepthWidths

        named = {"full": FastDepthWidths.full, "pruned": FastDepthWidths.pruned}
        widths = named[spec.widths]() if isinstance(spec.widths, str) else FastDepthWidths.scaled(spec.widths)
        backbone = FastDepth(widths, norm=spec.norm, dropout=spec.dropout, positive=spec.positive, size=spec.size)
    else:
        from ufmstar_torch.models.monodepth2 import MonodepthResNet

        backbone = MonodepthResNet(spec.layers, strides=spec.strides, dropout=spec.dropout, size=spec.size)
    backbone.preprocess = spec.input()
    return backbone


def build_network(
    spec: NetworkSpec, backbone: Backbone | None = None, *, init: str = "normal", std: float = INIT_STD
) -> UncertaintyNetwork | BatchEnsemble:
    """The network that ``spec`` describes, for training; "mc_dropout" does not sample by itself yet
    (``MonteCarloDropout`` makes it do so).

    Args:
        spec: what to build.
        backbone: with pretrained weights, as :func:`build_backbone` makes it; it becomes part of the
            network (a "batch_ensemble" takes a copy). None: random weights.
        init, std: how the factors of a "batch_ensemble" begin; see ``convert``.
    """
    backbone = build_backbone(spec) if backbone is None else backbone
    network = with_head(backbone, spec.method if spec.method in HEADS else "aleatoric")
    several = spec.method == "batch_ensemble"
    return BatchEnsemble(network, spec.members, init=init, std=std) if several else network


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _is_width(value: object) -> bool:
    if isinstance(value, str):
        return value in ("full", "pruned")
    return isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value < float("inf")


def _is_side(value: object, smallest: int) -> bool:
    return type(value) is int and value >= smallest and not value % _MULTIPLE
