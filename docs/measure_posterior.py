"""What each constant of the posterior does, on rendered tours with networks that are wrong in three ways.

    python docs/measure_posterior.py --weights fastdepth_nyu.onnx --tours 'tour:321?frames=40&size=240x320'

prints a row for each change of ``ufmstar_torch.posterior.model``, means over tours, networks and evidence: FastDepth,
the demo's first network and one that is made of the truth, off by a factor of its own in every cube of space; dense
evidence, tracked corners, and of the dense evidence only what is nearer than 40 % of the image. ``--clips`` names
recordings, for report: FastDepth, from the first anchor on, the NLL of the best constant variance, and the network's
depth times the frame's median g/d at the anchors.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from clips import demo_networks, line, shown
from torch import Tensor

from ufmstar_torch import UfMStar
from ufmstar_torch.anchors import Anchors, landmark_source
from ufmstar_torch.anchors.given import AnchorInput, check_anchors
from ufmstar_torch.camera import resize_intrinsics
from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.frame import FrameInput, check_frame
from ufmstar_torch.kernels import posterior_cpu
from ufmstar_torch.models.load import load_network
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.posterior.running import SIZE

SHOWN = ("delta1", "rmse", "ece_delta", "ece_q", "nll", "spearman")
DENSE, CORNERS, NEAR = "dense", "corners", "near"
NEAREST = 0.4  # share of the image that evidence of NEAR covers
STRIDE = 4  # judged are every fourth pixel of every fourth row
CUBE, FACTOR = 1.7, 0.35  # of the wrong network [m], and the standard deviation of its log factors
CHANGES: tuple[Mapping[str, Any], ...] = (
    {},
    {"wrong": 0.0, "other": 0.0, "inflation": 1.7, "growth": 0.06, "claimed": 0.25},
    *({"wrong": value} for value in (0.0, 0.01, 0.06)),
    *({"other": value} for value in (0.0, 0.2)),
    *({"spread": value} for value in (0.8, 3.0)),
    *({"window": value} for value in (0.06, 0.25)),
    *({"most": value} for value in (0.0, 3.0)),
    *({"growth": value} for value in (0.0, 0.06)),
    *({"inflation": value} for value in (1.0, 1.7)),
    *({"claimed": value} for value in (0.0, 1.0)),
    *({"alone": value} for value in (0.5, 1e9)),
    {"square": 1.0},
    {"climb": 1.0},
    *({"kappa": value} for value in (0.1, 2.0)),
    {"drift": (0.12, 0.12, 0.08, 0.06)},
    *({"hat": value} for value in (1e-6, 0.04)),
)


@dataclass(frozen=True, eq=False)
class Taken:
    """What the posterior is given of a frame, by evidence, and the truth [h, w] [m]."""

    frame: FrameInput
    anchors: Mapping[str, AnchorInput]
    claimed: Tensor
    truth: Tensor


def record(source: str, network: DepthNetwork | None, kinds: tuple[str, ...]) -> list[Taken]:
    """All frames of a sequence; None is the network that is made of the truth."""
    sources = {kind: landmark_source(kind) for kind in {DENSE if kind == NEAR else kind for kind in kinds}}
    ufm, taken = UfMStar(), []
    for frame in open_sequence(source).readable(print):
        if frame.image is None or frame.depth is None or not np.isfinite(frame.T_world_cam).all():
            continue
        depth, K = wrong(frame) if network is None else predicted(frame, network)
        truth = truth_at(frame, K[0].numpy(), (depth.shape[1], depth.shape[2]))
        assert truth is not None
        pose = torch.from_numpy(frame.T_world_cam)[None]
        given = check_frame(
            depth, pose, K, None, None, None, None, feature_count=0, rotation_tolerance=ufm.config.rotation_tolerance
        )
        marks = {
            kind: s.update(frame.image, frame.T_world_cam, frame.intrinsics).anchors(frame.intrinsics, K)
            for kind, s in sources.items()
        }
        if NEAR in kinds:
            marks[NEAR] = nearer(marks[DENSE], float(np.quantile(truth[truth > 0], NEAREST)))
        anchors = {kind: check_anchors(marks[kind], given, None) for kind in kinds}
        taken.append(Taken(given, anchors, ufm(depth, pose, K).variance, torch.from_numpy(truth)))
    return taken


def predicted(frame: Frame, network: DepthNetwork) -> tuple[Tensor, Tensor]:
    """Depth [1, h, w] and K [1, 3, 3]."""
    with torch.no_grad():
        x, K = network.preprocess(image_tensor(frame), torch.from_numpy(frame.intrinsics)[None])
        return network(x).depth.float(), K.double()


def wrong(frame: Frame) -> tuple[Tensor, Tensor]:
    """The truth over a factor of e^.4, and of its own in every cube of space; likewise."""
    assert frame.depth is not None
    size = (frame.depth.shape[0] * 7 // 10, frame.depth.shape[1] * 7 // 10)
    K = resize_intrinsics(torch.from_numpy(frame.intrinsics)[None], frame.depth.shape, size)
    z = truth_at(frame, K[0].numpy(), size)
    assert z is not None
    v, u = np.mgrid[: size[0], : size[1]]
    rays = np.stack([u, v, np.ones(size)], -1) @ np.linalg.inv(K[0].numpy()).T
    point = (rays * z[..., None]) @ frame.T_world_cam[:3, :3].T + frame.T_world_cam[:3, 3]
    cube = np.floor(point / CUBE).astype(np.int64) @ [73856093, 19349663, 83492791]
    factors = np.random.default_rng(0).normal(0.4, FACTOR, 64)
    return torch.from_numpy(z * np.exp(-factors[cube % 64]))[None].float(), K


def nearer(anchors: Anchors, limit: float) -> Anchors:
    """The anchors nearer than ``limit`` [m]."""
    near = anchors.depth < limit
    return replace(anchors, valid=near if anchors.valid is None else near & anchors.valid)


def figures(taken: list[Taken], kind: str, change: Mapping[str, Any]) -> dict[str, float]:
    """Of the posterior with one kind of evidence, and constants changed."""
    metrics, packed = SequenceMetrics(), torch.zeros(1, SIZE, dtype=torch.float64)
    with patch.object(posterior_cpu, "MODEL", posterior_cpu.MODEL._replace(**change)):
        for one in taken:
            packed, out = posterior_cpu.update(packed, one.frame, one.anchors[kind], one.claimed)
            metrics.update(*(x[..., ::STRIDE, ::STRIDE] for x in (out.depth[0], out.variance[0], one.truth)))
    return metrics.compute()


def scaled(taken: list[Taken], kind: str) -> dict[str, float]:
    """Of the network's depth times the frame's median g/d at the anchors."""
    metrics = SequenceMetrics(with_variance=False)
    for one in taken:
        anchors = one.anchors[kind]
        factor = (anchors.depth / anchors.predicted)[anchors.valid].median().nan_to_num(1.0)
        metrics.update((one.frame.depth[0] * factor)[::STRIDE, ::STRIDE], None, one.truth[::STRIDE, ::STRIDE])
    return metrics.compute()


def recordings(arguments: argparse.Namespace) -> Iterator[tuple[str, list[Taken]]]:
    """Every tour with every network, with its name."""
    networks: dict[str, DepthNetwork | None] = {"demo": demo_networks()[0], "made": None}
    if arguments.weights is not None:
        networks["FastDepth"] = load_network("fastdepth", arguments.weights).eval()
    for source in arguments.tours:
        for name, network in networks.items():
            yield f"{source}, {name}", record(source, network, (DENSE, CORNERS, NEAR))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tours", nargs="+", default=[], metavar="TOUR")
    parser.add_argument("--weights", type=Path, help="FastDepth's; without them two networks")
    parser.add_argument("--clips", nargs="+", default=[], metavar="SEQUENCE", help="recordings, with the constants")
    parser.add_argument("--only", nargs="+", default=None, help="constants that are changed; default: all")
    arguments = parser.parse_args()
    every = list(recordings(arguments))
    if every:
        line("changed", *(f"{evidence}: {name}" for evidence in ("all", NEAR) for name in SHOWN))
        line(*["---"] * (1 + 2 * len(SHOWN)))
    for change in CHANGES if every else ():
        if change and arguments.only is not None and not set(change) & set(arguments.only):
            continue
        rows = {k: [figures(taken, k, change) for _, taken in every] for k in (DENSE, CORNERS, NEAR)}
        columns = ([row for of_kind in rows.values() for row in of_kind], rows[NEAR])
        means = (np.mean([row[name] for row in of]) for of in columns for name in SHOWN)
        line(", ".join(f"{k} {v}" for k, v in change.items()) or "as it is", *map(shown, means))
    if arguments.clips:
        line("sequence", "evidence", *SHOWN, "constant", "median: delta1", "median: rmse")
        line(*["---"] * (5 + len(SHOWN)))
    for source in arguments.clips:
        taken = record(source, load_network("fastdepth", arguments.weights).eval(), (DENSE, CORNERS))
        for kind in (DENSE, CORNERS):
            first = next(i for i, one in enumerate(taken) if bool(one.anchors[kind].valid.any()))
            row = figures(taken[first:], kind, {})
            constant = 0.5 * (np.log(2 * np.pi * row["rmse"] ** 2) + 1)
            median = scaled(taken[first:], kind)
            after = (constant, median["delta1"], median["rmse"])
            line(Path(source).name, kind, *(shown(row[name]) for name in SHOWN), *map(shown, after))


if __name__ == "__main__":
    main()
