"""docs/thresholds.md: its code block runs, and its script counts right."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest
import torch
from pages import blocks
from test_intervals import CONFIG, K, frames

from ufmstar_torch import UfMStar
from ufmstar_torch.frames.prediction import DepthPrediction

DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    return importlib.import_module("measure_thresholds")


@pytest.fixture(scope="module")
def outputs():
    ufm = UfMStar(CONFIG)
    return [ufm(depth, T, K, anchors=anchors) for depth, T, anchors in frames(n=8)]


def frame_of(script, out, truth):
    return script.Frame(np.zeros((48, 64, 3), np.uint8), out, torch.full(out.depth.shape[1:], truth))


def test_the_planner_of_the_page_brakes_before_a_near_wall(outputs):
    """The wall is 2 m away; its image is as large as the page's map."""

    class Model:
        """Returns the last output, with depth and variance of a wall at a given distance."""

        def __init__(self, scale):
            self.scale = scale

        def __call__(self, image, pose, K):
            from dataclasses import replace

            last = outputs[-1]
            wide = {n: v.expand(1, 36, 48).mean().expand(1, 224, 224) for n, v in
                    {"depth": last.depth, "variance": last.variance, **last.maps}.items()}  # fmt: skip
            d, V = self.scale * wide.pop("depth"), self.scale**2 * wide.pop("variance")
            maps = wide | {"posterior_inlier_variance": 0.5 * V}
            return replace(last, depth=d, variance=V, maps=maps, prediction=DepthPrediction(d))

    (code,) = blocks((DOCS / "thresholds.md").read_text())
    body = code.split("\n", 1)[1]
    for scale, expected in ((1.0, False), (0.4, True)):
        scope = {"model": Model(scale), "video": [(None, None, None)]}
        exec(compile(body, "thresholds.md", "exec"), scope)
        assert bool(scope["brake"]) == expected


def test_rules_of_a_wall(script, outputs):
    found = {name: bool(near.double().mean() > 0.5) for name, near in script.rules(outputs[-1], 1.75).items()}
    assert found["network: d < x"], "the network sees the wall at 1.54 m"
    assert not found["posterior: d < x"]
    assert not found["P(nearer than x) > 0.5"]
    assert script.rules(outputs[-1], 2.5)["P(nearer than x) > 0.5"].all()
    assert "P(nearer than x) > 0.5" not in script.rules(outputs[0], 2.5), "no evidence yet"


def test_gates_divide_the_pixels_and_state_their_errors(script, outputs):
    frame, out = frame_of(script, outputs[-1], 2.0), outputs[-1]
    depth = out.network_depth[0]
    parts = script.gates(depth, (0.07 * depth).square(), frame)
    assert [len(part) for part in parts] == [0, depth.numel(), 0, 0]
    torch.testing.assert_close(parts[1], torch.full_like(parts[1], 0.3 / 1.3), rtol=1e-5, atol=0)


def test_fitted_factors_give_the_target_coverage(script):
    rng = torch.Generator().manual_seed(0)
    z = torch.randn(20_000, 1, generator=rng, dtype=torch.float64).abs()
    at_anchors = torch.tensor([[0.5, 1.5, 2.0]], dtype=torch.float64).expand(len(z), 3)
    factors = script.fitted([torch.cat([z, at_anchors], 1)])
    for factor, anchors, target in zip(factors, (0.5, 1.5, 2.0), script.TARGETS, strict=True):
        assert float((z <= factor * anchors).double().mean()) == pytest.approx(target, abs=0.005)


def test_stops_are_counted(script):
    stops = script.Stops()
    for truth, stop in ((True, True), (True, False), (False, True), (False, False), (False, False)):
        stops.add(truth, stop)
    assert stops.counts.tolist() == [2, 3, 1, 1]
