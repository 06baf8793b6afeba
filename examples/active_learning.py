"""Active learning with UfM*: which images of a walk are worth a label?

Every round streams the walk through the network(s) and UfM*, averages the variance of each image over 1,000 of its
pixels (section "Compute- and memory efficiency"), picks the most uncertain images under a budget, takes their ground
truth as labels and fine-tunes. Random picks, picks by the network's own variance and picks by the true error do the
same, from the same weights and with as many steps; views of the same rooms from another walk judge them all.

    python examples/active_learning.py --out results.json

`ufmstar_torch.train` trains networks; `ufmstar rank` scores your own images.
"""

from __future__ import annotations

import argparse
import copy
import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch import DepthPrediction, UfMStar, UfMStarConfig
from ufmstar_torch.eval.metrics import NLL, RMSE, Delta1
from ufmstar_torch.eval.run.files import write_json_atomic
from ufmstar_torch.eval.sequences import Frame, open_sequence
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.eval.tour import make_tour, tour_sequence
from ufmstar_torch.models import DepthNetwork, Preprocess, load_trained, read_info
from ufmstar_torch.train.losses import loss_of

# An image's score: none; mean A; mean V = M + A; mean M alone; the true mean squared error, which is unknown before
# labelling; and, beyond any budget, all labels at once.
STRATEGIES = ("random", "aleatoric", "ufmstar", "disagreement", "oracle", "everything")
# Rooms by the style of a tour's; the shipped networks were trained in homes and saw no hall.
ROOMS = {"home": "seen", "hall": "unseen"}


@dataclass(frozen=True, eq=False)
class View:
    """A posed frame as the network sees it."""

    image: Tensor  # [3, h, w] float32, the network's input
    depth: Tensor  # [h, w] float32 ground truth [m], 0 = none: the label, if it is asked for
    T_world_cam: Tensor  # [4, 4] float64 [m]
    intrinsics: Tensor  # [3, 3] float64 of the network's input [px]
    room: str = ""  # "seen", "unseen", or "" where it is not known


def views(frames: Iterable[Frame], preprocess: Preprocess, tour: Any = None) -> list[View]:
    """Frames with image and depth as views. Raises ValueError: a frame lacks one of the two."""
    result = []
    for frame in frames:
        if frame.image is None or frame.depth is None:
            raise ValueError(f"frame {frame.name} has no {'image' if frame.image is None else 'depth'}: it needs both")
        x, K = preprocess(image_tensor(frame), torch.from_numpy(frame.intrinsics)[None])
        truth, pose = truth_at(frame, K[0].numpy(), (x.shape[-2], x.shape[-1])), torch.from_numpy(frame.T_world_cam)
        assert truth is not None
        room = "" if tour is None else ROOMS[tour.style_at(pose[:3, 3])]
        result.append(View(x[0], torch.from_numpy(truth), pose, K[0], room))
    return result


def open_place(options: argparse.Namespace, repetition: int, preprocess: Preprocess, size: tuple[int, int]) -> Any:
    """The pool, of which some views may be labelled, and the held-back views that judge.

    In a tour, both are walks through the same rooms with another start, direction, sway and glances. In a recording,
    they are its first 60 % and its last 35 %, so that no neighbour of a labelled frame is judged.
    """
    if options.sequence is not None:
        sequence = open_sequence(options.sequence)
        pool = range(0, int(0.6 * len(sequence)), options.stride)[: options.frames]
        judged = sorted({*np.linspace(int(0.65 * len(sequence)), len(sequence) - 1, options.held_back).round()})
        return [views((sequence[int(i)] for i in part), preprocess) for part in (pool, judged)]
    seed, parts = options.tour + repetition, []
    for path, count, stride in ((0, options.frames, options.stride), (1, options.held_back, 5)):
        walk = tour_sequence(seed, frames=count * stride, size=size, style="mixed", path_seed=path)
        frames = (walk[i] for i in range(0, count * stride, stride))
        parts.append(views(frames, preprocess, make_tour(seed, "mixed")))
    return parts


def predict(members: Sequence[DepthNetwork], view: View, index: int) -> DepthPrediction:
    """One inference, as `UncertainDepth` alternates them: image i by member i mod N."""
    with torch.no_grad():
        prediction: DepthPrediction = members[index % len(members)](view.image[None])
    return prediction


