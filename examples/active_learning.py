"""Active learning with UfM*: which images of a walk are worth a label?

Every round streams the walk through the network(s) and UfM*, averages the variance of each image over 1,000 of its
pixels (section "Compute- and memory efficiency"), picks the most uncertain images under a budget, takes their ground
truth as labels and fine-tunes. Random picks, picks by the network's own variance and picks by the true error do
the same, from the same weights and with as many steps; views of the same rooms from another walk judge them all.

    python examples/active_learning.py --out out/active_learning

Read `run_strategy` first. What came out of it: docs/results/active_learning.md.
"""

from __future__ import annotations

import argparse
import copy
import math
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch
from active_learning_data import Environment, View, open_environment
from active_learning_measure import judge, measure_cost, predict
from active_learning_report import draw, report, summarise
from torch import Tensor

from ufmstar_torch import UfMStar
from ufmstar_torch.eval.run.files import write_json_atomic
from ufmstar_torch.eval.run.machine import hardware
from ufmstar_torch.models import DepthNetwork, load_trained, read_info
from ufmstar_torch.regress import sample_pixels
from ufmstar_torch.train.losses import loss_of

# What an image's score is: nothing; mean A; mean V = M + A; mean M alone; the true mean squared error, which nobody
# knows before labelling; and, beyond any budget, all labels at once.
STRATEGIES = ("random", "aleatoric", "ufmstar", "disagreement", "oracle", "everything")
QUICK = {"seeds": 2, "frames": 24, "held_back": 8, "budget": 2, "steps": 2, "pixels": 200}


@dataclass(frozen=True)
class Settings:
    """One experiment.

    Attributes:
        budget: labels in all, divided among the rounds.
        rounds: of scoring, picking and fine-tuning.
        spacing: picked frames are at least this far apart, so that no budget goes into near-duplicates.
        pixels: that the average of an image is taken over.
        steps: of fine-tuning per network, divided among the rounds.
        batch: images per step.
        learning_rate: of Adam at the start of each round; falls to 0 by its end.
        strategies: which are compared.

    Raises:
        ValueError: a number that cannot be.
    """

    budget: int = 12
    rounds: int = 2
    spacing: int = 4
    pixels: int = 1000
    steps: int = 30
    batch: int = 4
    learning_rate: float = 3e-4
    strategies: tuple[str, ...] = STRATEGIES

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "strategies" and not value > 0:
                raise ValueError(f"{field.name} must be positive, got {value}")
        if self.budget % self.rounds or self.steps % self.rounds:
            raise ValueError(
                f"budget and steps must be multiples of rounds, got {self.budget}, {self.steps}, {self.rounds}"
            )
        if unknown := sorted(set(self.strategies) - set(STRATEGIES)):
            raise ValueError(f"strategies must be some of {', '.join(STRATEGIES)}, got {unknown}")


def score_pool(members: Sequence[DepthNetwork], pool: Sequence[View], pixels: int) -> dict[str, list[float]]:
    """Stream the pool once and score every image, all scores over the same sample of pixels.

    Returns:
        By strategy, [m^2]: "ufmstar" V, "aleatoric" A, "disagreement" M = V - A - E, "oracle" squared error.

    Raises:
        ValueError: a network that predicts no aleatoric variance.
    """
    ufm = UfMStar()
    scores: dict[str, list[float]] = {name: [] for name in ("ufmstar", "aleatoric", "disagreement", "oracle")}
    for i, view in enumerate(pool):
        p = predict(members, view, i)
        if p.aleatoric_variance is None or p.variance is None:
            raise ValueError("the network must have an aleatoric or evidential head")
        valid = p.depth.isfinite() & (p.depth > 0) & p.variance.isfinite()
        stream = (p.depth, view.T_world_cam[None], view.intrinsics[None], p.aleatoric_variance, p.epistemic_variance)
        total = float(ufm.mean_uncertainty(*stream, valid, pixels=pixels, seed=i).mean)
        index, used = sample_pixels(valid, pixels, seed=i)  # the pixels that mean_uncertainty has taken
        truth = view.depth[None]
        scores["ufmstar"].append(total)
        scores["aleatoric"].append(_mean_at(p.aleatoric_variance, index, used))
        scores["disagreement"].append(total - _mean_at(p.variance, index, used))
        labelled = used & torch.gather((truth > 0).flatten(1), 1, index)
        scores["oracle"].append(_mean_at((p.depth - truth).square(), index, labelled))
    return scores


