"""Fuse a run's depth into a TSDF, with equal weights or with 1/sigma^2, and print the surface error [cm].

The second argument is the run's recording, whose ground truth is compared; without it, the surface alone is counted.

    ufmstar run "tour:5?frames=60&size=120x160" --model trained --weights models/weights/demo.safetensors \\
        --out out/tour
    python examples/tsdf.py out/tour "tour:5?frames=60&size=120x160"
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from ufmstar_torch.eval.run.export import gated_frames
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.files.limits import require_bytes

VOXEL, TRUNCATION = 0.08, 0.4  # [m]; the truncation is about the posterior's mean sigma
WEIGHTS = {"all alike": np.ones_like, "1/sigma^2": lambda sigma: 1 / np.maximum(sigma, 0.01) ** 2}


def fuse(frames, low, shape):
    """By name of the weights: sums of weight x signed distance [truncations], and of weights, [2, X, Y, Z]."""
    centres = low + VOXEL * np.indices(shape).reshape(3, -1).T
    sums = {name: np.zeros((2, len(centres))) for name in WEIGHTS}
    for frame in frames:
        camera = (centres - frame.T_world_cam[:3, 3]) @ frame.T_world_cam[:3, :3]
        seen = np.flatnonzero(camera[:, 2] > 0.1)
        u, v = np.rint((camera[seen] @ frame.intrinsics.T)[:, :2] / camera[seen, 2:]).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < frame.depth.shape[1]) & (v < frame.depth.shape[0])
        seen, pixels = seen[inside], (v[inside], u[inside])
        distance = (frame.depth[pixels] - camera[seen, 2]) / TRUNCATION
        near = distance > -1  # False for NaN: pixels without depth
        for name, weigh in WEIGHTS.items():
            weight = weigh(frame.sigma[pixels][near])
            sums[name][:, seen[near]] += weight * np.minimum(distance[near], 1), weight
    return {name: total.reshape(2, *shape) for name, total in sums.items()}


def surface(total, weight, low):
    """[P, 3] points where the mean distance is 0 between two voxels, those with the largest weight first."""
    field, points, support = total / np.where(weight > 0, weight, np.nan), [], []
    for axis in range(3):
        (a, b), (wa, wb) = ([np.delete(x, i, axis) for i in (-1, 0)] for x in (field, weight))
        at = np.nonzero((a * b < 0) & (np.abs(a) < 1) & (np.abs(b) < 1))
        share = (a[at] / (a[at] - b[at]))[:, None] * np.eye(3)[axis]
        points.append(low + VOXEL * (np.stack(at, -1) + share))
        support.append(np.minimum(wa, wb)[at])
    return np.concatenate(points)[np.argsort(-np.concatenate(support))]


def points_of(frames):
    """[P, 3] every fourth point of the frames' depth maps [m]."""
    points = [np.zeros((0, 3))]
    for frame in frames:
        v, u = (one[::4] for one in np.nonzero(frame.depth > 0))
        rays = np.linalg.inv(frame.intrinsics) @ np.stack([u, v, np.ones_like(u)])
        points.append((rays * frame.depth[v, u]).T @ frame.T_world_cam[:3, :3].T + frame.T_world_cam[:3, 3])
    return np.concatenate(points)


def main(out, recording=None):
    """Print and return, by weights: mean error [cm] and share of the true surface within 10 cm, best half and all;
    without ground truth the number of points on the surface."""
    frames, sequence = list(gated_frames(out, np.inf, np.inf)), recording and open_sequence(recording)
    known = [sequence[frame.index] for frame in frames] if sequence else []
    true = points_of([frame for frame in known if frame.depth is not None])
    extent = true if len(true) else points_of(frames)
    if not len(true):
        print("no ground truth, so no error: the second argument names the run's recording" if not sequence else
              f"{sequence.name} has no ground truth, so no error")  # fmt: skip
    low, results = extent.min(0) - 2 * VOXEL, {}
    shape = tuple(np.ceil((extent.max(0) - low) / VOXEL).astype(int) + 2)
    require_bytes(f"a grid of {' x '.join(map(str, shape))} voxels", int(np.prod(shape, dtype=float)) * 8 * 12)
    tree = cKDTree(true) if len(true) else None
    for name, sums in fuse(frames, low, shape).items():
        points = surface(*sums, low)
        if tree is None:
            results[name] = len(points)
            print(f"{name:10} {len(points)} points on the surface")
            continue
        for part, chosen in (("best half", points[: len(points) // 2]), ("all", points)):
            covered = float(np.mean(cKDTree(chosen).query(tree.data[::40])[0] < 0.1))
            results[name, part] = 100 * float(tree.query(chosen)[0].mean()), covered
            print(f"{name:10} {part:10} {results[name, part][0]:5.1f} cm, {covered:.0%} of the surface")
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder of `ufmstar run`")
    parser.add_argument("sequence", nargs="?", help="the run's recording, for its ground truth")
    arguments = parser.parse_args()
    main(arguments.out, arguments.sequence)
