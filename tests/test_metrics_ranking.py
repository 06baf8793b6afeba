"""Metrics of ranking: sparsification, rank correlation and the NLL by error."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from metric_maps import figures, maps
from scipy import stats

from ufmstar_torch.eval.metrics import (
    NLL,
    NLLByError,
    Sparsification,
    SpearmanCorrelation,
)


def sparsification(key: np.ndarray, error: np.ndarray, root: bool) -> np.ndarray:
    """The curve by sorting all pixels; ties in the order in which they stand."""
    ordered = error[np.argsort(key, kind="stable")]
    kept = [ordered[: round((1 - j / 50) * len(ordered))].mean() for j in range(50)]
    return np.sqrt(kept) if root else np.array(kept)


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
        # Bins of .7 %; seen: 1e-4.
        np.testing.assert_allclose(got[f"sparsification_{name}"].numpy(), by_variance, rtol=3e-3)
        assert float(got[f"ause_{name}"]) == pytest.approx(area(by_variance) - area(oracle), rel=1e-3)
        assert float(got[f"aurg_{name}"]) == pytest.approx(by_variance[0] - area(by_variance), rel=1e-3)
        assert float(got[f"aurg_{name}"]) > 0

    def test_ties_are_broken_at_random(self) -> None:
        """The same variance everywhere gains nothing and costs nothing, however the pixels are ordered."""
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

    def test_nll_by_error_over_confident_pixels(self) -> None:
        d, v, g = maps(100, 100)
        sure = v.sqrt() <= 0.2
        got = figures(NLLByError(), d, v, g, sure)["nll_by_error"]
        np.testing.assert_array_equal(got, figures(NLLByError(), d[sure], v[sure], g[sure])["nll_by_error"])
