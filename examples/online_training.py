"""Online training: on which images of a walk does an update pay? The error against the number of updates, on tours.

A camera walks from rooms that its network knows into one that it does not; a label and a step of training are made on
some images. ``TrainDecision`` chooses them; beside it as many at random (all three take the first eight), all, none.
"""

from copy import deepcopy
from importlib.resources import files

import numpy as np
import torch
from jsonargparse import auto_cli

from ufmstar_torch import UfMStar
from ufmstar_torch.eval.metrics import mean_and_ci
from ufmstar_torch.eval.tour import tour_sequence
from ufmstar_torch.models import AleatoricNetwork, load_trained
from ufmstar_torch.online import TrainDecision, image_statistics
from ufmstar_torch.train import loss_of


def walk(images: list[list[torch.Tensor]], network: AleatoricNetwork, chosen: TrainDecision | set[int]) -> list[float]:
    """Number of updates, and the mean over the images of the RMSE [m] before an update on it."""
    ufm, labelled, errors, last, rng = UfMStar(), list[int](), [], images[0][2], np.random.default_rng(0)
    optimizer = torch.optim.Adam(network.parameters(), 1e-4)
    for i, (x, truth, pose, K) in enumerate(images):
        with torch.no_grad():
            p = network(x)
        errors.append(float((p.depth - truth).square().mean().sqrt()))
        result = ufm.mean_uncertainty(p.depth, pose, K, p.aleatoric_variance, seed=i)
        statistics = image_statistics(result, torch.linalg.inv(last) @ pose)
        if chosen(statistics) if isinstance(chosen, TrainDecision) else i in chosen:
            labelled, last = [*labelled, i], pose
            batch = [images[j] for j in (i, *rng.choice(labelled, 3))]  # with labels that it has already
            x, truth = (torch.cat([one[part] for one in batch]) for part in (0, 1))
            before = loss_of(network.distribution(x), truth, truth > 0)
            optimizer.zero_grad()
            torch.autograd.backward(before)
            torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
            optimizer.step()
            if isinstance(chosen, TrainDecision):
                with torch.no_grad():
                    chosen.learn(statistics, float(before - loss_of(network.distribution(x), truth, truth > 0)))
    return [len(labelled), float(np.mean(errors))]


def main(walks: int = 4, frames: int = 64, cost: float = 0.06) -> None:
    """Tours 301, 302, ... under every choice: updates, RMSE [m], and its difference to random. cost: [nats]"""
    start = load_trained(str(files("ufmstar_torch.models").joinpath("weights", "demo.safetensors")))[0]
    assert isinstance(start, AleatoricNetwork)
    results: dict[str, list[list[float]]] = {name: [] for name in ("decided", "random", "all", "none")}
    for seed in range(301, 301 + walks):
        tour, rest, images = tour_sequence(seed, frames=4 * frames, style="mixed"), np.random.default_rng(seed), []
        for f in (tour[4 * i] for i in range(frames)):
            x, K = start.preprocess(torch.as_tensor(f.image).movedim(-1, 0)[None], f.intrinsics)
            images.append([x, torch.as_tensor(f.depth)[None], torch.as_tensor(f.T_world_cam), K])
        results["decided"].append(walk(images, deepcopy(start), TrainDecision(cost)))
        order = [*range(8), *rest.permutation(np.arange(8, frames)).tolist()]
        for name, count in (("random", int(results["decided"][-1][0])), ("all", frames), ("none", 0)):
            results[name].append(walk(images, deepcopy(start), set(order[:count])))
    for name, each in results.items():
        less, half = mean_and_ci(one[1] - random[1] for one, random in zip(each, results["random"], strict=True))
        print(
            "{:8} {:4.0f} updates  RMSE {:.3f} m, less random's {:+.3f} +- {:.3f}".format(
                name, *np.mean(each, 0), less, half
            )
        )


if __name__ == "__main__":
    auto_cli(main)