def select(scores: Sequence[float], budget: int, spacing: int, taken: Collection[int] = ()) -> list[int]:
    """Greedy picks: the highest score first, no two closer than ``spacing`` frames, nor to one that is taken already.

    Of equal scores the earlier frame wins; frames without a score (NaN) are never picked.

    Raises:
        ValueError: the pool is too short for the budget.
    """
    order = sorted((i for i, s in enumerate(scores) if not math.isnan(s)), key=lambda i: (-scores[i], i))
    picks: list[int] = []
    for i in order:
        if len(picks) < budget and all(abs(i - j) >= spacing for j in (*taken, *picks)):
            picks.append(i)
    if len(picks) < budget:
        raise ValueError(f"budget {budget} with spacing {spacing} does not fit into a pool of {len(scores)} frames")
    return picks


def fine_tune(
    start: Sequence[DepthNetwork], labelled: Sequence[View], settings: Settings, rng: np.random.Generator
) -> list[DepthNetwork]:
    """Copies of the networks, trained with the likelihood of the labels; mirrored images half of the time.

    The batch norms keep their statistics (eval mode): a dozen images are too few to estimate any.
    """
    members = copy.deepcopy(list(start))
    parameters = list({id(p): p for member in members for p in member.parameters()}.values())  # shared ones once
    steps = settings.steps // settings.rounds
    optimizer = torch.optim.Adam(parameters, settings.learning_rate)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1 - step / (steps * len(members)))
    for step in range(steps * len(members)):
        few = len(labelled) < settings.batch
        batch = [labelled[i] for i in rng.choice(len(labelled), settings.batch, replace=few)]
        image, depth = torch.stack([v.image for v in batch]), torch.stack([v.depth for v in batch])
        if rng.random() < 0.5:
            image, depth = image.flip(-1), depth.flip(-1)
        optimizer.zero_grad()
        loss_of(members[step % len(members)].distribution(image), depth, depth > 0).backward()
        torch.nn.utils.clip_grad_norm_(parameters, 10.0)
        optimizer.step()
        schedule.step()
    return members


def _mean_at(values: Tensor, index: Tensor, used: Tensor) -> float:
    """Mean of a map [1, H, W] over sampled pixels [1, n]; NaN without any."""
    return float(torch.gather(values.flatten(1), 1, index)[used].mean())


