"""Figures of a report: the values of lines, bars and points, read from the artists."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from evaluations import confident, draw_maps, in_memory, judge, record_of, rows_of

from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import Setting, setting_from
from ufmstar_torch.eval.methods.suite import suite_named
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.efficiency import STAGES, draw_stages
from ufmstar_torch.eval.report.figures_calibration import draw_calibration
from ufmstar_torch.eval.report.figures_error import draw_entropy, draw_error, entropies
from ufmstar_torch.eval.report.figures_sweep import default_value, draw_sweep, sweep_lines, sweeps
from ufmstar_torch.eval.report.quantities import NLL, difference, mean_of
from ufmstar_torch.eval.report.style import (
    legend_below,
    line_style,
    new_figure,
    save_figure,
)
from ufmstar_torch.eval.report.write import figures_of

ROWS = rows_of("Ensemble", "UfM-Ensemble-100K", "UfM*-Ensemble", "DepthOnly", "UfM*-DepthOnly")
ALONE, UFM, UFM_STAR, DEPTH, STAR_OF_DEPTH = ROWS
SEQUENCES = ("a", "b")


@pytest.fixture(scope="module")
def results() -> Results:
    """Results of two sequences of one data set; the merged results are the first sequence's."""
    records, merged = [], {}
    for sequence in SEQUENCES:
        variances = {row: draw_maps(row, sequence)[1] for row in (ALONE, UFM)}
        references = {row.method.name: confident(v) for row, v in variances.items() if v is not None}
        for row in ROWS:
            judged = judge(draw_maps(row, sequence), references)
            records.append(record_of("own", "rooms", sequence, row, judged))
            merged.setdefault(("rooms", row), judged.curves)
    empty = in_memory({(row, ("rooms", "a")): {} for row in ROWS})
    return replace(empty, records=tuple(records), merged=merged)


def drawn(axes: Any) -> dict[str, Any]:
    """The drawn lines by the name of their row."""
    return {line.get_label(): line for line in axes.lines if not line.get_label().startswith("_")}


def words(axes: Any) -> list[str]:
    return [text.get_text() for text in axes.texts]


def named(axes: Any) -> set[str]:
    return {text.get_text() for text in axes.get_legend().get_texts()}


class TestCalibration:
    def test_lines_are_the_curves_over_all_pixels(self, results):
        figure = draw_calibration(results, "rooms")
        shown = [axes for axes in figure.axes if axes.get_visible()]
        assert [axes.get_title(loc="left") for axes in shown] == ["Ensemble", "DepthOnly", "", ""]
        delta, quantile = drawn(shown[0]), drawn(shown[2])
        assert list(delta) == list(quantile) == ["exactly right", "network alone", "UfM-100K", "UfM*"]
        for row in (ALONE, UFM, UFM_STAR):
            curves = results.merged["rooms", row]
            np.testing.assert_array_equal(quantile[line_style(row.method).name].get_ydata(), curves["ece_q_observed"])
            pixels = np.array(curves["ece_delta_pixels"])
            plotted = pixels > 0.001 * pixels.sum()
            line = delta[line_style(row.method).name]
            np.testing.assert_array_equal(line.get_ydata(), np.array(curves["ece_delta_accuracy"], float)[plotted])
            assert line.get_color() == line_style(row.method).colour
        assert list(drawn(shown[1])) == ["exactly right", "UfM*"]  # a depth-only network has no variance
        (legend,) = figure.legends
        assert {text.get_text() for text in legend.get_texts()} == {
            "network alone",
            "UfM-100K",
            "UfM*",
            "exactly right",
        }


class TestError:
    def test_a_panel_per_reference(self, results):
        figure = draw_error(results, "rooms")
        shown = [axes for axes in figure.axes if axes.get_visible()]
        assert [axes.get_title(loc="left") for axes in shown] == [
            "Ensemble: where it is confident in each frame",
            "Ensemble: where UfM-100K is confident in each frame",
        ]
        for axes, reference in zip(shown, ("Ensemble", "UfM-Ensemble-100K"), strict=True):
            for row in (ALONE, UFM, UFM_STAR):
                line = drawn(axes)[line_style(row.method).name]
                expected = results.merged["rooms", row][f"nll_by_error:{reference}"]
                np.testing.assert_array_equal(line.get_ydata(), expected)
                np.testing.assert_array_equal(line.get_xdata(), np.arange(5, 100, 10))
        assert named(shown[0]) == {"network alone", "UfM-100K", "UfM*"}


