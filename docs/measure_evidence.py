"""How right and how certain anchors of images are: corners and dense evidence, on rendered tours and recordings.

    python docs/measure_evidence.py --sequences 'tour:60?style=mixed&frames=80&size=240x320' rgbd_dataset_freiburg1_xyz

prints a row for each sequence and source: anchors of a frame; the share of a 28 x 28 grid that has one; the median
normalised error |1/g - 1/z|/sigma over .674 (1 = as uncertain as stated); the share of anchors beyond 5 sigma; median
and 90th percentile of the relative error; the 90th percentile of those never confirmed and of those confirmed twice or
more; and the time of a frame [ms].
"""

from __future__ import annotations

import argparse
from time import process_time

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors import landmark_source
from ufmstar_torch.eval.sequences.frame import Frame, FrameSequence
from ufmstar_torch.eval.tour.open import open_sequence

GRID = 28
# The median of |z| of a standard normal variable.
NORMAL = 0.674


def truth(frame: Frame, pixel: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N] true depth at pixels [N, 2] of the image [m], 0 = unknown."""
    assert frame.depth is not None
    K = frame.intrinsics if frame.depth_intrinsics is None else frame.depth_intrinsics
    mapping = K @ np.linalg.inv(frame.intrinsics)
    u, v = np.rint(pixel @ mapping[:2, :2].T + mapping[:2, 2]).astype(int).T
    height, width = frame.depth.shape
    inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    return np.where(inside, frame.depth[v.clip(0, height - 1), u.clip(0, width - 1)], 0).astype(np.float64)


def row(sequence: FrameSequence, kind: str) -> str:
    """The figures of a source on a sequence."""
    source, normalised, relative, confirmed, counts, covered, ms = landmark_source(kind), [], [], [], [], [], []
    for frame in sequence.readable(print):
        if frame.image is None or frame.depth is None or not np.isfinite(frame.T_world_cam).all():
            continue
        started = process_time()
        result = source.update(frame.image, frame.T_world_cam, frame.intrinsics)
        ms.append(1000 * (process_time() - started))
        z = truth(frame, result.pixel)
        known = z > 0
        sigma, z = np.sqrt(result.variance[known]) / result.depth[known] ** 2, z[known]
        normalised.append((1 / result.depth[known] - 1 / z) / sigma)
        relative.append(np.abs(result.depth[known] / z - 1))
        confirmed.append(np.zeros(len(z)) if result.confirmed is None else result.confirmed[known])
        at = result.pixel / np.array(frame.image.shape[1::-1]) * GRID
        covered.append(len(np.unique(at.astype(int).clip(0, GRID - 1) @ [1, GRID])) / GRID**2)
        counts.append(len(result.depth))
    size, error, times = np.abs(np.concatenate(normalised)), np.concatenate(relative), np.concatenate(confirmed)
    parts = [np.quantile(error[part], 0.9) if part.any() else np.nan for part in (times == 0, times >= 2)]
    figures = (np.median(size) / NORMAL, np.mean(size > 5), np.median(error), np.quantile(error, 0.9), *parts)
    texts = [
        f"{np.mean(counts):.0f}",
        f"{np.mean(covered):.2f}",
        *(f"{x:.3f}" for x in figures),
        f"{np.median(ms):.1f}",
    ]
    return f"| {sequence.name} | {kind} | " + " | ".join(texts) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", nargs="+", required=True, metavar="SEQUENCE")
    parser.add_argument("--anchors", nargs="+", default=["corners", "dense"], metavar="SOURCE")
    arguments = parser.parse_args()
    for name in arguments.sequences:
        sequence = open_sequence(name)
        for kind in arguments.anchors:
            print(row(sequence, kind), flush=True)


if __name__ == "__main__":
    main()
