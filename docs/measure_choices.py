"""Measures two choices that the paper leaves open, with the paper's settings.

    python docs/measure_choices.py --root ../shared
    python docs/measure_choices.py --tours 200:203

prints, for every sequence, the figures of UfM* by the extent of a Gaussian in the regression's search, and the
number of Gaussians of at least 32 rows, if rows are merged segments, or rows of the image. docs/algorithm.md has the
results.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import torch
from clips import Clip, add_sources, clips, estimate, judge, line, shown

from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.kernels.cpu.segment import segment

PAPER = UfMStarConfig.paper()


def extending(sigmas: float) -> UfMStarConfig:
    """The paper's settings with another extent of a Gaussian, which is a constant."""
    return type("Extending", (UfMStarConfig,), {"neighbourhood_sigmas": sigmas})(**vars(PAPER))


SEARCHES = {
    **{f"{s:g} sigma": extending(s) for s in (1.0, 2.0, 3.0)},
    "all Gaussians": PAPER.replace(regression="exact"),
}  # fmt: skip


def searches(clip: Clip, stride: int) -> None:
    """RMS sigma [m], ECE_delta and ECE_q by the extent of a Gaussian in the search within .1 m."""
    for name, config in SEARCHES.items():
        figures = judge(clip, estimate(clip, UfMStar(config)), stride)
        line(clip.name, name, *(shown(figures[key]) for key in ("rms", "ece_delta", "ece_q")))


def gaussians(depth: np.ndarray, K: np.ndarray) -> tuple[int, int]:
    """Gaussians of a depth map of at least 2,000 pixels that have 32 merged segments, and that cover 32 image rows."""
    maps = torch.from_numpy(depth)[None], torch.from_numpy(K)[None]
    size = maps[0].shape[1:]
    labels = segment(*maps, replace(PAPER.segment, min_rows=1).scaled_to(*size))[1][0]
    rows = [int((labels == label).any(1).sum()) for label in range(int(labels.max()) + 1)]
    merged = segment(*maps, PAPER.segment.scaled_to(*size))[0]
    return int(merged.components[0]), sum(count >= PAPER.segment.min_rows for count in rows)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_sources(parser)
    arguments = parser.parse_args()
    for clip in clips(arguments):
        searches(clip, 4)
        counts = np.array([gaussians(depth, clip.K) for depth in clip.depth])
        line(clip.name, "Gaussians a frame", *(f"{mean:.1f}" for mean in counts.mean(0)))


if __name__ == "__main__":
    main()
