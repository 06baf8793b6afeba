"""The active-learning example: picks under a budget, training that touches nothing else, figures in closed form."""

from __future__ import annotations

import argparse
import copy
import json
import math
from itertools import combinations
from pathlib import Path
from typing import Any

import active_learning as example
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_networks import Linear, constant_head

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


def view(depth: float = 2.0, room: str = "", seed: int = 0) -> example.View:
    """A wall at ``depth`` with a random texture."""
    generator = torch.Generator().manual_seed(seed)
    K = torch.tensor([[60.0, 0, 47.5], [0, 60.0, 31.5], [0, 0, 1]], dtype=torch.float64)
    image = torch.rand(3, 64, 96, generator=generator)
    return example.View(image, torch.full((64, 96), depth), torch.eye(4, dtype=torch.float64), K, room)


def options(**values: Any) -> argparse.Namespace:
    return argparse.Namespace(**{**vars(example.parse([])), **values})


@pytest.fixture(scope="module")
def place() -> Any:
    """A pool of 12 views and 8 held-back ones."""
    return example.open_place(options(frames=12, held_back=8), 0, Preprocess(size=SPEC.size), SPEC.size)


# --- picks under a budget ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scores", "budget", "spacing", "taken", "picks"),
    [
        ([1, 9, 8, 3, 7, 2], 2, 2, (), [1, 4]),  # 2 is beside 1
        ([1, 9, 8, 3, 7, 2], 1, 2, (1,), [4]),  # a label of an earlier round keeps its distance too
        ([5, 5, 5, 5], 2, 2, (), [0, 2]),  # ties: the earlier frame
        ([math.nan, 1, math.nan, 2], 2, 1, (), [3, 1]),  # no score, no label
    ],
)
def test_exact_picks(scores, budget, spacing, taken, picks):
    assert example.select(scores, budget, spacing, taken) == picks
    with pytest.raises(ValueError, match="does not fit"):
        example.select(scores, 9, spacing, taken)


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


# --- scores ------------------------------------------------------------------------------------------


def test_scores_of_a_constant_network_are_known():
    members = [constant_network(2.5, 0.09), constant_network(1.5, 0.25)]
    scores = example.score_pool(members, [view() for _ in range(4)], pixels=500)
    np.testing.assert_allclose(scores["aleatoric"], [0.09, 0.25, 0.09, 0.25], rtol=1e-4)  # the members take turns
    np.testing.assert_allclose(scores["oracle"], 0.25, rtol=1e-5)
    total, own, between = (np.array(scores[name]) for name in ("ufmstar", "aleatoric", "disagreement"))
    np.testing.assert_allclose(total, own + between, rtol=1e-5)
    assert between[0] == pytest.approx(0, abs=1e-6), "the first view has nothing to disagree with"


# --- fine-tuning -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["ensemble", "batch_ensemble"])
def test_fine_tuning_learns_the_labels_and_leaves_the_start_alone(kind):
    start = networks()
    if kind == "batch_ensemble":
        start = [*BatchEnsemble(start[0], 2).eval().all_members()]
    before = copy.deepcopy([network.state_dict() for network in start])
    views = [view(1.0 + i, seed=i) for i in range(3)]
    settings = options(steps=20, rounds=1, batch=2, learning_rate=1e-2)
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


# --- the held-back part ------------------------------------------------------------------------------


