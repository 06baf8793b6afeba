"""Streaming metrics against independent implementations, closed forms and known errors of other code; rankings."""

from __future__ import annotations

import math
import warnings
from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from metric_maps import ALL, JUDGED, UNCERTAIN, figures, maps
from scipy import stats

from ufmstar_torch.eval.metrics import (
    NLL,
    DepthAccuracy,
    ECEDelta,
    ECEQuantile,
    EntropyHistogram,
    NLLByError,
    SequenceMetrics,
    Sparsification,
    SpearmanCorrelation,
    mean_and_ci,
)
from ufmstar_torch.eval.metrics.base import SumMetric


class TestAgainstIndependentImplementations:
    def test_accuracy(self) -> None:
        d, _, g = maps(40, 50)
        dn, gn = d.numpy(), g.numpy()
        accuracy = figures(DepthAccuracy(), d, None, g)
        assert float(accuracy["delta1"]) == np.mean(np.abs(dn - gn) <= 0.25 * gn)
        assert float(accuracy["delta1_ratio"]) == np.mean(np.maximum(dn / gn, gn / dn) < 1.25)
        assert accuracy["delta1"] != accuracy["delta1_ratio"]
        assert float(accuracy["abs_rel"]) == pytest.approx(np.mean(np.abs(dn - gn) / gn))
        assert float(accuracy["rmse"]) == pytest.approx(np.sqrt(np.mean((dn - gn) ** 2)))

    def test_delta1_closed_form(self) -> None:
        g = torch.full((5,), 4.0)
        d = torch.tensor([3.0, 5.0, 2.99, 5.01, 3.125])
        got = figures(DepthAccuracy(), d, None, g)
        assert float(got["delta1"]) == 3 / 5  # 3, 5 and 3.125: the interval is closed and lies around g
        assert float(got["delta1_ratio"]) == 0.0  # ratios 1.333, 1.25, 1.338, 1.2525, 1.28: open interval

    def test_ece_delta_is_a_numpy_loop(self) -> None:
        d, v, g = maps(20, 30, scale=2.0)
        got = figures(ECEDelta(delta=0.1, bins=8), d, v, g)
        dn, vn, gn = (x.numpy().ravel() for x in (d, v, g))
        confidence = stats.norm.cdf(0.1 * dn / np.sqrt(vn)) - stats.norm.cdf(-0.1 * dn / np.sqrt(vn))
        accurate, error = (gn >= 0.9 * dn) & (gn <= 1.1 * dn), 0.0
        for b in range(8):
            inside = (confidence >= b / 8) & ((confidence < (b + 1) / 8) | (b == 7))
            assert float(got["ece_delta_pixels"][b]) == inside.sum()
            if inside.any():
                gap = accurate[inside].mean() - confidence[inside].mean()
                assert float(got["ece_delta_accuracy"][b]) == pytest.approx(accurate[inside].mean())
                assert float(got["ece_delta_confidence"][b]) == pytest.approx(confidence[inside].mean())
                error += inside.mean() * abs(gap)
        assert float(got["ece_delta"]) == pytest.approx(error, rel=1e-12)

    def test_ece_quantile_is_scipys(self) -> None:
        # Asymmetric levels: symmetric ones hide a residual with its sign flipped.
        levels = [0.03, 0.1, 0.2, 0.6]
        d, v, g = maps(40, 50)
        g = g + 0.1  # biased, to test the sign of the residual
        got = figures(ECEQuantile(levels), d, v, g)
        observed = [np.mean(g.numpy() <= stats.norm.ppf(q, d.numpy(), np.sqrt(v.numpy()))) for q in levels]
        assert all(o < q for o, q in zip(observed, levels, strict=True))
        np.testing.assert_allclose(got["ece_q_observed"].numpy(), observed, rtol=0, atol=1e-15)
        assert float(got["ece_q"]) == pytest.approx(np.mean(np.abs(np.array(observed) - levels)), rel=1e-12)

    def test_entropy_is_scipys(self) -> None:
        d, v, g = maps(30, 30)
        v[0, :2] = torch.tensor([1e-12, 1e8])
        oracle = stats.norm(0, np.sqrt(v.numpy())).entropy().ravel()
        got = figures(EntropyHistogram(), d, v, g)
        assert float(got["entropy"]) == pytest.approx(oracle.mean())
        edges = np.concatenate([[-np.inf], np.linspace(-8.0, 8.0, 65), [np.inf]])
        counts = np.histogram(oracle, edges)[0]
        assert (counts[0], counts[-1]) == (1, 1)  # under and over the range
        np.testing.assert_array_equal(got["entropy_counts"].numpy(), counts)

    def test_the_authors_bins(self) -> None:
        """100 bins of the confidence; 101 levels, of which 0 and 1 are exact by definition."""
        d, v, g = maps(30, 40, scale=1.7)
        metrics = SequenceMetrics(bins="authors")
        metrics.update(d, v, g)
        got, curves = metrics.compute(), metrics.curves()
        dn, vn, gn = (x.numpy().ravel() for x in (d, v, g))
        levels = np.linspace(0, 1, 101)
        observed = [np.mean(gn <= stats.norm.ppf(q, dn, np.sqrt(vn))) for q in levels]
        np.testing.assert_allclose(curves["ece_q_levels"], levels, atol=1e-15)
        np.testing.assert_allclose(curves["ece_q_observed"], observed, atol=1e-15)
        assert curves["ece_q_observed"][0] == 0.0
        assert curves["ece_q_observed"][-1] == 1.0
        assert got["ece_q"] == pytest.approx(np.mean(np.abs(np.array(observed) - levels)), rel=1e-12)
        assert float(figures(ECEDelta(bins=100), d, v, g)["ece_delta"]) == got["ece_delta"]
        with pytest.raises(ValueError, match="bins must be one of ours, authors"):
            SequenceMetrics(bins="100")


