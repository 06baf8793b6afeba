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
from ufmstar_torch.train.module import TrainingModule, averaging, learning_rates
from ufmstar_torch.train.presets import TRAINING


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


def rates(recipe, total):
    """The learning rates of all steps, relative to the recipe's."""
    optimizer = torch.optim.SGD([torch.zeros(1)], recipe.learning_rate)
    schedule, found = learning_rates(optimizer, recipe, total), []
    for _ in range(total):
        found.append(optimizer.param_groups[0]["lr"] / recipe.learning_rate)
        optimizer.step()
        schedule.step()
    return found


@pytest.mark.parametrize("warm", [4, 0])
def test_the_learning_rate_rises_and_falls_as_a_cosine(warm):
    recipe = Recipe(warmup_steps=warm)
    found = rates(recipe, warm + 20)
    assert found[:warm] == pytest.approx([0.2, 0.4, 0.6, 0.8][:warm])
    assert found[warm:] == pytest.approx([(1 + math.cos(math.pi * n / 20)) / 2 for n in range(20)])
    assert rates(replace(recipe, schedule="constant"), 30)[warm:] == pytest.approx([1.0] * (30 - warm))


def test_the_running_mean_is_the_one_by_hand():
    """The first step's weights, and then a mean that remembers more and more."""
    module = nn.BatchNorm1d(2)
    callback = averaging(0.15)
    mean = torch.optim.swa_utils.AveragedModel(module, use_buffers=True, **callback._kwargs)
    expected = 0.0
    for n in range(5):
        with torch.no_grad():
            module.weight.fill_(n)
            module.running_mean.fill_(-n)
            module.num_batches_tracked.fill_(n)
        mean.update_parameters(module)
        factor = min(0.15, (n + 1) / (n + 11))
        expected = factor * expected + (1 - factor) * n
    torch.testing.assert_close(mean.module.weight.detach(), torch.full((2,), expected))
    torch.testing.assert_close(mean.module.running_mean, torch.full((2,), -expected))
    assert mean.module.num_batches_tracked == 4


class Fixed(nn.Module):
    """A network that returns predictions one after the other."""

    def __init__(self, *predictions):
        super().__init__()
        self.predictions = iter(predictions)

    def forward(self, image):
        return next(self.predictions)


def test_the_figures_of_a_validation_are_those_by_hand(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    depth = 1 + torch.rand(2, 5, 7, generator=generator, dtype=torch.float64)
    predicted = depth + torch.randn(2, 5, 7, generator=generator, dtype=torch.float64) / 3
    valid = torch.rand(2, 5, 7, generator=generator) < 0.6
    variance, truth = torch.full_like(depth, 0.3), torch.where(valid, depth, 0)
    monkeypatch.setattr(TrainingModule, "log", lambda *_, **__: None)

    def figures(*predictions):
        module = TrainingModule(Fixed(*predictions), Recipe(), 1)
        for n in range(len(predictions)):
            module.validation_step({"image": None, "depth": truth[n : n + 1]}, n)
        module.on_validation_epoch_end()
        return module.figures

    maps = [[value[n : n + 1] for value in (predicted, 0.25 * variance, 0.75 * variance)] for n in range(2)]
    found = figures(*(DepthPrediction(*m) for m in maps))
    error, goal = (predicted - depth)[valid].numpy(), depth[valid].numpy()
    normal = torch.distributions.Normal(predicted[valid], 0.3**0.5)
    assert found["val_nll"] == pytest.approx(-float(normal.log_prob(depth[valid]).mean()), rel=1e-12)
    assert found["val_rmse"] == pytest.approx(np.sqrt((error**2).mean()))
    assert found["val_rel"] == pytest.approx((abs(error) / goal).mean())
    ratio = np.maximum((goal + error) / goal, goal / (goal + error))
    assert found["val_delta1"] == pytest.approx(((ratio < 1.25) & (ratio > 0)).mean())
    # The mean squared error is the best constant variance.
    constants = [0.5 * (np.log(2 * np.pi * v) + (error**2).mean() / v) for v in np.geomspace(1e-3, 10, 2000)]
    assert found["val_nll_constant"] == pytest.approx(min(constants), abs=1e-4)
    assert found["val_nll_constant"] <= min(constants)
    assert "val_nll" not in figures(*(DepthPrediction(m[0]) for m in maps))
    truth.zero_()
    assert figures(*(DepthPrediction(*m) for m in maps)) == {}