def score_pool(members: Sequence[DepthNetwork], pool: Sequence[View], pixels: int) -> dict[str, list[float]]:
    """Stream the pool once and score every image, by V, A and M over the same sample of pixels.

    Returns:
        By strategy, [m^2]: "ufmstar" V, "aleatoric" A, "disagreement" M, "oracle" squared error.

    Raises:
        ValueError: a network that predicts no aleatoric variance.
    """
    ufm = UfMStar(UfMStarConfig(unmeasured="paper"))  # V counts measured disagreement alone
    scores: dict[str, list[float]] = {name: [] for name in ("ufmstar", "aleatoric", "disagreement", "oracle")}
    for i, view in enumerate(pool):
        p = predict(members, view, i)
        if p.aleatoric_variance is None or p.variance is None:
            raise ValueError("the network must have an aleatoric or evidential head")
        valid = p.depth.isfinite() & (p.depth > 0) & p.variance.isfinite()
        stream = (p.depth, view.T_world_cam[None], view.intrinsics[None], p.aleatoric_variance, p.epistemic_variance)
        result = ufm.mean_uncertainty(*stream, valid, pixels=pixels, seed=i)
        for name, part in (("ufmstar", result.total), ("disagreement", result.disagreement)):
            scores[name].append(float(part.mean))
        scores["aleatoric"].append(float(result.aleatoric.mean) if result.aleatoric else math.nan)
        labelled = valid & (view.depth > 0)
        scores["oracle"].append(float((p.depth - view.depth)[labelled].square().mean()))
    return scores


def select(scores: Sequence[float], budget: int, spacing: int, taken: Collection[int] = ()) -> list[int]:
    """Greedy picks: the highest score first, no two closer than ``spacing`` frames, nor to one that is ``taken``.

    The earlier of two frames with equal scores wins; frames without a score (NaN) are never picked.

    Raises:
        ValueError: the pool is too short for the budget.
    """
    picks: list[int] = []
    for i in sorted((i for i, s in enumerate(scores) if not math.isnan(s)), key=lambda i: (-scores[i], i)):
        if len(picks) < budget and all(abs(i - j) >= spacing for j in (*taken, *picks)):
            picks.append(i)
    if len(picks) < budget:
        raise ValueError(f"budget {budget} with spacing {spacing} does not fit into a pool of {len(scores)} frames")
    return picks


def fine_tune(
    start: Sequence[DepthNetwork], labelled: Sequence[View], options: argparse.Namespace, rng: np.random.Generator
) -> list[DepthNetwork]:
    """Copies of the networks, trained with the likelihood of the labels; mirrored images half of the time.

    The batch norms keep their statistics (eval mode): a dozen images are too few to estimate any.
    """
    members = copy.deepcopy(list(start))
    parameters = list({id(p): p for member in members for p in member.parameters()}.values())  # shared ones once
    steps = options.steps // options.rounds * len(members)
    optimizer = torch.optim.Adam(parameters, options.learning_rate)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1 - step / steps)
    for step in range(steps):
        few = len(labelled) < options.batch
        batch = [labelled[i] for i in rng.choice(len(labelled), options.batch, replace=few)]
        image, depth = torch.stack([v.image for v in batch]), torch.stack([v.depth for v in batch])
        if rng.random() < 0.5:
            image, depth = image.flip(-1), depth.flip(-1)
        optimizer.zero_grad()
        loss_of(members[step % len(members)].distribution(image), depth, depth > 0).backward()
        torch.nn.utils.clip_grad_norm_(parameters, 10.0)
        optimizer.step()
        schedule.step()
    return members


def judge(members: Sequence[DepthNetwork], held_back: Sequence[View]) -> dict[str, dict[str, float]]:
    """delta1, RMSE [m] and NLL [nats, with the network's own variance] of all views and by kind of room."""
    parts = ["all", *sorted({view.room for view in held_back} - {""})]
    metrics = {part: (Delta1(), RMSE(), NLL()) for part in parts}
    for i, view in enumerate(held_back):
        p = predict(members, view, i)
        for part in {"all", view.room} - {""}:
            for metric in metrics[part]:
                metric.update(p.depth, p.variance, view.depth[None])
    figures = {part: {k: float(v) for m in metrics[part] for k, v in m.compute().items()} for part in parts}
    return {part: {name: figures[part][name] for name in ("delta1", "rmse", "nll")} for part in parts}


