"""The example train_own_head.py, with a few frames."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import train_own_head as example

EXAMPLE = Path(example.__file__)


@pytest.mark.slow
def test_its_table_has_every_row(tmp_path, capsys, monkeypatch):
    few = {"tours": 1, "validation_tours": 1, "tour_frames": 4, "cache": str(tmp_path)}
    monkeypatch.setattr(example, "DATA", replace(example.DATA, **few))
    monkeypatch.setattr(example, "ROOMS", ("tour:1?frames=3&size=96x128",))
    train = example.train_module
    monkeypatch.setattr(
        example, "train_module", lambda *a, **o: train(*a, **o, batch_size=4, settings={"progress": False})
    )
    figures = example.main(["--out", str(tmp_path / "out"), "--epochs", "1"])
    rows = ["constant", "UfM* without head", "head: network", "head: ufmstar", "head: posterior"]
    assert list(figures) == rows
    assert all(math.isfinite(row[name]) for row in figures.values() for name in example.LOGGED)
    assert [line[:18].strip() for line in capsys.readouterr().out.splitlines() if line.startswith(tuple(rows))] == rows
    # The head does not change the depth.
    assert figures["constant"]["rmse"] == pytest.approx(figures["head: network"]["rmse"], rel=1e-6)
    assert len(EXAMPLE.read_text().splitlines()) < 60
