"""Coverage of intervals and pixels under a gate, against direct counts."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from evaluations import in_memory, rows_of

from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.metrics.intervals import IntervalCoverage
from ufmstar_torch.eval.report.figures_calibration import INTERVAL, OUTLIER, draw_calibration
from ufmstar_torch.eval.report.figures_error import draw_gates, gates_figure


def maps(n=4000, seed=0):
    """Depth, variance, ground truth and level of pixels; some have no truth, no depth or no level."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(1, 5, n)
    sigma = truth * 10 ** rng.uniform(-2, 0, n)
    depth = np.maximum(truth + sigma * rng.standard_normal(n), 0.01)
    level = rng.uniform(0, 1, n) ** 2
    truth[:50], depth[50:80], level[80:300] = 0, np.nan, np.nan
    return tuple(torch.from_numpy(x) for x in (depth, sigma**2, truth, level))


def test_coverage_is_the_share_of_levels_below():
    depth, variance, truth, level = maps()
    metrics = SequenceMetrics()
    metrics.update(depth, variance, truth, level=level)
    figures, curves = metrics.compute(), metrics.curves()
    found = level[(truth > 0) & level.isfinite()].numpy()
    for name, stated in (("coverage_50", 0.5), ("coverage_90", 0.9), ("coverage_99", 0.99)):
        assert figures[name] == pytest.approx((found <= stated).mean(), abs=1e-12)
    assert curves["coverage_levels"] == pytest.approx(np.arange(1, 101) / 100)
    assert curves["coverage_found"][36] == pytest.approx((found <= 0.37).mean(), abs=1e-12)


def test_levels_on_the_edge_are_covered():
    metric, one = SequenceMetrics(), torch.ones(3, dtype=torch.float64)
    metric.update(one, one, one, level=torch.tensor([0.5, 0.9, 0.99], dtype=torch.float64))
    figures = metric.compute()
    assert [figures[f"coverage_{level}"] for level in (50, 90, 99)] == pytest.approx([1 / 3, 2 / 3, 1])


def test_without_levels_there_is_no_coverage():
    metrics = SequenceMetrics()
    metrics.update(*maps()[:3])
    assert not any(name.startswith("coverage") for name in (*metrics.compute(), *metrics.curves()))
    assert np.isnan(metrics.curves()["gate_coverage"]).all()
    assert IntervalCoverage().compute() == {}
    with pytest.raises(ValueError, match="level must have the depth's shape"):
        metrics.update(*maps()[:3], level=torch.ones(3))


def test_a_gate_keeps_the_pixels_below_it():
    depth, variance, truth, level = maps()
    metrics = SequenceMetrics()
    for part in (slice(900), slice(900, None)):
        metrics.update(depth[part], variance[part], truth[part], level=level[part])
    curves = {name: np.array(values) for name, values in metrics.curves().items() if name.startswith("gate")}
    d, v, g, c = (x.numpy() for x in (depth, variance, truth, level))
    used = (g > 0) & np.isfinite(d)
    for i in (0, 20, 45, 90):
        below = used & (np.sqrt(v) / np.where(used, d, 1) <= curves["gate_threshold"][i])
        error = np.abs(d - g)[below] / g[below]
        assert curves["gate_kept"][i] == pytest.approx(below.sum() / used.sum())
        if not below.any():
            assert np.isnan(curves["gate_error"][i])
            continue
        assert curves["gate_error"][i] == pytest.approx(np.median(error), rel=0.05)
        assert curves["gate_delta1"][i] == pytest.approx((error <= 0.25).mean())
        leveled = below & np.isfinite(c)
        assert curves["gate_coverage"][i] == pytest.approx((c[leveled] <= 0.9).mean())


def test_the_report_draws_coverage_and_gates_of_rows_with_intervals():
    rows = rows_of("DepthOnly", "UfM*-DepthOnly")
    metrics, plain = SequenceMetrics(), SequenceMetrics()
    metrics.update(*maps()[:3], level=maps()[3])
    plain.update(*maps(seed=1)[:3])
    from dataclasses import replace

    empty = in_memory({(row, ("rooms", "a")): {} for row in rows})
    results = replace(empty, merged={("rooms", rows[0]): plain.curves(), ("rooms", rows[1]): metrics.curves()})
    axes = draw_calibration(results, "rooms").axes[-1]
    assert axes.get_xlabel() == INTERVAL.x
    lines = [line for line in axes.lines if line.get_label() != "exactly right"]
    assert len(lines) == 1
    np.testing.assert_allclose(lines[0].get_ydata(), metrics.curves()["coverage_found"])
    of_mixture = {"outlier_stated": [0.05], "outlier_found": [0.1], "outlier_pixels": [1]}
    with_outliers = replace(results, merged={("rooms", rows[1]): metrics.curves() | of_mixture})
    axes = draw_calibration(with_outliers, "rooms").axes[-1]
    assert (axes.get_xlabel(), axes.lines[1].get_ydata().tolist()) == (OUTLIER.x, [0.1])
    error, within, covered = draw_gates(results, "rooms").axes
    assert [len(axes.lines) for axes in (error, within, covered)] == [2, 2, 3]
    assert {text.get_text() for text in error.texts} == {"0.05", "0.1", "0.2"}
    assert draw_calibration(empty, "rooms") is None
    assert gates_figure({}, "") is None
