"""Sweeps with anchors: a figure for each setting, in it a line for each choice of anchors, and what they begin from."""

from __future__ import annotations

import math
from typing import Any

import pytest
from evaluations import in_memory

from ufmstar_torch.anchors.tracker import TrackerConfig
from ufmstar_torch.eval.engine.anchors import TRUTH_COUNT
from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import setting_from
from ufmstar_torch.eval.methods.suite import suite_named
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.figures_sweep import default_value, draw_sweep, sweep_lines, sweeps
from ufmstar_torch.eval.report.write import figures_of

STAR = Method.parse("UfM*-DepthOnly")
MOST = TrackerConfig().max_points
ROTATION_DRIFTS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5)


def results_of(rows: list[Row], nll: float = 2.0) -> Results:
    return in_memory({(row, ("d", "s")): {"nll": nll, "ece_delta": 0.1} for row in rows}, "ablation-anchors")


@pytest.fixture(scope="module")
def results() -> Results:
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
def test_anchored_rows_are_a_line_that_goes_through_the_row_without_noise(results, name, values):
    lines = sweep_lines(results, "depth_only", name)
    anchored = [line for line in lines if dict(line.rest) == {"anchors": "tracked"}]
    assert [point.value for point in anchored[0].points] == pytest.approx(values)
    (at_default,) = (point for point in anchored[0].points if point.value == default_value(name))
    assert at_default.rows == (row(anchors="tracked"),)
    assert anchored[0].words == "anchored"
    # And no row of another line is among those of plain UfM*.
    (alone,) = (line for line in lines if line.method == STAR and not line.rest)
    assert all(not r.setting.anchors for point in alone.points for r in point.rows)


def test_numbers_of_anchors_begin_with_none(results):
    lines = {line.words: line for line in sweep_lines(results, "depth_only", "anchor_count") if len(line.points) > 1}
    assert set(lines) == {"anchored", "truth anchors"}
    assert [point.value for point in lines["truth anchors"].points] == [0, 5, 20, 100, 300]
    assert [point.value for point in lines["anchored"].points] == [0, 5, 20, MOST]
    # Plain UfM* where no row says 0; and a row that says nothing has as many as the tracker follows.
    assert lines["anchored"].points[0].rows == (Row(STAR),)
    assert lines["anchored"].points[-1].rows == (row(anchors="tracked"),)
    assert lines["truth anchors"].points[0].rows == (row(anchors="truth", anchor_count=0),)
    both = results_of([row(anchors="truth"), *(row(anchors="truth", anchor_count=n) for n in (0, 20))])
    assert [point.value for point in sweep_lines(both, "depth_only", "anchor_count")[0].points] == [0, 20, TRUTH_COUNT]


def test_settings_beside_the_anchors_are_lines_of_their_own():
    drifts = (0.0, 0.1, 0.2)
    mores = ({}, {"disagreement": "overlap"}, {"anchors": "tracked"}, {"anchors": "tracked", "corrected": True})
    result = results_of([row(**more, **({"rotation_drift": v} if v else {})) for more in mores for v in drifts])
    words = [line.words for line in sweep_lines(result, "depth_only", "rotation_drift")]
    assert words == ["", "disagreement overlap", "anchored", "anchored, depth corrected on"]
    axes = draw_sweep(result, "depth_only", "rotation_drift").axes[0]
    assert len({line.get_color() for line in axes.lines if not line.get_label().startswith("_")}) == 4


def test_words_and_switches_are_no_values():
    rows = [row(), *(row(disagreement="overlap", prior_weight=v) for v in (1.0, 2.0, 3.0))]
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


def test_the_report_has_them(results):
    names = {name for name, _ in figures_of(results) if name.startswith("sweep")}
    assert names >= {f"sweep depth_only {name}" for name in ("anchor_count", "track_noise", "anchors.shrinkage")}
