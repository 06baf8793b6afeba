"""How much the constants of anchors matter, where poses and depths are exact: rendered tours.

    python docs/measure_anchors.py --tours 60:66

prints the table of docs/anchors.md: the demo's first network, depth alone; means over the tours.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from clips import Clip, add_sources, clips, judge, line, shown

from ufmstar_torch import AnchorConfig, UfMStar, UfMStarConfig
from ufmstar_torch.anchors import Landmarks, LandmarkTracker, TrackerConfig
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.sequences.open import open_sequence

STRIDE = 4  # judged are every fourth pixel of every fourth row
ANCHORED: Mapping[str, Any] = {"anchors": AnchorConfig()}
# What is tried: of UfM*, and of the tracker.
OF_UFM: tuple[Mapping[str, Any], ...] = (
    {},
    {"disagreement": "overlap"},
    ANCHORED,
    {**ANCHORED, "disagreement": "overlap"},
    *({"anchors": AnchorConfig(shrinkage=kappa)} for kappa in (1.0, 5.0, 20.0)),
    *({"anchors": AnchorConfig(half_life=frames)} for frames in (5.0, 10.0, 100.0)),
)
OF_TRACKER: tuple[Mapping[str, Any], ...] = (
    *({"max_relative_sigma": share} for share in (0.1, 0.2, 0.3, 0.5)),
    *({"min_views": views} for views in (3,)),
    *({"max_error": pixels} for pixels in (1.5, 5.0)),
    *({"pixel_noise": pixels} for pixels in (0.5, 2.0)),
    *({"window": views} for views in (5, 15)),
    *({"spacing": pixels} for pixels in (10.0, 20.0)),
)


@dataclass(frozen=True, eq=False)
class Tour:
    """Predictions of a tour, and its images."""

    clip: Clip
    frames: list[Frame]


def tours(arguments: argparse.Namespace) -> Iterator[Tour]:
    """The tours asked for, with depth alone."""
    first, last = (int(word) for word in arguments.tours.split(":"))
    sources = iter([f"tour:{seed}?style=mixed&frames={arguments.frames}" for seed in range(first, last)])
    for clip in clips(arguments):
        if clip.aleatoric is None:
            yield Tour(clip, list(open_sequence(next(sources))))


def tracked(tour: Tour, config: TrackerConfig) -> list[Landmarks]:
    """The landmarks of every frame."""
    tracker = LandmarkTracker(config)
    return [tracker.update(frame.image, frame.T_world_cam, frame.intrinsics) for frame in tour.frames]


def figures(tour: Tour, landmarks: list[Landmarks], config: UfMStarConfig) -> list[float]:
    """ECE_delta, ECE_q, AUSE [m] and Spearman of UfM*."""
    clip, ufm, maps = tour.clip, UfMStar(config), []
    K = torch.from_numpy(clip.K)[None]
    for depth, pose, frame, result in zip(clip.depth, clip.pose, tour.frames, landmarks, strict=True):
        anchors = result.anchors(frame.intrinsics, K) if config.anchors is not None else None
        maps.append(ufm(torch.from_numpy(depth)[None], torch.from_numpy(pose)[None], K, anchors=anchors).variance[0])
    judged = judge(clip, torch.stack(maps).numpy(), STRIDE)
    return [judged[name] for name in ("ece_delta", "ece_q", "ause_rmse", "spearman")]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_sources(parser)
    arguments = parser.parse_args()
    if arguments.tours is None:
        parser.error("constants are chosen on tours: give --tours")
    every = list(tours(arguments))
    own = [tracked(tour, TrackerConfig()) for tour in every]

    def told(name: str, landmarks: list[list[Landmarks]], config: UfMStarConfig) -> None:
        result = [figures(tour, marks, config) for tour, marks in zip(every, landmarks, strict=True)]
        line(name, *map(shown, np.mean(result, axis=0)))

    for values in OF_UFM:
        told(", ".join(f"{k} {v}" for k, v in values.items()) or "UfM\\*", own, UfMStarConfig(**values))
    for values in OF_TRACKER:
        changed = [tracked(tour, TrackerConfig(**values)) for tour in every]
        told(", ".join(f"{k} {v}" for k, v in values.items()), changed, UfMStarConfig(anchors=AnchorConfig()))


if __name__ == "__main__":
    main()
