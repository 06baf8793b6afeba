"""Online training on tours: for which images is a label and a training step worth its cost?

Compares ``TrainDecision`` with random selection of as many images, with all images and with none. Every selection but
the last includes the first eight images.
"""

import sys
from copy import deepcopy
from importlib.resources import files
from typing import Any

import numpy as np
import torch
import tyro
from train_decision import TrainDecision, image_statistics

from ufmstar_torch import UfMStar
from ufmstar_torch.eval.metrics import mean_and_ci
from ufmstar_torch.eval.tour import tour_sequence
from ufmstar_torch.models import load_trained
from ufmstar_torch.train import loss_of


def walk(images: list[Any], network: Any, chosen: TrainDecision | set[int]) -> tuple[int, float]:
    """Number of updates, and the mean over the images of the RMSE [m] before an update on it."""
    ufm, labelled, errors, last, rng = UfMStar(), list[int](), [], images[0][2], np.random.default_rng(0)
    optimizer = torch.optim.Adam(network.parameters(), 1e-4)
    for i, (x, truth, pose, K) in enumerate(images):
        p = torch.no_grad()(network)(x)
        errors.append(float((p.depth - truth).square().mean().sqrt()))
        result = ufm.mean_uncertainty(p.depth, pose, K, p.aleatoric_variance, seed=i)
        statistics = image_statistics(result, torch.linalg.inv(last) @ pose)
        if chosen(statistics) if isinstance(chosen, TrainDecision) else i in chosen:
            labelled, last = [*labelled, i], pose
            batch = [images[j] for j in (i, *rng.choice(labelled, 3))]  # on earlier labels
            x, truth = (torch.cat([one[part] for one in batch]) for part in (0, 1))
            before = loss_of(network.distribution(x), truth, truth > 0)
            optimizer.zero_grad()
            torch.autograd.backward(before)
            torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
            optimizer.step()
            if isinstance(chosen, TrainDecision):
                after = loss_of(network.distribution(x), truth, truth > 0)
                chosen.learn(statistics, float((before - after).detach()))
    return len(labelled), float(np.mean(errors))


def main(walks: int = 4, frames: int = 64, cost: float = 0.06) -> dict[str, list[tuple[int, float]]]:
    """Tours 301, 302, ...: by choice the mean updates, RMSE [m], its difference to random's, interval; cost [nats]."""
    start: Any = load_trained(str(files("ufmstar_torch.models").joinpath("weights", "demo.safetensors")))[0]
    results: dict[str, list[tuple[int, float]]] = {name: [] for name in ("decided", "random", "all", "none")}
    for seed in range(301, 301 + walks):
        print(f"tour {seed}", file=sys.stderr, flush=True)
        tour = tour_sequence(seed, frames=4 * frames, style="mixed")
        each: Any = ((f, start.preprocess(f.image, f.intrinsics)) for f in (tour[4 * i] for i in range(frames)))
        images = [[x, *map(torch.from_numpy, (f.depth[None], f.T_world_cam)), K] for f, (x, K) in each]
        results["decided"].append(walk(images, deepcopy(start), TrainDecision(cost)))
        order = [*range(8), *np.random.default_rng(seed).permutation(range(8, frames)).tolist()]
        for name, count in (("random", results["decided"][-1][0]), ("all", frames), ("none", 0)):
            results[name].append(walk(images, deepcopy(start), set(order[:count])))
    print(f"{'choice':8} {'updates':>8} {'RMSE [m]':>9}  difference to random [m]{', 95 % interval' * (walks > 1)}")
    for name, rows in results.items():
        updates, rmse = np.mean(rows, 0)
        mean, interval = mean_and_ci(np.subtract(rows, results["random"])[:, 1])
        print(f"{name:8} {updates:8.1f} {rmse:9.3f}  {mean:+.3f}{f' +- {interval:.3f}' * (walks > 1)}")
    return results


if __name__ == "__main__":
    tyro.cli(main)
