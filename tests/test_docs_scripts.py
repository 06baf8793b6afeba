"""The scripts of docs/results: closed forms of their figures, and runs on a tiny tour."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from ufmstar_torch import PosteriorConfig
from ufmstar_torch.eval.sequences.frame import Entry

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
    """A clip of a resting camera before a wall 2 m away; frame n's depth has the error ``error[n]`` [m]."""
    truth = np.full((len(error), 48, 64), 2.0, np.float32)
    depth = (truth + error[:, None, None]).astype(np.float32)
    return script("clips").Clip("wall", depth, None, truth, np.tile(np.eye(4), (len(error), 1, 1)), K)


def test_controls_keep_what_they_say(script: Any) -> None:
    """The scaled variance has the target mean; the shuffled one permutes the values within each frame."""
    disagreement, rng = script("measure_disagreement"), np.random.default_rng(0)
    variance = rng.uniform(0.1, 1, (3, 8, 9)).astype(np.float32)
    has_truth = rng.random((3, 8, 9)) < 0.7
    scaled = disagreement.scaled_to(2.5, variance, has_truth)
    assert scaled[has_truth].mean() == pytest.approx(2.5, rel=1e-6)
    mixed = disagreement.shuffled(variance, has_truth)
    for i in range(3):
        np.testing.assert_array_equal(np.sort(mixed[i][has_truth[i]]), np.sort(variance[i][has_truth[i]]))
        np.testing.assert_array_equal(mixed[i][~has_truth[i]], variance[i][~has_truth[i]])
    assert (mixed[has_truth] != variance[has_truth]).mean() > 0.5


def test_places_divide_the_pixels(script: Any) -> None:
    """The thirds of depth, and border, edges and the rest, each cover all pixels with ground truth."""
    clip = resting(script, np.linspace(0, 1, 5))
    clip.depth[:, 20:30, 20:40] *= 2
    places = script("measure_disagreement").places(clip)
    count = {name: int(mask.sum()) for name, mask in places.items()}
    assert sum(count[f"{name} third"] for name in ("nearest", "middle", "farthest")) == count["all"]
    assert count["border (16 px)"] + count["depth edges"] + count["the rest"] == count["all"]
    # The outline of the block inside the border: its first row and column, and those after its last.
    inside = np.zeros((48, 64), dtype=bool)
    inside[20, 20:40] = inside[30, 20:40] = inside[20:30, 20] = inside[20:30, 40] = True
    assert count["depth edges"] == 5 * int(inside.sum())


