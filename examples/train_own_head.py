"""Train an uncertainty head on your own depth network, then evaluate it with and without UfM*. `python
examples/train_own_head.py`

The network (replace it with yours) learns depth in rendered rooms. The head learns the frozen network's errors in
others.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ufmstar_torch import DepthPrediction
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.frame import in_memory
from ufmstar_torch.models import AleatoricHead, wrap_network
from ufmstar_torch.train import DataConfig, judge_network, train_module
from ufmstar_torch.train.uncertainty import LOGGED

DATA = DataConfig("tour", tours=10, validation_tours=2, tour_frames=20, tour_size=(96, 128))
ROOMS = ("tour:1?frames=30&size=96x128", "tour:2?frames=30&size=96x128")


def network() -> nn.Module:
    """Image [B, 3, H, W] to depth [B, 1, H / 2, W / 2] [m]."""
    layers: list[nn.Module] = []
    for inputs, outputs, stride in ((3, 24, 2), (24, 48, 2), (48, 96, 2), (96, 96, 1), (96, 192, 1)):
        layers += [nn.Conv2d(inputs, outputs, 3, stride, 1), nn.BatchNorm2d(outputs), nn.ReLU()]
    return nn.Sequential(*layers, nn.PixelShuffle(4), nn.Conv2d(12, 1, 3, padding=1), nn.Softplus())


def main(words: list[str] | None = None) -> dict[str, dict[str, float]]:
    """Train network and head, print the table, and return its figures by row."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, default=Path("own_head"), help="folder for both trainings")
    parser.add_argument("--epochs", type=int, default=12, help="of each training; 2 end within a minute")
    o = parser.parse_args(words)
    rooms = [in_memory(open_sequence(name)) for name in ROOMS]
    how: dict[str, Any] = {"epochs": o.epochs, "learning_rate": 3e-3, "overwrite": True}
    depth = train_module(network(), "depth-only", DATA, o.out / "depth", fine_tune=True, **how)
    head = train_module(depth, AleatoricHead, replace(DATA, first_tour=20_000), o.out / "head", **how)
    rmse = json.loads((o.out / "depth" / "summary.json").read_text())["mean"]["val_rmse"]
    # The same depth with one variance for all pixels.
    constant = wrap_network(lambda x: DepthPrediction(depth(x).depth, torch.full_like(x[:, 0], rmse**2)))
    judged = {"constant": judge_network(constant, rooms, rows=("network",))["network"]}
    judged["UfM* without head"] = judge_network(depth, rooms, rows=("ufmstar",))["ufmstar"]
    judged |= {f"head: {name}": row for name, row in judge_network(head, rooms).items()}
    figures = {name: metrics.compute() for name, metrics in judged.items()}
    for name, row in figures.items():
        print(f"{name:18}", "  ".join(f"{figure} {row[figure]:.3f}" for figure in LOGGED))
    return figures


if __name__ == "__main__":
    main()
