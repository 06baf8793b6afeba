"""Intervals and probabilities of the depth: closed forms, the oracle, what held-out anchors change, what is refused."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import oracle_interval as oracle
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from torch.special import ndtr

from ufmstar_torch import AnchorConfig, PosteriorConfig, Recalibration, UfMStar, UfMStarConfig, UncertainDepth
from ufmstar_torch.anchors import Anchors
from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.posterior import conformal
from ufmstar_torch.posterior.distribution import DepthDistribution
from ufmstar_torch.posterior.running import views

CONFIG = UfMStarConfig(anchors=AnchorConfig(), posterior=PosteriorConfig())
K = torch.tensor([[40.0, 0, 24], [0, 40, 18], [0, 0, 1]])
TWO = [(0.97, 2.0, 0.04), (0.03, 2.0, 4.0)]
APART = [(0.7, 2.0, 0.01), (0.3, 1.2, 0.04)]  # also with different means
NORMAL, QUANTILES = list(oracle.NORMAL.values()), [0.6, 1.9, 4.0]


def distribution(components, quantiles=NORMAL):
    parts = (torch.tensor(x, dtype=torch.float64)[:, None, None] for x in zip(*components, strict=True))
    return DepthDistribution(*parts, torch.tensor([quantiles], dtype=torch.float64))


@pytest.mark.parametrize("components", [[(1.0, 3.0, 0.25)], TWO, APART])
@pytest.mark.parametrize("quantiles", [NORMAL, QUANTILES])
def test_a_mixture_s_intervals_and_probabilities_equal_the_oracle_s(components, quantiles):
    mixture = distribution(components, quantiles)
    for level in (0.2, 0.5, 0.83, 0.99, 0.995):
        expected = oracle.interval(components, level, quantiles)
        assert [float(x) for x in mixture.interval(level)] == pytest.approx(expected, rel=1e-6, abs=1e-6)
    for x in (0.05, 0.9, 1.3, 2.0, 2.4, 5.0):
        expected = oracle.probability_nearer(components, x, quantiles)
        assert float(mixture.below(torch.tensor([[x]]))) == pytest.approx(expected, rel=1e-6, abs=1e-7)


@given(st.floats(0.01, 0.99), st.floats(0.0, 0.5), st.floats(0.05, 3.0), st.floats(0.3, 2.0), st.floats(0.1, 3.0))
@example(0.984375, 0.5, 1.0, 1.0, 3.0)  # the lower end is a few nanometres
def test_ends_of_intervals_are_positive_ordered_and_hold_their_probability(level, p, sigma, first, growth):
    """The bisection finds an end to a micrometre."""
    quantiles = [first * 0.67, first * 0.67 + growth, first * 0.67 + 2 * growth]
    mixture = distribution([(1 - p, 2.0, sigma**2), (p, 2.0, 4 * sigma**2)], quantiles)
    lower, upper = mixture.interval(level)
    assert 0 <= float(lower) <= float(upper)
    within, beyond = (float(mixture.below(upper + x) - mixture.below(lower - x)) for x in (-2e-6, 2e-6))
    assert within - 1e-3 <= level <= beyond + 1e-3
    assert float(mixture.central_level(upper)) == pytest.approx(level, abs=1e-3)


def test_a_depth_is_positive():
    """Half of the mass of a component with sigma = 5 d is below 0; it is spread over the positive depths."""
    mixture = distribution([(1.0, 1.0, 25.0)])
    assert float(mixture.below(torch.zeros(1, 1))) == 0.0
    assert float(mixture.below(torch.full((1, 1), -1.0))) == 0.0
    assert float(mixture.below(torch.full((1, 1), 1e-3))) < 1e-3
    assert float(mixture.below(torch.full((1, 1), 60.0))) == pytest.approx(1.0, abs=1e-9)


@given(st.lists(st.tuples(st.floats(0, 6), st.floats(0, 1)), max_size=30), st.integers(0, 50), st.floats(-1, 1))
def test_the_update_equals_the_oracle_s(scored, frames, log):
    scores, weights = (np.array([x[i] for x in scored]) for i in range(2))
    state = np.array([frames, log, log + 0.1, log - 0.2])
    after, found = updated(state, scores, weights), np.zeros(5)
    np.testing.assert_allclose(after, oracle.updated(state, scores, weights), rtol=1e-12)
    conformal.quantiles(after, found[2:])
    np.testing.assert_allclose(found[2:], oracle.quantiles(after), rtol=1e-12)


def updated(state, scores, weights):
    """The state after a frame with errors of ``scores`` standard deviations, on either side."""
    after, z = state.copy(), scores * np.where(np.arange(len(scores)) % 2, 1, -1)
    conformal.adapt(after, ndtr(torch.from_numpy(z)).numpy(), weights)
    return after


def test_weights_equal_the_oracle_s_and_give_the_scores_the_image_s_distances():
    rng = np.random.default_rng(0)
    distance, area, everywhere = rng.uniform(0, 0.5, 60), rng.uniform(0.1, 1, 60), rng.uniform(0, 0.3, 784) ** 2
    weights = weighed(distance, area, everywhere)
    np.testing.assert_allclose(weights, oracle.weights(distance, area, everywhere), rtol=1e-12)
    rare = (distance > 0.05) & (distance <= 0.12)
    share = ((everywhere > 0.05) & (everywhere <= 0.12)).mean()
    assert weights[rare].sum() / weights.sum() == pytest.approx(share, rel=0.3)
    assert not weighed(distance, 0 * area, everywhere).any()


def weighed(distance, area, everywhere):
    weights = np.zeros_like(area)
    conformal.weigh(distance, area, everywhere, weights)
    return weights


def test_the_quantiles_follow_the_scores_forget_old_ones_and_a_frame_with_few_counts_less():
    rng, state = np.random.default_rng(2), np.zeros(4)
    for factor in [3.0] * 60 + [0.5] * 90:
        state = updated(state, factor * np.abs(rng.standard_normal(100)), np.ones(100))
    assert np.exp(state[1:3]) == pytest.approx(0.5, rel=0.1)
    one, many = (updated(state, np.full(n, 99.0), np.ones(n)) for n in (1, 100))
    assert 0 < one[2] - state[2] < 0.1 * (many[2] - state[2])


def frames(factor=1.3, noise=0.02, n=12, streams=1):
    """A wall at 2 m that the network sees ``factor`` times too near, with anchors of relative noise ``noise``."""
    rng = np.random.default_rng(3)
    for i in range(n):
        pixel = rng.uniform([0, 0], [47, 35], (streams, 80, 2))
        g = 2.0 * np.exp(noise * rng.standard_normal((streams, 80)))
        T = torch.eye(4, dtype=torch.float64)
        T[0, 3] = 0.02 * i
        anchors = Anchors(*(torch.from_numpy(x) for x in (pixel, g, (0.02 * g) ** 2)))
        yield torch.full((streams, 36, 48), 2.0 / factor), T, anchors


def last_output(ufm, **how):
    out = None
    for depth, T, anchors in frames(**how):
        out = ufm(depth, T, K, anchors=anchors)
    return out


def test_the_posterior_s_intervals_hold_the_depth_and_follow_the_errors_at_anchors():
    outs = [last_output(UfMStar(CONFIG), noise=noise, n=25) for noise in (0.005, 0.15)]
    widths = []
    for out in outs:
        lower, upper = out.interval(0.9)
        assert lower.shape == out.depth.shape
        assert lower.dtype == out.depth.dtype
        assert bool(((lower <= 2) & (upper >= 2)).all())
        widths.append(float((upper - lower).median()))
    # Anchors of stated noise 2 % that scatter by 15 % widen the intervals by more than the variance alone says.
    assert float(outs[1].quantiles[0, 0]) > 1.5**conformal.TRUST * float(outs[0].quantiles[0, 0])
    assert widths[1] > 2 * widths[0]
    near, between = outs[0].probability_nearer(1.0), outs[0].probability_between(1.5, 3.0)
    assert float(near.max()) < 0.01
    assert float(between.min()) > 0.95
    thresholds = torch.full_like(outs[0].depth, 2.5)
    assert torch.equal(outs[0].probability_nearer(thresholds), outs[0].probability_nearer(2.5))


def test_probabilities_add_up_and_rise_with_the_threshold():
    out = last_output(UfMStar(CONFIG))
    nearer = [out.probability_nearer(x) for x in (0.5, 1.0, 1.9, 2.1, 4.0, 100.0)]
    assert all(bool((b >= a).all()) for a, b in itertools.pairwise(nearer))
    torch.testing.assert_close(out.probability_between(1.0, 2.1), nearer[3] - nearer[1])
    torch.testing.assert_close(nearer[-1], torch.ones_like(nearer[-1]), rtol=0, atol=1e-3)


def test_without_evidence_an_interval_is_refused():
    plain = last_output(UfMStar(UfMStarConfig(anchors=AnchorConfig())))
    first = next(frames())
    early = UfMStar(CONFIG)(first[0], first[1], K, anchors=first[2])
    for out, reason in ((plain, "or a Recalibration"), (early, "too few anchors were held out so far")):
        assert not out.has_intervals
        for name, values in (
            ("interval", [0.9]),
            ("probability_nearer", [1.0]),
            ("probability_between", [1.0, 2.0]),
        ):
            with pytest.raises(ValueError, match=rf"an interval needs evidence.*{reason}"):
                getattr(out, name)(*values)


def test_of_two_streams_the_one_without_evidence_has_no_interval():
    ufm = UfMStar(CONFIG)
    for depth, T, anchors in frames(streams=2):
        valid = torch.stack([torch.ones(80), torch.zeros(80)]).bool()
        out = ufm(depth, T, K, anchors=dataclasses.replace(anchors, valid=valid))
    for value in (*out.interval(0.5), out.probability_nearer(2.0)):
        assert bool(value[0].isfinite().all())
        assert bool(value[1].isnan().all())


def test_arguments_are_checked():
    out = last_output(UfMStar(CONFIG))
    for level in (0, 1, -0.1, 90):
        with pytest.raises(ValueError, match=r"level must lie within \(0, 1\)"):
            out.interval(level)
    with pytest.raises(ValueError, match="near must be at most far"):
        out.probability_between(2.0, 1.0)


def test_pixels_that_are_not_valid_have_no_interval():
    ufm = UfMStar(CONFIG)
    for depth, T, anchors in frames():
        hole = depth.clone()
        hole[:, 3:6, 4:9] = torch.nan
        out = ufm(hole, T, K, anchors=anchors)
    for value in (*out.interval(0.9), out.probability_nearer(2.0)):
        assert bool((value.isfinite() == out.valid).all())


def test_a_recalibrated_variance_has_the_normal_distribution_s_interval():
    ufm = UfMStar(recalibration=Recalibration((1e-6, 1.0), (0.01, 0.09)))
    out = last_output_plain(ufm)
    lower, upper = out.interval(0.9)
    torch.testing.assert_close(upper - lower, 2 * 1.6448536 * out.std, rtol=1e-3, atol=0)
    torch.testing.assert_close(out.probability_nearer(out.depth), torch.full_like(out.depth, 0.5), rtol=1e-4, atol=0)


def last_output_plain(ufm):
    return ufm(torch.full((1, 36, 48), 2.0), torch.eye(4), K)


def test_uncertain_depth_has_the_same_intervals():
    model, ufm = UncertainDepth(None, CONFIG), UfMStar(CONFIG)
    for depth, T, anchors in frames():
        out = model.update(DepthPrediction(depth), T, K, anchors=anchors)
        expected = ufm(depth, T, K, anchors=anchors)
    assert out.prediction is not None
    for value, same in zip(out.ufm.interval(0.9), out.interval(0.9), strict=True):
        torch.testing.assert_close(value, same, rtol=0, atol=0, equal_nan=True)
    for value, same in zip(out.interval(0.9), expected.interval(0.9), strict=True):
        torch.testing.assert_close(value, same, rtol=0, atol=0, equal_nan=True)
    assert torch.equal(out.probability_nearer(1.0).nan_to_num(), expected.probability_nearer(1.0).nan_to_num())


def test_the_correction_is_saved_with_the_state():
    whole, first, second = (UfMStar(CONFIG) for _ in range(3))
    given_frames = list(frames(n=8))
    for ufm, part in ((whole, given_frames), (first, given_frames[:5])):
        for depth, T, anchors in part:
            out = ufm(depth, T, K, anchors=anchors)
        assert out.has_intervals
    second.load_state_dict(first.state_dict())
    for depth, T, anchors in given_frames[5:]:
        after = second(depth, T, K, anchors=anchors)
    assert torch.equal(second.posterior, whole.posterior)
    expected = whole(given_frames[-1][0], given_frames[-1][1], K).quantiles
    assert torch.equal(second(given_frames[-1][0], given_frames[-1][1], K).quantiles, expected)
    assert after.has_intervals
    second.reset([0])
    assert not bool(second.posterior.any())
    whole.reset(keep_evidence=True)
    assert bool(whole.posterior.any())


@pytest.mark.parametrize("values", [[-1.0, 0, 0, 0], [2.5, 0, 0, 0], [3.0, 9.0, 0, 0]])
def test_an_impossible_correction_is_refused(values):
    ufm = UfMStar(CONFIG)
    last_output(ufm, n=4)
    state = {name: value.clone() for name, value in ufm.state_dict().items()}
    views(state["posterior"][0].numpy()).intervals[:] = values
    with pytest.raises(RuntimeError, match=r"posterior holds impossible values: (quantiles|a number of frames)"):
        ufm.load_state_dict(state)
