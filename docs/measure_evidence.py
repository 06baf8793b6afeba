"""How right and how certain anchors of images are: corners and dense evidence, on rendered tours and recordings.

    python docs/measure_evidence.py 'tour:62?style=hall&frames=60&size=240x320' rgbd_dataset_freiburg1_xyz

prints for each sequence and source: anchors of a frame; the share of a 28 x 28 grid that has one; the median normalised
error |1/g - 1/z|/sigma over .674 (1 = as uncertain as stated); the share of anchors beyond 5 sigma; the median relative
error; and the processor time of a frame [ms].
"""

import sys
from pathlib import Path
from time import process_time

import numpy as np

from ufmstar_torch.anchors import landmark_source
from ufmstar_torch.eval.sequences.open import open_sequence

GRID, NORMAL = 28, 0.674  # the median of |z| of a standard normal variable

for name in sys.argv[1:]:
    frames = [
        f for f in open_sequence(name).readable(print) if f.image is not None and np.isfinite(f.T_world_cam).all()
    ]
    for kind in ("corners", "dense"):
        source, sizes, errors, counts, covered, ms = landmark_source(kind), [], [], [], [], []
        for frame in frames:
            started = process_time()
            found = source.update(frame.image, frame.T_world_cam, frame.intrinsics)
            ms.append(1000 * (process_time() - started))
            K = frame.intrinsics if frame.depth_intrinsics is None else frame.depth_intrinsics
            to_depth, (height, width) = K @ np.linalg.inv(frame.intrinsics), frame.depth.shape
            u, v = np.rint(found.pixel @ to_depth[:2, :2].T + to_depth[:2, 2]).astype(int).T
            inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
            z = np.where(inside, frame.depth[v.clip(0, height - 1), u.clip(0, width - 1)], 0).astype(float)
            g, sigma, z = found.depth[z > 0], np.sqrt(found.variance[z > 0]), z[z > 0]
            sizes.extend(np.abs(1 / g - 1 / z) * g**2 / sigma)
            errors.extend(np.abs(g / z - 1))
            cell = (found.pixel / np.array(frame.image.shape[1::-1]) * GRID).astype(int).clip(0, GRID - 1)
            covered.append(len(np.unique(cell @ [1, GRID])) / GRID**2)
            counts.append(len(found.depth))
        figures = np.mean(covered), np.median(sizes) / NORMAL, np.mean(np.array(sizes) > 5), np.median(errors)
        texts = [f"{np.mean(counts):.0f}", *(f"{x:.3f}" for x in figures), f"{np.median(ms):.1f}"]
        print(f"| {Path(name).name} | {kind} | " + " | ".join(texts) + " |", flush=True)
