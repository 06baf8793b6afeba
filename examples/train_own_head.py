"""A head on a depth network of your own: what does it gain, and what does UfM* add? `python examples/train_own_head.py`

The network learns depth in rendered rooms (instead of it, take yours). Then a head on the frozen network learns how far
it errs. Both are judged in other rooms, beside one constant variance.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from ufmstar_torch import DepthPrediction
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.frame import in_memory
from ufmstar_torch.models import AleatoricHead
from ufmstar_torch.train import DataConfig, judge_network, train_module

FIGURES = ("delta1", "nll", "ece_delta", "ece_q", "ause_rmse")


def network() -> nn.Module:
    """Image [B, 3, H, W] to depth [B, 1, H / 2, W / 2] [m]."""
    layers: list[nn.Module] = []
    for inputs, outputs, stride in ((3, 24, 2), (24, 48, 2), (48, 96, 2), (96, 96, 1), (96, 192, 1)):
        layers += [nn.Conv2d(inputs, outputs, 3, stride, 1), nn.BatchNorm2d(outputs), nn.ReLU()]
    return nn.Sequential(*layers, nn.PixelShuffle(4), nn.Conv2d(12, 1, 3, padding=1), nn.Softplus())


class Constant(nn.Module):
    """A network with one variance [m^2] for all pixels."""

    def __init__(self, depth: nn.Module, variance: float) -> None:
        super().__init__()
        self.depth, self.variance = depth, variance

    def forward(self, image: Tensor) -> DepthPrediction:
        """Depth [B, H, W] [m] of ``image`` [B, 3, H, W]."""
        depth: Tensor = self.depth(image).depth
        return DepthPrediction(depth, torch.full_like(depth, self.variance))


def main(words: Sequence[str] | None = None) -> dict[str, dict[str, float]]:
    """Train network and head, print the table, and return its figures by row."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("own_head"), help="folder for both trainings")
    parser.add_argument("--tours", type=int, default=12, help="rooms to learn from")
    parser.add_argument("--epochs", type=int, default=20, help="of each training")
    parser.add_argument("--judged", nargs="+", default=[f"tour:{seed}?frames=30&size=96x128" for seed in (1, 2)])
    options = parser.parse_args(words)
    size = {"tour_frames": 20, "tour_size": (96, 128), "render_workers": 2}
    data = DataConfig(kind="tour", tours=options.tours, validation_tours=2, **size)
    out, rooms = options.out, [in_memory(open_sequence(name)) for name in options.judged]
    how = {"epochs": options.epochs, "learning_rate": 3e-3, "overwrite": True}
    depth = train_module(network(), "depth-only", data, out / "depth", fine_tune=True, **how)
    rmse = json.loads((out / "depth" / "summary.json").read_text())["mean"]["val_rmse"]
    head = train_module(depth, AleatoricHead, data, out / "head", **how)
    rows = {"constant": judge_network(Constant(depth, rmse**2), rooms, rows=("network",))["network"]}
    rows["UfM* without head"] = judge_network(depth, rooms, rows=("ufmstar",))["ufmstar"]
    rows |= {f"head: {name}": row for name, row in judge_network(head, rooms).items()}
    print(f"| {' | '.join(('', *FIGURES))} |\n|{'---|' * (1 + len(FIGURES))}")
    for name, row in rows.items():
        print(f"| {name} | {' | '.join(f'{row.figures[figure]:.3f}' for figure in FIGURES)} |")
    return {name: dict(row.figures) for name, row in rows.items()}


if __name__ == "__main__":
    main()
