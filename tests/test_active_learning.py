"""The active-learning example: picks under a budget, training that touches nothing else, figures in closed form."""

from __future__ import annotations

import copy
import json
import math
from itertools import combinations
from pathlib import Path
from typing import Any

import active_learning as example
import active_learning_data as data
import numpy as np
import pytest
import torch
from active_learning_measure import judge, measure_cost, predict
from active_learning_report import interval, summarise, unseen_share
from hypothesis import given
from hypothesis import strategies as st
from tiny_networks import Linear, constant_head

from ufmstar_torch import UfMStar
from ufmstar_torch.eval.tour import export_tour, tour_sequence
from ufmstar_torch.models import AleatoricNetwork, BatchEnsemble, NetworkSpec, Preprocess, build_network, save_trained
from ufmstar_torch.train.losses import loss_of

SPEC = NetworkSpec(widths=0.1, positive="softplus", size=(64, 96), preprocess="resize")


def networks(count: int = 2) -> list[Any]:
    torch.manual_seed(0)
    return [build_network(SPEC).eval() for _ in range(count)]


def constant_network(depth: float, variance: float) -> AleatoricNetwork:
    """Predicts the same everywhere."""
    network = AleatoricNetwork(Linear(weights=(0.0, 0.0), offset=depth))
    constant_head(network.head, (math.log(variance),))
    return network.eval()


def view(name: str, depth: float = 2.0, room: str = "", seed: int = 0) -> data.View:
    """A wall at ``depth`` with a random texture."""
    generator = torch.Generator().manual_seed(seed)
    K = torch.tensor([[60.0, 0, 47.5], [0, 60.0, 31.5], [0, 0, 1]], dtype=torch.float64)
    image = torch.rand(3, 64, 96, generator=generator)
    return data.View(name, image, torch.full((64, 96), depth), torch.eye(4, dtype=torch.float64), K, room)


@pytest.fixture(scope="module")
def place() -> data.Environment:
    part = {"frames": 12, "stride": 2, "held_back": 8}
    return data.open_environment("tour:200001", 0, **part, size=SPEC.size, preprocess=Preprocess(size=SPEC.size))


# --- picks under a budget ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scores", "budget", "spacing", "taken", "picks"),
    [
        ([1, 9, 8, 3, 7, 2], 2, 1, (), [1, 2]),
        ([1, 9, 8, 3, 7, 2], 2, 2, (), [1, 4]),  # 2 is beside 1
        ([1, 9, 8, 3, 7, 2], 2, 4, (), [1, 5]),
        ([1, 9, 8, 3, 7, 2], 1, 2, (1,), [4]),  # a label of an earlier round keeps its distance too
        ([5, 5, 5, 5], 2, 2, (), [0, 2]),  # ties: the earlier frame
        ([math.nan, 1, math.nan, 2], 2, 1, (), [3, 1]),  # no score, no label
        ([-3, -1, -2], 1, 1, (), [1]),
    ],
)
def test_exact_picks(scores, budget, spacing, taken, picks):
    assert example.select(scores, budget, spacing, taken) == picks


@given(
    scores=st.lists(st.integers(0, 5), min_size=30, max_size=40),  # many ties
    budget=st.integers(1, 5),
    spacing=st.integers(1, 3),
)
def test_picks_are_spaced_greedy_and_repeatable(scores, budget, spacing):
    picks = example.select(scores, budget, spacing)
    assert len(set(picks)) == budget
    assert all(abs(i - j) >= spacing for i, j in combinations(picks, 2))
    assert picks == example.select(scores, budget, spacing)
    for i in set(range(len(scores))) - set(picks):  # whoever was passed over was beaten, or too near to a better one
        nearby = [j for j in picks if abs(i - j) < spacing]
        better = [j for j in (nearby or picks) if (-scores[j], j) < (-scores[i], i)]
        assert better if nearby else len(better) == budget


def test_a_budget_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"budget 3 with spacing 3 does not fit into a pool of 6"):
        example.select([1, 2, 3, 4, 5, 6], 3, 3)
    with pytest.raises(ValueError, match="does not fit"):
        example.select([1.0, math.nan], 2, 1)


