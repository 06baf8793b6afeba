"""docs/draw_gain.py: which rows are compared, and that it draws them."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ufmstar_torch.eval.suite.record import Record

DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.fixture
def gain(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(DOCS))
    return importlib.import_module("draw_gain")


def record(sequence: str, method: str, nll: float, over: float = 0.0) -> Record:
    figures = {"nll": nll, "ece_delta": 2 * nll, "ece_q": 3 * nll, "overconfidence": over}
    return Record("own", "tum", sequence, "FastDepth", method, figures=figures)


def test_a_point_is_ufm_star_less_the_network_alone_on_the_same_sequence(
    gain: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows of UfM, of another sequence, of depth alone and without a partner make no point."""
    records = [
        record("a", "MC-Dropout", 2.0, over=0.25),
        record("a", "UfM-MCD", 7.0),
        record("a", "UfM*-MCD", 1.5, over=9.0),
        record("b", "UfM*-MCD", 0.5),
        record("b", "Aleatoric", 0.5, over=0.5),
        record("b", "DepthOnly", 0.5),
        record("b", "UfM*-DepthOnly", 0.5),
    ]
    monkeypatch.setattr(gain, "load_results", lambda folder, with_sums: SimpleNamespace(records=records))
    assert gain.points([Path("a"), Path("a")]) == 2 * [
        ("mc_dropout", 0.25, {"nll": -0.5, "ece_delta": -1.0, "ece_q": -1.5})
    ]


def test_draws_both_kinds(gain: Any, tmp_path: Path) -> None:
    point = ("ensemble", 0.3, {"nll": -1.0, "ece_delta": -0.1, "ece_q": -0.01})
    out = tmp_path / "gain.png"
    gain.draw([point], [point, point]).savefig(out)
    assert out.stat().st_size > 1000
