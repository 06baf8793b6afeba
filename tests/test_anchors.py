"""Effects of anchors on the variance; without anchors nothing changes (values: test_anchors_oracle.py)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from oracle_anchors import weight

import scenes
from ufmstar_torch import AnchorConfig, UfMStar, UfMStarConfig
from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.anchors.evidence import Evidence, inliers, means, observe

HEIGHT, WIDTH = 48, 64
ON = UfMStarConfig(anchors=AnchorConfig(), unmeasured="paper")  # evidence alone


def anchors_of(truth, count, rng):
    """Exact anchors at random pixels of a true depth map [H, W]."""
    v, u = rng.integers(0, HEIGHT, count), rng.integers(0, WIDTH, count)
    parts = np.stack([u, v], -1).astype(float), truth[v, u], np.zeros(count)
    return Anchors(*(torch.tensor(part)[None] for part in parts))


def test_anchored_without_anchors_is_plain():
    depths, poses, K = scenes.sequence(6, HEIGHT, WIDTH, 0.05)
    plain, anchored = UfMStar(ON.replace(anchors=None), dtype=torch.float64), UfMStar(ON, dtype=torch.float64)
    for depth, T in zip(depths, poses, strict=True):
        arguments = torch.tensor(depth)[None], torch.tensor(T), torch.tensor(K)
        a, b = plain(*arguments), anchored(*arguments)
        torch.testing.assert_close(a.variance, b.variance, rtol=0, atol=0, equal_nan=True)
        assert a.anchored is None
        assert bool((b.anchored[b.valid] == 0).all())
        assert b.statistics.anchors.tolist() == [0]
    with pytest.raises(ValueError, match=r"anchors must be None where UfMStarConfig\.anchors is off"):
        plain(*arguments, anchors=anchors_of(depth, 5, np.random.default_rng(0)))


def test_a_common_bias_is_measured_and_counted_once():
    """20 % too far everywhere, and 4 % flicker between frames: r = 1/1.2 - 1 on average."""
    depths, poses, K = scenes.sequence(24, HEIGHT, WIDTH, 0.0)
    ufm, rng, sums = UfMStar(ON, dtype=torch.float64), np.random.default_rng(3), np.zeros(3)
    for i, (truth, T) in enumerate(zip(depths, poses, strict=True)):
        depth = torch.tensor(truth * 1.2 * (1 + 0.04 * rng.standard_normal()))[None]
        output = ufm(depth, torch.tensor(T), torch.tensor(K), anchors=anchors_of(truth, 150, rng))
        if i < 8:
            continue
        seen = output.valid[0]
        z = torch.tensor(truth)[seen]
        depth, bias = output.depth[0][seen], output.bias[0][seen]
        squares = (depth - z).square(), output.variance[0][seen], (depth * (1 + bias) - z).square()
        sums += [float(value.mean()) for value in squares]
    error, claimed, corrected = sums
    # The claimed mean square equals the measured one: B excludes M's part.
    assert 0.8 < claimed / error < 1.25
    assert corrected < 0.15 * error


def rows(values, valid=None, pixel=None):
    """Checked anchors of a stream, in a line 5 px apart, by (predicted, depth, variance, network's variance)."""
    columns = torch.tensor(values, dtype=torch.float64).T[:, None]
    n = len(values)
    ok = torch.ones(1, n, dtype=torch.bool) if valid is None else torch.tensor([valid])
    line = [[5.0 * i, 0.0] for i in range(n)] if pixel is None else pixel
    predicted, depth, variance, network_variance = columns
    return Anchors(
        torch.tensor([line]), depth, variance, ok, index=torch.zeros(1, n, dtype=torch.int64), predicted=predicted,
        network_variance=network_variance,
    )  # fmt: skip


@given(st.integers(0, 10**6), st.floats(0.5, 1.0), st.floats(0.5, 20.0))
@example(70097, 0.5, 1.0)  # a frame whose anchors all have a weight below one half
@settings(max_examples=30)
def test_sums_and_means_by_hand(seed, memory, kappa):
    rng = np.random.default_rng(seed)
    n, k = 3, 3  # too few to support each other: all are used
    sums, total = np.zeros((k, 3)), np.zeros(3)
    evidence = Evidence(torch.zeros(1, k, 3, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64))
    for _ in range(3):
        d, g = rng.uniform(1, 4, n), rng.uniform(1, 4, n)
        s2, network_variance = rng.uniform(0, 0.1, (2, n))
        share = rng.uniform(0, 0.3, (n, k))
        evidence, used = observe(
            evidence,
            rows(list(zip(d, g, s2, network_variance, strict=True))),
            lambda values, share=share: torch.einsum("nk,bnc->bkc", torch.tensor(share), values),
            memory,
        )
        errors, claims = list((g - d) / d), (s2 + network_variance) / d**2
        weights = [weight(claims[a], errors[:a] + errors[a + 1 :]) for a in range(n)]
        assert used[0].tolist() == [w >= 0.5 for w in weights]
        if max(weights) >= 0.5:  # without a used anchor nothing fades
            sums, total = sums * memory, total * memory
        for a in range(n):
            row = weights[a] * np.array([1, errors[a], errors[a] ** 2 - claims[a]])
            total += row
            for c in range(k):
                sums[c] += share[a, c] * row
    np.testing.assert_allclose(evidence.component[0].numpy(), sums, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(evidence.overall[0].numpy(), total, rtol=1e-12, atol=1e-14)
    beyond, stream = means(evidence, kappa)
    expected = total[1:] / (total[0] + kappa)
    np.testing.assert_allclose(stream[0].numpy(), expected, rtol=1e-12, atol=1e-14)
    for c in range(k):
        shrunk = (sums[c, 1:] + kappa * expected) / (sums[c, 0] + kappa)
        np.testing.assert_allclose(beyond[0, c].numpy() + expected, shrunk, rtol=1e-10, atol=1e-12)


def test_outliers_are_those_without_support():
    good = [(2.0, 2.0 * ratio, 0.0, 0.0) for ratio in (0.98, 0.99, 1.0, 1.01, 1.02, 1.03)]
    result = inliers(rows([*good, (2.0, 5.0, 0.0, 0.0), (2.0, 5.0, 25.0, 0.0)]))
    assert result.tolist() == [[True] * 6 + [False, True]], "an anchor as uncertain as that contradicts nothing"
    masked = inliers(rows(good, [True] * 4 + [False] * 2))
    assert masked.tolist() == [[True] * 4 + [False] * 2]


def test_a_region_that_differs_from_the_rest_is_believed():
    many = [(2.0, 2.0, 0.0, 0.0)] * 40
    other = [(2.0, 3.0, 0.0, 0.0)] * 6
    pixel = [[float(i % 8), float(i // 8)] for i in range(40)] + [[60.0 + i, 40.0] for i in range(6)]
    assert bool(inliers(rows(many + other, pixel=pixel)).all())


def test_anchors_that_make_no_sense_are_left_out_and_counted():
    depth = torch.full((1, HEIGHT, WIDTH), 2.0)
    depth[0, 0, 0] = torch.nan
    K, T = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), torch.eye(4)
    pixel = torch.tensor([[[5.0, 5.0], [0.0, 0.0], [-3.0, 5.0], [5.0, 99.0], [torch.nan, 1.0], [6.0, 6.0], [7.0, 7.0]]])
    z = torch.tensor([[2.0, 2.0, 2.0, 2.0, 2.0, -1.0, torch.inf]])
    output = UfMStar(ON)(depth, T, K, anchors=Anchors(pixel, z, torch.full_like(z, 0.01)))
    assert output.statistics.anchors.tolist() == [1]
    assert bool(torch.isfinite(output.variance[output.valid]).all())
    mask = torch.zeros_like(z, dtype=torch.bool)
    nothing = UfMStar(ON)(depth, T, K, anchors=Anchors(pixel, z, torch.full_like(z, 0.01), mask))
    assert nothing.statistics.anchors.tolist() == [0]
    empty = Anchors(torch.zeros(1, 0, 2), torch.zeros(1, 0), torch.zeros(1, 0))
    assert UfMStar(ON)(depth, T, K, anchors=empty).statistics.anchors.tolist() == [0]


@pytest.mark.parametrize(
    ("change", "error", "told"),
    [
        ({"pixel": torch.zeros(1, 4)}, ValueError, r"anchors.pixel must be \[1, N, 2\]"),
        ({"depth": torch.zeros(1, 5)}, ValueError, "anchors.depth must have shape"),
        ({"depth": torch.zeros(1, 4, dtype=torch.int64)}, TypeError, "anchors.depth must have a floating"),
        ({"variance": torch.zeros(4)}, ValueError, "anchors.variance must have shape"),
        ({"pose_error": torch.zeros(())}, ValueError, "anchors.pose_error must have shape"),
        ({"shared": 0.1}, TypeError, "anchors.shared must be a torch.Tensor"),
        ({"scale": torch.zeros(1, 4)}, ValueError, "anchors.scale must have shape"),
        ({"valid": torch.ones(1, 4)}, TypeError, "anchors.valid must be a torch.bool"),
        ({"pixel": None}, TypeError, "anchors.pixel must be a torch.Tensor, got NoneType"),
        ({"valid": torch.ones(1, 4, device="meta") > 0}, ValueError, "anchors.valid must lie on the depth's device"),
    ],
)
def test_wrong_anchors_are_refused_before_anything_changes(change, error, told):
    fields = {"pixel": torch.zeros(1, 4, 2), "depth": torch.ones(1, 4), "variance": torch.zeros(1, 4)} | change
    ufm = UfMStar(ON)
    K = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    with pytest.raises(error, match=told):
        ufm(torch.full((1, HEIGHT, WIDTH), 2.0), torch.eye(4), K, anchors=Anchors(**fields))
    assert ufm.frames.numel() == 0
