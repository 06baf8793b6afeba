"""The example tsdf.py: weighted averages of views, and a small error for a run with exact depth."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import tsdf as example

from ufmstar_torch import cli


def view(depth, sigma):
    maps = {"depth": np.full((40, 40), depth), "sigma": np.full((40, 40), sigma)}
    K = np.array([[40.0, 0, 19.5], [0, 40, 19.5], [0, 0, 1]])
    return SimpleNamespace(T_world_cam=np.eye(4), intrinsics=K, **maps)


def test_views_are_averaged_by_their_weights():
    """Planes at 2 m (sigma 0.1 m) and 2.2 m (0.2 m): at 2.1 m, or with weights 100 and 25 at 2.04 m."""
    low = np.array([-0.4, -0.4, 1.01])
    sums = example.fuse([view(2.0, 0.1), view(2.2, 0.2)], low, (10, 10, 25))
    for name, depth in (("all alike", 2.1), ("1/sigma^2", 2.04)):
        points = example.surface(*sums[name], low)
        assert len(points) == 100
        np.testing.assert_allclose(points[:, 2], depth, atol=1e-9)


@pytest.mark.slow
def test_the_example(tmp_path, capsys):
    out = tmp_path / "out"
    words = [
        "run",
        "tour:5?frames=8&size=60x80",
        "--depth",
        "self",
        "--plain",
        "--no-video",
        "--no-sheet",
        "--out",
        str(out),
    ]
    assert cli.main(words) == 0
    counted = example.main(out)
    assert "no ground truth, so no error" in capsys.readouterr().out
    assert all(points > 100 for points in counted.values())
    results = example.main(out, words[1])
    assert "1/sigma^2  best half" in capsys.readouterr().out
    assert all(error < 100 * example.VOXEL for (_, part), (error, _) in results.items() if part == "best half")
