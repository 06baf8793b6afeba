"""The examples of active learning and of wrapping a network."""

from __future__ import annotations

import math

import active_learning
import numpy as np
import pytest
import torch
import wrap_network

from ufmstar_torch import DepthPrediction


def test_scores_of_a_constant_network_are_known():
    """One view: the total is A plus the square of a fifth of the depth."""

    def network(x):
        return DepthPrediction(torch.full((1, 32, 48), 2.0), torch.full((1, 32, 48), 0.25))

    K = torch.tensor([[[40.0, 0, 23.5], [0, 40, 15.5], [0, 0, 1]]], dtype=torch.float64)
    images = [(torch.zeros(1, 3, 32, 48), None, torch.eye(4, dtype=torch.float64), K)]
    assert active_learning.scores(network, images, "aleatoric") == pytest.approx([0.25])
    assert active_learning.scores(network, images, "total") == pytest.approx([0.25 + 0.4**2])


@pytest.mark.slow
def test_the_loop_chooses_trains_and_judges(capsys):
    results = active_learning.main(seeds=1, frames=10, labels=4, steps=2)
    assert list(results) == ["before", "random", *active_learning.PARTS]
    assert all(len(rows) == 1 and math.isfinite(rows[0]) for rows in results.values())
    assert len({rows[0] for rows in results.values()}) > 2, "training and the choice change the error"
    heading, *lines = capsys.readouterr().out.splitlines()
    assert "RMSE [m]" in heading
    assert [line.split()[0] for line in lines] == ["before", "random", *["mean"] * 3]
    assert all("nan" not in line for line in lines), "of one seed"


def test_a_wrapped_network_has_a_better_posterior():
    rows = {name: metrics.compute() for name, metrics in wrap_network.main(frames=14).items()}
    assert rows["posterior"]["rmse"] < 0.9 * rows["UfM*"]["rmse"]
    assert np.isfinite(rows["UfM*"]["nll"])
