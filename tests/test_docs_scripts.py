"""The scripts behind docs/results/analysis.md: closed forms of what they measure, and one run on a tiny tour."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from ufmstar_torch import PosteriorConfig

DOCS = Path(__file__).resolve().parents[1] / "docs"
# A camera of 70 degrees.
K = np.array([[45.7, 0.0, 31.5], [0.0, 45.7, 23.5], [0.0, 0.0, 1.0]])


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Imports a script of docs/ by name."""
    monkeypatch.syspath_prepend(str(DOCS))

    def load(name: str) -> ModuleType:
        return importlib.import_module(name)

    return load


def resting(script: Any, error: np.ndarray) -> Any:
    """A clip of a camera at rest before a wall 2 m away, whose frames are wrong by ``error`` [N] m."""
    truth = np.full((len(error), 48, 64), 2.0, np.float32)
    depth = (truth + error[:, None, None]).astype(np.float32)
    return script("clips").Clip("wall", depth, None, truth, np.tile(np.eye(4), (len(error), 1, 1)), K)


def test_bias_and_varying_error_of_a_camera_at_rest(script: Any) -> None:
    """e = b + a (-1)^j: mean square b^2 + a^2, unbiased variance a^2 n / (n - 1), seen by every view."""
    n, b, a = 6, 0.5, 0.125
    clip = resting(script, b + a * (-1.0) ** np.arange(n))
    points = script("measure_views").surface_points(clip)
    assert points.at.shape[1] == 3 * 6 * 8  # every second frame, every eighth pixel
    np.testing.assert_array_equal(points.views, n)
    np.testing.assert_allclose(points.squares / points.views, b**2 + a**2, rtol=1e-12)
    np.testing.assert_allclose(points.varying, a**2 * n / (n - 1), rtol=1e-9)


def test_points_behind_another_surface_are_not_counted(script: Any) -> None:
    """Half of the frames see a nearer wall: each surface is seen by its own three frames only."""
    clip = resting(script, np.zeros(6))
    clip.truth[3:] = 1.5
    points = script("measure_views").surface_points(clip)
    np.testing.assert_array_equal(points.views, 3)


def test_parts_of_the_distance_vanish_without_change(script: Any) -> None:
    """The same map from the same place: all of W2^2 is rounding; a wall that jumps by 1 cm moves along the ray."""
    views, rest = script("measure_views"), resting(script, np.zeros(3))
    for terms, pixels in views.pairs(rest.depth, rest):
        assert pixels.sum() > 0
        np.testing.assert_allclose(terms, 0, atol=1e-10)
    jump = resting(script, np.array([0.0, 0.01]))
    ((terms, pixels),) = views.pairs(jump.depth, jump)
    along, across, _ = (terms * pixels).sum(1) / pixels.sum()
    # A point at z moves by .01 r, |r| >= 1, exactly along its ray.
    assert along >= 0.01**2 * (1 - 1e-5)
    assert across < 1e-8


def test_controls_keep_what_they_say(script: Any) -> None:
    """A scaled variance has the wanted mean, a shuffled one the same values frame by frame, at other pixels."""
    disagreement, rng = script("measure_disagreement"), np.random.default_rng(0)
    variance = rng.uniform(0.1, 1, (3, 8, 9)).astype(np.float32)
    known = rng.random((3, 8, 9)) < 0.7
    scaled = disagreement.scaled_to(2.5, variance, known)
    assert scaled[known].mean() == pytest.approx(2.5, rel=1e-6)
    mixed = disagreement.shuffled(variance, known)
    for i in range(3):
        np.testing.assert_array_equal(np.sort(mixed[i][known[i]]), np.sort(variance[i][known[i]]))
        np.testing.assert_array_equal(mixed[i][~known[i]], variance[i][~known[i]])
    assert (mixed[known] != variance[known]).mean() > 0.5