@pytest.mark.parametrize("values", [{"budget": 0}, {"spacing": -1}, {"learning_rate": math.nan}, {"budget": 5}])
def test_impossible_settings_are_named(values):
    with pytest.raises(ValueError, match=next(iter(values))):
        example.Settings(**values)
    with pytest.raises(ValueError, match="strategies must be some of"):
        example.Settings(strategies=("guess",))


# --- scores ------------------------------------------------------------------------------------------


def test_scores_of_a_constant_network_are_known():
    members = [constant_network(2.5, 0.09), constant_network(1.5, 0.25)]
    scores = example.score_pool(members, [view(f"{i}", depth=2.0) for i in range(4)], pixels=500)
    np.testing.assert_allclose(scores["aleatoric"], [0.09, 0.25, 0.09, 0.25], rtol=1e-4)  # the members take turns
    np.testing.assert_allclose(scores["oracle"], 0.25, rtol=1e-5)
    total, own, between = (np.array(scores[name]) for name in ("ufmstar", "aleatoric", "disagreement"))
    np.testing.assert_allclose(total, own + between, rtol=1e-5)
    assert between[0] == pytest.approx(0, abs=1e-6), "the first view has nothing to disagree with"


def test_a_score_over_all_pixels_is_the_mean_of_the_dense_map(place):
    members = networks(1)
    (score,) = example.score_pool(members, place.pool[:1], pixels=64 * 96)["ufmstar"]
    p, v = predict(members, place.pool[0], 0), place.pool[0]
    dense = UfMStar()(p.depth, v.T_world_cam[None], v.intrinsics[None], p.aleatoric_variance)
    assert score == pytest.approx(float(dense.variance.mean()), rel=1e-5)


def test_a_network_without_a_variance_is_refused(place):
    spec = NetworkSpec(method="depth", widths=0.1, positive="softplus", size=(64, 96), preprocess="resize")
    with pytest.raises(ValueError, match="aleatoric or evidential head"):
        example.score_pool([build_network(spec).eval()], place.pool, 10)


def test_the_cost_is_measured_side_by_side(place):
    cost = measure_cost(networks(), place.pool, pixels=200)
    assert cost["pixels"] == 200
    assert cost["threads"] == torch.get_num_threads()
    assert all(cost[name] > 0 for name in ("network_ms", "dense_ms", "sample_ms", "ratio"))
    assert {len(means) for means in cost["means"].values()} == {len(place.pool)}
    # The same frames: before the moving average sets in, the sample's mean is the map's up to the sampling.
    assert cost["means"]["sample"][0] == pytest.approx(cost["means"]["dense"][0], rel=0.1)


# --- fine-tuning -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["ensemble", "batch_ensemble"])
def test_fine_tuning_learns_the_labels_and_leaves_the_start_alone(kind):
    start = networks()
    if kind == "batch_ensemble":
        start = [*BatchEnsemble(start[0], 2).eval().all_members()]
    before = copy.deepcopy([network.state_dict() for network in start])
    views = [view(f"{i}", depth=1.0 + i, seed=i) for i in range(3)]
    settings = example.Settings(steps=20, rounds=1, batch=2, learning_rate=1e-2)
    tuned = example.fine_tune(start, views, settings, np.random.default_rng(0))

    def loss(members: list[Any]) -> float:
        image, depth = torch.stack([v.image for v in views]), torch.stack([v.depth for v in views])
        with torch.no_grad():
            return sum(float(loss_of(m.distribution(image), depth, depth > 0)) for m in members)

    assert loss(tuned) < loss(start) - 0.15
    for network, state in zip(start, before, strict=True):
        assert all(torch.equal(value, state[name]) for name, value in network.state_dict().items())
    for network, state in zip(tuned, before, strict=True):
        moved = {name for name, value in network.state_dict().items() if not torch.equal(value, state[name])}
        assert moved, "every member is trained"
        assert not [name for name in moved if "running" in name or "num_batches" in name]
    if kind == "batch_ensemble":
        assert tuned[0].ensemble is tuned[1].ensemble is not start[0].ensemble


