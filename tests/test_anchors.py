"""Anchors: what they teach, where it is spread, and that without them nothing changes."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from oracle_anchors import weight

import scenes
from ufmstar_torch import AnchorConfig, UfMStar, UfMStarConfig
from ufmstar_torch.anchors.anchors import AnchorInput, Anchors
from ufmstar_torch.anchors.evidence import Evidence, inliers, means, observe
from ufmstar_torch.anchors.extension import anchored_term

HEIGHT, WIDTH = 48, 64
ON = UfMStarConfig(anchors=AnchorConfig(), unmeasured="paper")  # evidence alone


def anchors_of(truth, count, rng, *, noise=0.0, variance=None, outliers=0.0):
    """Anchors at random pixels of a true depth map [H, W]; a share ``outliers`` of them is anywhere from .3 to 6 m."""
    v, u = rng.integers(0, HEIGHT, count), rng.integers(0, WIDTH, count)
    depth = truth[v, u] + noise * rng.standard_normal(count)
    wrong = rng.random(count) < outliers
    depth = np.where(wrong, rng.uniform(0.3, 6.0, count), depth)
    spread = np.full(count, noise**2 if variance is None else variance)
    return Anchors(
        *(torch.tensor(x)[None] for x in (np.stack([u, v], -1).astype(float), depth, spread)),
    )


def walk(predict, frames=24, config=ON, **options):
    """Run UfM* over a rendered room with ``predict(truth, frame, rng)``; the outputs and the true depths."""
    depths, poses, K = scenes.sequence(frames, HEIGHT, WIDTH, 0.0)
    rng = np.random.default_rng(3)
    ufm, outputs = UfMStar(config, dtype=torch.float64), []
    count = options.pop("count", 150)
    for i, (truth, T) in enumerate(zip(depths, poses, strict=True)):
        given_now = anchors_of(truth, count, rng, **options) if count else None
        depth = torch.tensor(predict(truth, i, rng))[None]
        outputs.append(ufm(depth, torch.tensor(T), torch.tensor(K), anchors=given_now))
    return ufm, outputs, depths


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
    with pytest.raises(ValueError, match=r"UfMStarConfig\.anchors is None"):
        plain(*arguments, anchors=anchors_of(depth, 5, np.random.default_rng(0)))
    with pytest.raises(ValueError, match="needs anchors"):
        a.corrected()


def test_a_common_bias_is_measured_and_counted_once():
    # 20 % too far everywhere, and 4 % flicker between frames: r = 1/1.2 - 1 on average.
    _, outputs, depths = walk(lambda z, i, rng: z * 1.2 * (1 + 0.04 * rng.standard_normal()))
    sums = np.zeros(4)
    for output, truth in list(zip(outputs, depths, strict=True))[8:]:
        seen = output.valid[0]
        z = torch.tensor(truth)[seen]
        corrected, remaining = (x[0][seen] for x in output.corrected())
        squares = (output.depth[0][seen] - z).square(), output.variance[0][seen], (corrected - z).square(), remaining
        sums += [float(value.mean()) for value in squares]
    error, claimed, left, claimed_left = sums
    # The claimed mean square is the measured one: M's part has been taken off B, not added to it.
    assert 0.8 < claimed / error < 1.25
    assert left < 0.15 * error
    assert claimed_left < 0.7 * claimed  # M stays


def test_different_biases_are_separated():
    def predict(truth, i, rng):
        return np.where(truth > 2.5, truth * 1.3, truth)

    _, outputs, depths = walk(predict, count=300)
    output, truth = outputs[-1], torch.tensor(depths[-1])
    relative = output.anchored[0] / output.depth[0].square()
    far, near = truth > 2.8, (truth < 2.2) & output.valid[0]
    assert int(far.sum()) > 200
    assert int(near.sum()) > 200
    assert float(relative[far].mean()) > 2.5 * float(relative[near].mean())


def test_gross_outliers_do_not_poison():
    def predict(truth, i, rng):
        return truth * 1.3

    _, clean, _ = walk(predict)
    _, dirty, _ = walk(predict, outliers=0.3)
    for a, b in list(zip(clean, dirty, strict=True))[8:]:
        ratio = float(b.anchored[b.valid].mean() / a.anchored[a.valid].mean())
        assert 0.5 < ratio < 2.0
        assert float(b.statistics.anchors_used[0] / b.statistics.anchors[0]) < 0.9


def test_the_anchors_own_noise_is_no_error_of_the_network():
    _, outputs, _ = walk(lambda z, i, rng: z, noise=0.5, count=300)
    _, fooled, _ = walk(lambda z, i, rng: z, noise=0.5, variance=0.0, count=300)
    message, doubled = (float(np.mean([o.anchored[o.valid].mean() for o in run[8:]])) for run in (outputs, fooled))
    assert doubled > 0.05, "without its variance the noise would be taken for the network's"
    assert message < 0.25 * doubled


def test_the_lesson_outlasts_the_anchors():
    depths, poses, K = scenes.sequence(30, HEIGHT, WIDTH, 0.0)
    rng, ufm = np.random.default_rng(0), UfMStar(ON.replace(disagreement="overlap"))
    for i, (truth, T) in enumerate(zip(depths, poses, strict=True)):
        anchors = anchors_of(truth, 100, rng) if i < 10 else None
        output = ufm(torch.tensor(truth * 1.2)[None], torch.tensor(T), torch.tensor(K), anchors=anchors)
    r2 = (1 / 1.2 - 1) ** 2
    claimed = (output.variance / output.depth.square())[output.valid]
    assert 0.8 * r2 < float(claimed.median()) < 1.2 * r2
    plain = (output.disagreement / output.depth.square())[output.valid]
    assert float(plain.median()) < 0.5 * r2, "without the lesson less is claimed"


def test_what_is_claimed_is_the_larger_of_disagreement_and_lesson():
    _, outputs, depths = walk(lambda z, i, rng: z * 1.2 * (1 + 0.1 * rng.standard_normal()), frames=10)
    once, often = outputs[0], outputs[-1]
    # Seen once, nothing was compared: M is 0 there, not because views agree, and anchors alone speak.
    assert float(once.disagreement[once.valid].max()) == 0
    expected = float((once.depth[0] - torch.tensor(depths[0])).square()[once.valid[0]].mean())
    assert 0.8 < float(once.variance[once.valid].mean()) / expected < 1.1  # a little is shrunk away
    assert 0.05 < float((often.anchored[often.valid] == 0).double().mean()) < 0.95, "M is the larger in some places"
    torch.testing.assert_close(often.variance, often.disagreement + often.anchored, rtol=1e-14, atol=0, equal_nan=True)
    d2, m = torch.tensor([[4.0, 4.0, 1.0]]), torch.tensor([[0.1, 0.9, 0.2]])
    term, both = anchored_term(d2.sqrt(), torch.tensor([[0.2, 0.2, -0.3]]), m)
    torch.testing.assert_close(both, torch.tensor([[0.8, 0.9, 0.2]]))
    torch.testing.assert_close(term, both - m)


def rows(values, valid=None, pixel=None):
    """AnchorInput of one stream from (predicted, depth, variance, own variance) tuples, in a line 5 px apart."""
    columns = torch.tensor(values, dtype=torch.float64).T[:, None]
    n = len(values)
    ok = torch.ones(1, n, dtype=torch.bool) if valid is None else torch.tensor([valid])
    line = [[5.0 * i, 0.0] for i in range(n)] if pixel is None else pixel
    return AnchorInput(torch.tensor([line]), torch.zeros(1, n, dtype=torch.int64), *columns, ok)


@given(st.integers(0, 10**6), st.floats(0.5, 1.0), st.floats(0.5, 20.0))
@example(70097, 0.5, 1.0)  # a frame whose anchors all count less than half
@settings(max_examples=30)
def test_sums_and_means_by_hand(seed, memory, kappa):
    rng = np.random.default_rng(seed)
    n, k = 3, 3  # fewer than could support each other: all are taken
    sums, total = np.zeros((k, 3)), np.zeros(3)
    evidence = Evidence.empty(1, k, dtype=torch.float64, device="cpu")
    for _ in range(3):
        d, g = rng.uniform(1, 4, n), rng.uniform(1, 4, n)
        s2, own = rng.uniform(0, 0.1, (2, n))
        share = rng.uniform(0, 0.3, (n, k))
        evidence, used = observe(
            evidence,
            rows(list(zip(d, g, s2, own, strict=True))),
            lambda values, share=share: torch.einsum("nk,bnc->bkc", torch.tensor(share), values),
            memory,
        )
        errors, claims = list((g - d) / d), (s2 + own) / d**2
        weights = [weight(claims[a], errors[:a] + errors[a + 1 :]) for a in range(n)]
        assert used[0].tolist() == [w >= 0.5 for w in weights]
        if max(weights) >= 0.5:  # without an anchor that is used nothing fades
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


def test_without_new_anchors_nothing_fades_and_one_does_not_decide():
    depths, poses, K = scenes.sequence(8, HEIGHT, WIDTH, 0.0)
    ufm, rng = UfMStar(ON), np.random.default_rng(0)
    for i, (truth, T) in enumerate(zip(depths, poses, strict=True)):
        depth = torch.tensor(truth * 1.5)[None]
        ufm(depth, torch.tensor(T), torch.tensor(K), anchors=anchors_of(truth, 40, rng) if i == 0 else None)
        if i == 0:
            learnt = ufm.overall_evidence.clone()
        assert torch.equal(ufm.overall_evidence, learnt)
    one = Evidence(torch.zeros(1, 2, 3), torch.tensor([[1.0, -0.3, 0.09]]))
    torch.testing.assert_close(means(one, 5.0)[1], torch.tensor([[-0.05, 0.015]], dtype=torch.float64))


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


def test_state_is_carried_reset_and_the_same_in_both_tiers():
    depths, poses, K = scenes.sequence(8, HEIGHT, WIDTH, 0.03)
    fast, slow = UfMStar(ON, dtype=torch.float64), UfMStar(ON.replace(backend="torch"), dtype=torch.float64)
    rng = np.random.default_rng(1)
    for i, (truth, T) in enumerate(zip(depths, poses, strict=True)):
        anchors = anchors_of(truth, 60, rng, noise=0.01)
        arguments = torch.tensor(truth * 1.1)[None], torch.tensor(T), torch.tensor(K)
        if i == 4:
            resumed = UfMStar(ON, dtype=torch.float64)
            resumed.load_state_dict(copy.deepcopy(fast.state_dict()))
        a, b = fast(*arguments, anchors=anchors), slow(*arguments, anchors=anchors)
        torch.testing.assert_close(a.variance, b.variance, rtol=1e-9, atol=1e-12, equal_nan=True)
        torch.testing.assert_close(a.bias, b.bias, rtol=1e-9, atol=1e-12, equal_nan=True)
        if i >= 4:
            again = resumed(*arguments, anchors=anchors).variance
            torch.testing.assert_close(again, a.variance, rtol=0, atol=0, equal_nan=True)
    assert float(fast.overall_evidence[0, 0]) > 100
    fast.reset([0])
    assert float(fast.overall_evidence.abs().max()) == 0
    assert float(fast.evidence.abs().max()) == 0


def test_a_sample_of_pixels_has_the_same_variance():
    _, outputs, depths = walk(lambda z, i, rng: z * 1.2, frames=4, config=ON.replace(ema_alpha=1.0))
    depths, poses, K = scenes.sequence(4, HEIGHT, WIDTH, 0.0)
    rng, ufm = np.random.default_rng(3), UfMStar(ON.replace(ema_alpha=1.0), dtype=torch.float64)
    for truth, T in zip(depths, poses, strict=True):
        anchors = anchors_of(truth, 150, rng)
        mean = ufm.mean_uncertainty(
            torch.tensor(truth * 1.2)[None], torch.tensor(T), torch.tensor(K), anchors=anchors, fraction=1.0
        )
    last = outputs[-1]
    np.testing.assert_allclose(float(mean.mean[0]), float(last.variance[last.valid].mean()), rtol=1e-9)