class TestEntropy:
    def test_histograms_and_means(self, results):
        figure = draw_entropy(results, "ensemble")
        axes = figure.axes[0]
        means = [line.get_xdata()[0] for line in axes.lines]
        for row, mean in zip((ALONE, UFM, UFM_STAR), means, strict=True):  # every sequence has as many pixels
            assert mean == pytest.approx(np.mean([r.figures["entropy"] for r in results.of(row)]), rel=1e-9)
        assert {line.get_linestyle() for line in axes.lines} == {"--"}
        assert means[0] < means[1] < means[2]  # the more overconfident the method, the smaller its sigma
        (histograms,) = entropies(results, "ensemble").values()
        for histogram in histograms.values():
            assert (histogram.density * np.diff(histogram.edges)).sum() == pytest.approx(1.0)  # no pixel lies outside
        assert words(axes) == [
            f"{name}: mean {mean:.2f}" for name, mean in zip(("network alone", "UfM-100K", "UfM*"), means, strict=True)
        ]

    def test_pixels_without_a_variance_are_told(self):
        curves = {"entropy_counts": [25, 0, 75, 0], "entropy_edges": [-1.0, 0.0, 1.0]}
        result = in_memory({(UFM_STAR, ("d", "s")): {"entropy": 0.5}})
        result = replace(result, records=(replace(result.records[0], curves=curves),))
        # The share of all pixels, including pixels without a variance.
        assert entropies(result, "ensemble")["d"][UFM_STAR].density.tolist() == [0.0, 0.75]
        assert words(draw_entropy(result, "ensemble").axes[0]) == ["UfM*: mean 0.50\n(25 % with hardly any V)"]


def noisy(value: float, seed: int = 0) -> Row:
    return Row(UFM_STAR.method, Setting(rotation_noise=value, seed=seed) if value else Setting())


@pytest.fixture(scope="module")
def swept() -> Results:
    """NLL = level of the sequence + noise / 10, with two seeds at 2 degrees that differ by .2."""
    values = {noisy(5.0): 0.5, noisy(0.0): 0.0, noisy(2.0, 1): 0.1, noisy(2.0, 2): 0.3, ALONE: 2.0}
    levels = {"a": 1.0, "b": 4.0, "c": 10.0, "d": 4.0, "e": 6.0}
    pairs = [(row, s) for row in values for s in levels]
    return in_memory({(row, ("d", s)): {"nll": levels[s] + values[row], "ece_delta": 0.1} for row, s in pairs})


def points_of(results: Results) -> dict[float, Any]:
    """The results of plain UfM* by rotation noise."""
    lines = sweep_lines(results, "ensemble", "rotation_noise")
    return next(line.points for line in lines if line.method == UFM_STAR.method and not line.rest)


class TestSweeps:
    def test_points_rise_and_seeds_are_averaged_first(self, swept):
        assert sweeps(swept) == [("ensemble", "rotation_noise")]
        result = points_of(swept)
        assert list(result) == [0.0, 2.0, 5.0]
        assert [len(records) for records in result.values()] == [5, 10, 5]
        mean = mean_of(result[2.0], NLL)
        assert (mean.value, mean.sequences) == (pytest.approx(5.2), 5)
        deviation = math.sqrt((4.0**2 + 1.0**2 + 5.0**2 + 1.0**2 + 1.0**2) / 4)
        assert mean.half == pytest.approx(2.7764451051977934 * deviation / math.sqrt(5))
        change = difference(result[5.0], result[0.0], NLL)
        assert (change.value, change.half) == (pytest.approx(0.5), pytest.approx(0.0, abs=1e-9))

    def test_lines_bands_and_the_base_alone(self, swept):
        figure = draw_sweep(swept, "ensemble", "rotation_noise")
        above = figure.axes[0]
        line, dashed = drawn(above)["UfM*"], drawn(above)["network alone"]
        np.testing.assert_allclose(line.get_xdata(), [0, 2, 5])
        np.testing.assert_allclose(line.get_ydata(), [5.0, 5.2, 5.5])
        assert (dashed.get_linestyle(), set(dashed.get_ydata())) == ("--", {7.0})
        half = mean_of(points_of(swept)[0.0], NLL).half
        band = above.collections[0].get_paths()[0].vertices
        assert band[:, 1].min() == pytest.approx(5.0 - half)
        assert figure.axes[-1].get_xlabel() == "rotation noise [°]"


class TestCost:
    def test_shares_of_the_stages(self, results):
        times = dict(zip(STAGES, (0.5, 3.0, 1.0, 1.5, 0.5, 3.0, 0.5), strict=True))
        stages = {"stages": {name: {"median_ms": ms} for name, ms in times.items()}}
        row = {"row": "UfM*-Ensemble", "network": "FastDepth", "stages": stages}
        axes = draw_stages(replace(results, efficiency={"rows": [row, {**row, "stages": None}]})).axes[0]
        assert [bar.get_width() for bar in axes.patches] == pytest.approx([5, 30, 10, 15, 5, 30, 5])
        assert "10.0 ms" in words(axes)
        assert draw_stages(results) is None


def test_the_same_figure_gives_the_same_file_and_no_global_state(tmp_path):
    import matplotlib

    before, pyplot = dict(matplotlib.rcParams), "matplotlib.pyplot" in sys.modules
    for kind in ("svg", "png", "jpg"):
        files = [tmp_path / f"{name}.{kind}" for name in ("one", "two")]
        for file in files:
            figure = new_figure(3, 2, "title")
            figure.subplots().plot([0, 1], [0, 1])
            save_figure(figure, file)
        assert files[0].read_bytes() == files[1].read_bytes()
    assert dict(matplotlib.rcParams) == before
    assert ("matplotlib.pyplot" in sys.modules) == pyplot


