"""Online training: the statistics of an image, the decision, and the example."""

from __future__ import annotations

import math

import numpy as np
import online_training as example
import pytest
import torch
from train_decision import TrainDecision, image_statistics

import scenes
from ufmstar_torch import AnchorConfig, UfMStar, UfMStarConfig
from ufmstar_torch.anchors import Anchors

DEPTHS, POSES, K = scenes.sequence(2, 48, 64, 0.05)


def statistics_of(config, motion=None, **inputs):
    ufm = UfMStar(config)
    for depth, pose in zip(DEPTHS, POSES, strict=True):
        d = torch.tensor(depth)[None]
        result = ufm.mean_uncertainty(d, torch.tensor(pose), torch.tensor(K), 0.04 * torch.ones_like(d), **inputs)
    return result, image_statistics(result, torch.eye(4) if motion is None else motion)


def test_statistics_are_of_depth_parts_motion_and_landmarks():
    c, s = math.cos(0.3), math.sin(0.3)
    motion = torch.tensor([[c, -s, 0, 0.6], [s, c, 0, 0], [0, 0, 1, 0.8], [0, 0, 0, 1]])
    result, plain = statistics_of(UfMStarConfig(backend="torch"), motion)
    assert len(plain) == 4 * 4 + 4  # V, M, A and depth; measured pixels, motion and landmarks
    depth = float(result.depth.mean)
    expected = [float(result.measured), 1 / depth, 0.3, 0]
    np.testing.assert_allclose(plain[-4:], expected, rtol=1e-5)
    assert float(plain[8]) == pytest.approx(math.log(0.04), rel=1e-4), "the mean of A"
    assert float(plain[12]) == pytest.approx(math.log(depth), rel=1e-5)
    anchors = Anchors(
        torch.tensor([[[20.0, 20.0], [40.0, 30.0]]]), torch.tensor([[2.0, 2.5]]), torch.tensor([[1e-4, 1e-4]])
    )
    result, anchored = statistics_of(UfMStarConfig(anchors=AnchorConfig()), anchors=anchors)
    assert len(anchored) == len(plain) + 4, "and B"
    assert float(anchored[-1]) == pytest.approx(2 / int(result.statistics.valid_pixels))
    assert bool(anchored.isfinite().all())


def images(count, seed=0):
    """Statistics [count, 5] of images, and the gain of an update on each: .1 times the second statistic, and noise."""
    rng = np.random.default_rng(seed)
    x = torch.from_numpy(rng.normal(size=(count, 5)))
    return x, 0.1 * x[:, 1] + 0.01 * torch.from_numpy(rng.normal(size=count))


def test_the_expected_gain_is_that_of_ridge_regression():
    x, gain = images(30)
    decision = TrainDecision(0.05, half_life=1e9)
    for one, value in zip(x, gain, strict=True):
        decision.learn(one, float(value))
    z, y = (x - x.mean(0)) / x.std(0, correction=0), gain - gain.mean()
    weights = torch.linalg.solve(z.T @ z + torch.eye(5), z.T @ y)
    new = torch.tensor([0.3, 1.0, -0.5, 0.2, 0.0])
    expected = gain.mean() + (new - x.mean(0)) / x.std(0, correction=0) @ weights
    mean, error = decision.expected(new)
    assert mean == pytest.approx(float(expected), rel=1e-6)
    assert mean == pytest.approx(0.1, abs=4 * error)
    assert 0 < error < 0.02


def test_it_trains_where_that_pays():
    x, gain = images(300)
    decision, chosen = TrainDecision(0.05), []
    for i, (one, value) in enumerate(zip(x, gain, strict=True)):
        chosen.append(decision(one))
        if chosen[-1]:
            decision.learn(one, float(value))
        assert chosen[i] or i >= decision.first
    late = torch.tensor(chosen[100:])
    pays = gain[100:] > 0.05
    assert (late == pays).double().mean() > 0.9
    assert decision.updates == sum(chosen) < 150
    free = TrainDecision(-1.0)
    for one, value in zip(x[:20], gain, strict=False):
        free.learn(one, float(value))
    assert all(free(one) for one in x), "with a negative cost every update is made"


def test_old_updates_fade():
    x, gain = images(400)
    decision = TrainDecision(0.0, half_life=10.0)
    for sign, part in ((1, slice(0, 200)), (-1, slice(200, 400))):
        for one, value in zip(x[part], gain[part], strict=True):
            decision.learn(one, sign * float(value))
    assert decision.expected(torch.tensor([0.0, 1, 0, 0, 0]))[0] == pytest.approx(-0.1, abs=0.03)


def test_what_makes_no_sense_is_refused():
    decision = TrainDecision(0.1)
    decision.learn(torch.ones(3), 1.0)
    for statistics, gain in ((torch.ones(4), 1.0), (torch.ones(3), math.nan)):
        with pytest.raises(ValueError, match=r"3 finite values as before|gain and statistics must be finite"):
            decision.learn(statistics, gain)
    huge = torch.full((3,), 1e200, dtype=torch.float64)
    for call, message in (
        (lambda: decision.learn(huge, 1.0), "also their squares"),
        (lambda: decision.expected(torch.ones(4)), "3 finite values as before"),
        (lambda: decision.expected(torch.full((3,), math.nan)), "3 finite values as before"),
        (lambda: TrainDecision(math.nan), "cost must be finite, first at least 2"),
        (lambda: TrainDecision(0.1, first=1), "cost must be finite, first at least 2"),
        (lambda: TrainDecision(0.1, half_life=0.0), "cost must be finite, first at least 2"),
        (lambda: TrainDecision(0.1).expected(torch.ones(3)), r"call learn\(\) first"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.slow
def test_the_example_counts_its_updates(capsys):
    results = example.main(walks=1, frames=10, cost=9.0)
    assert {name: row[0] for name, [row] in results.items()} == {"decided": 8, "random": 8, "all": 10, "none": 0}
    assert results["random"] == results["decided"], "the same images give the same error"
    assert len({row[1] for [row] in results.values()}) == 3
    heading, *lines = capsys.readouterr().out.splitlines()
    assert "RMSE [m]" in heading
    assert [line.split()[0] for line in lines] == list(results)
    assert all("nan" not in line for line in lines), "of one walk"
