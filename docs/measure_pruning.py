"""How many Gaussians SPGF's two pruning rules keep on real depth, and how many pixels they cover.

    python docs/measure_pruning.py --root ../shared

prints the tables of docs/results/segmentation.md: every frame of the four shared sequences, cut to the central
square and resized to 224 x 224 (nearest neighbour), upstream's thresholds for TUM except those named, taken
as they are or converted from the 640 x 480 they were made for.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.camera import crop_intrinsics, resize_intrinsics
from ufmstar_torch.config import SPGFConfig
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.kernels.segment_cpu import segment
from ufmstar_torch.segment_input import SegmentInput

SEQUENCES = {
    "fr1/xyz": "rgbd_dataset_freiburg1_xyz",
    "fr3/teddy": "rgbd_dataset_freiburg3_teddy",
    "HoloLens office": "hololens_office",
    "TartanAir P000": "tartanair_sample/P000",
}
RULES = (("either", 2000, 32), ("both", 2000, 32), ("either", 200, 16), ("both", 200, 16))


def square_depths(folder: Path, size: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Depth [1, size, size] float32 and intrinsics [1, 3, 3] of every frame that has a depth map."""
    sequence = open_sequence(folder)
    own = sequence.intrinsics if sequence.depth_intrinsics is None else sequence.depth_intrinsics
    for entry in sequence.entries:
        if entry.load_depth is None:
            continue
        depth = torch.from_numpy(np.asarray(entry.load_depth(), dtype=np.float32))
        height, width = depth.shape
        side = min(height, width)
        top, left = (height - side) // 2, (width - side) // 2
        K = crop_intrinsics(torch.as_tensor(own, dtype=torch.float64)[None], top, left)
        pick = ((torch.arange(size) + 0.5) * side / size).long()
        square = depth[top : top + side, left : left + side][pick][:, pick]
        yield square[None].contiguous(), resize_intrinsics(K, (side, side), (size, size))


def row(frames: list[tuple[Tensor, Tensor]], config: SPGFConfig) -> str:
    """Median (least) number of Gaussians and median (least) share of the usable pixels they cover."""
    counts, shares = [], []
    for depth, K in frames:
        mixture, labels = segment(SegmentInput.checked(depth, K, config))
        usable = (depth > 0) & (depth <= config.depth_limit)
        counts.append(int(mixture.components[0]))
        shares.append(100 * float((labels >= 0).sum() / usable.sum().clamp_min(1)))
    return f"{np.median(counts):.0f} ({min(counts)}), {np.median(shares):.0f} % ({min(shares):.0f} %)"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True, help="folder that holds data/")
    parser.add_argument("--size", type=int, default=224, help="side of the square images [px]")
    arguments = parser.parse_args()
    data = {name: list(square_depths(arguments.root / "data" / p, arguments.size)) for name, p in SEQUENCES.items()}
    for scaled in (False, True):
        print(f"\nThresholds {'converted from 640 x 480' if scaled else 'as they are'}:\n")
        names = [f"{name} ({len(frames)})" for name, frames in data.items()]
        print("| drop if | " + " | ".join(names) + " |\n" + "|---" * (len(names) + 1) + "|")
        for prune, pixels, rows in RULES:
            upstream = SPGFConfig.preset("tum")
            config = replace(upstream, prune=prune, min_pixels=pixels, min_rows=rows, scale_with_image=scaled)
            limits = config.scaled_to(arguments.size, arguments.size)
            word = "or" if prune == "either" else "and"
            cells = [row(frames, config) for frames in data.values()]
            print(f"| < {limits.min_pixels} px {word} < {limits.min_rows} rows | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