def test_the_overlap_figure_shows_the_improvement_in_nll_with_its_zero_line() -> None:
    """The paper's figure: NLL of aleatoric minus that of UfM*-Aleatoric over the skipped images; then the others."""
    skips, figures = (0, 1, 4), {}
    for name, falls in (("Aleatoric", 0.0), ("UfM*-Aleatoric", 1.0)):
        (row,) = rows_of(name)
        for skip in skips:
            for sequence, level in (("a", 2.0), ("b", 6.0)):
                nll = level - falls * (3 - skip / 2)
                figures[Row(row.method, Setting(skip=skip)), ("d", sequence)] = {"nll": nll, "ece_delta": 0.1}
    figure = draw_sweep(in_memory(figures), "aleatoric", "skip")
    assert len(figure.axes) == 4
    assert "improvement" in figure.axes[0].get_title(loc="left")
    lines = drawn(figure.axes[0])
    assert lines["UfM*"].get_xdata().tolist() == list(skips)
    np.testing.assert_allclose(lines["UfM*"].get_ydata(), [3.0, 2.5, 1.0])
    assert list(lines["network alone"].get_ydata()) == [0, 0]
    assert "network alone" in drawn(figure.axes[1])


# ---- sweeps with anchors ----

STAR = STAR_OF_DEPTH.method
ROTATION_DRIFTS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5)


def results_of(rows: list[Row], nll: float = 2.0) -> Results:
    return in_memory({(row, ("d", "s")): {"nll": nll, "ece_delta": 0.1} for row in rows}, "ablation-anchors")


@pytest.fixture(scope="module")
def anchored() -> Results:
    return results_of(list(suite_named("ablation-anchors").rows))


def row(**values: Any) -> Row:
    return Row(STAR, setting_from(values))


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("rotation_drift", ROTATION_DRIFTS),
        ("track_noise", (0.0, 1.0, 2.0, 4.0, 8.0)),
        ("anchors.half_life", (10.0, 30.0, 100.0)),
    ],
)
def test_anchored_rows_are_a_line_that_goes_through_the_row_without_noise(anchored, name, values):
    lines = sweep_lines(anchored, "depth_only", name)
    tracked = [line for line in lines if dict(line.rest) == {"anchors": "corners"}]
    assert list(tracked[0].points) == pytest.approx(values)
    assert [r.row for r in tracked[0].points[default_value(name)]] == [row(anchors="corners")]
    assert tracked[0].words == "anchors corners"
    # The line of plain UfM* has no other row's points.
    (alone,) = (line for line in lines if line.method == STAR and not line.rest)
    assert not any(r.row.setting.anchors for records in alone.points.values() for r in records)


def test_numbers_of_anchors_are_lines_of_the_rows_that_state_one(anchored):
    lines = {line.words: line for line in sweep_lines(anchored, "depth_only", "anchor_count") if len(line.points) > 1}
    assert {words: list(line.points) for words, line in lines.items()} == {
        "anchors truth": [0, 5, 20, 100, 300],
        "anchors corners": [5, 20],
    }


def test_words_and_switches_are_no_values():
    rows = [row(), *(row(unmeasured="nan", prior_weight=v) for v in (1.0, 2.0, 3.0))]
    rows += [row(**{"segment.prune": rule}) for rule in ("either", "none")] + [row(overlap_weighted=True)]
    assert sweeps(results_of(rows)) == [("depth_only", "prior_weight")]
    assert math.isnan(default_value("segment.prune"))
    assert math.isnan(default_value("no_such_setting"))
    assert math.isnan(default_value("anchor_count"))


def test_nlls_beyond_measure_leave_the_others_to_be_seen():
    rows = [row(**({"rotation_drift": v} if v else {})) for v in (0.0, 0.1, 0.2)]
    wild = draw_sweep(results_of(rows, nll=1e30), "depth_only", "rotation_drift")
    assert [axes.get_yscale() for axes in wild.axes[:3]] == ["symlog", "linear", "linear"]
    low, high = wild.axes[0].get_ylim()
    assert low < 0 < 1e30 < high < 1e31


def test_the_report_has_them(anchored):
    names = {name for name, _ in figures_of(anchored)}
    assert names >= {f"sweep depth_only {name}" for name in ("anchor_count", "track_noise", "anchors.shrinkage")}
    assert draw_sweep(anchored, "depth_only", "anchor_count").axes[0].get_xscale() == "symlog"


def test_a_legend_of_long_names_lies_within_the_figure():
    figure = new_figure(12.6, 4.6, "")
    axes = figure.subplots()
    names = [f"networks in turn, with UfM* and dense anchors, number {i}" for i in range(5)]
    for i, name in enumerate(names):
        axes.plot([0, 1], [i, i], label=name)
    legend_below(figure)
    figure.draw_without_rendering()
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == names
    box = legend.get_window_extent()
    assert 0 <= box.x0 < box.x1 <= figure.bbox.x1
