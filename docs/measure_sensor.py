"""Measures the filling of a depth camera's holes: half of the depth is removed, the rest serves as anchors.

    python docs/measure_sensor.py fastdepth_nyu.onnx SEQUENCE ...

prints for each sequence figures on the removed half: of the network, and of the posterior with the rest of the depth as
anchors alone, with dense anchors of the images alone, and with both (``--anchors sensor``), also by the cause of
the removal. In each frame, a sixth of the depth is removed at depth edges, a sixth because it is farthest, and the
remainder in discs of .03 to .12 image widths or, with ``--dark``, on the darkest surfaces. The exact depth of tours
gets the noise of ``--sensor``, blurred over 3 pixels.
"""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from unittest.mock import patch

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch import AnchorConfig, PosteriorConfig, UfMStarConfig
from ufmstar_torch.anchors.sensor import sensor_sigma
from ufmstar_torch.eval.engine.judge import UFM
from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.eval.engine.stream import FrameResult, frame_results
from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.run.job import RunJob
from ufmstar_torch.eval.sequences.frame import Entry, FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.eval.tour.sequence import PREFIX

SHARE, EACH = 0.5, 1 / 6  # of the depth: removed, and removed for each of the first two reasons
DISCS = 0.03, 0.12  # radii [widths]
FIGURES = ("rmse", "delta1", "ece_delta", "mixture_ece_delta", "ece_q", "nll")


CAUSES = EDGE, FAR, HOLE = "edges", "far", "holes"


def removed(
    depth: NDArray[np.float32], seed: int, image: NDArray[np.uint8] | None = None
) -> dict[str, NDArray[np.bool_]]:
    """By cause, [H, W] True at the removed pixels, which are half of those with a depth; with an RGB image, the holes
    are its darkest pixels."""
    import cv2

    valid, rng, kernel = depth > 0, np.random.default_rng(seed), np.ones((9, 9), np.uint8)
    filled = np.where(valid, depth, np.nan).astype(np.float32)
    high, low = cv2.dilate(np.nan_to_num(filled, nan=0.0), kernel), cv2.erode(np.nan_to_num(filled, nan=1e6), kernel)
    contrast = np.where(valid, high / low, 0)
    edge = valid & (contrast > np.quantile(contrast[valid], 1 - EACH))
    left = valid & ~edge
    far = left & (depth > np.quantile(depth[left], 1 - EACH * valid.sum() / left.sum()))
    left, hole = left & ~far, np.zeros_like(valid)
    height, width = depth.shape
    v, u = np.ogrid[:height, :width]
    if image is not None:
        grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 3.0)
        grey = cv2.resize(grey, (width, height))
        hole = left & (grey <= np.quantile(grey[left], (SHARE - 2 * EACH) * valid.sum() / left.sum()))
    while image is None and (edge | far | hole).sum() < SHARE * valid.sum():
        radius, row, column = rng.uniform(*DISCS) * width, rng.uniform(0, height), rng.uniform(0, width)
        hole |= left & ((v - row) ** 2 + (u - column) ** 2 < radius**2)
    return {EDGE: edge, FAR: far, HOLE: hole}


def rest(entry: Entry, seed: int, noise: str | None, dark: bool = False) -> NDArray[np.float32]:
    """The depth that serves as anchors, with the noise of a kind of sensor."""
    import cv2

    assert entry.load_depth is not None
    depth, image = entry.load_depth(), entry.load_image() if dark and entry.load_image else None
    left = np.where(np.any([*removed(depth, seed, image).values()], axis=0), np.float32(0), depth)
    if noise is None:
        return left
    noises = cv2.GaussianBlur(np.random.default_rng([seed, 1]).standard_normal(depth.shape), (0, 0), 1.0)
    noisy = left + sensor_sigma(left.astype(np.float64), noise) * noises / noises.std()
    return np.where(left > 0, noisy.clip(0.01), 0).astype(np.float32)


