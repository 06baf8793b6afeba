"""A method and a metric of your own on the evaluation's loop over frames, beside UfM*.

    python examples/own_method.py SEQUENCE --model fastdepth --weights fastdepth_nyu.onnx

A method is an ``Estimator``: a prediction and a pose in, a variance per pixel out. A metric is a ``FrameSink``: it sees
what every row makes of a frame, and the ground truth at the row's pixels. All rows share one pass over the images.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import torch

from ufmstar_torch import UfMStarConfig
from ufmstar_torch.eval.engine.estimators import Alone, Answer, Gaussians
from ufmstar_torch.eval.engine.judge import UFM, RunMetrics
from ufmstar_torch.eval.engine.load import network_source
from ufmstar_torch.eval.engine.rows import RowRunner
from ufmstar_torch.eval.engine.stream import FrameResult, FrameSink, FrameStream
from ufmstar_torch.eval.sequences import open_sequence


class ShareOfDepth(Alone):
    """A method: the standard deviation is a tenth of the depth. It keeps nothing from frame to frame."""

    def update(self, predicted: Any, T_world_cam: torch.Tensor, anchors: Any = None) -> Answer:
        """The variance of a frame [1, h, w] [m^2]."""
        answer = super().update(predicted, T_world_cam)
        return {**answer, "variance": (0.1 * answer["depth"]).square().where(answer["valid"], torch.nan)}


class Coverage(FrameSink):
    """A metric: the share of pixels whose truth lies within two standard deviations, by row."""

    def __init__(self) -> None:
        self.inside: dict[str, int] = {}
        self.pixels: dict[str, int] = {}

    def take(self, result: FrameResult) -> None:
        """Add a frame."""
        for key, row in result.rows.items():
            if row.truth is None or row.variance is None:
                continue
            truth = torch.from_numpy(row.truth)
            judged = row.valid & (truth > 0)
            error = (truth - row.depth)[judged].abs()
            hits = int((error <= 2 * row.variance[judged].sqrt()).sum())
            self.inside[key] = self.inside.get(key, 0) + hits
            self.pixels[key] = self.pixels.get(key, 0) + int(judged.sum())


def main(words: Sequence[str] | None = None) -> dict[str, dict[str, float]]:
    """Judge both methods; their figures by row."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sequence", help="a folder that ufmstar run reads, a video, or tour:SEED")
    parser.add_argument("--model", default="fastdepth", help="kind of network, as of ufmstar run")
    parser.add_argument("--weights", required=True, nargs="+")
    options = parser.parse_args(words)
    sequence, device = open_sequence(options.sequence), torch.device("cpu")
    source = network_source(options.model, options.weights)
    config = UfMStarConfig(on_bad_frame="skip")
    rows = [
        RowRunner("UfM*", source, Gaussians(config, device), skips_faults=True),
        RowRunner("a tenth", source, ShareOfDepth()),
    ]
    metrics, coverage = {row.key: RunMetrics(row.key, {}) for row in rows}, Coverage()
    FrameStream(sequence, range(len(sequence)), rows).drive([*metrics.values(), coverage])
    figures = {key: one.figures()[UFM] for key, one in metrics.items()}
    for key, values in figures.items():
        values["within 2 sigma"] = coverage.inside[key] / coverage.pixels[key]
        print(f"{key:8}", "  ".join(f"{name} {values[name]:.3f}" for name in ("rmse", "ece_delta", "within 2 sigma")))
    return figures


if __name__ == "__main__":
    main()
