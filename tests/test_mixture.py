"""The metrics of the posterior's two-component mixture."""

from __future__ import annotations

import math

import pytest
import torch

from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.metrics.base import flat_pixels
from ufmstar_torch.eval.metrics.mixture import Mixture


def drawn(p: float, v1: float, v2: float, n: int = 200_000, seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Depth, variance, ground truths of the mixture, v_1 and p."""
    rng = torch.Generator().manual_seed(seed)
    depth = 2 + 2 * torch.rand(n, generator=rng, dtype=torch.float64)
    outlier = torch.rand(n, generator=rng) < p
    sigma = torch.where(outlier, v2, v1).double().sqrt()
    truth = depth + sigma * torch.randn(n, generator=rng, dtype=torch.float64)
    variance = torch.full_like(depth, (1 - p) * v1 + p * v2)
    return depth, variance, truth, torch.full_like(depth, v1), torch.full_like(depth, p)


def test_truths_drawn_from_the_mixture_are_calibrated_and_their_normal_is_not() -> None:
    depth, variance, truth, inlier, outlier = drawn(0.1, 0.01, 0.25)
    metrics = SequenceMetrics()
    metrics.update(depth, variance, truth, mixture=(inlier, outlier))
    figures = metrics.compute()
    assert figures["mixture_ece_delta"] < 0.003
    assert figures["mixture_ece_q"] < 0.003
    assert figures["mixture_coverage"] == pytest.approx(0.9973, abs=0.001)
    assert figures["ece_q"] > 0.03
    assert figures["mixture_nll"] < figures["nll"] - 0.1


def test_outliers_are_counted_by_their_stated_probability() -> None:
    """p = .1: a tenth of the errors has sigma = .5, of which a share 2 (1 - Phi(.6)) is beyond 3 x .1."""
    depth, variance, truth, inlier, outlier = drawn(0.1, 0.01, 0.25)
    metrics = SequenceMetrics()
    metrics.update(depth, variance, truth, mixture=(inlier, outlier))
    metrics.update(depth[:100], variance[:100], truth[:100], mixture=(inlier[:100], 1 - outlier[:100]))
    curves = metrics.curves()
    assert curves["outlier_pixels"] == [0, len(depth), *[0] * 7, 100]
    expected = 0.9 * math.erfc(3 / 2**0.5) + 0.1 * math.erfc(0.6 / 2**0.5)
    assert curves["outlier_stated"][1] == pytest.approx(expected, abs=1e-5)
    # With p = .9 and the same variance of .034, v_2 = (.034 - .1 x .01)/.9.
    expected_of_many = 0.1 * math.erfc(3 / 2**0.5) + 0.9 * math.erfc(0.3 / (2 * 0.033 / 0.9) ** 0.5)
    assert curves["outlier_stated"][9] == pytest.approx(expected_of_many, abs=1e-5)
    assert curves["outlier_found"][1] == pytest.approx(expected, abs=0.002)
    assert math.isnan(curves["outlier_found"][0])


def test_without_outliers_it_is_the_normal_distribution() -> None:
    depth, variance, truth, inlier, _ = drawn(0.0, 0.04, 1.0, 1000)
    metrics = SequenceMetrics()
    metrics.update(depth, variance, truth, mixture=(inlier, torch.zeros_like(depth)))
    figures = metrics.compute()
    for name in ("nll", "ece_delta", "ece_q"):
        assert figures[f"mixture_{name}"] == pytest.approx(figures[name], rel=1e-12)


def test_nll_of_one_pixel_by_hand() -> None:
    """v = 1.09, v_1 = .1 and p = .1: v_2 = 10."""
    metric, (depth, variance, truth, *mixture) = Mixture(), (torch.tensor([[x]]) for x in (3.0, 1.09, 3.5, 0.1, 0.1))
    metric.add(flat_pixels(depth, variance, truth, mixture=(mixture[0], mixture[1])))
    density = sum(w * math.exp(-(0.5**2) / v / 2) / math.sqrt(2 * math.pi * v) for w, v in ((0.9, 0.1), (0.1, 10.0)))
    assert float(metric.compute()["mixture_nll"]) == pytest.approx(-math.log(density), rel=1e-5)


def test_pixels_that_state_no_mixture_are_left_out_and_none_gives_no_figures() -> None:
    one, nan = torch.ones(1), torch.tensor([torch.nan])
    metric = Mixture()
    for depth, variance, truth, inlier, outlier in (
        (nan, one, one, one, one),
        (one, one, 0 * one, one, one),
        (one, one, one, nan, one),
        (one,) * 4 + (nan,),
    ):
        metric.add(flat_pixels(depth, variance, truth, mixture=(inlier, outlier)))
    assert metric.compute() == {}
    metrics = SequenceMetrics()
    metrics.update(one, one, one)
    assert not [name for name in metrics.compute() if name.startswith("mixture")]
    with pytest.raises(ValueError, match=r"outlier must have the depth's shape \(1,\), got \(2,\)"):
        metrics.update(one, one, one, mixture=(one, torch.ones(2)))


def test_parts_of_a_sequence_add_up() -> None:
    maps = drawn(0.2, 0.02, 0.5, 2000)
    whole, first, second = (SequenceMetrics() for _ in range(3))
    for metrics, part in ((whole, slice(None)), (first, slice(900)), (second, slice(900, None))):
        depth, variance, truth, inlier, outlier = (x[part] for x in maps)
        metrics.update(depth, variance, truth, mixture=(inlier, outlier))
    first.merge_state(second)
    assert first.compute() == pytest.approx(whole.compute(), rel=1e-12, nan_ok=True)
