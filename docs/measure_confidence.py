"""Measures the benefit of a confidence in an arbitrary unit: UfM* with anchors on rendered tours, with and without it.

    python docs/measure_confidence.py

The network is the demo's first one, which predicts sigma. The rows ignore sigma ("today"), pass it in metres (A), or
pass a confidence: 1/(1 + sigma^2), a logit that rises with the error, sigma per depth, or random numbers. Each row has,
for both sources of anchors, means over tours, the paired difference to "today" with its 95 % interval, and the NLL of
the posterior.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from clips import demo_networks, line
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch import (
    AnchorConfig,
    DepthPrediction,
    PosteriorConfig,
    UfMStarConfig,
    UncertainDepth,
)
from ufmstar_torch.anchors import Anchors, landmark_source
from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.eval.sequences.open import open_sequence

KINDS_OF_TOURS = ("811?style=home", "812?style=hall", "813?style=home", "815?style=mixed", "816?style=hall",
                  "821?style=blank", "823?style=mixed", "832?style=blank&pan=1")  # fmt: skip
SOURCES, FIGURES = ("dense", "corners"), ("ece_delta", "nll", "ause_rmse", "spearman")
STUDENT = 2.365  # 97.5 % quantile for eight tours
A = "A, in metres"
UNITS: dict[str, Callable[[Tensor, Tensor], Tensor] | None] = {
    "today": None,
    A: None,
    "1/(1 + σ²)": lambda d, s: 1 / (1 + s**2),
    "logit": lambda d, s: (s / (5 - s.clamp_max(4.99))).log(),
    "σ/d": lambda d, s: s / d,
    "random": lambda d, s: torch.rand(d.shape, generator=torch.Generator().manual_seed(int(1e4 * d.mean()))),
}


@dataclass(frozen=True, eq=False)
class Prepared:
    """One frame: depth and sigma [1, h, w] [m], truth [h, w], pose, K, and anchors by source."""

    depth: Tensor
    sigma: Tensor
    truth: Tensor
    pose: Tensor
    K: Tensor
    anchors: dict[str, Anchors]


def prepare(source: str) -> list[Prepared]:
    """The frames of a tour."""
    network, sources = demo_networks()[0], {kind: landmark_source(kind) for kind in SOURCES}
    prepared = []
    for frame in open_sequence(source).readable(print):
        with torch.no_grad():
            x, K = network.preprocess(image_tensor(frame), torch.from_numpy(frame.intrinsics)[None].double())
            text = network(x)
        depth, truth = text.depth.float(), truth_at(frame, K[0].numpy(), (text.depth.shape[1], text.depth.shape[2]))
        found = {k: s.update(frame.image, frame.T_world_cam, frame.intrinsics) for k, s in sources.items()}
        anchors = {k: marks.anchors(frame.intrinsics, K) for k, marks in found.items()}
        pose = torch.from_numpy(frame.T_world_cam)[None]
        prepared.append(Prepared(depth, text.aleatoric_variance.sqrt(), torch.from_numpy(truth), pose, K, anchors))
    return prepared


def figures(prepared: list[Prepared], source: str, unit: str) -> list[float]:
    """``FIGURES`` of V, the share of frames in which the confidence is used, and the NLL of the posterior."""
    to_unit = UNITS[unit]
    sections = {"confidence": to_unit is not None, "posterior": PosteriorConfig()}
    model = UncertainDepth(None, UfMStarConfig(anchors=AnchorConfig(), **sections))
    metrics, corrected, used = SequenceMetrics(), SequenceMetrics(), 0.0
    for one in prepared:
        a = one.sigma.square() if unit == A else None
        c = None if to_unit is None else to_unit(one.depth, one.sigma)
        prediction = DepthPrediction(one.depth, a, confidence=c)
        out = model.update(prediction, one.pose, one.K, anchors=one.anchors[source])
        metrics.update(one.depth[0], out.ufm_variance[0], one.truth)
        corrected.update(out.depth[0], out.variance[0], one.truth)
        confidence = out.statistics.confidence
        used += confidence is not None and float(confidence) > 0
    found = metrics.compute()
    return [*(found[name] for name in FIGURES), used / len(prepared), corrected.compute()["nll"]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tours", nargs="+", default=KINDS_OF_TOURS, help="seed and style, as 811?style=home")
    parser.add_argument("--frames", type=int, default=60, help="of a tour")
    arguments = parser.parse_args()
    rows: dict[tuple[str, str], list[list[float]]] = {(s, unit): [] for s in SOURCES for unit in UNITS}
    for tour in arguments.tours:
        prepared = prepare(f"tour:{tour}&frames={arguments.frames}&size=240x320")
        for source, unit in rows:
            rows[source, unit].append(figures(prepared, source, unit))
    line("", *FIGURES, "used", "posterior's NLL")
    line(*["---"] * 7)
    for (source, unit), values in rows.items():
        line(f"{source}: {unit}", *compared(np.array(values), np.array(rows[source, "today"])))


def compared(values: NDArray[np.float64], today: NDArray[np.float64]) -> list[str]:
    """Means [figures] over tours, with the paired difference to ``today`` ± 95 %."""
    difference = values - today
    spread = STUDENT * difference.std(0, ddof=1) / len(values) ** 0.5 if len(values) > 1 else np.zeros(len(values[0]))
    shown = [f"{mean:.3f}" for mean in values.mean(0)]
    if not difference.any():
        return shown
    pairs = list(zip(shown, difference.mean(0), spread, strict=True))
    return [
        f"{mean} ({by:+.3f} ± {half:.3f})" if i != len(FIGURES) else mean for i, (mean, by, half) in enumerate(pairs)
    ]


if __name__ == "__main__":
    main()
