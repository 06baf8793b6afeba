"""docs/draw_anchors.py: what its maps hold where the network's error is known, and which of them share a scale."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ufmstar_torch.eval.tour.sequence import open_tour
from ufmstar_torch.prediction import DepthPrediction

DOCS = Path(__file__).resolve().parents[1] / "docs"
TOUR = "tour:300003?frames=12&size=96x128&sensor=0"
TOO_FAR = 1.25


class Biased:
    """Puts everything 25 % too far, on all frames alike: the truth by the image, at half the image's size."""

    def __init__(self, frames: list[Any]) -> None:
        self._known = {frame.image.tobytes(): frame.depth for frame in frames}

    def preprocess(self, image: torch.Tensor, K: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        half = torch.tensor([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]], dtype=torch.float64)
        return image, half @ K

    def __call__(self, image: torch.Tensor) -> DepthPrediction:
        truth = self._known[image[0].permute(1, 2, 0).numpy().tobytes()]
        # The pixel that ground truth is taken from, whichever of the four that is: their mean, nearly.
        depth = TOO_FAR * truth.reshape(48, 2, 64, 2).mean((1, 3))
        return DepthPrediction(torch.from_numpy(depth)[None])


@pytest.fixture(scope="module")
def script() -> Any:
    sys.path.insert(0, str(DOCS))
    yield importlib.import_module("draw_anchors")
    sys.path.remove(str(DOCS))


@pytest.fixture(scope="module")
def shot(script: Any) -> Any:
    frames = list(open_tour(TOUR))  # rendered once
    return script.last_shot(frames, Biased(frames))


def test_a_bias_of_known_size_is_measured_spread_and_corrected(shot: Any) -> None:
    r = 1 / TOO_FAR - 1
    assert shot.depth.shape == (48, 64)
    assert len(shot.measured) > 5
    assert np.median(shot.measured) == pytest.approx(r, abs=0.03)
    known = np.isfinite(shot.truth)
    assert np.median(shot.error[known] / shot.truth[known]) == pytest.approx(TOO_FAR - 1, rel=0.03)
    assert np.median(shot.bias) == pytest.approx(r, abs=0.05)
    left = np.abs(shot.corrected - shot.truth)[known]
    assert np.median(left) < 0.3 * np.median(shot.error[known])
    assert (shot.anchored >= shot.plain - 1e-6)[known].all()
    assert np.median(shot.anchored / shot.depth) == pytest.approx(-r, abs=0.06)
    assert np.median(shot.plain) < 0.9 * np.median(shot.anchored)


def test_what_is_compared_has_one_scale(script: Any, shot: Any) -> None:
    figure = script.draw(shot)
    panels = {axes.get_title().split("\n")[0].split(":")[0]: axes for axes in figure.axes if axes.get_title()}
    assert len(panels) == 8
    limits = {name: axes.images[0].get_clim() for name, axes in panels.items()}
    metres = ("true error", "σ of UfM*", "σ with anchors", "error of corrected depth")
    assert len({limits[name] for name in metres}) == 1
    (dots,) = panels[f"relative error at {len(shot.measured)} anchors"].collections
    np.testing.assert_array_equal(dots.get_array(), shot.measured)
    np.testing.assert_array_equal(dots.get_offsets(), shot.pixel)
    assert dots.get_clim() == limits["expected from them"] == limits["true relative error"]
    low, high = dots.get_clim()
    assert low == -high, "0 is the middle of the colours"
    np.testing.assert_allclose(panels["true error"].images[0].get_array().filled(np.nan), shot.error)


@pytest.mark.slow
def test_the_command_draws_a_tour(script: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    out = tmp_path / "anchors.jpg"
    monkeypatch.setattr(sys, "argv", ["draw_anchors.py", "--tour", "tour:7?frames=5&size=48x64", "--out", str(out)])
    script.main()
    assert out.stat().st_size > 10_000


def test_the_picture_is_there_and_small() -> None:
    assert 20_000 < (DOCS / "images" / "anchors.jpg").stat().st_size < 300_000
    assert "images/anchors.jpg" in (DOCS / "results" / "anchors.md").read_text()
