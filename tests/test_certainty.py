"""Unmeasured pixels are not reported as certain, and unusable depth is rejected."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from modules import CONFIG, H, K, W, frame
from walks import SPGF

from ufmstar_torch import SPGFConfig, UfMStar, UfMStarConfig, UncertainDepth
from ufmstar_torch.config import PAPER
from ufmstar_torch.eval.engine.estimators import make_estimator
from ufmstar_torch.eval.engine.networks import NetworkSource
from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.frames.prediction import DepthPrediction, NetworksInTurn
from ufmstar_torch.models import Ensemble, wrap_network
from ufmstar_torch.models.alignment import AlignedNetwork, Alignment
from ufmstar_torch.runtime.checked import flat

pytestmark = pytest.mark.numerics


def test_beyond_the_networks_range_nothing_is_certain():
    """25 m, then 40 m from one pose: V is NaN there, not 0."""
    ufm = UfMStar(CONFIG)
    for far in (25.0, 40.0):
        depth = torch.full((1, H, W), 2.0)
        depth[:, :, W // 2 :] = far
        out = ufm(depth, torch.eye(4), K)
        assert bool(out.variance[..., W // 2 :].isnan().all())
        assert bool(out.variance[..., : W // 2].isfinite().all())
        assert int(out.statistics.beyond[0]) == int((~out.valid).sum()) == H * (W // 2)
        assert int(out.statistics.out_of_range[0]) == 0
    reaching = CONFIG.replace(segment=SPGFConfig(**{**SPGF.to_dict(), "max_depth": 80.0}))
    out = UfMStar(reaching)(depth, torch.eye(4), K)
    assert bool(out.valid.all())
    assert int(out.statistics.beyond[0]) == 0


class Ranged(torch.nn.Module):
    """Predicts 3 m, but 60 m at the left, and states the range ``max_depth``."""

    def __init__(self, max_depth):
        super().__init__()
        self.max_depth = max_depth

    def forward(self, x):
        depth = torch.full((len(x), *x.shape[-2:]), 3.0)
        depth[:, :, : W // 2] = 60.0
        return DepthPrediction(depth)


@pytest.mark.parametrize(
    ("ranges", "max_depth", "expected"),
    [
        ([80.0], None, 80.0),
        ([None], None, None),
        ([80.0], 20.0, 20.0),  # stated by the user
        ([10.0, 80.0], None, 80.0),
        ([80.0, None], None, None),
        (["80"], None, None),
        ([-1.0], None, None),
    ],
)
def test_the_pipeline_follows_the_networks_stated_range(ranges, max_depth, expected):
    model = UncertainDepth([Ranged(r) for r in ranges], UfMStarConfig(segment=replace(SPGF, max_depth=max_depth)))
    assert model.ufm.config.segment.max_depth == expected
    out = model(torch.rand(1, 3, H, W), torch.eye(4), K)
    left = out.valid[..., : W // 2]
    assert bool(left.all()) is (expected == 80.0)
    assert int(out.statistics.beyond[0]) == int((~left).sum())


def test_declared_ranges_reach_the_pipeline_and_the_evaluation():
    network = wrap_network(lambda x: x[:, :1], max_depth=7.0)
    assert UncertainDepth(network).ufm.config.segment.depth_limit == 7.0
    assert Ensemble([network, wrap_network(lambda x: x[:, :1], max_depth=9.0)]).max_depth == 9.0
    assert AlignedNetwork(network, Alignment("inverse", 1.0, 0.0, max_depth=5.0)).max_depth == 5.0
    assert UfMStarConfig().within(7.0).segment == SPGFConfig(max_depth=7.0)
    assert UfMStarConfig().segment.depth_limit == 20.0
    source = NetworkSource(NetworksInTurn(network), torch.device("cpu"), {})
    assert source.max_depth == 7.0
    made = make_estimator(Row(Method.parse("UfM*-DepthOnly")), torch.device("cpu"), source)
    assert made.ufm.config.segment.max_depth == 7.0


CHOICES = {
    "paper": {},
    "relative": {"unmeasured_relative": 0.2},
    "nan": {},
}


def test_a_point_far_from_everything_reads_as_chosen():
    far = torch.full((1, 1, 3), 500.0)
    for choice, expected in (("paper", 0.0), ("relative", float("nan")), ("nan", float("nan"))):
        ufm = UfMStar(CONFIG.replace(unmeasured=choice, **CHOICES[choice]))
        for i in range(2):
            ufm(*frame(i))
        np.testing.assert_allclose(float(ufm.query(far).disagreement), expected, rtol=1e-6)


@pytest.mark.parametrize("choice", CHOICES)
def test_a_large_noisy_image_without_a_segment_reads_as_chosen(choice):
    """With 5 cm of noise between neighbours, no segment reaches the minimum length of a large image."""
    size = (600, 900)
    noisy = 1 + 0.05 * torch.randn(2, 1, *size, generator=torch.Generator().manual_seed(0))
    camera = torch.tensor([[800.0, 0, 450], [0, 800, 300], [0, 0, 1]])
    ufm = UfMStar(UfMStarConfig(unmeasured=choice, **CHOICES[choice]))
    for depth in noisy:
        out = ufm(depth, torch.eye(4), camera)
        assert int(out.statistics.segments[0]) == 0
        assert int(out.statistics.unmeasured[0]) == depth.numel()
    expected = {"paper": 0.0, "nan": float("nan")}
    mean = (0.2 * noisy).square().mean(0) if choice == "relative" else torch.full((1, *size), expected[choice])
    np.testing.assert_allclose(out.variance.numpy(), mean.numpy(), rtol=1e-5)


@pytest.mark.parametrize("choice", CHOICES)
def test_what_was_not_measured_does_not_make_the_next_frame_certain(choice):
    """In the paper, M is 0 in the first view, so the moving average halves M in the second view. With another setting
    it does not."""
    first, second = frame(0), frame(1)
    config = CONFIG.replace(unmeasured=choice, **CHOICES[choice])
    smoothed, plain = UfMStar(config), UfMStar(config.replace(ema_alpha=1.0))
    for ufm in (smoothed, plain):
        ufm(*first)
    a, b = smoothed(*second), plain(*second)
    compared = b.measured > 0.5
    assert int(compared.sum()) > 100
    ratio = (a.disagreement / b.disagreement)[compared]
    if choice == "paper":
        assert float(ratio.median()) == pytest.approx(0.5, rel=1e-4)
    elif choice == "nan":
        np.testing.assert_allclose(ratio.numpy(), 1.0, rtol=1e-4)
    else:
        assert float(ratio.min()) > 0.5


def test_a_frame_without_a_segment_warns_once(caplog):
    ufm = UfMStar(CONFIG)
    depth, pose, intrinsics = frame(0)
    with caplog.at_level("WARNING", "ufmstar_torch"):
        out = ufm(1000 * depth, pose, intrinsics)
        assert int(out.statistics.beyond[0]) > 0
        assert int(out.statistics.valid_pixels[0]) == 0
        ufm(1000 * depth, pose, intrinsics)
        UfMStar(CONFIG)(torch.zeros_like(depth), pose, intrinsics)  # no valid depth, so no segment is expected
    (warning,) = caplog.messages
    assert re.match(r"stream 0: .*no segment.*beyond segment\.max_depth = 20\.0 m.*in metres", warning)


def test_the_papers_configuration():
    paper = UfMStarConfig.paper()
    assert (paper.segment.min_pixels, paper.segment.min_rows, paper.segment.prune) == (2000, 32, "either")
    assert (paper.regression, paper.near_radius, paper.far_radius) == ("neighbourhood", 0.1, 0.5)
    assert paper.unmeasured == "paper"
    # SPGF's t = a z^2 / f at the paper's 224 x 224 for any camera; the same length at 518 x 518.
    assert paper.segment.scaled_to(224, 224).slope(123.0) == pytest.approx(2.4 / 123)
    assert paper.segment.scaled_to(518, 518).slope(123.0 * 518 / 224) == pytest.approx(2.4 / 123)
    ours, theirs = flat(UfMStarConfig(merge=None).to_dict()), flat(paper.to_dict())
    assert {name: theirs[name] for name in ours if ours[name] != theirs[name]} | {"merge": None} == dict(PAPER)
    assert UfMStarConfig.from_dict(paper.to_dict()) == paper


def test_outputs_print_as_a_line():
    ufm = UfMStar(CONFIG)
    mean = ufm.mean_uncertainty(*frame(0), pixels=50)
    out = ufm(*frame(1))
    for text in (repr(out), repr(mean), repr(out.statistics)):
        assert "valid_pixels=" in text
        assert "\n" not in text
        assert "tensor(" not in text
