"""Measures the effect of each constant of the posterior on rendered tours with four networks.

    python docs/measure_posterior.py --weights fastdepth_nyu.onnx

prints the posterior's figures as means over tours (± 95 % of their mean), networks and evidence, and by how much each
changes where one constant of ``PosteriorConfig`` is halved and doubled (``--change NAME=VALUE ...``: other values; *:
beyond the 95 % interval of the paired difference). The tours are two homes, a hall, two plain homes, and a plain one
in which the camera turns in place. The networks are FastDepth, the demo's first one, and two that corrupt the ground
truth: one multiplies the depth in every cube of space by a random factor, the other smooths depth edges. The evidence
is dense, tracked corners, or the dense evidence in the nearest 40 % of the image. Every frame is predicted once, so
another value of a constant costs some seconds. ``--clips`` names recordings or tours: FastDepth, or without
``--weights`` the demo's first network, from the first anchor on, also with each ``--change``.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from importlib.resources import as_file, files
from itertools import islice, product
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, interpolate

from ufmstar_torch import PosteriorConfig, UfMStar
from ufmstar_torch.anchors import landmark_source
from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.anchors.check import check_anchors
from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.frames.frame import FrameInput, check_frame
from ufmstar_torch.gaussians.camera import resize_intrinsics
from ufmstar_torch.models.load import load_network
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.trained import load_trained
from ufmstar_torch.posterior.running import SIZE
from ufmstar_torch.posterior.update import update

KINDS_OF_TOURS = ("711?style=home", "713?style=home", "712?style=hall", "721?style=blank", "723?style=blank",
                  "732?style=blank&pan=1")  # fmt: skip
TOURS = [f"tour:{kind}&frames=40&size=240x320" for kind in KINDS_OF_TOURS]
MIXTURE = ("mixture_nll", "mixture_ece_delta", "mixture_ece_q", "mixture_coverage")
# Mean probability of another surface at pixels beyond and within 3 standard deviations of it; share of frames whose
# RMSE exceeds 1.1 times the network's.
LAST = ("outlier_beyond", "outlier_within", "worse_frames")
FIGURES = ("delta1", "rmse", "ece_delta", "ece_q", "nll", "spearman", *MIXTURE, *LAST)
KINDS = DENSE, CORNERS, NEAR = "dense", "corners", "near"
NEAREST = 0.4  # share of the image that evidence of NEAR covers
STRIDE = 4  # metrics use every fourth pixel of every fourth row
CUBE, FACTOR = 1.7, 0.35  # corrupted truth: cube size [m], standard deviation of the log factors
BLUR = 4, 5  # corrupted truth without edges: rows and columns
STUDENT = 2.571  # 97.5 % quantile for six tours


@dataclass(frozen=True, eq=False)
class Prepared:
    """One frame's input of the posterior, its anchors by source of evidence, and the true depth [h, w] [m]."""

    frame: FrameInput
    anchors: Mapping[str, Anchors]
    claimed: Tensor
    truth: Tensor


def prepare(source: str, network: DepthNetwork | bool, frames: int | None = None) -> list[Prepared]:
    """Predictions and anchors of a sequence's frames."""
    sources, ufm, prepared = {kind: landmark_source(kind) for kind in (DENSE, CORNERS)}, UfMStar(), []
    for frame in islice(open_sequence(source).readable(print), frames):
        if frame.image is None or frame.depth is None or not np.isfinite(frame.T_world_cam).all():
            continue
        depth, K = made(frame, network) if isinstance(network, bool) else predicted(frame, network)
        truth = truth_at(frame, K[0].numpy(), (depth.shape[1], depth.shape[2]))
        assert truth is not None
        pose, options = torch.from_numpy(frame.T_world_cam)[None], {"rotation_tolerance": 0.01}
        checked = check_frame(depth, pose, K, None, None, None, **options)
        marks = {
            kind: s.update(frame.image, frame.T_world_cam, frame.intrinsics).anchors(frame.intrinsics, K)
            for kind, s in sources.items()
        }
        anchors = {kind: check_anchors(marks[kind], checked, ()) for kind in marks}
        near = anchors[DENSE].depth < float(np.quantile(truth[truth > 0], NEAREST))
        anchors[NEAR] = replace(anchors[DENSE], valid=anchors[DENSE].valid & near)
        prepared.append(Prepared(checked, anchors, ufm(depth, pose, K).variance, torch.from_numpy(truth)))
    return prepared


def predicted(frame: Frame, network: DepthNetwork) -> tuple[Tensor, Tensor]:
    """Depth [1, h, w] and K [1, 3, 3]."""
    with torch.no_grad():
        x, K = network.preprocess(image_tensor(frame), torch.from_numpy(frame.intrinsics)[None])
        return network(x).depth.float(), K.double()