def test_later_rounds_score_anew_and_train_on_the_picks_alone(place, monkeypatch):
    start, chosen = networks(1), options(budget=2, rounds=2, spacing=2, steps=2)
    trained: list[list[int]] = []
    scored: list[Any] = []
    true_fine_tune = example.fine_tune

    def fine_tune(members: Any, labelled: Any, *rest: Any) -> Any:
        trained.append([next(i for i, v in enumerate(place[0]) if v is one) for one in labelled])
        return true_fine_tune(members, labelled, *rest)

    def score_pool(members: Any, pool: Any, pixels: int) -> dict[str, list[float]]:
        scored.append(members)
        return {"ufmstar": [float(i == (7 if len(scored) == 1 else 3)) for i in range(12)]}

    monkeypatch.setattr(example, "fine_tune", fine_tune)
    monkeypatch.setattr(example, "score_pool", score_pool)
    assert example.run_strategy("ufmstar", start, place[0], chosen, seed=0)[0] == [7, 3]
    assert trained == [[7], [7, 3]]
    assert scored[0][0] is start[0]
    assert scored[1][0] is not start[0], "the second round is scored by what the first has learnt"
    chance = [example.run_strategy("random", start, place[0], chosen, seed=s)[0] for s in (0, 0, 1)]
    assert chance[0] == chance[1] != chance[2]
    assert example.run_strategy("everything", start, place[0], chosen, seed=0)[0] == list(range(12))
    assert len(scored) == 2, "random picks need no score"


def test_a_recordings_parts_do_not_touch(tmp_path, monkeypatch):
    folder = export_tour(tour_sequence(1, frames=20, size=(32, 48), path_seed=0), tmp_path / "walk")
    seen = []
    true_views = example.views
    monkeypatch.setattr(
        example, "views", lambda frames, *rest: true_views((seen.append(f) or f for f in frames), *rest)
    )
    chosen = options(sequence=str(folder), frames=99, held_back=99)
    pool, _ = example.open_place(chosen, 0, Preprocess(size=(32, 48)), (1, 1))
    assert [frame.index for frame in seen] == [0, 2, 4, 6, 8, 10, 13, 14, 15, 16, 17, 18, 19]
    assert (len(pool), {v.room for v in pool}) == (6, {""})
    for depth in (folder / "depth").glob("*"):
        depth.unlink()
    (folder / "depth").rmdir()
    with pytest.raises(ValueError, match="has no depth"):
        example.open_place(chosen, 0, Preprocess(size=(32, 48)), (1, 1))


def test_judging_against_closed_forms():
    figures = example.judge([constant_network(2.5, 0.25)], [view(2.0, "seen"), view(4.0, "unseen"), view(2.0, "seen")])
    assert figures["seen"]["rmse"] == pytest.approx(0.5, rel=1e-5)
    assert figures["unseen"]["rmse"] == pytest.approx(1.5, rel=1e-5)
    assert figures["all"]["rmse"] == pytest.approx(math.sqrt((0.5**2 * 2 + 1.5**2) / 3), rel=1e-5)
    assert (figures["seen"]["delta1"], figures["unseen"]["delta1"]) == pytest.approx((1.0, 0.0))
    assert figures["unseen"]["nll"] == pytest.approx(1.5**2 / 0.5 + 0.5 * math.log(2 * math.pi * 0.25), rel=1e-5)


# --- the report --------------------------------------------------------------------------------------


def test_differences_are_taken_within_a_seed():
    def figures(rmse: float) -> dict[str, dict[str, float]]:
        return {"all": {"rmse": rmse}}

    places = [
        {"before": figures(9), "after": {"random": figures(chance), "ufmstar": figures(chance - gain)}}
        for chance, gain in ((1.0, 0.2), (5.0, 0.3), (3.0, 0.4))
    ]
    lines = example.report({"places": places}).splitlines()
    assert "| random | 3.000 | - |" in lines
    assert f"| ufmstar | 2.700 | -0.300 ± {4.302653 * 0.1 / math.sqrt(3):.3f} |" in lines


def test_the_whole_loop(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights, out = tmp_path / "tiny.safetensors", tmp_path / "results.json"
    save_trained(weights, networks(), SPEC)
    words = "--seeds 1 --frames 24 --held-back 8 --budget 2 --steps 2 --pixels 200 --strategies random ufmstar"
    example.main([*words.split(), "--weights", str(weights), "--out", str(out)])
    results = json.loads(out.read_text())
    (place,) = results["places"]
    for strategy in ("random", "ufmstar"):
        first, second = place["picks"][strategy]
        assert abs(first - second) >= results["settings"]["spacing"]
        assert all(math.isfinite(value) for value in place["after"][strategy]["all"].values())
    assert "| ufmstar |" in capsys.readouterr().out