def test_fine_tuning_repeats_from_its_seed():
    start, views = networks(1), [view(f"{i}", depth=1.0 + i, seed=i) for i in range(3)]
    settings = example.Settings(steps=2, rounds=1)

    def tuned(seed: int) -> torch.Tensor:
        (network,) = example.fine_tune(start, views, settings, np.random.default_rng(seed))
        return torch.cat([p.detach().flatten() for p in network.parameters()])

    assert torch.equal(tuned(0), tuned(0))
    assert not torch.equal(tuned(0), tuned(1))


# --- the held-back part ------------------------------------------------------------------------------


def test_pool_and_held_back_part_share_rooms_but_no_view(place):
    names = [v.name for v in (*place.pool, *place.held_back)]
    assert len(set(names)) == len(names) == 20
    poses = {v.T_world_cam.numpy().tobytes() for v in (*place.pool, *place.held_back)}
    images = {v.image.numpy().tobytes() for v in (*place.pool, *place.held_back)}
    assert len(poses) == len(images) == len(names)
    assert {v.room for v in (*place.pool, *place.held_back)} <= {"seen", "unseen"}
    assert all(v.depth.min() > 0.05 and v.image.shape == (3, 64, 96) for v in place.pool)


def test_no_held_back_view_is_trained_on_and_no_label_beyond_the_picks_used(place, monkeypatch):
    trained: list[list[data.View]] = []
    true_fine_tune = example.fine_tune

    def spy(start: Any, labelled: Any, *rest: Any) -> Any:
        trained.append(list(labelled))
        return true_fine_tune(start, labelled, *rest)

    monkeypatch.setattr(example, "fine_tune", spy)
    start, settings = networks(1), example.Settings(budget=4, rounds=2, spacing=1, steps=2, pixels=100)
    first = example.score_pool(start, place.pool, settings.pixels)
    for strategy in example.STRATEGIES:
        trained.clear()
        picks, after = example.run_strategy(strategy, start, place, first, settings, seed=3)
        assert set(after) >= {"all"}
        held_back = {id(v) for v in place.held_back}
        assert not held_back & {id(v) for views in trained for v in views}
        if strategy == "everything":
            assert picks == list(range(12))
        else:
            assert [[v.name for v in views] for views in trained] == [
                [place.pool[i].name for i in picks[:2]],
                [place.pool[i].name for i in picks],
            ]


def test_scores_decide_and_later_rounds_score_anew(place, monkeypatch):
    start, settings = networks(1), example.Settings(budget=2, rounds=2, spacing=2, steps=2, pixels=100)
    first = {"ufmstar": [float(i == 7) for i in range(12)]}
    requested: list[Any] = []

    def scored(members: Any, pool: Any, pixels: int) -> dict[str, list[float]]:
        requested.append(members)
        return {"ufmstar": [float(i == 3) for i in range(12)]}

    monkeypatch.setattr(example, "score_pool", scored)
    picks, _ = example.run_strategy("ufmstar", start, place, first, settings, seed=0)
    assert picks == [7, 3]
    assert len(requested) == 1
    assert requested[0][0] is not start[0], "the second round is scored by what the first has learnt"
    chance = [example.run_strategy("random", start, place, first, settings, seed=s)[0] for s in (0, 0, 1)]
    assert chance[0] == chance[1] != chance[2]
    assert len(requested) == 1, "random picks look at no score"


def test_a_recordings_parts_do_not_touch(tmp_path):
    folder = export_tour(tour_sequence(1, frames=20, size=(32, 48), path_seed=0), tmp_path / "walk")
    kwargs = {"frames": 99, "stride": 2, "held_back": 99, "size": (1, 1), "preprocess": Preprocess(size=(32, 48))}
    place = data.open_environment(str(folder), 0, **kwargs)
    pool, judged = ([int(v.name.split("/")[1]) for v in part] for part in (place.pool, place.held_back))
    assert pool == [0, 2, 4, 6, 8, 10]
    assert judged == [13, 14, 15, 16, 17, 18, 19]
    assert {v.room for v in place.pool} == {""}
    for depth in (folder / "depth").glob("*"):
        depth.unlink()
    (folder / "depth").rmdir()
    with pytest.raises(ValueError, match="has no depth"):
        data.open_environment(str(folder), 0, **kwargs)