class TestMeaning:
    @pytest.mark.parametrize(("scale", "sign"), [(3.0, 1), (0.3, -1)])
    def test_wrong_variance_shows_with_its_sign(self, scale: float, sign: int) -> None:
        d, v, g = maps(200, 300, scale=scale)  # errors `scale` times what the variance says
        got = figures(ECEDelta(), d, v, g)
        assert sign * float(got["overconfidence"]) > 0.02
        assert float(got["ece_delta"]) > 0.02
        observed = figures(ECEQuantile([0.1, 0.9]), d, v, g)["ece_q_observed"]
        assert sign * (float(observed[0]) - stats.norm.cdf(stats.norm.ppf(0.1))) > 0
        oracle = stats.norm.cdf(stats.norm.ppf([0.1, 0.9]) / scale)
        np.testing.assert_allclose(observed.numpy(), oracle, atol=5e-3)


class TestZeroVariance:
    def test_quantile_is_the_depth_itself(self) -> None:
        d, v = torch.full((4,), 2.0), torch.zeros(4)
        got = figures(ECEQuantile([0.2, 0.8]), d, v, torch.tensor([1.0, 2.0, 2.1, 3.0]))
        assert got["ece_q_observed"].tolist() == [0.5, 0.5]  # at or below: 1 and 2

    def test_confidence_is_one(self) -> None:
        d, v = torch.full((4,), 2.0), torch.zeros(4)
        got = figures(ECEDelta(bins=5), d, v, torch.tensor([1.0, 2.0, 2.1, 3.0]))
        assert got["ece_delta_pixels"].tolist() == [0, 0, 0, 0, 4]
        assert float(got["ece_delta"]) == 0.5


