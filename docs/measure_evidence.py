"""Measures the errors and stated variances of anchors from images, and of the posterior on wrong poses and images.

    python docs/measure_evidence.py 'tour:62?style=hall&frames=60&size=240x320' rgbd_dataset_freiburg1_xyz

prints for each sequence and source: anchors of a frame; the share of a 28 x 28 grid that has one; the median normalised
error |1/g - 1/z|/sigma over .674 (1 = as uncertain as stated); the share of anchors beyond 5 sigma; the median relative
error; the shares of anchors that are off by more than 25 %, and that also state less than 10 %; and the processor time
of a frame [ms].

    python docs/measure_evidence.py --weights fastdepth_nyu.onnx --frames 30 SEQUENCE ...

prints, for each defect and sequence, for FastDepth with the posterior from dense evidence: RMSE over the network's /
root mean square z / the same within .05 image widths of an anchor / percent of pixels beyond 3 sigma / ``calibration``
/ the median ``pose_error`` [px]. The first frames are left out, because they have no parallax.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from time import process_time

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch import AnchorConfig, PosteriorConfig, UfMStar, UfMStarConfig
from ufmstar_torch.anchors import Anchors, landmark_source
from ufmstar_torch.eval.methods.perturb import Drift, perturbed, rotation
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.models.load import load_network
from ufmstar_torch.models.network import DepthNetwork

GRID, NORMAL = 28, 0.674  # the median of |z| of a standard normal variable
FIRST, STRIDE = 5, 4  # metrics use every fourth pixel of every fourth row, from the sixth frame on
WRONG, CERTAIN = 0.25, 0.1  # relative error and stated relative standard deviation of an anchor
NEAR = 0.05  # image widths from an anchor
Frames = list[Frame]


def usable(name: str, count: int | None) -> Frames:
    """The first frames of a sequence that have an image, a depth and a pose."""
    frames = open_sequence(name).readable(print)
    fine = (f for f in frames if f.image is not None and f.depth is not None and np.isfinite(f.T_world_cam).all())
    return list(islice(fine, count))


def anchors(name: str, frames: Frames, kind: str) -> str:
    """A row of the first table."""
    source, sizes, errors, stated, counts, covered, ms = landmark_source(kind), [], [], [], [], [], []
    for frame in frames:
        assert frame.depth is not None
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
        stated.extend(sigma / g)
        assert frame.image is not None
        cell = (found.pixel / np.array(frame.image.shape[1::-1]) * GRID).astype(int).clip(0, GRID - 1)
        covered.append(len(np.unique(cell @ [1, GRID])) / GRID**2)
        counts.append(len(found.depth))
    wrong, certain = np.array(errors) > WRONG, np.array(stated) < CERTAIN
    figures = [np.mean(covered), np.median(sizes) / NORMAL, np.mean(np.array(sizes) > 5), np.median(errors)]
    figures += [wrong.mean(), (wrong & certain).mean()]
    texts = [f"{np.mean(counts):.0f}", *(f"{x:.3f}" for x in figures), f"{np.median(ms):.1f}"]
    return f"| {Path(name).name} | {kind} | " + " | ".join(texts) + " |"


def posed(frames: Frames, poses: list[NDArray[np.float64]]) -> Frames:
    """The frames with these poses."""
    return [replace(frame, T_world_cam=T) for frame, T in zip(frames, poses, strict=True)]


def noisy(degrees: float) -> Callable[[Frames], Frames]:
    """Rotation noise of every pose."""
    setting = Setting(rotation_noise=degrees)
    return lambda frames: posed(frames, [perturbed(f.T_world_cam, setting, f.index) for f in frames])


def late(count: int) -> Callable[[Frames], Frames]:
    """Replace every pose by the pose ``count`` frames earlier."""
    return lambda frames: posed(frames, [frames[max(i - count, 0)].T_world_cam for i in range(len(frames))])


def drifting(frames: Frames) -> Frames:
    """Rotation drift of .2 degrees a frame."""
    drift = Drift(Setting(rotation_drift=0.2))
    return posed(frames, [drift.of(f.T_world_cam, f.index) for f in frames])


def scaled(frames: Frames) -> Frames:
    """Translations 5 % too long."""
    return posed(frames, [f.T_world_cam * np.array([1, 1, 1, 1.05]) + np.diag([0, 0, 0, -0.05]) for f in frames])


def rolling(frames: Frames) -> Frames:
    """Rows that are exposed one after the other, from half a frame's rotation before to half of one after."""
    turned = []
    for i, frame in enumerate(frames):
        assert frame.image is not None
        one, other = frames[max(i - 1, 0)].T_world_cam, frames[min(i + 1, len(frames) - 1)].T_world_cam
        step = cv2.Rodrigues(one[:3, :3].T @ other[:3, :3])[0][:, 0] / (2 if 0 < i < len(frames) - 1 else 1)
        height, width = frame.image.shape[:2]
        K, (v, u) = frame.intrinsics, np.mgrid[:height, :width].astype(float)
        rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
        each = np.stack([row @ rotation(step * (j / height - 0.5)).T for j, row in enumerate(rays)]) @ K.T
        where = (each[..., :2] / each[..., 2:]).astype(np.float32)
        image = cv2.remap(frame.image, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        turned.append(replace(frame, image=np.asarray(image, np.uint8)))
    return turned


def exposed(frames: Frames) -> Frames:
    """Brightness that changes by 25 % from frame to frame."""
    gain = np.exp(np.random.default_rng(0).normal(0, 0.25, len(frames)))
    images = [np.clip(f.image * g, 0, 255).astype(np.uint8) for f, g in zip(frames, gain, strict=True)]
    return [replace(frame, image=image) for frame, image in zip(frames, images, strict=True)]


DEFECTS: dict[str, Callable[[Frames], Frames]] = {
    "as recorded": lambda frames: frames,
    "rotation noise .5°": noisy(0.5),
    "1°": noisy(1),
    "2°": noisy(2),
    "1 frame late": late(1),
    "3 frames late": late(3),
    "reversed": lambda frames: posed(frames, [f.T_world_cam for f in frames[::-1]]),
    "drift .2° a frame": drifting,
    "frozen image": lambda frames: [replace(f, image=frames[0].image, depth=frames[0].depth) for f in frames],
    "scale 5 %": scaled,
    "rolling shutter": rolling,
    "exposure": exposed,
}


def predicted(frame: Frame, network: DepthNetwork) -> tuple[Tensor, Tensor, NDArray[np.float32]]:
    """Depth [1, h, w], K [1, 3, 3] and the truth [h, w] of a frame."""
    with torch.no_grad():
        x, K = network.preprocess(image_tensor(frame), torch.from_numpy(frame.intrinsics)[None])
        depth = network(x).depth.float()
    truth = truth_at(frame, K[0].double().numpy(), (depth.shape[1], depth.shape[2]))
    assert truth is not None
    return depth, K.double(), truth


def judged(frames: Frames, predictions: list[tuple[Tensor, Tensor, NDArray[np.float32]]]) -> str:
    """A cell of the second table."""
    config = UfMStarConfig(anchors=AnchorConfig(), posterior=PosteriorConfig())
    ufm, source, network, z, near, errors = UfMStar(config), landmark_source("dense"), [], [], [], []
    calibration, pose = [], []
    for i, (frame, (depth, K, truth)) in enumerate(zip(frames, predictions, strict=True)):
        marks = source.update(frame.image, frame.T_world_cam, frame.intrinsics).anchors(frame.intrinsics, K)
        out = ufm(depth, torch.from_numpy(frame.T_world_cam)[None], K, anchors=marks)
        if i < FIRST:
            continue
        parts = (depth, out.depth, out.variance)
        d, g, V, t = (x[::STRIDE, ::STRIDE].ravel() for x in (*(part[0].numpy() for part in parts), truth))
        measured = (t > 0) & np.isfinite(g)
        network.append(np.square(d - t)[measured])
        errors.append(np.square(g - t)[measured])
        z.append((np.square(g - t) / V)[measured])
        near.append(close(marks, depth)[::STRIDE, ::STRIDE].ravel()[measured])
        calibration.append(float(out.statistics.calibration[0]))
        pose.append(float(out.statistics.pose_error[0]))
    squares = np.concatenate(z)
    ratio = (np.concatenate(errors).mean() / np.concatenate(network).mean()) ** 0.5
    shown = [x[np.isfinite(x)] for x in (np.array(calibration[-10:]), np.array(pose))]
    rest = [f"{np.median(x):.1f}" if len(x) else "–" for x in shown]
    near_squares = squares[np.concatenate(near)]
    rms = [f"{x.mean() ** 0.5:.1f}" if len(x) else "–" for x in (squares, near_squares)]
    return " / ".join([f"{ratio:.2f}", *rms, f"{100 * (squares > 9).mean():.0f}", *rest])


def close(marks: Anchors, depth: Tensor) -> NDArray[np.bool_]:
    """Pixels [h, w] of a depth map [1, h, w] that have an anchor nearby."""
    height, width = depth.shape[1:]
    u, v = np.rint(marks.pixel[0][marks.valid[0]].numpy()).astype(int).T if marks.valid is not None else ([], [])
    free = np.full((height, width), 1, np.uint8)
    free[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)] = 0
    return np.asarray(cv2.distanceTransform(free, cv2.DIST_L2, 5) < NEAR * width) & bool((free == 0).any())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="+")
    parser.add_argument("--weights", type=Path, help="FastDepth's: the second table")
    parser.add_argument("--frames", type=int, help="of a sequence")
    parser.add_argument("--defects", nargs="+", choices=DEFECTS, default=list(DEFECTS), metavar="NAME")
    arguments = parser.parse_args()
    if arguments.weights is None:
        for name in arguments.sequences:
            frames = usable(name, arguments.frames)
            for kind in ("corners", "dense"):
                print(anchors(name, frames, kind), flush=True)
        return
    network = load_network("fastdepth", arguments.weights).eval()
    clips = [usable(name, arguments.frames) for name in arguments.sequences]
    as_recorded = [[predicted(frame, network) for frame in frames] for frames in clips]
    print("| | " + " | ".join(Path(name).name for name in arguments.sequences) + " |")
    for defect in arguments.defects:
        cells = []
        for frames, plain in zip(clips, as_recorded, strict=True):
            changed = DEFECTS[defect](frames)
            same = [one.image is other.image for one, other in zip(changed, frames, strict=True)]
            cells.append(judged(changed, plain if all(same) else [predicted(frame, network) for frame in changed]))
        print(f"| {defect} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
