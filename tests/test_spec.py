"""NetworkSpec: accepted values, JSON, and the network built from it."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from ufmstar_torch.models import (
    BatchEnsemble,
    EvidentialDepth,
    FastDepth,
    GaussianDepth,
    MonodepthResNet,
    MonteCarloDropout,
    NetworkSpec,
    PointDepth,
    Preprocess,
    build_backbone,
    build_network,
)
from ufmstar_torch.models.batch_ensemble import converted_layers
from ufmstar_torch.models.monodepth2 import IMAGENET_MEAN, IMAGENET_STD

SMALL = NetworkSpec(widths=0.1, size=(32, 64))

SPECS = [
    {"method": "depth", "widths": "pruned", "norm": False, "positive": "relu", "preprocess": "resize"},
    {"method": "aleatoric", "widths": 1, "size": (64, 640)},
    {"method": "evidential", "widths": 0.015, "dropout": 0.5},
    {"method": "mc_dropout", "architecture": "monodepth2", "layers": 34, "strides": "v1", "dropout": 0.2},
    {"method": "batch_ensemble", "architecture": "monodepth2", "strides": "v1.5", "members": 4, "size": (640, 64)},
]


@pytest.mark.parametrize("values", SPECS, ids=lambda values: values["method"])
def test_a_spec_survives_json(values):
    spec = NetworkSpec(**values)
    assert NetworkSpec.from_dict(json.loads(json.dumps(spec.to_dict()))) == spec


@pytest.mark.parametrize("architecture", ["fastdepth", "monodepth2"])
@pytest.mark.parametrize("preprocess", ["nyu", "resize"])
def test_the_input_is_what_the_network_wants(architecture, preprocess):
    changes = {"architecture": "monodepth2", "layers": 18} if architecture == "monodepth2" else {"widths": 0.1}
    spec = NetworkSpec(size=(64, 96), preprocess=preprocess, **changes)
    statistics = {"mean": IMAGENET_MEAN, "std": IMAGENET_STD} if architecture == "monodepth2" else {}
    nyu = Preprocess.nyu((64, 96), **statistics)
    assert spec.input() == (nyu if preprocess == "nyu" else Preprocess(size=(64, 96), **statistics))
    network = build_network(spec)
    assert network.preprocess == network.backbone.preprocess == spec.input()
    if preprocess == "nyu":  # from the architecture
        kind = {"fastdepth": FastDepth, "monodepth2": MonodepthResNet}[architecture]
        assert kind(size=(64, 96)).preprocess == spec.input()


@pytest.mark.parametrize("name", ["depth", "aleatoric", "evidential", "mc_dropout", "batch_ensemble"])
def test_the_method_decides_the_head(name):
    several = name == "batch_ensemble"
    spec = replace(SMALL, method=name, dropout=0.2, members=3 if several else 1)
    network = build_network(spec).eval()
    image = torch.rand(2, 3, 32, 64)
    message = network.distribution(image)
    expected = {"depth": PointDepth, "evidential": EvidentialDepth}.get(name, GaussianDepth)
    assert type(message) is expected
    assert message.depth.shape == (6 if several else 2, 32, 64)
    assert isinstance(network, BatchEnsemble) == several
    if name == "mc_dropout":
        assert (network(image).depth == network(image).depth).all()  # samples only inside its wrapper
        sampled = MonteCarloDropout(network)
        assert (sampled(image).depth != sampled(image).depth).any()


def test_a_pretrained_backbone_is_used():
    backbone = build_backbone(SMALL)
    assert build_network(SMALL, backbone).backbone is backbone
    spec = replace(SMALL, method="batch_ensemble", members=3)
    image = torch.rand(1, 3, 32, 64)
    network = build_network(spec, backbone, std=0.0).eval()
    expected = backbone.eval()(image).depth
    torch.testing.assert_close(network.member(1)(image).depth, expected, rtol=1e-5, atol=1e-5)
    assert not converted_layers(backbone)
