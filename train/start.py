"""The network at the start of a training: its initial weights, random or from a file, and its trained parameters."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from torch import nn

from ufmstar_torch.models.checkpoints import CheckpointError, fill
from ufmstar_torch.models.network import Backbone, DepthNetwork
from ufmstar_torch.models.spec import NetworkSpec, build_backbone, build_network
from ufmstar_torch.models.trained import load_for_training, read_info
from ufmstar_torch.runtime.kinds import check_kinds

IMAGENET = "imagenet"
# [1] Standard deviation of a BatchEnsemble's factors with pretrained weights. With .5, the value for random weights,
# the error of FastDepth's published network before the first step is 63 % of the depth instead of 28 % (HoloLens
# frames, batch statistics), with .1 it is 33 %; its members still differ by half a metre.
PRETRAINED_STD = 0.1
WAYS = f"trained .safetensors, FastDepth's .onnx, ResNet weights (.pth, or {IMAGENET!r}), or Monodepth2's folder"


@check_kinds
def starting_network(
    spec: NetworkSpec, init: Path | None, member: int = 0, module: nn.Module | None = None
) -> DepthNetwork:
    """The network of a spec with the weights of a file; other weights are drawn from torch's generator.

    Args:
        spec: of the network.
        init: None, or one of: a file of this program (all weights for the same method, also between aleatoric and
            mc_dropout; otherwise encoder and decoder, below a new head); FastDepth's weights as .onnx; the ImageNet
            weights of a ResNet with torchvision's keys, or "imagenet", which torchvision downloads; the folder with
            Monodepth2's encoder.pth and depth.pth of the same ResNet.
        member: index in an ensemble; also selects the member of a trained ensemble.
        module: the custom network of ``spec``; copied. None = its checkpoint's.

    Raises:
        FileNotFoundError: there is no such file.
        CheckpointError: the file is damaged or does not fit.
        ValueError: the file contains another architecture than the spec's; the message names options that may fit.
    """
    if init is None and spec.module is not None:
        network = spec.module.build(weights=True) if module is None else copy.deepcopy(module)
        return build_network(spec, build_backbone(spec, network), std=PRETRAINED_STD)
    if init is None:
        return build_network(spec)
    if init.suffix == ".safetensors" and _is_trained(init):
        return _from_trained(spec, init, member, module)
    if spec.architecture == "fastdepth":
        return build_network(spec, _from_onnx(spec, init), std=PRETRAINED_STD)
    return build_network(spec, _from_resnet(spec, init), std=PRETRAINED_STD)


def missing_start(spec: NetworkSpec, init: Path | None) -> str | None:
    """A remark if the initial weights differ from the authors', or None."""
    if spec.architecture != "monodepth2" or init is not None:
        return None
    encoder = f"the ResNet{spec.layers} encoder starts from random weights"
    return f"{encoder}; that of the authors' DecTrain starts from ImageNet: --init {IMAGENET}"


def train_only(network: nn.Module, prefixes: Sequence[str]) -> int:
    """Freeze all parameters except those whose names begin with one of ``prefixes``, or match it (``*.r``), in place.
    Returns the number of trained weights. Raises ValueError: a prefix matches no parameter; the message names the
    network's parts."""
    names = [name for name, _ in network.named_parameters()]
    for prefix in prefixes:
        if not any(_fits(name, prefix) for name in names):
            parts = sorted({".".join(name.split(".")[:2]) for name in names})
            raise ValueError(f"trainable: no parameter begins with {prefix!r}; expected one of {', '.join(parts)}")
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(not prefixes or any(_fits(name, prefix) for prefix in prefixes))
    return sum(p.numel() for p in network.parameters() if p.requires_grad)


def _fits(name: str, prefix: str) -> bool:
    return name.startswith(prefix) or fnmatchcase(name, prefix)


def _is_trained(path: Path) -> bool:
    try:
        read_info(path)
    except CheckpointError:
        return False
    return True


def _from_trained(spec: NetworkSpec, path: Path, member: int, module: nn.Module | None) -> DepthNetwork:
    """The network of a trained file: all weights if the methods agree, otherwise those of the backbone. The specs may
    differ in input, dropout and method only."""
    info = read_info(path)
    source = load_for_training(path, module)[member % info.networks]
    shared = ("size", "preprocess", "dropout", "dropout_both", "method", "members", "module")
    adapted = replace(info.spec, **{name: getattr(spec, name) for name in shared})
    if adapted != spec:
        raise ValueError(f"init: {path} holds {info.spec}, which does not fit {spec}")
    # "mc_dropout" is an aleatoric network that samples at test time.
    trained, expected = ("aleatoric" if m == "mc_dropout" else m for m in (info.spec.method, spec.method))
    if (trained, info.spec.members) == (expected, spec.members):
        network: DepthNetwork = build_network(spec, build_backbone(spec, copy.deepcopy(module)))
        fill(network, source.state_dict(), str(path))
        return network
    if info.spec.method == "batch_ensemble":
        raise ValueError(f"init: {path} holds a batch_ensemble, whose backbone does not fit a single network")
    backbone = build_backbone(spec, copy.deepcopy(module))
    trained_backbone: Any = source.backbone
    fill(backbone, trained_backbone.state_dict(), str(path))
    return build_network(spec, backbone, std=PRETRAINED_STD)


def _from_onnx(spec: NetworkSpec, path: Path) -> Backbone:
    from ufmstar_torch.models.fastdepth import FastDepth

    if path.suffix != ".onnx":
        raise ValueError(f"init: a fastdepth starts from .onnx or a trained .safetensors, got {path}")
    backbone = build_backbone(spec)
    source = FastDepth.from_onnx(path, dropout=spec.dropout, size=spec.size)
    if not isinstance(backbone, FastDepth) or source.widths != backbone.widths:
        raise ValueError(f"init: {path} has the channels {source.widths}; --set network.widths=pruned or full may fit")
    norm = "encoder.0.norm.weight" in source.state_dict()
    if norm != spec.norm:
        kind = "has batch norms" if norm else "has folded batch norms"
        raise ValueError(f"init: {path} {kind}: --set network.norm={str(norm).lower()} fits")
    fill(backbone, source.state_dict(), str(path))
    return backbone


def _from_resnet(spec: NetworkSpec, path: Path) -> Backbone:
    from ufmstar_torch.models.monodepth2 import MonodepthResNet
    from ufmstar_torch.models.monodepth2_import import load_monodepth2

    backbone = None if spec.module is not None else build_backbone(spec)
    if not isinstance(backbone, MonodepthResNet):
        raise ValueError(f"init: {path} is no start for {spec.architecture}; expected {WAYS}")
    if path.is_dir():
        try:
            load_monodepth2(backbone, path / "encoder.pth", path / "depth.pth")
        except CheckpointError as error:
            raise CheckpointError(f"init: {error}; another network.layers may fit") from error
        return backbone
    weights = None if str(path) == IMAGENET else path
    source = MonodepthResNet.imagenet(weights, spec.layers, strides=spec.strides)
    backbone.encoder.load_state_dict(source.encoder.state_dict())
    return backbone