def test_places_divide_the_pixels(script: Any) -> None:
    """Thirds of depth, and border, edges and the rest, are each all pixels with ground truth."""
    clip = resting(script, np.linspace(0, 1, 5))
    clip.depth[:, 20:30, 20:40] *= 2
    places = script("measure_disagreement").places(clip)
    count = {name: int(mask.sum()) for name, mask in places.items()}
    assert sum(count[f"{name} third"] for name in ("nearest", "middle", "farthest")) == count["all"]
    assert count["border (16 px)"] + count["depth edges"] + count["the rest"] == count["all"]
    # The step's outline inside the border: the row and column where the block begins, and those after its end.
    inside = np.zeros((48, 64), dtype=bool)
    inside[20, 20:40] = inside[30, 20:40] = inside[20:30, 20] = inside[20:30, 40] = True
    assert count["depth edges"] == 5 * int(inside.sum())


def test_the_scripts_run(script: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Every table of a tour of six frames, and the pictures, from its beginning to its end."""
    result = script("clips").clips(argparse.Namespace(root=None, tours="200:201", frames=6, fov=None))
    clip, ensemble = result
    assert clip.aleatoric is None
    assert ensemble.aleatoric is not None
    tables = script("measure_disagreement").TABLES
    for table in tables.values():
        table(ensemble, 4)
    script("measure_views").share(resting(script, np.linspace(-0.1, 0.1, 6)))
    precision = script("measure_precision")
    half, brain = (np.median(precision.changes(clip, dtype)) for dtype in precision.DTYPES.values())
    assert 0 < half < brain < 1
    factors = script("measure_factors")
    monkeypatch.setattr(factors, "CHANGES", {"alpha = 1 (no average)": {"ema_alpha": 1.0}})
    figures = [factors.figures(clip), factors.figures(ensemble)]
    factors.table("both", figures)
    printed = capsys.readouterr().out
    assert "| UfM*, shuffled within each frame |" in printed
    assert "| A + M, M shuffled |" in printed
    assert "| alpha = 1 (no average) |" in printed
    assert "nan" not in printed.split("both, 2 clips")[1]
    draw = script("draw_analysis")
    assert len(draw.draw_factors({"both": figures}).axes) == 2


@pytest.mark.slow
def test_constants_of_anchors(script: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Each choice has a line with its figures; anchors change them, and a tracker that never answers does not."""
    measure = script("measure_anchors")
    monkeypatch.setattr(measure, "OF_UFM", ({}, measure.ANCHORED))
    monkeypatch.setattr(measure, "OF_TRACKER", ({"min_views": 10},))
    monkeypatch.setattr("sys.argv", ["measure_anchors.py", "--tours", "201:202", "--frames", "8"])
    measure.main()
    lines = [line.strip("| \n").split(" | ") for line in capsys.readouterr().out.splitlines()]
    assert [name for name, *_ in lines] == ["UfM\\*", "anchored True", "min_views 10"]
    plain, anchored, never = (np.array(values, dtype=float) for _, *values in lines)
    assert (anchored != plain).all()
    np.testing.assert_array_equal(never, plain)


@pytest.mark.slow
def test_a_constant_of_the_posterior_variance_leaves_the_depth(script: Any) -> None:
    """A tiny tour and the network that is made of the truth: the depth stays, the variance follows the constant."""
    posterior = script("measure_posterior")
    prepared = posterior.prepare("tour:1?frames=6&size=96x128", None)
    for kind in (posterior.DENSE, posterior.NEAR):
        configs = (PosteriorConfig(unseen=value, prior_weight=1e6) for value in (0.0, 1.0))
        rows = (posterior.figures(prepared, kind, config) for config in configs)
        slow, fast = (dict(zip(posterior.FIGURES, row, strict=True)) for row in rows)
        assert fast["rmse"] == slow["rmse"] > 0
        assert abs(fast["nll"] - slow["nll"]) > 0.01
