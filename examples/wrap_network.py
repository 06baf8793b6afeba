"""Run your own depth network with UfM*, and evaluate its variance and corrected depth in a rendered hall.

Replace `network` by yours: any function or module from images to depth, here in a dict.
"""

from importlib.resources import files
from typing import Any

import torch
import tyro
from torch import Tensor

from ufmstar_torch import UncertainDepth
from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.tour import tour_sequence
from ufmstar_torch.models import load_trained, wrap_network


def main(tour: int = 5, frames: int = 40) -> dict[str, SequenceMetrics]:
    """The figures of depth and variance, by row."""
    pretrained: Any = load_trained(str(files("ufmstar_torch.models").joinpath("weights", "demo.safetensors")))[0]

    def network(image: Tensor) -> dict[str, Tensor]:
        return {"metric_depth": pretrained(image).depth}

    wrapped = wrap_network(network, "metric_depth", preprocess=pretrained.preprocess)
    model = UncertainDepth(wrapped)
    rows = {"UfM*": SequenceMetrics(), "posterior": SequenceMetrics()}
    walk = tour_sequence(tour, frames=150, style="hall")
    for frame in (walk[i] for i in range(frames)):
        out = model(frame.image, frame.T_world_cam, frame.intrinsics)  # NumPy arrays, PIL images or tensors
        truth = wrapped.preprocess.apply_depth(torch.from_numpy(frame.depth))
        rows["UfM*"].update(out.network_depth[0], out.ufm_variance[0], truth)
        rows["posterior"].update(out.depth[0], out.variance[0], truth)
    for name, metrics in rows.items():
        figures = metrics.compute()
        print(f"{name:10}", *(f"{key} {figures[key]:.3f}" for key in ("delta1", "rmse", "nll", "ece_delta", "ece_q")))
    return rows


if __name__ == "__main__":
    tyro.cli(main)
