"""NetworkSpec: what it accepts, JSON, and that the network built is the one described."""

from __future__ import annotations

import json
from dataclasses import FrozenInstanceError, replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from ufmstar_torch.models import (
    BatchEnsemble,
    DecoderDropout,
    EvidentialDepth,
    FastDepth,
    FastDepthWidths,
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

METHODS = st.sampled_from(
    [
        {"method": "depth"},
        {"method": "aleatoric"},
        {"method": "evidential", "dropout": 0.5},
        {"method": "mc_dropout", "dropout": 0.2},
        {"method": "batch_ensemble", "members": 4},
    ]
)
ARCHITECTURES = st.one_of(
    st.fixed_dictionaries(
        {
            "architecture": st.just("fastdepth"),
            "widths": st.one_of(st.sampled_from(["full", "pruned"]), st.floats(0.01, 4.0), st.just(1)),
            "norm": st.booleans(),
            "positive": st.sampled_from(["relu", "softplus"]),
        }
    ),
    st.fixed_dictionaries(
        {
            "architecture": st.just("monodepth2"),
            "layers": st.sampled_from([18, 34, 50]),
            "strides": st.sampled_from(["v1", "v1.5"]),
        }
    ),
)
SIZES = st.tuples(*[st.integers(2, 20).map(lambda n: 32 * n)] * 2)


@given(method=METHODS, architecture=ARCHITECTURES, size=SIZES, preprocess=st.sampled_from(["nyu", "resize"]))
def test_a_spec_survives_json(method, architecture, size, preprocess):
    spec = NetworkSpec(**method, **architecture, size=size, preprocess=preprocess)
    assert NetworkSpec.from_dict(json.loads(json.dumps(spec.to_dict()))) == spec


def test_what_is_missing_takes_its_default():
    assert NetworkSpec.from_dict({}) == NetworkSpec()
    assert NetworkSpec.from_dict({"size": [64, 96]}).size == (64, 96)


def test_a_spec_cannot_be_changed():
    with pytest.raises(FrozenInstanceError):
        SMALL.dropout = 0.5


IMPOSSIBLE = [
    ({"architecture": "unet"}, "architecture must be one of"),
    ({"method": "ensemble"}, "method must be one of"),
    ({"widths": "half"}, "widths must be"),
    ({"widths": 0}, "widths must be"),
    ({"widths": float("inf")}, "widths must be"),
    ({"widths": True}, "widths must be"),
    ({"norm": 1}, "norm must be True or False"),
    ({"positive": "exp"}, "positive must be one of"),
    ({"architecture": "monodepth2", "layers": 101}, "layers must be one of"),
    ({"architecture": "monodepth2", "strides": "v2"}, "strides must be one of"),
    ({"dropout": 1.0}, r"dropout must (lie in \[0.0, 1.0\)|be a number)"),
    ({"dropout": -0.1}, r"dropout must (lie in \[0.0, 1.0\)|be a number)"),
    ({"dropout": float("nan")}, r"dropout must (lie in \[0.0, 1.0\)|be a number)"),
    ({"dropout": "0.2"}, r"dropout must (lie in \[0.0, 1.0\)|be a number)"),
    ({"method": "mc_dropout"}, "dropout must be positive for 'mc_dropout'"),
    ({"method": "batch_ensemble"}, "members must be at least 2"),
    ({"method": "batch_ensemble", "members": 2.0}, "members must be a whole number"),
    ({"members": 10}, "members must be 1 for 'aleatoric'"),
    ({"size": (224, 225)}, "multiples of 32 px"),
    ({"size": (224,)}, "multiples of 32 px"),
    ({"size": 224}, "multiples of 32 px"),
    ({"size": (0, 224)}, "multiples of 32 px"),
    ({"architecture": "monodepth2", "size": (32, 64)}, "from 64 px on"),
    ({"preprocess": "crop"}, "preprocess must be one of"),
    ({"layers": 18}, "layers is of 'monodepth2' only, not of 'fastdepth'"),
    ({"architecture": "monodepth2", "widths": "pruned"}, "widths is of 'fastdepth' only"),
    ({"width": 1.0}, r"NetworkSpec has no \['width'\]"),
]


@pytest.mark.parametrize(("values", "message"), IMPOSSIBLE)
def test_impossible_values(values, message):
    with pytest.raises(ValueError, match=message):
        NetworkSpec.from_dict(values)


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
    if preprocess == "nyu":  # the architecture's own, so that nothing is said twice
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
        assert (network(image).depth == network(image).depth).all()  # samples only within its wrapper
        sampled = MonteCarloDropout(network)
        assert (sampled(image).depth != sampled(image).depth).any()


@pytest.mark.parametrize(
    ("widths", "expected"),
    [
        ("full", FastDepthWidths.full()),
        ("pruned", FastDepthWidths.pruned()),
        (1, FastDepthWidths.full()),
        (0.25, FastDepthWidths.scaled(0.25)),
    ],
)
def test_widths(widths, expected):
    with torch.device("meta"):
        assert build_backbone(NetworkSpec(widths=widths)).widths == expected


def test_options_of_fastdepth_arrive():
    backbone = build_backbone(replace(SMALL, norm=False, positive="softplus", dropout=0.3))
    assert not any(isinstance(m, nn.BatchNorm2d) for m in backbone.modules())
    assert isinstance(backbone.head.activation, nn.Softplus)
    assert {m.p for m in backbone.modules() if isinstance(m, DecoderDropout)} == {0.3}


def test_options_of_monodepth2_arrive():
    with torch.device("meta"):
        backbone = build_backbone(NetworkSpec("monodepth2", layers=50, strides="v1", dropout=0.3))
        other = build_backbone(NetworkSpec("monodepth2", layers=18))
    assert (backbone.layers, backbone.strides) == (50, "v1")
    assert backbone.encoder.layer2[0].conv1.stride == (2, 2)
    assert {m.p for m in backbone.modules() if isinstance(m, DecoderDropout)} == {0.3}
    assert other.layers == 18


def test_a_pretrained_backbone_is_used():
    backbone = build_backbone(SMALL)
    assert build_network(SMALL, backbone).backbone is backbone
    spec = replace(SMALL, method="batch_ensemble", members=3)
    image = torch.rand(1, 3, 32, 64)
    network = build_network(spec, backbone, std=0.0).eval()
    expected = backbone.eval()(image).depth
    torch.testing.assert_close(network.member(1)(image).depth, expected, rtol=1e-5, atol=1e-5)
    assert not converted_layers(backbone)


def test_factors_begin_as_asked():
    spec = replace(SMALL, method="batch_ensemble", members=3)
    signs = {value.item() for f in build_network(spec, init="sign").factors() for value in f.unique()}
    assert signs == {-1.0, 1.0}
    near = torch.cat([f.detach().flatten() for f in build_network(spec, std=0.01).factors()])
    assert near.std().item() == pytest.approx(0.01, rel=0.05)
