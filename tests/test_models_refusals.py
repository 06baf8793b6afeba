"""Invalid settings and calls of the networks: the message names the argument."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch
import transformers
from onnx_files import small_network
from tiny_networks import Linear
from torch import nn

from ufmstar_torch import UncertainDepth
from ufmstar_torch.models import (
    AlignedNetwork,
    Alignment,
    BatchEnsemble,
    DecoderDropout,
    DepthNetwork,
    Ensemble,
    FastDepth,
    FastDepthWidths,
    MonodepthResNet,
    MonteCarloDropout,
    NetworkSpec,
    OnnxSpec,
    OutputSpec,
    Preprocess,
    convert,
    fit_affine_depth,
    fit_inverse_depth,
    load_network,
    set_sampling,
    with_head,
    wrap_network,
)
from ufmstar_torch.models.inference import Inference

INF, NAN = float("inf"), float("nan")
METRIC = {"kind": "metric"}
MAPS, IMAGE = torch.ones(2, 6, 8), torch.zeros(1, 3, 64, 64)
GLPN = transformers.GLPNConfig(depths=[1] * 4, hidden_sizes=[8] * 4, num_attention_heads=[1] * 4, decoder_hidden_size=8)
glpn = transformers.GLPNForDepthEstimation
spec, onnx, preprocess = NetworkSpec.from_dict, OnnxSpec.from_dict, Preprocess.from_dict
resnet = partial(MonodepthResNet, 18)


def members(*sizes: int) -> list[DepthNetwork]:
    """Networks with inputs of these heights [px]."""
    return [wrap_network(Linear(), preprocess=Preprocess(size=(size, 8))) for size in sizes]


def batch_ensemble() -> BatchEnsemble:
    return BatchEnsemble(with_head(Linear(), "aleatoric"), 3).eval()


REFUSALS: list[tuple[Callable[[], object], str]] = [
    (lambda: spec({"architecture": "unet"}), "architecture"),
    (lambda: spec({"method": "ensemble"}), "method"),
    (lambda: spec({"widths": "half"}), "widths"),
    (lambda: spec({"widths": INF}), "widths"),
    (lambda: spec({"widths": True}), "widths"),
    (lambda: spec({"norm": 1}), "norm"),
    (lambda: spec({"positive": "exp"}), "positive"),
    (lambda: spec({"architecture": "monodepth2", "layers": 101}), "layers"),
    (lambda: spec({"dropout": 1.0}), "dropout"),
    (lambda: spec({"method": "mc_dropout"}), "dropout"),
    (lambda: spec({"method": "batch_ensemble"}), "members"),
    (lambda: spec({"members": 10}), "members"),
    (lambda: spec({"size": (224, 225)}), "size"),
    (lambda: spec({"size": 224}), "size"),
    (lambda: spec({"architecture": "monodepth2", "size": (32, 64)}), "size"),
    (lambda: spec({"layers": 18}), "layers is of 'monodepth2' only"),
    (lambda: spec({"architecture": "monodepth2", "widths": "pruned"}), "widths is of 'fastdepth' only"),
    (lambda: spec({"width": 1.0}), r"no \['width'\]"),
    (lambda: preprocess({"sise": [224, 224]}), r"no \['sise'\]"),
    (lambda: preprocess({"crop": [0, 3]}), "crop"),
    (lambda: preprocess({"size": [3]}), "size"),
    (lambda: preprocess({"resize_height": 0}), "resize_height"),
    (lambda: preprocess({"aspect_multiple": 14}), "aspect_multiple .*needs a size"),
    (lambda: preprocess({"value_range": 0.0}), "value_range"),
    (lambda: preprocess({"std": [1.0, 0.0, 1.0]}), "std"),
    (lambda: preprocess({"mean": [1.0]}), "mean"),
    (lambda: Preprocess(crop=(9, 9))(torch.zeros(1, 3, 6, 8), torch.eye(3)), "crop"),
    (lambda: Preprocess()(torch.zeros(1, 3, 6, 8), torch.ones(4, 4)), "intrinsics .*is this the pose"),
    (lambda: Preprocess().apply_image(torch.zeros(6, 8)), "image"),
    (lambda: Preprocess().apply_image(torch.zeros(1, 1, 6, 8)), "image"),
    (lambda: Preprocess().apply_image(torch.zeros(1, 3, 6, 8, dtype=torch.int64)), "image must be uint8 or floating"),
    (lambda: Preprocess().apply_image(torch.full((1, 3, 6, 8), 255.0)), r"image must lie in \[0, 1\]"),
    (lambda: Preprocess().apply_image(torch.full((1, 3, 6, 8), NAN)), r"image must lie in \[0, 1\]"),
    (lambda: Preprocess().apply_image(torch.zeros(1, 3, 0, 8)), r"image must be .*\(1, 3, 0, 8\)"),
    (lambda: onnx({}), r"needs \['outputs'\]"),
    (lambda: onnx({"outputs": {}}), r"needs \['kind'\]"),
    (lambda: onnx({"outputs": {"kind": "meters"}}), "kind"),
    (lambda: onnx({"outputs": {"kind": "inverse"}}), "declared 'inverse', but UfM"),
    (lambda: onnx({"outputs": {**METRIC, "unit": "mm"}}), r"no \['unit'\]"),
    (lambda: onnx({"outputs": {**METRIC, "scale": 0}}), "scale"),
    (lambda: onnx({"outputs": {**METRIC, "aleatoric_kind": "sigma"}}), "aleatoric_kind"),
    (lambda: onnx({"outputs": {**METRIC, "epistemic_kind": "confidence"}}), "a confidence is no spread"),
    (lambda: onnx({"outputs": METRIC, "layout": "CHW"}), "layout"),
    (lambda: onnx({"outputs": METRIC, "channels": "gray"}), "channels"),
    (lambda: onnx({"outputs": {**METRIC, "depth": 0}}), "must name ONNX outputs, got position 0"),
    (lambda: onnx({"outputs": METRIC, "preprocess": {"resize": 3}}), r"Preprocess has no \['resize'\]"),
    (lambda: OutputSpec("metric", focal=0.0), "focal"),
    (lambda: wrap_network(Linear(), inverse=True), "declared 'inverse', but UfM"),
    (lambda: wrap_network("weights.pth"), "network .*got str 'weights.pth': load it, as load_network"),
    (lambda: wrap_network(nn.ReLU), r"got the class ReLU: pass an instance, ReLU\(...\)"),
    (lambda: wrap_network(nn.ReLU().state_dict()), "weights need their network"),
    (lambda: wrap_network([nn.ReLU()]), "several networks are a list of wrapped ones"),
    (lambda: wrap_network(nn.ReLU(), preprocess=(224, 224)), "preprocess must be a Preprocess"),
    (lambda: wrap_network(transformers.GLPNModel(GLPN)), "a ...ForDepthEstimation .*got GLPNModel"),
    (lambda: wrap_network(glpn(GLPN)), "has no preprocessor_config.json, .* declare it in a spec"),
    (lambda: wrap_network(glpn(GLPN), focal=300.0), "only scale, takes_int"),
    (lambda: wrap_network(glpn(GLPN), takes_intrinsics=True), "takes_intrinsics goes with Depth Pro"),
    (lambda: UncertainDepth(glpn(GLPN)), "has no preprocessor_config.json, .* declare it in a spec"),
    (lambda: UncertainDepth(transformers.GLPNModel(GLPN)), "a ...ForDepthEstimation .*got GLPNModel"),
    (lambda: wrap_network(lambda x: x[:, 0], "metric")(IMAGE), "no output 'metric'"),
    (lambda: wrap_network(lambda x: 3.0)(IMAGE), "got float"),
    (lambda: load_network("fast", "w.pth"), "'fast', expected one of"),
    (lambda: load_network("fastdepth"), "'fastdepth' needs weights"),
    (lambda: load_network("fastdepth", "w.pth", strides=3), "strides"),
    (lambda: load_network("onnx", "n"), "needs a spec"),
    (lambda: load_network("exported", "n", spec=METRIC), r"no \['kind'\]"),
    (lambda: small_network()(torch.zeros(1, 3, 240, 320)), "image .*multiples of 32"),
    (lambda: small_network()(torch.zeros(1, 1, 64, 64)), "image"),
    (lambda: small_network()(IMAGE.to(torch.uint8)), "image"),
    (lambda: FastDepth(positive="exp"), "positive"),
    (lambda: FastDepth(size=(224, 230)), "size"),
    (lambda: FastDepthWidths.scaled(0.0), "width"),
    (lambda: replace(FastDepthWidths.full(), decoder=(1, 2, 3, 4, 5)), r"decoder\[1\]"),
    (lambda: MonodepthResNet(20), "layers"),
    (lambda: resnet(strides="v2"), "strides"),
    (lambda: resnet(decoder=(1, 2)), "decoder"),
    (lambda: resnet(size=(224, 230)), "size"),
    (lambda: resnet(size=(32, 64)), "size"),
    (lambda: resnet(dropout=1.0), "dropout"),
    (lambda: DecoderDropout(NAN), "dropout"),
    (lambda: set_sampling(nn.Dropout(0.2), True), "no decoder dropout"),
    (lambda: MonteCarloDropout(with_head(Linear(), "aleatoric")), "no decoder dropout"),
    (lambda: with_head(Linear(), "mc"), "method"),
    (lambda: with_head(Linear(), "aleatoric", 4), "scales"),
    (lambda: Ensemble(members(8)), "members must be at least two"),
    (lambda: Ensemble(members(8, 16)), "members must have the same preprocessing"),
    (lambda: convert(nn.Sequential(nn.BatchNorm2d(3)), 3), "nothing to convert"),
    (lambda: convert(convert(nn.Linear(3, 3), 3), 3), "converted already"),
    (lambda: convert(nn.Linear(3, 3), 1), "members"),
    (lambda: convert(nn.Linear(3, 3), 3, std=NAN), "std"),
    (lambda: batch_ensemble().distribution(IMAGE, repeat=False), "batch of 1 cannot be split among 3"),
    (lambda: batch_ensemble().member(3), "member"),
    (lambda: batch_ensemble().folded(-1), "member"),
    (lambda: batch_ensemble().distribution(IMAGE, 3), "member"),
    (lambda: Inference("onnx", "bf16"), "precision"),
    (lambda: Inference("tensorrt"), "runtime"),
    (lambda: AlignedNetwork(nn.Conv2d(3, 1, 1, 2), Alignment("affine", 1.0, 0.0))(IMAGE), "network must return"),
    (lambda: Alignment("metric", 1.0, 0.0), "kind"),
    (lambda: Alignment("inverse", 0.0, 0.0), "scale"),
    (lambda: Alignment("inverse", NAN, 0.0), "scale"),
    (lambda: Alignment("inverse", 1.0, INF), "shift"),
    (lambda: Alignment("inverse", torch.ones(2), 0.0), "both be numbers or both"),
    (lambda: Alignment("inverse", 1.0, 0.0, -1.0), "max_depth"),
    (lambda: Alignment("affine", torch.ones(2), torch.ones(2)).depth(torch.ones(3, 1, 1)), "prediction"),
    (lambda: fit_inverse_depth(MAPS[0], MAPS), "prediction"),
    (lambda: fit_inverse_depth(MAPS, MAPS[:1]), "depth"),
    (lambda: fit_inverse_depth(MAPS, MAPS.long()), "depth"),
    (lambda: fit_inverse_depth(MAPS, MAPS, MAPS), "valid"),
    (lambda: fit_inverse_depth(MAPS, MAPS, weights=-MAPS), "weights"),
    (lambda: fit_affine_depth(MAPS, MAPS, shift=None, min_points=1), "min_points"),
]


@pytest.mark.parametrize(("call", "message"), REFUSALS, ids=range(len(REFUSALS)))
def test_it_is_refused_and_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises((ValueError, TypeError, IndexError), match=message):
        call()
