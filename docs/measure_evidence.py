"""How right and how certain anchors of images are: corners and dense evidence, on rendered tours and recordings.

    python docs/measure_evidence.py --sequences 'tour:60?style=mixed&frames=80&size=240x320' rgbd_dataset_freiburg1_xyz

prints a row for each sequence and source: anchors of a frame; the share of a 28 x 28 grid that has one; the median
normalised error |1/g - 1/z|/sigma over .674 (1 = as uncertain as stated); the share of anchors beyond 5 sigma; median
and 90th percentile of the relative error; the 90th percentile of those never confirmed and of those confirmed twice or
more; and the time of a frame [ms]. ``--disturb noise focal`` measures each sequence again as a worse recording would
be, the truth unchanged (see ``DISTURBANCES``).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from time import process_time

import cv2
import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors import landmark_source
from ufmstar_torch.anchors.landmarks import LandmarkSource
from ufmstar_torch.anchors.tracker import Landmarks
from ufmstar_torch.eval.methods.perturb import Drift, perturbed
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.sequences.frame import Frame, FrameSequence
from ufmstar_torch.eval.sequences.open import open_sequence

GRID = 28
# The median of |z| of a standard normal variable.
NORMAL = 0.674


def exact(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Frames as they are."""
    yield from frames


def noise(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Independent noise of .1 degrees and 3 mm on every pose."""
    setting = Setting(rotation_noise=0.1, translation_noise=0.003)
    for frame in frames:
        yield replace(frame, T_world_cam=perturbed(frame.T_world_cam, setting, frame.index))


def drift(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Poses that drift by .05 degrees and 2 mm from frame to frame."""
    walk = Drift(Setting(rotation_drift=0.05, translation_drift=0.002))
    for frame in frames:
        yield replace(frame, T_world_cam=walk.of(frame.T_world_cam, frame.index))


def late(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Poses from before the image, by .05 of the time between frames, with a jitter of .03."""
    before = None
    for frame in frames:
        T = frame.T_world_cam
        if before is not None:
            by = np.random.default_rng([5, frame.index]).normal(0.05, 0.03)
            T = T.copy()
            T[:3, 3] += by * (before[:3, 3] - T[:3, 3])
            turned = cv2.Rodrigues(T[:3, :3].T @ before[:3, :3])[0]
            T[:3, :3] = T[:3, :3] @ cv2.Rodrigues(by * turned)[0]
        before = frame.T_world_cam
        yield replace(frame, T_world_cam=T)


def focal(frames: Iterable[Frame]) -> Iterator[Frame]:
    """A focal length that is stated 1 % too long."""
    for frame in frames:
        yield replace(frame, intrinsics=frame.intrinsics * np.array([[1.01, 1, 1], [1, 1.01, 1], [1, 1, 1]]))


def centre(frames: Iterable[Frame]) -> Iterator[Frame]:
    """A principal point that is stated 2 px too far to the right."""
    for frame in frames:
        yield replace(frame, intrinsics=frame.intrinsics + np.array([[0, 0, 2.0], [0, 0, 0], [0, 0, 0]]))


def lens(frames: Iterable[Frame]) -> Iterator[Frame]:
    """A radial distortion of .02 that was not removed."""
    for frame in frames:
        assert frame.image is not None
        size = frame.image.shape[1::-1]
        distortion = np.array([0.02, 0, 0, 0])
        maps = cv2.initUndistortRectifyMap(
            frame.intrinsics, distortion, np.eye(3), frame.intrinsics, size, cv2.CV_32FC1
        )
        yield replace(frame, image=cv2.remap(frame.image, *maps, cv2.INTER_LINEAR))


def image(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Noise of 4 gray levels, and an exposure that changes by up to 15 % from image to image."""
    for frame in frames:
        rng = np.random.default_rng([7, frame.index])
        assert frame.image is not None
        worse = frame.image * rng.uniform(0.85, 1.15) + rng.normal(0, 4, frame.image.shape)
        yield replace(frame, image=np.clip(worse, 0, 255).astype(np.uint8))


def blur(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Motion blur of up to 4 px in any direction, another one for each image."""
    for frame in frames:
        rng = np.random.default_rng([8, frame.index])
        assert frame.image is not None
        length, angle, kernel = rng.uniform(0, 4), rng.uniform(0, np.pi), np.zeros((9, 9), np.float32)
        for way in np.linspace(-length / 2, length / 2, 41):
            kernel[round(4 + way * np.sin(angle)), round(4 + way * np.cos(angle))] += 1 / 41
        yield replace(frame, image=np.asarray(cv2.filter2D(frame.image, -1, kernel), np.uint8))


Disturbance = Callable[[Iterable[Frame]], Iterator[Frame]]
DISTURBANCES: dict[str, Disturbance] = {
    function.__name__: function for function in (exact, noise, drift, late, focal, centre, lens, image, blur)
}


def truth(frame: Frame, pixel: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N] true depth at pixels [N, 2] of the image [m], 0 = unknown."""
    assert frame.depth is not None
    K = frame.intrinsics if frame.depth_intrinsics is None else frame.depth_intrinsics
    mapping = K @ np.linalg.inv(frame.intrinsics)
    u, v = np.rint(pixel @ mapping[:2, :2].T + mapping[:2, 2]).astype(int).T
    height, width = frame.depth.shape
    inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    return np.where(inside, frame.depth[v.clip(0, height - 1), u.clip(0, width - 1)], 0).astype(np.float64)


def usable(sequence: FrameSequence) -> list[Frame]:
    """The frames that have an image, a depth and a pose."""
    frames = list(sequence.readable(print))
    return [f for f in frames if f.image is not None and f.depth is not None and np.isfinite(f.T_world_cam).all()]


def measured(
    frames: list[Frame], source: LandmarkSource, disturbance: Disturbance
) -> Iterator[tuple[Frame, Landmarks, float]]:
    """The frames as they are, the anchors of the disturbed ones, and the processor time of each [s]."""
    for frame, given in zip(frames, disturbance(frames), strict=True):
        started = process_time()
        yield frame, source.update(given.image, given.T_world_cam, given.intrinsics), process_time() - started


def row(name: str, frames: list[Frame], kind: str, disturbed: str = "exact") -> str:
    """The figures of a source on a sequence."""
    normalised, relative, confirmed, counts, covered, ms = [], [], [], [], [], []
    for frame, result, seconds in measured(frames, landmark_source(kind), DISTURBANCES[disturbed]):
        assert frame.image is not None
        ms.append(1000 * seconds)
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
    return f"| {name} | {disturbed} | {kind} | " + " | ".join(texts) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", nargs="+", required=True, metavar="SEQUENCE")
    parser.add_argument("--anchors", nargs="+", default=["corners", "dense"], metavar="SOURCE")
    parser.add_argument("--disturb", nargs="+", default=["exact"], choices=list(DISTURBANCES), metavar="HOW")
    arguments = parser.parse_args()
    for name in arguments.sequences:
        frames = usable(open_sequence(name))
        for disturbed in arguments.disturb:
            for kind in arguments.anchors:
                print(row(Path(name).name, frames, kind, disturbed), flush=True)


if __name__ == "__main__":
    main()