class TestMasks:
    @pytest.mark.parametrize("kind", ALL)
    def test_true_means_use(self, kind: type[SumMetric]) -> None:
        """True in the mask means use: an inverted mask would evaluate the invalid pixels."""
        d, v, g = maps(20, 30)
        valid = torch.zeros(20, 30, dtype=torch.bool)
        valid[3:9, 4:20] = True
        expected = figures(kind(), d[valid], v[valid], g[valid])
        poisoned = torch.where(valid, d, 1e6)
        for name, value in figures(kind(), poisoned, v, g, valid).items():
            torch.testing.assert_close(value, expected[name], rtol=0, atol=0, equal_nan=True)

    @pytest.mark.parametrize("kind", ALL)
    def test_nothing_valid_is_nan_and_no_crash(self, kind: type[SumMetric]) -> None:
        d, v, g = maps(4, 5)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            empty = [kind().compute()]
            if kind in JUDGED:
                empty.append(figures(kind(), d, v, torch.zeros_like(g)))
            empty.append(figures(kind(), d, v, g, torch.zeros_like(g, dtype=torch.bool)))
        headline = {"delta1", "abs_rel", "rmse", "nll", "ece_delta", "ece_q", "entropy"}
        headline |= {"ause_rmse", "aurg_abs_rel", "spearman", "nll_by_error"}
        for got in empty:
            assert all(bool(value.isnan().all()) for name, value in got.items() if name in headline)
            assert headline & got.keys()

    def test_arguments_are_not_changed(self) -> None:
        d, v, g = (x.float() for x in maps(6, 7))
        g[0], v[1], d[2] = math.nan, -1.0, math.inf
        before = [x.clone() for x in (d, v, g)]
        SequenceMetrics().update(d, v, g, g > 2)
        for old, new in zip(before, (d, v, g), strict=True):
            torch.testing.assert_close(new, old, rtol=0, atol=0, equal_nan=True)


class TestStreaming:
    @given(cut=st.integers(0, 12), seed=st.integers(0, 99))
    def test_parts_add_up_to_the_whole(self, cut: int, seed: int) -> None:
        d, v, g = maps(12, 9, seed=seed, scale=1.5)
        whole, first, second = SequenceMetrics(), SequenceMetrics(), SequenceMetrics()
        whole.update(d, v, g)
        first.update(d[:cut], v[:cut], g[:cut])
        second.update(d[cut:], v[cut:], g[cut:])
        first.merge_state(second)
        assert first.compute() == pytest.approx(whole.compute(), rel=1e-12, abs=1e-14, nan_ok=True)
        for name, curve in whole.curves().items():
            np.testing.assert_allclose(first.curves()[name], curve, rtol=1e-12, atol=1e-15)

    @pytest.mark.parametrize("shape", [(24,), (4, 6), (2, 3, 4), (2, 1, 3, 4)])
    def test_any_leading_shape(self, shape: tuple[int, ...]) -> None:
        d, v, g = maps(24)
        flat, shaped = SequenceMetrics(), SequenceMetrics()
        flat.update(d, v, g)
        shaped.update(d.reshape(shape), v.reshape(shape), g.reshape(shape))
        assert flat.compute() == shaped.compute()

    def test_memory_does_not_grow(self) -> None:
        d, v, g = maps(30, 30)
        metrics, sizes = SequenceMetrics(), []
        for _ in range(3):
            metrics.update(d, v, g)
            sizes.append(sum(x.nelement() * x.element_size() for x in metrics.state_dict().values()))
        assert sizes[0] == sizes[1] == sizes[2] < 2.4e6

    def test_settings_are_checked_and_others_do_not_merge(self) -> None:
        with pytest.raises(ValueError, match=r"settings.*0\.25.*0\.5"):
            ECEDelta(0.25).merge_state(ECEDelta(0.5))
        with pytest.raises(ValueError, match="delta must lie"):
            ECEDelta(1.0)
        with pytest.raises(ValueError, match="levels must rise"):
            ECEQuantile([0.5, 0.5])
        with pytest.raises(ValueError, match="other must hold"):
            SequenceMetrics().merge_state(SequenceMetrics(with_variance=False))


