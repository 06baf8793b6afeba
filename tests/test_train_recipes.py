"""Recipes of a training and its arithmetic: presets, options, schedule, losses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.train import PRESETS, DataConfig, FitSettings, Job, Recipe, preset
from ufmstar_torch.train.member import new_network
from ufmstar_torch.train.module import move_average, share_of_rate
from ufmstar_torch.train.presets import TRAINING
from ufmstar_torch.train.progress import Sums, Validation


def test_every_method_of_the_paper_is_a_preset_of_both_architectures():
    methods = {"depth-only", "aleatoric", "evidential", "mc-dropout", "ensemble", "batch-ensemble"}
    assert set(PRESETS) == {f"{a}-{m}" for a in ("monodepth2", "fastdepth") for m in methods} | {
        "demo", "fastdepth-ufmstar",
    }  # fmt: skip
    for name, recipe in PRESETS.items():
        if name in ("demo", "fastdepth-ufmstar"):
            continue
        # Section VII, and the heads' size from table 1.
        assert (recipe.network.size, recipe.epochs, recipe.weight_decay) == ((224, 224), 50, 1e-4)
        assert (recipe.beta1, recipe.beta2) == (0.9, 0.999)
        assert recipe.network.dropout == 0.2
        assert max(recipe.members, recipe.network.members) == (10 if "ensemble" in name else 1)
        assert recipe.learning_rate == TRAINING[recipe.network.architecture]["learning_rate"]
        heads = recipe.network.architecture == "monodepth2" and recipe.network.method != "depth"
        assert recipe.network.head_scales == (4 if heads else 1)
    # DecTrain's.
    assert (preset("monodepth2-ensemble").batch_size, preset("monodepth2-ensemble").learning_rate) == (4, 1e-4)


def test_members_are_the_ensembles_or_the_batch_ensembles():
    assert preset("fastdepth-ensemble").with_members(3).members == 3
    recipe = preset("fastdepth-batch-ensemble").with_members(3)
    assert (recipe.members, recipe.network.members) == (1, 3)


def test_ensembles_of_different_seeds_share_no_member(tmp_path):
    job = Job(preset("demo"), DataConfig(kind="tour"), FitSettings(out=tmp_path))
    jobs = [replace(job, settings=replace(job.settings, seed=seed)) for seed in range(3)]
    assert len({j.seed(member) for j in jobs for member in range(1000)}) == 3 * 1000
    assert [job.seed(member) for member in range(10)] == list(range(10))
    # The seed determines the weights: one ensemble's second member differs from the next seed's first.
    second, first = new_network(jobs[0], 1), new_network(jobs[1], 0)
    key = "backbone.encoder.0.conv.weight"
    assert not torch.equal(second.state_dict()[key], first.state_dict()[key])
    with pytest.raises(ValueError, match=r"Recipe\.members must lie in \[1, 1000\]"):
        Recipe(members=1001)


def test_the_learning_rate_rises_and_falls_as_a_cosine():
    recipe = Recipe(warmup_steps=4)
    rates = [share_of_rate(step, 24, recipe) for step in range(24)]
    assert rates[:4] == pytest.approx([0.2, 0.4, 0.6, 0.8])
    assert rates[4:] == pytest.approx([(1 + math.cos(math.pi * n / 20)) / 2 for n in range(20)])
    assert share_of_rate(30, 24, recipe) == 0
    assert share_of_rate(1000, 24, replace(recipe, schedule="constant")) == 1


def test_the_running_mean_is_the_one_by_hand():
    averaged, network = nn.BatchNorm1d(2), nn.BatchNorm1d(2)
    expected = torch.ones(2)
    for n in range(5):
        with torch.no_grad():
            network.weight.fill_(n)
            network.num_batches_tracked.fill_(n)
        move_average(averaged, network, 0.75)
        expected = 0.75 * expected + 0.25 * n
    torch.testing.assert_close(averaged.weight.detach(), expected)
    assert averaged.num_batches_tracked == 4


def test_the_yardstick_is_the_likelihood_of_one_variance():
    generator = torch.Generator().manual_seed(0)
    depth = 1 + torch.rand(2, 5, 7, generator=generator, dtype=torch.float64)
    predicted = depth + torch.randn(2, 5, 7, generator=generator, dtype=torch.float64) / 3
    valid = torch.rand(2, 5, 7, generator=generator) < 0.6
    variance = torch.full_like(depth, 0.3)
    validation, alone = Validation(), Validation()
    for n in range(2):
        maps = (value[n : n + 1] for value in (predicted, 0.25 * variance, 0.75 * variance))
        validation.update(DepthPrediction(*maps), depth[n : n + 1], valid[n : n + 1])
    error, truth = (predicted - depth)[valid].numpy(), depth[valid].numpy()
    figures = validation.figures(Sums(torch.tensor([0.3 * 11, 11], dtype=torch.float64)))
    normal = torch.distributions.Normal(predicted[valid], 0.3**0.5)
    assert figures["val_nll"] == pytest.approx(-float(normal.log_prob(depth[valid]).mean()), rel=1e-12)
    # A constant variance has no gain.
    assert figures["val_nll_constant"] == pytest.approx(figures["val_nll"], rel=1e-12)
    assert figures["val_rmse"] == pytest.approx(np.sqrt((error**2).mean()))
    assert figures["val_rel"] == pytest.approx((abs(error) / truth).mean())
    ratio = np.maximum((truth + error) / truth, truth / (truth + error))
    assert figures["val_delta1"] == pytest.approx(((ratio < 1.25) & (ratio > 0)).mean())
    # The mean squared error is the best constant variance.
    constants = [
        validation.figures(Sums(torch.tensor([v, 1.0], dtype=torch.float64)))["val_nll_constant"]
        for v in np.geomspace(1e-3, 10, 200)
    ]
    best = validation.figures(Sums(torch.tensor([(error**2).mean(), 1.0], dtype=torch.float64)))["val_nll_constant"]
    assert figures["val_nll_constant_best"] == pytest.approx(best)
    assert best <= min(constants)
    alone.update(DepthPrediction(predicted), depth, valid)
    assert "val_nll" not in alone.figures(Sums())


def test_the_sums_of_training_steps_need_no_value_before_the_epoch_ends():
    """A tensor of the device "meta" has no value to wait for."""
    step = torch.zeros(2, dtype=torch.float64, device="meta")
    assert Sums().plus(step).plus(step).values.device.type == "meta"
    sums = Sums().plus(torch.tensor([3.0, 2.0])).plus(torch.tensor([1.0, 6.0]))
    assert (sums.mean(), sums.pixels) == (0.5, 8.0)
    assert math.isnan(Sums().mean())
