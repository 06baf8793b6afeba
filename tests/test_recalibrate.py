"""Recalibration of the variance: the map's form, its fit to counts, and its use in recalibrate, run and the module."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_suite import write_network, write_rooms

from ufmstar_torch import Recalibration, UfMStar, UfMStarConfig, cli
from ufmstar_torch.eval.metrics.ranking import SpearmanCorrelation
from ufmstar_torch.eval.metrics.recalibration import figures, fit

MAP = Recalibration((0.01, 0.1, 1.0), (0.2, 0.2, 4.0))


def counts(variance, z):
    """Counts [V, e] of pixels with squared errors V z^2, as in the metric."""
    metric, depth = SpearmanCorrelation(), torch.full_like(variance, 50.0)
    metric.update(depth, variance, depth + z)
    return metric.joint.double().numpy()


def drawn(variance, scale, seed=0):
    """Counts of errors drawn from N(0, scale)."""
    noise = torch.from_numpy(np.random.default_rng(seed).standard_normal(len(variance)))
    return counts(variance, noise * torch.as_tensor(scale).sqrt())


# ---- the map ----


def test_the_map_is_linear_in_logarithms_between_its_knots():
    v = torch.tensor([0.0, 1e-6, 0.01, 0.1, 0.1 * math.sqrt(10), 1.0, 7.0, math.nan], dtype=torch.float64)
    expected = [0.2, 0.2, 0.2, 0.2, math.sqrt(0.2 * 4.0), 4.0, 28.0]
    torch.testing.assert_close(MAP(v)[:-1], torch.tensor(expected, dtype=torch.float64), rtol=1e-12, atol=0)
    assert MAP(v)[-1].isnan()
    assert MAP(v.float()).dtype == torch.float32
    assert MAP(v.reshape(2, 4)).shape == (2, 4)


@given(
    knots=st.lists(st.floats(1e-6, 1e6), min_size=1, max_size=8, unique=True),
    steps=st.lists(st.floats(0, 10), min_size=8, max_size=8),
    v=st.lists(st.floats(0, 1e8), min_size=2, max_size=20),
)
def test_the_map_never_reverses_an_order(knots, steps, v):
    recalibrated = tuple(float(x) for x in np.cumsum(steps)[: len(knots)] + 0.1)
    mapped = Recalibration(tuple(sorted(knots)), recalibrated)(torch.tensor(sorted(v), dtype=torch.float64))
    assert (mapped.diff() >= -1e-9 * mapped[1:]).all()
    assert (mapped > 0).all()


def test_a_file_comes_back(tmp_path):
    file = tmp_path / "map.json"
    MAP.save(file)
    assert Recalibration.from_json(file) == MAP
    file.write_text(json.dumps({"variance": [1], "recalibrated": [1], "colour": "red"}))
    with pytest.raises(ValueError, match="colour"):
        Recalibration.from_json(file)
    file.write_text("[" * 200_000)
    with pytest.raises(ValueError, match=r"map\.json is not JSON: its values are nested too deep"):
        Recalibration.from_json(file)


# ---- the fit ----


def test_an_isotonic_fit_recovers_a_monotone_law_and_gives_zero_a_value():
    v = torch.from_numpy(np.exp(np.random.default_rng(2).uniform(-6, 0, 400_000)))
    v[:20_000] = 0.0
    law = 0.04 + 2 * v
    fitted = fit([drawn(v, law)])
    at = torch.tensor([0.0, 0.01, 0.05, 0.3], dtype=torch.float64)
    torch.testing.assert_close(fitted(at), 0.04 + 2 * at, rtol=0.12, atol=0)
    before, after = (figures(drawn(v, law, seed=3), map_) for map_ in (None, fitted))
    assert before["zero_share"] == pytest.approx(0.05)
    assert after["zero_share"] == 0
    assert after["coverage_error"] < 0.01 < before["coverage_error"]
    exact = (0.5 * ((2 * math.pi * law).log() + 1)).mean()
    assert after["nll"] == pytest.approx(float(exact), abs=0.04)


def test_every_sequence_has_the_same_weight():
    v = torch.full((1000,), 0.1, dtype=torch.float64)
    short, long = drawn(v, v), drawn(v.repeat(50), 9 * v.repeat(50), seed=5)
    one, other = fit([short, long]).recalibrated[0], fit([short, long / 50]).recalibrated[0]
    assert one == pytest.approx(other)


# ---- the module ----


def test_the_module_maps_v_and_nothing_else():
    generator = torch.Generator().manual_seed(0)
    depth = 2 + torch.rand(2, 1, 24, 32, generator=generator)
    T, K = torch.eye(4, dtype=torch.float64)[None], torch.tensor([[30.0, 0, 15.5], [0, 30, 11.5], [0, 0, 1]])[None]
    plain, mapped = UfMStar(UfMStarConfig()), UfMStar(UfMStarConfig(), recalibration=MAP)
    for frame in depth:
        a = torch.full_like(frame, 0.02)
        one, other = plain(frame, T, K, a), mapped(frame, T, K, a)
    torch.testing.assert_close(other.variance, MAP(one.variance), rtol=0, atol=0, equal_nan=True)
    torch.testing.assert_close(other.disagreement, one.disagreement, rtol=0, atol=0, equal_nan=True)
    mean, mapped_mean = (ufm.mean_uncertainty(depth[1], T, K, a, pixels=768) for ufm in (plain, mapped))
    assert float(mapped_mean.mean) > float(mean.mean)


def test_other_settings_and_another_network_are_refused():
    fitted = Recalibration((1.0,), (2.0,), ufm=UfMStarConfig(ema_alpha=0.5, on_bad_frame="skip").to_dict(), network="a")
    UfMStar(UfMStarConfig(ema_alpha=0.5, backend="torch"), recalibration=fitted)
    with pytest.raises(ValueError, match=r"ema_alpha = 0\.5 \(now 1\.0\)"):
        UfMStar(UfMStarConfig(ema_alpha=1.0), recalibration=fitted)
    fitted.require(UfMStarConfig(ema_alpha=0.5), "a")
    with pytest.raises(ValueError, match="fitted to the network a, not b"):
        fitted.require(UfMStarConfig(ema_alpha=0.5), "b")


# ---- the commands ----


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    """An evaluation of a tiny network on two of three sequences: (sequences, weights, folder)."""
    root = tmp_path_factory.mktemp("recalibrate")
    rooms, weights = write_rooms(root / "rooms", frames=3), write_network(root / "net.safetensors", "depth")
    words = eval_words(weights, root / "out", rooms / "ash", rooms / "birch")
    assert cli.main(words) == 0
    return rooms, weights, root / "out"


def eval_words(weights, out, *roots):
    words = ["eval", "--suite", "depth-only", "--network", f"depth_only=trained:{weights}", "--no-report"]
    return [*words, *(w for r in roots for w in ("--root", f"rooms={r}")), "--out", str(out)]


def test_a_fit_to_an_evaluation(evaluated, tmp_path, capsys):
    out = evaluated[2]
    file = tmp_path / "map.json"
    assert cli.main(["recalibrate", str(out), "--row", "UfM*-DepthOnly", "--to", str(file)]) == 0
    printed = capsys.readouterr().out
    assert "rooms/ash" in printed
    assert "fitted to 2 sequences" in printed
    fitted = Recalibration.from_json(file)
    assert fitted.row == "UfM*-DepthOnly"
    assert fitted.sequences == ("rooms/ash", "rooms/birch")


def test_run_applies_the_map(evaluated, tmp_path, capsys):
    rooms, weights, out = evaluated
    default = ["run", str(rooms / "cedar"), "--model", "trained", "--weights", str(weights), "--no-video", "--no-sheet"]
    words, file = [*default, "--plain"], tmp_path / "map.json"
    mapping = ["--recalibration", str(file)]
    assert cli.main([*words, "--out", str(tmp_path / "plain")]) == 0
    assert cli.main(["recalibrate", str(out), "--row", "UfM*-DepthOnly", "--to", str(file)]) == 0
    assert cli.main([*words, *mapping, "--out", str(tmp_path / "mapped")]) == 0
    assert cli.main(["run", str(rooms / "ash"), *words[2:], *mapping, "--out", str(tmp_path / "fitted")]) == 0
    capsys.readouterr()
    assert cli.main([*default, *mapping, "--out", str(tmp_path / "corrected")]) == 2
    assert "anchors.half_life = None (now 30.0)" in capsys.readouterr().err
    assert cli.main([*words, *mapping, "--out", str(tmp_path / "other"), "--set", "ema_alpha=0.7"]) == 2
    assert "ema_alpha = " in capsys.readouterr().err
    assert cli.main([*words, *mapping, "--out", str(tmp_path / "plain")]) == 2, "another run"
    assert cli.main([*words, "--recalibration", str(tmp_path / "none.json"), "--out", str(tmp_path / "none")]) == 2
    fitted, other = (json.loads((tmp_path / n / "summary.json").read_text())["warnings"] for n in ("fitted", "mapped"))
    assert any("was fitted to this sequence" in text for text in fitted)
    assert not any("was fitted to this sequence" in text for text in other)
    plain, mapped = (
        np.stack([np.load(path)["variance"] for path in sorted((tmp_path / name / "frames").glob("*.npz"))])
        for name in ("plain", "mapped")
    )
    assert (mapped[np.isfinite(mapped)] > 0).all()
    assert not np.array_equal(plain, mapped, equal_nan=True)


MISTAKES = {
    "no such row": (["--row", "UfM*-Ensemble"], "--row must be one of UfM*-DepthOnly"),
    "not UfM*": (["--row", "UfM-DepthOnly"], "--row must be one of UfM*-DepthOnly"),
}


@pytest.mark.parametrize(("words", "message"), MISTAKES.values(), ids=MISTAKES)
def test_mistakes_are_one_line(evaluated, tmp_path, capsys, words, message):
    assert cli.main(["recalibrate", str(evaluated[2]), "--to", str(tmp_path / "m.json"), *words]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "m.json").exists()