def made(frame: Frame, edges: bool) -> tuple[Tensor, Tensor]:
    """Corrupted truth [1, h, w] and K: divided by e^.4, and by a factor per cube of space (``edges``) or smoothed."""
    assert frame.depth is not None
    size = (frame.depth.shape[0] * 7 // 10, frame.depth.shape[1] * 7 // 10)
    K = resize_intrinsics(torch.from_numpy(frame.intrinsics)[None], frame.depth.shape, size)
    z = truth_at(frame, K[0].numpy(), size)
    assert z is not None
    if not edges:
        coarse = adaptive_avg_pool2d(torch.from_numpy(z)[None, None].clamp_min(0.1).log(), BLUR)
        return (interpolate(coarse, size, mode="bilinear")[0] - 0.4).exp().float(), K
    v, u = np.mgrid[: size[0], : size[1]]
    rays = np.stack([u, v, np.ones(size)], -1) @ np.linalg.inv(K[0].numpy()).T
    point = (rays * z[..., None]) @ frame.T_world_cam[:3, :3].T + frame.T_world_cam[:3, 3]
    cube = np.floor(point / CUBE).astype(np.int64) @ [73856093, 19349663, 83492791]
    factors = np.random.default_rng(0).normal(0.4, FACTOR, 64)
    return torch.from_numpy(z * np.exp(-factors[cube % 64]))[None].float(), K


def figures(prepared: list[Prepared], kind: str, config: PosteriorConfig) -> list[float]:
    """``FIGURES`` of the posterior with one kind of evidence."""
    metrics, packed = SequenceMetrics(), torch.zeros(1, SIZE, dtype=torch.float64)
    worse, outliers = [], []
    for one in prepared:
        packed, out = update(packed, one.frame, one.anchors[kind], one.claimed, config)
        maps = out.depth[0], out.variance[0], one.truth, one.frame.depth[0], out.inlier[0], out.outlier[0]
        depth, variance, truth, network, *mixture = (x[..., ::STRIDE, ::STRIDE] for x in maps)
        metrics.update(depth, variance, truth, mixture=(mixture[0], mixture[1]))
        measured = (truth > 0) & (network > 0)
        error, before = (truth - depth)[measured], (truth - network)[measured]
        worse.append((error.square().mean() > 1.21 * before.square().mean()).double())
        outliers.append(torch.stack([mixture[1][measured], error.square() / variance[measured]]))
    p, z2 = torch.cat(outliers, 1)
    of_outliers = float(p[z2 > 9].nanmean()), float(p[z2 <= 9].nanmean())
    row = metrics.compute() | dict(zip(LAST, (*of_outliers, float(torch.stack(worse).nanmean())), strict=True))
    return [row[name] for name in FIGURES]


def changed(config: PosteriorConfig, **values: float) -> PosteriorConfig:
    """A posterior's config with other values. Constants are attributes of the class; a subclass changes them."""
    settings = {one.name: values.pop(one.name, getattr(config, one.name)) for one in fields(config)}
    return type("Changed", (PosteriorConfig,), values)(**settings)


def with_change(config: PosteriorConfig, change: str) -> PosteriorConfig:
    """The config with one NAME=VALUE."""
    name, _, value = change.partition("=")
    return changed(config, **{name: type(getattr(config, name))(value)})


def by_tour(tours: list[list[list[Prepared]]], config: PosteriorConfig) -> NDArray[np.float64]:
    """[tours, figures] means over networks and evidence."""
    return np.array([np.mean([figures(p, kind, config) for p in tour for kind in KINDS], 0) for tour in tours])


def interval(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Half width of the 95 % interval of the mean over tours."""
    return STUDENT * rows.std(0, ddof=1) / len(rows) ** 0.5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, help="FastDepth's")
    parser.add_argument("--frames", type=int, default=20, help="of a tour")
    parser.add_argument("--change", nargs="+", metavar="NAME=VALUE", help="default: each constant halved and doubled")
    parser.add_argument("--clips", nargs="+", default=[], metavar="SEQUENCE", help="recordings instead of tours")
    arguments = parser.parse_args()
    if not (arguments.weights or arguments.clips):
        parser.error("the tours need --weights")
    with as_file(files("ufmstar_torch.models") / "weights" / "demo.safetensors") as weights:
        demo = load_trained([weights])[0].eval()
    config, network = PosteriorConfig(), demo
    if arguments.weights:
        network = load_network("fastdepth", arguments.weights).eval()
    print("| " + " | ".join(["", *FIGURES]) + " |\n" + "|---" * (1 + len(FIGURES)) + "|")
    for source in arguments.clips:
        prepared = prepare(source, network)
        for kind, change in product((DENSE, CORNERS), ("", *(arguments.change or ()))):
            first = next(i for i, one in enumerate(prepared) if bool(one.anchors[kind].valid.any()))
            row = figures(prepared[first:], kind, with_change(config, change) if change else config)
            name = " ".join([f"{Path(source).name}, {kind}", change]).strip()
            print(f"| {name} | " + " | ".join(f"{x:.3f}" for x in row) + " |", flush=True)
    if arguments.clips:
        return
    networks = [network, demo, True, False]
    tours = [[prepare(tour, one, arguments.frames) for one in networks] for tour in TOURS]
    start = by_tour(tours, config)
    means = zip(start.mean(0), interval(start), strict=True)
    print("| as it is | " + " | ".join(f"{m:.3f} ± {h:.3f}" for m, h in means) + " |", flush=True)
    values = {
        name: value
        for name in PosteriorConfig.__annotations__
        if isinstance(value := getattr(config, name), int | float)
    }
    halved_and_doubled = [f"{name}={value * by:g}" for name, value in values.items() for by in (0.5, 2)]
    for change in arguments.change or [text for text in halved_and_doubled if not text.startswith("discs=1.5")]:
        difference = by_tour(tours, with_change(config, change)) - start
        means = zip(difference.mean(0), interval(difference), strict=True)
        print(f"| {change} | " + " | ".join(f"{m:+.3f}{'*' * bool(abs(m) > h)}" for m, h in means) + " |", flush=True)


if __name__ == "__main__":
    main()
