"""Anchors that must not spoil the others: absurd values, padding and rule violations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import scenes
from ufmstar_torch import AnchorConfig, PosteriorConfig, UfMStar, UfMStarConfig
from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.anchors.evidence import Evidence, inliers, observe

H, W = 48, 64
ON = UfMStarConfig(anchors=AnchorConfig())


def taught(spoilt=None, at=5, frames=8):
    """Mean B/d^2 after every frame of a network that is 20 % off. ``spoilt`` (depth, variance) is the only anchor of
    frame 5."""
    depths, poses, K = scenes.sequence(frames, H, W, 0.0)
    rng, ufm, result = np.random.default_rng(0), UfMStar(ON), []
    for i, (truth, T) in enumerate(zip(depths, poses, strict=True)):
        v, u = rng.integers(0, H, 40), rng.integers(0, W, 40)
        pixel, depth = torch.tensor(np.stack([u, v], -1)[None].astype(float)), torch.tensor(truth[v, u])[None].clone()
        variance = torch.full_like(depth, 1e-4)
        if spoilt is not None and i == at:
            pixel, depth, variance = pixel[:, :1], *(torch.tensor([[x]], dtype=torch.float64) for x in spoilt)
        anchors = Anchors(pixel, depth, variance)
        out = ufm(torch.tensor(1.2 * truth)[None], torch.tensor(T), torch.tensor(K), anchors=anchors)
        result.append(float((out.anchored / out.depth.square())[out.valid].mean()))
    return result, int(out.statistics.anchors_used[0])


@pytest.fixture(scope="module")
def without():
    return taught()[0]


@pytest.mark.parametrize(
    "spoilt",
    [(1e30, 1e-4), (1e200, 1e-4), (1e4, 1e-4), (1e-30, 0.0), (2.0, 1e300), (2.0, 1e4), (2.0, 4.0), (1e200, 1e300)],
)
def test_an_anchor_without_information_changes_nothing(spoilt, without):
    result, used = taught(spoilt)
    assert np.isfinite(result).all()
    assert used >= 30
    # The frame with the bad anchor has no effect, so the difference is at most the effect of one frame's forty anchors.
    np.testing.assert_allclose(result, without, rtol=0.25)


@pytest.mark.parametrize(
    ("predicted", "truth", "right", "far"),
    [(0.015, 2.0, 0, 200), (8.0, 0.04, 0, 200), (0.015, 2.0, 200, 4), (2.0, 2.0, 200, 0)],
)
def test_many_rejected_anchors_widen_the_variance(predicted, truth, right, far, caplog):
    """Two streams; the second has no wrong anchor."""
    config = UfMStarConfig(anchors=AnchorConfig(), posterior=PosteriorConfig())
    ufm, rng, n = UfMStar(config), np.random.default_rng(0), right + far
    K = torch.tensor([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
    pixel = torch.tensor(rng.uniform([0, 0], [W - 1, H - 1], (n, 2)))[None].expand(2, -1, -1)
    depth = torch.tensor([predicted] * right + [truth] * far, dtype=torch.float64)
    anchors = Anchors(
        pixel, torch.stack([depth, torch.full_like(depth, predicted)]), torch.full((2, n), 1e-12).double()
    )
    for _ in range(3):
        out = ufm(torch.full((2, H, W), predicted), torch.eye(4), K, anchors=anchors)
    many, statistics = far > right, out.statistics
    assert statistics.anchors_rejected.tolist() == [far, 0]
    assert int(statistics.anchors_used[1]) > 0.9 * n
    for sigma in (out.ufm_variance.sqrt(), out.std):
        assert float(sigma[1].median()) < 0.3 * predicted
        assert (sigma[0] > 0.3 * abs(truth - predicted)).all() if many else sigma[0].median() < 0.3 * predicted
    assert [record.message[:9] for record in caplog.records if "anchors are off" in record.message] == [
        "stream 0:"
    ] * many


def anchored_std(claim, frames=6, every=False):
    """std [m] of a network that is 1 m too far, in frames with 60 anchors; its variance is ``claim`` [m^2] at one
    anchor."""
    depths, poses, K = scenes.sequence(frames, H, W, 0.0)
    rng, ufm, result = np.random.default_rng(1), UfMStar(ON), []
    for i, (truth, T) in enumerate(zip(depths, poses, strict=True)):
        v, u = rng.integers(0, H, 60), rng.integers(0, W, 60)
        depth = torch.tensor(truth[v, u])[None]
        anchors = Anchors(torch.tensor(np.stack([u, v], -1)[None].astype(float)), depth, torch.full_like(depth, 1e-4))
        aleatoric = torch.full((1, H, W), 1e-4, dtype=torch.float64)
        if claim is not None and (every or i == 0):
            aleatoric[0, v[7], u[7]] = claim
        out = ufm(torch.tensor(truth + 1.0)[None], torch.tensor(T), torch.tensor(K), aleatoric, anchors=anchors)
        result.append(float(out.std[out.valid].median()))
    return result, out.statistics


@pytest.mark.parametrize("every", [False, True])
@given(st.floats(-4, 12))
@settings(max_examples=8, deadline=None)
def test_one_large_claim_does_not_switch_anchors_off(every, exponent):
    result, statistics = anchored_std(10.0**exponent, every=every)
    np.testing.assert_allclose(result, anchored_std(None)[0], rtol=0.1)
    assert 60 >= int(statistics.anchors[0]) >= int(statistics.anchors_used[0]) >= 50
    if every and exponent > 2:
        assert int(statistics.anchors_used[0]) < int(statistics.anchors[0]), "the statistics count it out"


def test_no_weighted_claim_exceeds_the_other_anchors_errors():
    rng = np.random.default_rng(3)
    for n in (1, 2, 3, 4, 5, 9, 300):
        for _ in range(30):
            d = np.full(n, 3.0)
            rows = stream(np.stack([5.0 * np.arange(n), np.zeros(n)], -1), rng.normal(0.1, 0.01, n), n)
            variance = torch.tensor(10.0 ** rng.uniform(-6, 12, n))[None]
            spoilt = replace(
                rows,
                predicted=rows.predicted * torch.tensor(d),
                depth=rows.depth * 3,
                network_variance=variance,
            )
            evidence = Evidence(torch.zeros(1, 1, 3, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64))
            sums, _ = observe(evidence, spoilt, lambda values: values.sum(1, keepdim=True), 1.0)
            squares = (spoilt.depth / spoilt.predicted - 1).square().sum()
            assert -max(1.0, 4 * float(squares)) <= float(sums.overall[0, 2]) <= float(squares)


def stream(pixel, log_ratio, padded):
    n = len(log_ratio)
    fields = [torch.zeros(1, padded, *shape, dtype=torch.float64) for shape in ((2,), (), (), (), ())]
    fields[0][0, :n], fields[2][0, :n] = torch.tensor(pixel), torch.tensor(np.exp(log_ratio))
    fields[1] += 1
    fields[2][0, n:] = 1
    index, valid = torch.zeros(1, padded, dtype=torch.int64), torch.arange(padded)[None] < n
    pixel, predicted, depth, variance, network_variance = fields
    return Anchors(pixel, depth, variance, valid, index=index, predicted=predicted, network_variance=network_variance)


def test_padding_does_not_decide_which_neighbours_are_asked():
    rng = np.random.default_rng(0)
    for _ in range(40):
        n = int(rng.integers(9, 60))
        pixel = rng.integers(0, 6, (n, 2)).astype(float)  # a grid: many anchors are equally near
        ratio = np.where(rng.random(n) < 0.5, rng.uniform(-1, 1, n), 0.02 * rng.standard_normal(n))
        alone = inliers(stream(pixel, ratio, n))
        for padded in (n + 1, n + 40, 200):
            assert torch.equal(inliers(stream(pixel, ratio, padded))[:, :n], alone)
