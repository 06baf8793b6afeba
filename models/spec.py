"""The specification of a trainable network as plain values, which is stored with its weights and rebuilds it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from torch import nn

from ufmstar_torch.files.limits import require_pixels
from ufmstar_torch.models.batch_ensemble import INIT_STD, BatchEnsemble
from ufmstar_torch.models.heads import HEADS, UncertaintyNetwork, with_head
from ufmstar_torch.models.module_backbone import ModuleBackbone, ModuleSpec
from ufmstar_torch.models.network import MULTIPLE, Backbone, fits
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.runtime.checked import Checked, choice, number, section
from ufmstar_torch.runtime.kinds import check_kinds

MOST_MEMBERS = 1000  # of an ensemble, and the factor of a training's seeds (``train.settings.Job.seed``)
_SMALLEST = {"fastdepth": 32, "monodepth2": 64}  # [px]
# Fields of one architecture; the others require their defaults, so that specs of the same network are equal.
_ONLY = {"widths": "fastdepth", "norm": "fastdepth", "positive": "fastdepth"}
_ONLY |= {"layers": "monodepth2", "strides": "monodepth2", "module": "module"}


@dataclass(frozen=True)
class NetworkSpec(Checked):
    """The complete description of a network for :func:`build_network`, without the weights.

    An ensemble consists of several "aleatoric" networks of one spec; its file contains their number.

    Attributes:
        architecture: "fastdepth", "monodepth2", or "module": a custom network.
        method: "depth" (no variance), "aleatoric", "evidential", "mc_dropout" (aleatoric, sampled by its
            decoder's dropout) or "batch_ensemble" (aleatoric, ``members`` in one).
        widths: of FastDepth: "full", "pruned", or a factor of the full widths.
        norm: FastDepth has batch norms; False: they are folded into its convolutions.
        positive: FastDepth's last activation: "relu" as published, or "softplus", which gives every pixel a depth and a
            gradient.
        layers: of monodepth2's ResNet.
        strides: of monodepth2's ResNet: "v1" (in a bottleneck's first convolution) or "v1.5" (in its second).
        dropout: [1] share of the decoder's features that are dropped in training (and where "mc_dropout" samples).
        dropout_both: dropout after both convolutions of a decoder's level instead of the second only.
        head_scales: number of uncertainty heads: 1, or 4 in training as in Poggi et al. (2020).
        members: of "batch_ensemble"; 1 for every other method.
        size: (height, width) [px] of the input, multiples of 32.
        preprocess: conversion of a camera image to that size: "nyu" (the centre crop of NYU's validation) or "resize"
            (the whole image, each axis by its own factor).
        module: the network of "module", whose ``preprocess`` replaces ``size`` and ``preprocess``.

    Raises:
        ValueError: an invalid value, or contradictory fields.
    """

    architecture: str = choice("fastdepth", "monodepth2", "module")
    method: str = choice("aleatoric", "depth", "evidential", "mc_dropout", "batch_ensemble")
    widths: str | float = "full"
    norm: bool = True
    positive: str = choice("relu", "softplus")
    layers: int = choice(50, 34, 18)
    strides: str = choice("v1.5", "v1")
    dropout: float = number(0.0, "p", "1", 0.0, 1.0, open_high=True)
    dropout_both: bool = False
    head_scales: int = choice(1, 4)
    members: int = number(1, "N", "networks", 1, MOST_MEMBERS)
    size: tuple[int, int] = (224, 224)
    preprocess: str = choice("nyu", "resize")
    module: ModuleSpec | None = section(ModuleSpec, optional=True, on=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        width = self.widths
        positive = isinstance(width, (int, float)) and not isinstance(width, bool) and 0 < width < float("inf")
        if width not in ("full", "pruned") and not positive:
            raise ValueError(f"NetworkSpec.widths must be 'full', 'pruned' or a positive number, got {width!r}")
        if self.method == "mc_dropout" and not self.dropout:
            raise ValueError("NetworkSpec.dropout must be positive for 'mc_dropout', which samples with it")
        if (self.members > 1) != (self.method == "batch_ensemble"):
            expected = "1" if self.members > 1 else "at least 2"
            raise ValueError(f"NetworkSpec.members must be {expected} for {self.method!r}, got {self.members}")
        is_module = self.architecture == "module"
        if is_module and self.module is None:
            raise ValueError("NetworkSpec.module must describe the network of architecture 'module'")
        size, smallest = self.size, _SMALLEST.get(self.architecture, 1)
        whole = type(size) is tuple and len(size) == 2 and all(type(side) is int for side in size)
        if not whole or not fits(*size, 1 if is_module else MULTIPLE, smallest):
            expected = f"multiples of {MULTIPLE} px from {smallest} px on"
            raise ValueError(f"NetworkSpec.size must be (height, width) in {expected}, got {size!r}")
        require_pixels("NetworkSpec.size", size)
        for f in fields(self):
            if _ONLY.get(f.name, self.architecture) != self.architecture and getattr(self, f.name) != f.default:
                raise ValueError(f"NetworkSpec.{f.name} is of {_ONLY[f.name]!r} only, not of {self.architecture!r}")

    def to_dict(self) -> dict[str, Any]:
        """The fields as plain values for JSON."""
        values = {**super().to_dict(), "size": list(self.size)}
        if self.module is None:
            del values["module"]  # equal to files that are older than the field
        return values

    def input(self) -> Preprocess:
        """The preprocessing from a camera image to the network's input."""
        if self.module is not None:
            return self.module.preprocess
        statistics: dict[str, Any] = {}
        if self.architecture == "monodepth2":
            from ufmstar_torch.models.monodepth2 import IMAGENET_MEAN, IMAGENET_STD

            statistics = {"mean": IMAGENET_MEAN, "std": IMAGENET_STD}
        nyu = self.preprocess == "nyu"
        return Preprocess.nyu(self.size, **statistics) if nyu else Preprocess(size=self.size, **statistics)


@check_kinds
def build_backbone(spec: NetworkSpec, module: nn.Module | None = None) -> Backbone:
    """The encoder and decoder of ``spec``, with random weights from torch's generator, or with a custom ``module``."""
    if spec.module is not None:
        return ModuleBackbone(spec.module.build() if module is None else module, spec.module, spec.dropout)
    backbone: Backbone
    options: dict[str, Any] = {name: getattr(spec, name) for name in ("dropout", "dropout_both", "size")}
    if spec.architecture == "fastdepth":
        from ufmstar_torch.models.fastdepth import FastDepth, FastDepthWidths

        named = {"full": FastDepthWidths.full, "pruned": FastDepthWidths.pruned}
        widths = named[spec.widths]() if isinstance(spec.widths, str) else FastDepthWidths.scaled(spec.widths)
        backbone = FastDepth(widths, norm=spec.norm, positive=spec.positive, **options)
    else:
        from ufmstar_torch.models.monodepth2 import MonodepthResNet

        backbone = MonodepthResNet(spec.layers, strides=spec.strides, **options)
    backbone.preprocess = spec.input()
    return backbone


@check_kinds
def build_network(
    spec: NetworkSpec, backbone: Backbone | None = None, *, std: float = INIT_STD
) -> UncertaintyNetwork | BatchEnsemble:
    """The network of ``spec``, for training; "mc_dropout" samples only when wrapped in ``MonteCarloDropout``.

    Args:
        spec: of the network.
        backbone: from :func:`build_backbone`, with pretrained weights; becomes a submodule (a "batch_ensemble" copies
            it). None: random weights.
        std: standard deviation of the initial factors of a "batch_ensemble"; see ``convert``.
    """
    backbone = build_backbone(spec) if backbone is None else backbone
    network = with_head(backbone, spec.method if spec.method in HEADS else "aleatoric", spec.head_scales)
    several = spec.method == "batch_ensemble"
    return BatchEnsemble(network, spec.members, std=std) if several else network