def run_strategy(
    strategy: str, start: Sequence[DepthNetwork], pool: Sequence[View], options: argparse.Namespace, seed: int
) -> tuple[list[int], list[DepthNetwork]]:
    """The loop: score, pick, label, fine-tune, and again; ``seed``: of random picks and of the order of training.

    Returns:
        The frames picked, in this order, and the networks that were trained on them.
    """
    chance = np.random.default_rng([seed, 1]).random(len(pool)).tolist()
    members, picks = list(start), list(range(len(pool))) if strategy == "everything" else []
    for number in range(options.rounds):
        if strategy != "everything":
            scores = chance if strategy == "random" else score_pool(members, pool, options.pixels)[strategy]
            picks += select(scores, options.budget // options.rounds, options.spacing, picks)
        rng = np.random.default_rng([seed, 2, number])
        members = fine_tune(members, [pool[i] for i in picks], options, rng)
    return picks, members


def gap(values: Sequence[float]) -> str:
    """Mean and half width of its 95 % confidence interval (Student's t)."""
    from scipy.stats import t

    n = len(values)
    half = float(t.ppf(0.975, n - 1)) * stdev(values) / math.sqrt(n) if n > 1 else math.nan
    return f"{fmean(values):+.3f} ± {half:.3f}"


def report(results: dict[str, Any]) -> str:
    """A table for each part of the held-back views: RMSE [m] before, after, and less that of random picks.

    Rooms differ more than strategies do: the difference within a seed tells more than two means side by side.
    """
    lines, places = [], results["places"]
    for part in places[0]["before"]:
        before = fmean(place["before"][part]["rmse"] for place in places)
        lines += [f"\n{part} ({len(places)} seeds; RMSE before: {before:.3f} m)\n"]
        lines += ["| picks by | RMSE [m] | less random's [m] |", "|---|---|---|"]
        for strategy in places[0]["after"]:
            after = [place["after"][strategy][part]["rmse"] for place in places]
            chance = [place["after"].get("random", place["after"][strategy])[part]["rmse"] for place in places]
            less = gap([a - b for a, b in zip(after, chance, strict=True)])
            lines.append(f"| {strategy} | {fmean(after):.3f} | {'-' if strategy == 'random' else less} |")
    return "\n".join(lines)


def parse(words: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    shipped = Path(str(files("ufmstar_torch.models").joinpath("weights", "demo.safetensors")))
    parser.add_argument("--out", type=Path, default=Path("active_learning.json"))
    parser.add_argument("--weights", type=Path, default=shipped, help="of `ufmstar train` (default: the shipped ones)")
    parser.add_argument("--sequence", help="a recording with depth; without it, tours are walked through")
    parser.add_argument("--tour", type=int, default=200001, help="first seed; every repetition has other rooms")
    parser.add_argument("--strategies", nargs="+", choices=STRATEGIES, default=STRATEGIES)
    for name, default, text in (
        ("seeds", 4, "repetitions"),
        ("frames", 160, "of the pool"),
        ("stride", 2, "steps of the walk from one frame of the pool to the next"),
        ("held-back", 64, "frames that judge"),
        ("budget", 12, "labels in all, divided among the rounds"),
        ("rounds", 2, "of scoring, picking and fine-tuning"),
        ("spacing", 4, "least distance of two picked frames, so that no budget goes into near-duplicates"),
        ("pixels", 1000, "that the mean of an image is taken over"),
        ("steps", 30, "of fine-tuning per network, divided among the rounds"),
        ("batch", 4, "images per step"),
    ):
        parser.add_argument(f"--{name}", type=int, default=default, help=text)
    parser.add_argument("--learning-rate", type=float, default=3e-4, help="of Adam; falls to 0 in each round")
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> dict[str, Any]:
    """Run all strategies in all places, print the tables, and write every pick and figure as JSON."""
    options = parse(words)
    start, size = load_trained(options.weights), read_info(options.weights).spec.size
    places = []
    for seed in range(options.seeds):
        pool, held_back = open_place(options, seed, start[0].preprocess, size)
        place: dict[str, Any] = {"before": judge(start, held_back), "picks": {}, "after": {}}
        for strategy in options.strategies:
            place["picks"][strategy], members = run_strategy(strategy, start, pool, options, seed)
            place["after"][strategy] = judge(members, held_back)
        places.append(place)
    results = {"settings": vars(options), "places": places}
    write_json_atomic(options.out, results)
    print(report(results))
    return results


if __name__ == "__main__":
    main()
