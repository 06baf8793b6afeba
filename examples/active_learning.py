"""Active learning on tours: which images of a walk are worth a label?

Two rounds label the images with the largest mean variance, or random images. Another walk is the test set.
"""

import sys
from copy import deepcopy
from importlib.resources import files
from typing import Any

import numpy as np
import torch
import tyro

from ufmstar_torch import UfMStar
from ufmstar_torch.eval.metrics import DepthAccuracy, mean_and_ci
from ufmstar_torch.eval.tour import tour_sequence
from ufmstar_torch.frames.choose import choose
from ufmstar_torch.models import load_trained
from ufmstar_torch.train import loss_of

PARTS = {"mean A": "aleatoric", "mean V": "total", "mean M": "disagreement"}


def walk(seed: int, path: int, frames: int, network: Any) -> list[Any]:
    """Every second image of a walk as the network sees it, its true depth, pose and intrinsics."""
    tour = tour_sequence(seed, frames=2 * frames, style="mixed", path_seed=path)
    each: Any = ((f, network.preprocess(f.image, f.intrinsics)) for f in (tour[2 * i] for i in range(frames)))
    return [(x, torch.from_numpy(f.depth[None]), torch.from_numpy(f.T_world_cam), K) for f, (x, K) in each]


def scores(network: Any, images: list[Any], part: str) -> list[float]:
    """The mean of one part of every image's variance over 1,000 of its pixels [m^2]."""
    ufm, found = UfMStar(), list[float]()
    for i, (x, _, pose, K) in enumerate(images):
        p = torch.no_grad()(network)(x)
        found.append(float(getattr(ufm.mean_uncertainty(p.depth, pose, K, p.aleatoric_variance, seed=i), part).mean))
    return found


def trained(network: Any, labelled: list[Any], steps: int, rng: np.random.Generator) -> Any:
    """The network, trained further with the likelihood of the labels."""
    optimizer = torch.optim.Adam(network.parameters(), 3e-4)
    for _ in range(steps):
        batch = [labelled[i] for i in rng.choice(len(labelled), 4)]
        x, truth = (torch.cat([one[part] for one in batch]) for part in (0, 1))
        optimizer.zero_grad()
        torch.autograd.backward(loss_of(network.distribution(x), truth, truth > 0))
        optimizer.step()
    return network


def main(seeds: int = 4, frames: int = 160, labels: int = 12, steps: int = 60) -> dict[str, list[float]]:
    """By selection rule: mean RMSE [m] after training, its difference to random selection, and the interval."""
    start: Any = load_trained(str(files("ufmstar_torch.models").joinpath("weights", "demo.safetensors")))[0]
    results: dict[str, list[float]] = {name: [] for name in ("before", "random", *PARTS)}
    for seed in range(200_001, 200_001 + seeds):
        pool, held_back = (walk(seed, path, frames, start) for path in (0, 1))
        for name, rows in results.items():
            print(f"walk {seed}: {name}", file=sys.stderr, flush=True)
            network, chosen, rng, errors = start, list[int](), np.random.default_rng(seed), DepthAccuracy()
            for _ in range(0 if name == "before" else 2):
                score = np.array(scores(network, pool, PARTS[name]) if name in PARTS else rng.random(frames))
                score[chosen] = np.nan
                chosen += choose(torch.from_numpy(score), labels // 2, poses=torch.stack([one[2] for one in pool]))
                network = trained(deepcopy(network), [pool[i] for i in chosen], steps, rng)
            for x, truth, *_ in held_back:
                errors.update(torch.no_grad()(network)(x).depth, None, truth)
            rows.append(float(errors.compute()["rmse"]))
    print(f"{'choice':8} {'RMSE [m]':>9}  difference to random [m]{', 95 % interval' * (seeds > 1)}")
    for name, rows in results.items():
        mean, interval = mean_and_ci(np.subtract(rows, results["random"]))
        print(f"{name:8} {np.mean(rows):9.3f}  {mean:+.3f}{f' +- {interval:.3f}' * (seeds > 1)}")
    return results


if __name__ == "__main__":
    tyro.cli(main)