def run_strategy(
    strategy: str, start: Sequence[DepthNetwork], place: Environment, first: Mapping[str, list[float]],
    settings: Settings, seed: int,
) -> tuple[list[int], dict[str, dict[str, float]]]:  # fmt: skip
    """The loop: score, pick, label, fine-tune, and again.

    Args:
        strategy: one of `STRATEGIES`.
        start: the networks that all strategies start from; they stay as they are.
        place: where.
        first: `score_pool` of ``start``, which all strategies share.
        settings: of the experiment.
        seed: of random picks, and of the order of training.

    Returns:
        The frames picked, in this order, and `judge` of the held-back part.
    """
    chance = np.random.default_rng([seed, 1]).random(len(place.pool)).tolist()
    members, picks = list(start), []
    for number in range(settings.rounds):
        if strategy == "everything":
            picks = list(range(len(place.pool)))
        else:
            scores = {"random": chance} if strategy == "random" else first
            if number > 0 and strategy != "random":
                scores = score_pool(members, place.pool, settings.pixels)
            picks += select(scores[strategy], settings.budget // settings.rounds, settings.spacing, picks)
        rng = np.random.default_rng([seed, 2, number])
        members = fine_tune(members, [place.pool[i] for i in picks], settings, rng)
    return picks, judge(members, place.held_back)


def experiment(options: argparse.Namespace, settings: Settings) -> dict[str, Any]:
    """All strategies in all environments."""
    info, start = read_info(options.weights), load_trained(options.weights)
    places, runs = [], []
    for seed in range(options.seeds):
        place = open_environment(
            options.sequence, seed, frames=options.frames, stride=options.stride, held_back=options.held_back,
            size=info.spec.size, preprocess=start[0].preprocess,
        )  # fmt: skip
        cost = measure_cost(start, place.pool, settings.pixels)
        dense, sample = (set(select(m, settings.budget, settings.spacing)) for m in cost["means"].values())
        cost["picks_agree"] = len(dense & sample)
        first, before = score_pool(start, place.pool, settings.pixels), judge(start, place.held_back)
        rooms = [view.room for view in place.pool]
        places.append({"name": place.name, "rooms": rooms, "scores": first, "before": before, "cost": cost})
        for strategy in settings.strategies:
            picks, after = run_strategy(strategy, start, place, first, settings, seed)
            runs.append({"seed": seed, "strategy": strategy, "picks": picks, "after": after})
            shown = ", ".join(f"{part} {before[part]['rmse']:.3f} -> {after[part]['rmse']:.3f}" for part in after)
            print(f"{place.name}, {strategy}: RMSE [m] {shown}", flush=True)
    return {"weights": info.path.name, "networks": len(start), "places": places, "runs": runs}


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line; ``--quick`` sets small numbers where others are not given."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    shipped = Path(str(files("ufmstar_torch.models").joinpath("weights", "demo.safetensors")))
    defaults = {f.name: f.default for f in fields(Settings)} | {"seeds": 5, "frames": 160, "stride": 2, "held_back": 64}
    parser.add_argument("--out", type=Path, required=True, help="folder for results.json and active_learning.png")
    parser.add_argument("--sequence", default="tour:200001?style=mixed", help="tour:SEED?style=STYLE, or a recording")
    parser.add_argument("--weights", type=Path, default=shipped, help="of `ufmstar train` (default: the shipped ones)")
    parser.add_argument("--quick", action="store_true", help="a few frames and steps, to see it run")
    parser.add_argument("--seeds", type=int, help="repetitions: other rooms, random picks and order of training")
    parser.add_argument("--frames", type=int, help="of the pool")
    parser.add_argument("--stride", type=int, help="steps of the walk from one frame of the pool to the next")
    parser.add_argument("--held-back", type=int, help="frames that judge")
    parser.add_argument("--strategies", nargs="+", choices=STRATEGIES)
    for name in ("budget", "rounds", "spacing", "pixels", "steps", "batch"):
        parser.add_argument(f"--{name}", type=int, help="see Settings")
    parser.add_argument("--learning-rate", type=float, help="see Settings")
    given = vars(parser.parse_args(arguments))
    chosen = {name: value for name, value in given.items() if value is not None}
    return argparse.Namespace(**{**defaults, **(QUICK if given["quick"] else {}), **chosen})


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Run the experiment and leave results.json and active_learning.png in a folder."""
    options = parse(arguments)
    values = {f.name: getattr(options, f.name) for f in fields(Settings)}
    settings = Settings(**{**values, "strategies": tuple(values["strategies"])})
    options.out.mkdir(parents=True, exist_ok=True)
    wall, processor = time.perf_counter(), time.process_time()
    results = {"sequence": options.sequence, "settings": asdict(settings)} | experiment(options, settings)
    results |= {"seconds": time.perf_counter() - wall, "processor_seconds": time.process_time() - processor}
    results |= {"summary": summarise(results), "hardware": hardware()}
    write_json_atomic(options.out / "results.json", results)
    draw(options.out / "active_learning.png", results)
    print(report(results))
    return results


if __name__ == "__main__":
    main()