class TestSequence:
    def test_mean_and_ci_is_scipys(self) -> None:
        values = [0.2, 0.4, 0.35, 0.9, 0.1]
        mean, half = mean_and_ci(values)
        low, high = stats.t.interval(0.95, 4, np.mean(values), stats.sem(values))
        assert (mean - half, mean + half) == pytest.approx((low, high), rel=1e-12)

    def test_mean_and_ci_edges(self) -> None:
        assert mean_and_ci([0.5, math.nan])[0] == 0.5
        assert math.isnan(mean_and_ci([0.5])[1])
        assert all(math.isnan(x) for x in mean_and_ci([]))


class TestErrors:
    @pytest.mark.parametrize("kind", ALL)
    @pytest.mark.parametrize(
        ("change", "match"),
        [
            ({"target": torch.ones(3, 5)}, "target must have the depth's shape"),
            ({"valid": torch.ones(4, 5)}, "valid must be a bool mask"),
            ({"target": torch.ones(4, 5, dtype=torch.int64)}, "target must be floating point"),
            ({"variance": None}, "variance must be given"),
        ],
    )
    def test_maps(self, kind: type[SumMetric], change: dict[str, torch.Tensor | None], match: str) -> None:
        arguments = dict(zip(("depth", "variance", "target"), maps(4, 5), strict=True)) | change
        if "variance" in change and kind not in UNCERTAIN:
            return
        with pytest.raises(ValueError, match=match):
            kind().update(**arguments)


def loop(d: np.ndarray, v: np.ndarray, g: np.ndarray, use: np.ndarray) -> dict[str, float]:
    """All sums as scalars in plain loops."""
    sums: Counter[str] = Counter()
    for x, w, t, chosen in zip(d.flat, v.flat, g.flat, use.flat, strict=True):
        predicted, true = math.isfinite(x) and 0 <= w < math.inf, 0 < t < math.inf
        if chosen and predicted and w > 0:
            sums["EntropyHistogram.total"] += 0.5 * math.log(2 * math.pi * math.e * w)
            sums["EntropyHistogram.pixels"] += 1
        if not (chosen and true):
            continue
        sums["DepthAccuracy.with_truth"] += 1
        if math.isfinite(x):
            sums["DepthAccuracy.pixels"] += 1
            sums["DepthAccuracy.hits"] += abs(x - t) <= 0.25 * t
            sums["DepthAccuracy.hits_ratio"] += x > 0 and max(x / t, t / x) < 1.25
            sums["DepthAccuracy.relative"] += abs(x - t) / t
            sums["DepthAccuracy.squared"] += (x - t) ** 2
        if predicted and w > 0:
            sums["NLL.total"] += (x - t) ** 2 / (2 * w) + 0.5 * math.log(2 * math.pi * w)
            sums["NLL.pixels"] += 1
        sums["ECEQuantile.pixels"] += predicted
    return dict(sums)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_hostile_maps_add_up_to_what_loops_say(dtype: torch.dtype) -> None:
    """Excluded values, values at the ends of ranges, and a mask."""
    d, v, g = maps(30, 40, scale=1.5)
    for value, at in ((d, 0), (v, 1), (g, 2)):
        for row, special in enumerate((math.nan, math.inf, -math.inf, 0.0, -1.0, 1e-9, 1e-8, 1e4, 1e15)):
            value[3 * row + at, ::7] = special
    v[29, ::2] = 0
    d, v, g = (value.to(dtype) for value in (d, v, g))
    valid = torch.rand(30, 40, generator=torch.Generator().manual_seed(0)) > 0.2
    metrics = SequenceMetrics()
    metrics.update(d, v, g, valid)
    sums = metrics.state_dict()
    expected = loop(*(value.double().numpy() for value in (d, v, g)), valid.numpy())
    for name, total in expected.items():
        assert float(sums[f"metrics.{name}"]) == pytest.approx(total, rel=1e-12), name
    judged, found = int(sums["metrics.ECEQuantile.pixels"]), metrics.compute()
    assert found["nll"] == pytest.approx(expected["NLL.total"] / expected["NLL.pixels"], rel=1e-12)
    for name, kind in (("left_out_share", "DepthAccuracy"), ("nll_left_out_share", "NLL")):
        used = expected[f"{kind}.pixels"] / expected["DepthAccuracy.with_truth"]
        assert found[name] == pytest.approx(1 - used, rel=1e-12)
    for name in ("ECEDelta.pixels", "Sparsification.count", "SpearmanCorrelation.joint"):
        assert int(sums[f"metrics.{name}"].sum()) == judged
    alone = SequenceMetrics(with_variance=False)
    alone.update(d, None, g, valid)
    assert all(torch.equal(value, sums[name]) for name, value in alone.state_dict().items())