class RemovedHalf:
    """Figures of the network and of the posterior on the removed half of a sequence's depth."""

    def __init__(self, whole: FrameSequence, dark: bool) -> None:
        self._whole, self._dark, self.anchors = whole, dark, list[int]()
        self.network, self.posterior = ({cause: SequenceMetrics() for cause in ("all", *CAUSES)} for _ in range(2))

    def add(self, result: FrameResult) -> None:
        """Add a frame."""
        if UFM not in result.rows:
            return
        row, frame = result.rows[UFM], self._whole[result.index]
        if frame.depth is None or not row.corrected or row.landmarks is None:
            return
        causes = removed(frame.depth, result.index, frame.image if self._dark else None)
        for cause, gone in {"all": np.any([*causes.values()], axis=0), **causes}.items():
            hidden = np.where(gone, frame.depth, np.float32(0))
            truth = truth_at(replace(frame, depth=hidden), row.intrinsics, row.size)
            assert truth is not None
            target = torch.from_numpy(truth)
            self.network[cause].update(row.prediction.depth[0], row.map("ufm_variance"), target, row.valid)
            self.posterior[cause].update(row.depth, row.variance, target, row.valid, row.mixture)
        self.anchors.append(len(row.landmarks.depth))


def measure(path: str, weights: str, sensor: str | None, images: bool, frames: int | None, dark: bool) -> RemovedHalf:
    """Run one kind of anchors on a sequence."""
    whole = open_sequence(path)
    if frames is not None:
        whole = replace(whole, entries=whole.entries[:frames])
    noise = sensor if path.startswith(PREFIX) else None
    entries = tuple(
        replace(
            entry, load_depth=entry.load_depth and partial(rest, entry, seed, noise, dark), load_image=entry.load_image
        )
        for seed, entry in enumerate(whole.entries)
    )
    source = NetworkChoice("", "fastdepth", (weights,), None).load(torch.device("cpu"))
    config = UfMStarConfig(anchors=AnchorConfig(), posterior=PosteriorConfig(), on_bad_frame="skip")
    job = RunJob(
        replace(whole, entries=entries), range(len(entries)), source, config.within(source.max_depth, False),
        torch.device("cpu"), {}, landmarks="dense", sensor=sensor,
    )  # fmt: skip
    (row, _), judged = job.row(), RemovedHalf(whole, dark)
    assert row.anchors is not None
    without_images = patch.object(row.anchors, "tracked", return_value=None)
    with nullcontext() if images else without_images:
        for result in frame_results(job.sequence, job.indices, [row]):
            judged.add(result)
    return judged


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", help="FastDepth's")
    parser.add_argument("sequences", nargs="+", metavar="SEQUENCE")
    parser.add_argument("--frames", type=int, help="first ones alone")
    parser.add_argument("--sensor", default="stereo")
    parser.add_argument("--dark", action="store_true", help="remove depth of dark surfaces instead of discs")
    options = parser.parse_args()
    for path in options.sequences:
        print(path)
        kinds = {"sensor": (options.sensor, False), "images": (None, True), "both": (options.sensor, True)}
        for name, (sensor, images) in kinds.items():
            judged = measure(path, options.weights, sensor, images, options.frames, options.dark)
            if name == "sensor":
                print("  network      ", figures_of(judged.network["all"]))
            for cause in ("all", *CAUSES) if name == "both" else ("all",):
                share = judged.posterior[cause].compute()["rmse"] / judged.network[cause].compute()["rmse"]
                text = f"RMSE x {share:.3f}, {np.mean(judged.anchors):.0f} anchors"
                print(f"  {name:6} {cause:6}", figures_of(judged.posterior[cause]), text)


def figures_of(metrics: SequenceMetrics) -> dict[str, float]:
    computed = metrics.compute()
    return {figure: round(computed[figure], 3) for figure in FIGURES if figure in computed}


if __name__ == "__main__":
    main()