def test_the_tables_of_a_tour(script: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """Every table of a tour of six frames."""
    clip, ensemble = script("clips").clips(argparse.Namespace(root=None, tours="200:201", frames=6, fov=None))
    assert clip.aleatoric is None
    assert ensemble.aleatoric is not None
    for table in script("measure_disagreement").TABLES.values():
        table(ensemble, 4)
    printed = capsys.readouterr().out
    assert "| UfM*, shuffled within each frame |" in printed
    assert "| A + M, M shuffled |" in printed


@pytest.mark.parametrize(
    ("name", "wrong", "pointwise", "gaussian"),
    [("A", 0, 0, 0), ("B", 1, 1, 1), ("C", 1, 0, 0), ("D", 1, 0, 1), ("E", 0, 0, 1)],
)
def test_the_papers_cases_of_disagreement(script: Any, name: str, wrong: int, pointwise: int, gaussian: int) -> None:
    """Each case's error and disagreements are zero (0) or not (1), as the paper orders them."""
    case = script("draw_disagreement_cases").make_case(name)
    assert (case.error > 0.2) == wrong
    assert (case.error < 1e-9) != wrong
    for value, high in ((case.pointwise, pointwise), (case.gaussian, gaussian)):
        assert (value > 0.04) == high
        assert (abs(value) < 1e-12) != high


def test_the_gaussian_disagreement_of_a_part_is_below_that_of_the_whole(script: Any) -> None:
    """D and E lie between A and B, and B's disagreements are those of two points .6 m apart."""
    a, b, d, e = (script("draw_disagreement_cases").make_case(name) for name in "ABDE")
    assert a.gaussian < e.gaussian < d.gaussian < b.gaussian
    assert (b.pointwise, b.gaussian) == (pytest.approx(0.6**2 / 2), pytest.approx(0.3**2))


def test_settings_and_constants_of_the_posterior_change(script: Any) -> None:
    """Both are changed by name, and the others stay."""
    changed, config = script("measure_posterior").changed, PosteriorConfig()
    assert (changed(config, half_life=10.0).half_life, changed(config, discs=6).discs) == (10.0, 6)
    assert script("measure_posterior").with_change(config, "discs=6").discs == 6
    one = changed(config, drift=0.1)
    assert (one.drift, one.half_life, one.discs) == (0.1, config.half_life, config.discs)


@pytest.mark.slow
def test_a_constant_of_the_posterior_variance_leaves_the_depth(script: Any) -> None:
    """With a network of corrupted truth, the constant changes the variance and not the depth."""
    posterior = script("measure_posterior")
    prepared = posterior.prepare("tour:1?frames=6&size=96x128", True)
    for kind in (posterior.DENSE, posterior.NEAR):
        configs = (posterior.changed(PosteriorConfig(), unseen=value, prior_weight=1e6) for value in (0.0, 1.0))
        rows = (posterior.figures(prepared, kind, config) for config in configs)
        slow, fast = (dict(zip(posterior.FIGURES, row, strict=True)) for row in rows)
        assert fast["rmse"] == slow["rmse"] > 0
        assert abs(fast["nll"] - slow["nll"]) > 0.01


@pytest.mark.slow
def test_the_table_of_confidences(script: Any, capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    """Every unit and source has a row, and an unused confidence changes nothing."""
    words = ["measure_confidence.py", "--tours", "1?style=home", "--frames", "2"]
    monkeypatch.setattr("sys.argv", words)
    script("measure_confidence").main()
    rows = {
        line.split("|")[1].strip(): line.split("|")[2:] for line in capsys.readouterr().out.splitlines() if "|" in line
    }
    assert len(rows) == 14
    assert rows["dense: random"] == rows["dense: today"] != rows["dense: A, in metres"]


def test_distances_of_clouds(script: Any, tmp_path: Path) -> None:
    """An exported plane 3 cm before the true one; a tenth of its points are 50 cm off."""
    from ufmstar_torch.eval.run.gaussians import vertex_table, write_ply

    plane = np.stack([*np.meshgrid(np.arange(20) / 100, np.arange(20) / 100), np.ones((20, 20))], -1).reshape(-1, 3)
    moved = plane + np.array([0, 0, 0.03])
    moved[:36] += [0, 0, 0.5]
    for name, points in (("truth", plane), ("cloud", moved)):
        kinds = dict.fromkeys(("x", "y", "z"), "<f8") | {"sigma": "<f4"}  # as `ufmstar export`
        table = vertex_table(kinds, points, np.ones((400, 1)))
        write_ply(tmp_path / f"{name}.ply", table, "x y z sigma [m]")
    clouds = script("measure_clouds")
    read = [clouds.read_points(tmp_path / f"{name}.ply") for name in ("cloud", "truth")]
    np.testing.assert_allclose(read[0], moved, atol=1e-6)
    median, most, back = clouds.distances(*read)
    assert median == pytest.approx(3, abs=1e-3)
    assert most == pytest.approx(3, abs=1e-3)
    assert back == pytest.approx(3, abs=0.5)


def test_the_times_of_streams(script: Any, capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    monkeypatch.setattr("sys.argv", ["measure_streams.py", "1", "3", "--frames", "1"])
    script("measure_streams").main()
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == ["1 streams at once", "3 streams at once"]
    assert all(float(line.split()[-2]) > 0 for line in lines)


def test_stated_outliers_are_found_where_the_mixture_is_right(script: Any) -> None:
    """Errors drawn from the mixture lie beyond three standard deviations of the inliers as often as stated, which is
    less often than the probability: outliers may have small errors."""
    rng, n = np.random.default_rng(0), 200_000
    p, inlier = rng.uniform(0, 1, n), rng.uniform(0.01, 0.1, n)
    outlier = inlier * rng.uniform(16, 60, n)
    error = rng.normal(size=n) * np.sqrt(np.where(rng.random(n) < p, outlier, inlier))
    d = np.full(n, 5.0)
    table = script("measure_movers").outliers(np.stack([d, (1 - p) * inlier + p * outlier, inlier, p, d + error], 1))
    share, mean, stated, found = table.T
    np.testing.assert_allclose(found, stated, atol=0.01)
    assert share.sum() == pytest.approx(1)
    assert (found[2:] < 0.75 * mean[2:]).all()


@pytest.mark.parametrize(
    ("noise", "sigma"), [(None, 0.0), ("stereo", 0.001 + 0.003 * 2.5**2), ("tof", 0.01 + 0.01 * 2.5)]
)
def test_half_of_a_depth_camera_s_depth_is_removed(script: Any, noise: str | None, sigma: float) -> None:
    """Each reason removes about a sixth, no pixel is removed twice, and the rest has the noise of the sensor."""
    sensor, depth = script("measure_sensor"), np.full((240, 320), 2.5, np.float32)
    depth[100:180, 200:300], depth[:80], depth[220:, :30] = 1.5, np.linspace(5, 4, 80)[:, None], 0
    causes = sensor.removed(depth, 0)
    gone = np.stack([*causes.values()])
    assert gone.sum(0).max() == 1
    assert not gone[:, depth == 0].any()
    shares = gone.sum((1, 2)) / (depth > 0).sum()
    assert shares.sum() == pytest.approx(0.5, abs=0.03)
    assert causes["far"].any()
    assert depth[causes["far"]].min() > 4
    left = sensor.rest(Entry("0", np.eye(4), None, depth.copy), 0, noise)
    np.testing.assert_array_equal(left > 0, (depth > 0) & ~gone.any(0))
    image = np.repeat(np.linspace(0, 255, 320, dtype=np.uint8)[None, :, None], 240, 0).repeat(3, 2)
    assert np.nonzero(sensor.removed(depth, 0, image)["holes"])[1].max() < 120, "the darkest surfaces"
    wall = left[(left > 0) & (depth == 2.5)]
    assert wall.std() == pytest.approx(sigma, rel=0.1)
    assert wall.mean() == pytest.approx(2.5, abs=0.01)