def sparsification(key: np.ndarray, error: np.ndarray, root: bool) -> np.ndarray:
    """The curve from sorting all pixels; ties stay in their original order."""
    ordered = error[np.argsort(key, kind="stable")]
    means = [ordered[: round((1 - j / 50) * len(ordered))].mean() for j in range(50)]
    return np.sqrt(means) if root else np.array(means)


def area(curve: np.ndarray) -> float:
    return float(np.trapezoid(curve, dx=1 / 50) + curve[-1] / 50)


class TestRanking:
    @pytest.mark.parametrize("name", ["rmse", "abs_rel"])
    def test_ause_and_aurg_are_those_of_sorted_pixels(self, name: str) -> None:
        d, v, g = maps(300, 400)
        root = name == "rmse"
        e = (((d - g) ** 2) if root else (d - g).abs() / g).numpy().ravel()
        by_variance, oracle = sparsification(v.numpy().ravel(), e, root), sparsification(e, e, root)
        got = figures(Sparsification(), d, v, g)
        # Bins of .7 %; observed error: 1e-4.
        np.testing.assert_allclose(got[f"sparsification_{name}"].numpy(), by_variance, rtol=3e-3)
        assert float(got[f"ause_{name}"]) == pytest.approx(area(by_variance) - area(oracle), rel=1e-3)
        assert float(got[f"aurg_{name}"]) == pytest.approx(by_variance[0] - area(by_variance), rel=1e-3)
        assert float(got[f"aurg_{name}"]) > 0

    def test_ties_are_broken_at_random(self) -> None:
        """A constant variance has an AURG of 0 for any order of the pixels."""
        d, _, g = maps(100, 100)
        order = (d - g).abs().flatten().argsort()
        for index in (order, order.flip(0)):
            got = figures(Sparsification(), d.flatten()[index], torch.ones(10_000), g.flatten()[index].double())
            assert abs(float(got["aurg_rmse"])) < 1e-12
            assert abs(float(got["aurg_abs_rel"])) < 1e-12

    @pytest.mark.parametrize("kind", ["many", "rounded", "narrow", "zeros"])
    def test_spearman_is_scipys(self, kind: str) -> None:
        d, v, g = maps(300, 400)
        if kind == "rounded":
            v = (v.sqrt() * 10).round().div(10).square().clamp(min=1e-3)
        if kind == "narrow":
            v = 0.1 + 0.5 * v
        if kind == "zeros":
            v = torch.where(torch.arange(400) < 200, 0.0, v)
        got = figures(SpearmanCorrelation(), d, v, g)
        exact = stats.spearmanr(v.numpy().ravel(), ((d - g) ** 2).numpy().ravel()).statistic
        assert abs(float(got["spearman"]) - exact) < 2e-3

    def test_nll_by_error_is_that_of_sorted_pixels(self) -> None:
        d, v, g = maps(300, 400)
        got = figures(NLLByError(), d, v, g)
        error = (d - g).abs().numpy().ravel()
        nll = -stats.norm.logpdf(g.numpy(), d.numpy(), v.sqrt().numpy()).ravel()
        groups = np.array_split(np.argsort(error), 10)
        oracle = np.array([nll[i].mean() for i in groups])
        # The smallest errors lie close together in metres: within .02 nats of the mean.
        np.testing.assert_allclose(got["nll_by_error"].numpy(), oracle, atol=0.02)
        total = figures(NLL(), d, v, g)["nll"]
        assert float(got["nll_by_error"].mean()) == pytest.approx(float(total), rel=1e-12)
