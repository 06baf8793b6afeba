"""docs/draw_cases.py: the paper's cases A to E by closed forms and by the oracle, and the picture of them."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import oracle
from ufmstar_torch.gaussian import pointwise_disagreement

DOCS = Path(__file__).resolve().parents[1] / "docs"
pytestmark = pytest.mark.numerics


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(DOCS))
    return importlib.import_module("draw_cases")


def test_pointwise_disagreement_is_the_trace_of_the_sample_covariance() -> None:
    points = np.random.default_rng(0).normal(size=(5, 7, 3))
    expected = [np.trace(np.cov(each.T)) for each in points]
    np.testing.assert_allclose(pointwise_disagreement(torch.tensor(points)).numpy(), expected, rtol=1e-12)
    same = torch.ones(4, 3, dtype=torch.float32)
    assert float(pointwise_disagreement(same)) == 0
    assert pointwise_disagreement(same).dtype == torch.float32
    for wrong in (torch.ones(1, 3), torch.ones(4, 2), torch.ones(3)):
        with pytest.raises(ValueError, match="points must be"):
            pointwise_disagreement(wrong)


def test_the_papers_cases(script: Any) -> None:
    """With a wrong estimate b: m_p = 2 b^2 where views differ by 2 b, m_g = b^2 where whole regions do."""
    b = script.WRONG
    cases = {name: script.Case.of(offsets) for name, offsets in script.OFFSETS.items()}
    error = {name: case.error for name, case in cases.items()}
    m_p = {name: case.pointwise for name, case in cases.items()}
    m_g = {name: case.gaussian for name, case in cases.items()}
    assert error == pytest.approx({"A": 0, "B": b, "C": b, "D": b, "E": 0})
    assert m_p == pytest.approx({"A": 0, "B": 2 * b**2, "C": 0, "D": 0, "E": 0})
    # A and C: no disagreement, with an error or without; B: both see it.
    assert (m_g["A"], m_g["B"], m_g["C"]) == pytest.approx((0, b**2, 0), abs=1e-9)
    # D and E: half of the region moves by 2 b, so the means of the two views are b apart.
    for name in ("D", "E"):
        assert b**2 / 4 < m_g[name] < b**2
    assert m_g["E"] == pytest.approx(by_oracle(cases["E"]), rel=1e-6)
    assert m_g["D"] == pytest.approx(by_oracle(cases["D"]), rel=1e-6)


def by_oracle(case: Any) -> float:
    """m_g from NumPy: the mean W2^2 to the barycenter of the views' Gaussians."""
    views = [view.numpy() for view in case.estimates]
    means = [view.mean(0) for view in views]
    covariances = []
    for view in views:
        values, vectors = np.linalg.eigh(np.cov(view.T))
        covariances.append(vectors @ np.diag(np.maximum(values, 1e-6)) @ vectors.T)
    centre, S = oracle.barycenter(means, covariances, [1.0, 1.0])
    return float(np.mean([oracle.w2_squared(centre, S, m, c) for m, c in zip(means, covariances, strict=True)]))


@pytest.mark.slow  # matplotlib
def test_the_picture_shows_every_case(script: Any, tmp_path: Path) -> None:
    figure = script.draw({name: script.Case.of(offsets) for name, offsets in script.OFFSETS.items()})
    assert [axes.get_title(loc="left")[:2] for axes in figure.axes[:5]] == ["A:", "B:", "C:", "D:", "E:"]
    assert [len(line.get_xdata()) for line in figure.axes[5].lines[:2]] == [5, 5]
    script.save_figure(figure, tmp_path / "cases.png")
    assert (tmp_path / "cases.png").stat().st_size > 10_000