@pytest.mark.parametrize("name", ["tour:", "tour:-1", "tour:x", "tour:1?path=2", "tour:1?"])
def test_a_tours_name(name):
    assert data.parse_tour("tour:7") == (7, "mixed")
    assert data.parse_tour("tour:7?style=home") == (7, "home")
    if name != "tour:1?":
        with pytest.raises(ValueError, match="a tour is named"):
            data.parse_tour(name)


def test_judging_against_closed_forms():
    views = [view("a", 2.0, "seen"), view("b", 4.0, "unseen"), view("c", 2.0, "seen")]
    figures = judge([constant_network(2.5, 0.25)], views)
    assert figures["seen"]["rmse"] == pytest.approx(0.5, rel=1e-5)
    assert figures["unseen"]["rmse"] == pytest.approx(1.5, rel=1e-5)
    assert figures["all"]["rmse"] == pytest.approx(math.sqrt((0.5**2 * 2 + 1.5**2) / 3), rel=1e-5)
    assert figures["seen"]["delta1"] == pytest.approx(1.0)
    assert figures["unseen"]["delta1"] == 0.0
    assert figures["unseen"]["nll"] == pytest.approx(1.5**2 / 0.5 + 0.5 * math.log(2 * math.pi * 0.25), rel=1e-5)


# --- the report --------------------------------------------------------------------------------------


def test_an_interval_is_students():
    assert interval([1.0, 2.0, 3.0])["ci95"] == pytest.approx(4.302653 / math.sqrt(3), rel=1e-6)
    assert interval([1.0, 2.0, 3.0])["mean"] == 2
    assert math.isnan(interval([1.0])["ci95"])


def test_differences_are_taken_within_a_seed():
    def figures(rmse: float) -> dict[str, dict[str, float]]:
        return {"all": {"rmse": rmse, "delta1": 0.5, "nll": 1.0}}

    rmse = {"random": [1.0, 5.0], "ufmstar": [0.8, 4.8]}
    results = {
        "settings": {"strategies": tuple(rmse)},
        "places": [{"before": figures(9), "rooms": ["seen", "unseen", "unseen"]} for _ in range(2)],
        "runs": [
            {"seed": s, "strategy": name, "picks": [0, 2 - s], "after": figures(values[s])}
            for name, values in rmse.items()
            for s in range(2)
        ],
    }
    summary = summarise(results)["all"]
    assert summary["ufmstar"]["rmse_minus_random"]["values"] == pytest.approx([-0.2, -0.2])
    assert summary["ufmstar"]["rmse_minus_random"]["ci95"] == pytest.approx(0, abs=1e-9)
    assert summary["ufmstar"]["rmse"]["mean"] == pytest.approx(2.8)
    assert summary["before"]["rmse"]["mean"] == 9
    assert unseen_share(results, "random") == [0.5, 0.5]


def test_the_whole_loop(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights = tmp_path / "tiny.safetensors"
    save_trained(weights, networks(), SPEC)
    out = tmp_path / "out"
    example.main(
        ["--quick", "--seeds", "1", "--weights", str(weights), "--out", str(out), "--strategies", "random", "ufmstar"]
    )
    results = json.loads((out / "results.json").read_text())
    assert results["settings"]["budget"] == example.QUICK["budget"]
    assert [run["strategy"] for run in results["runs"]] == ["random", "ufmstar"]
    (place,) = results["places"]
    for run in results["runs"]:
        assert len(run["picks"]) == 2
        assert abs(run["picks"][0] - run["picks"][1]) >= results["settings"]["spacing"]
        assert all(math.isfinite(value) for value in run["after"]["all"].values())
    assert len(place["rooms"]) == len(place["scores"]["ufmstar"]) == example.QUICK["frames"]
    assert place["cost"]["sample_ms"] > 0
    assert place["cost"]["dense_ms"] > 0
    assert 0 <= place["cost"]["picks_agree"] <= 2
    printed = capsys.readouterr().out
    assert "| ufmstar |" in printed
    assert "Mean of V over 200 pixels" in printed
    assert (out / "active_learning.png").stat().st_size < 150_000
