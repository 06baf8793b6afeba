"""Recipes of a training and its arithmetic: presets, options, schedule, losses."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from ufmstar_torch.models import build_network
from ufmstar_torch.prediction import DepthPrediction
from ufmstar_torch.train import PRESETS, DataConfig, FitSettings, Job, Recipe, preset
from ufmstar_torch.train.member import new_network
from ufmstar_torch.train.module import move_average, share_of_rate, step_seed
from ufmstar_torch.train.presets import OURS, table
from ufmstar_torch.train.progress import Sums, Validation


def test_every_method_of_the_paper_is_a_preset_of_both_architectures():
    methods = {"depth-only", "aleatoric", "evidential", "mc-dropout", "ensemble", "batch-ensemble"}
    assert set(PRESETS) == {f"{a}-{m}" for a in ("monodepth2", "fastdepth") for m in methods} | {
        "demo", "fastdepth-ufmstar",
    }  # fmt: skip
    for name, recipe in PRESETS.items():
        if name in ("demo", "fastdepth-ufmstar"):
            continue
        # Section V-A.
        assert (recipe.network.size, recipe.epochs, recipe.weight_decay) == ((224, 224), 50, 1e-4)
        assert (recipe.beta1, recipe.beta2) == (0.9, 0.999)
        assert recipe.network.dropout == 0.2
        assert max(recipe.members, recipe.network.members) == (10 if "ensemble" in name else 1)
        assert recipe.learning_rate == OURS[recipe.network.architecture]["learning_rate"]


def test_the_table_has_a_row_for_every_preset():
    text, sources = table().split("\n\n")
    lines = text.splitlines()
    assert [line.split()[0] for line in lines] == ["preset", *PRESETS]
    assert re.search("From the paper .*size, epochs, .*Ours, .*learning rate", sources, re.DOTALL)
    row = dict(zip(re.split(r"\s{2,}", lines[0]), re.split(r"\s{2,}", lines[6]), strict=True))
    assert (row["preset"], row["members"], row["learning rate"]) == ("monodepth2-batch-ensemble", "10", "0.0001 cosine")


def test_the_demo_fits_into_six_megabytes():
    recipe = preset("demo")
    numbers = sum(value.numel() for value in build_network(recipe.network).state_dict().values())
    assert recipe.half
    assert 3 <= recipe.members <= 4
    # Half precision, with some room for the tensors that it cannot hold and for what the file says of itself.
    assert 2.1 * numbers * recipe.members < 6e6


@pytest.mark.parametrize("name", PRESETS)
def test_recipes_survive_json(name):
    assert Recipe.from_dict(json.loads(json.dumps(PRESETS[name].to_dict()))) == PRESETS[name]


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"epoch": 3}, r"Recipe has no \['epoch'\]"),
        ({"epochs": 0}, r"Recipe\.epochs must lie in \[1"),
        ({"epochs": 2.5}, r"Recipe\.epochs must be a whole number"),
        ({"learning_rate": 0}, r"Recipe\.learning_rate must lie in \(0"),
        ({"learning_rate": float("nan")}, r"Recipe\.learning_rate must be a number"),
        ({"beta2": 1.0}, r"Recipe\.beta2 must lie in \[0, 1\)"),
        ({"schedule": "linear"}, r"Recipe\.schedule must be one of \('cosine', 'constant'\)"),
        ({"network": {"width": 2}}, r"NetworkSpec has no \['width'\]"),
        ({"network": {"method": "batch_ensemble", "members": 4}, "members": 2}, r"members must be 1 for a batch"),
    ],
)
def test_impossible_recipes_are_named(values, told):
    with pytest.raises(ValueError, match=told):
        Recipe.from_dict(values)


def test_members_are_the_ensembles_or_the_batch_ensembles():
    assert preset("fastdepth-ensemble").with_members(3).members == 3
    recipe = preset("fastdepth-batch-ensemble").with_members(3)
    assert (recipe.members, recipe.network.members) == (1, 3)


def test_ensembles_of_different_seeds_share_no_member(tmp_path):
    job = Job(preset("demo"), DataConfig(kind="tour"), FitSettings(out=tmp_path))
    jobs = [replace(job, settings=replace(job.settings, seed=seed)) for seed in range(3)]
    assert len({j.seed(member) for j in jobs for member in range(1000)}) == 3 * 1000
    assert [job.seed(member) for member in range(10)] == list(range(10))
    # Weights come from the seed: the second member of one is not the first of the next.
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


def test_seeds_of_steps_differ():
    seeds = {step_seed(s, rank, step) for s in range(4) for rank in range(4) for step in range(-1, 200)}
    assert len(seeds) == 4 * 4 * 201
    assert all(0 <= seed < 2**63 for seed in seeds)


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
    figures = validation.figures(Sums(0.3 * 11, 11))
    normal = torch.distributions.Normal(predicted[valid], 0.3**0.5)
    assert figures["val_nll"] == pytest.approx(-float(normal.log_prob(depth[valid]).mean()), rel=1e-12)
    # The head's variance is the same everywhere, so it gains nothing.
    assert figures["val_nll_constant"] == pytest.approx(figures["val_nll"], rel=1e-12)
    assert figures["val_rmse"] == pytest.approx(np.sqrt((error**2).mean()))
    assert figures["val_rel"] == pytest.approx((abs(error) / truth).mean())
    ratio = np.maximum((truth + error) / truth, truth / (truth + error))
    assert figures["val_delta1"] == pytest.approx(((ratio < 1.25) & (ratio > 0)).mean())
    # No constant does better than the mean squared error.
    constants = [validation.figures(Sums(v, 1))["val_nll_constant"] for v in np.geomspace(1e-3, 10, 200)]
    best = validation.figures(Sums((error**2).mean(), 1))["val_nll_constant"]
    assert figures["val_nll_constant_best"] == pytest.approx(best)
    assert best <= min(constants)
    alone.update(DepthPrediction(predicted), depth, valid)
    assert "val_nll" not in alone.figures(Sums())


def test_invalid_pixels_count_for_nothing():
    depth = torch.tensor([[[1.0, 0.0, float("nan"), 2.0]]])
    valid = torch.tensor([[[True, True, True, False]]])
    prediction = DepthPrediction(torch.tensor([[[1.5, 9.0, 9.0, 9.0]]]), torch.ones(1, 1, 4))
    validation = Validation()
    validation.update(prediction, depth, valid)
    figures = validation.figures(Sums())
    assert (figures["val_rmse"], figures["val_nll"]) == (0.5, pytest.approx(0.125 + math.log(2 * math.pi) / 2))
    validation = Validation()
    validation.update(prediction, depth, ~valid & (depth > 5))
    assert validation.figures(Sums()) == {}
