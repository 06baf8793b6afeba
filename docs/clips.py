"""Predictions, variances and figures of a sequence, used by the scripts of docs/results/disagreement.md."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.sequences import FrameError
from ufmstar_torch.eval.sequences.frame import Frame, FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.models.load import load_network
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.models.trained import load_trained

Map = NDArray[np.float32]
SHARED = {
    "fr1/xyz": "rgbd_dataset_freiburg1_xyz",
    "fr3/teddy": "rgbd_dataset_freiburg3_teddy",
    "HoloLens office": "hololens_office",
    "TartanAir P000": "tartanair_sample/P000",
}


@dataclass(frozen=True, eq=False)
class Clip:
    """The predictions of a sequence.

    Attributes:
        name: as in the tables.
        depth: [N, h, w] [m].
        aleatoric: [N, h, w] [m^2], or None.
        truth: [N, h, w] [m], 0 = none.
        pose: [N, 4, 4] camera-to-world [m].
        K: [3, 3] [px].
    """

    name: str
    depth: Map
    aleatoric: Map | None
    truth: Map
    pose: NDArray[np.float64]
    K: NDArray[np.float64]

    @property
    def has_truth(self) -> NDArray[np.bool_]:
        """[N, h, w] where there is ground truth."""
        return self.truth > 0


def add_sources(parser: argparse.ArgumentParser) -> None:
    """The options of :func:`clips`."""
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--root", type=Path, help="folder that holds data/ and weights/")
    source.add_argument("--tours", help="seeds FIRST:LAST, the last one left out")
    parser.add_argument("--frames", type=int, default=90, help="of a tour")
    parser.add_argument("--fov", type=float, nargs="+", help="horizontal fields of view of the tours [deg], in turn")


def clips(arguments: argparse.Namespace) -> Iterator[Clip]:
    """With ``--root``: FastDepth on the shared sequences. With ``--tours``: one network, then four alternating networks
    with their variance."""
    if arguments.root is not None:
        network = load_network("fastdepth", arguments.root / "weights" / "fastdepth_nyu.onnx").eval()
        for name, path in SHARED.items():
            yield predict(name, str(arguments.root / "data" / path), [network], aleatoric=False)
        return
    members = demo_networks()
    first, last = (int(word) for word in arguments.tours.split(":"))
    for seed in range(first, last):
        fov = "" if arguments.fov is None else f"&fov={arguments.fov[(seed - first) % len(arguments.fov)]:g}"
        tour = f"tour:{seed}?style=mixed&frames={arguments.frames}{fov}"
        yield predict(f"tour {seed}, depth only", tour, members[:1], aleatoric=False)
        yield predict(f"tour {seed}, ensemble", tour, members, aleatoric=True)


def demo_networks() -> list[DepthNetwork]:
    """The networks that come with the package, trained on small rooms."""
    with as_file(files("ufmstar_torch.models") / "weights" / "demo.safetensors") as weights:
        return [member.eval() for member in load_trained([weights])]


def readable(sequence: FrameSequence) -> Iterator[Frame]:
    """The frames of a sequence that can be decoded."""
    for index in range(len(sequence)):
        try:
            yield sequence[index]
        except FrameError:
            continue


def predict(name: str, source: str, members: list[DepthNetwork], *, aleatoric: bool) -> Clip:
    """Predict every readable frame; the members alternate. ``aleatoric`` keeps their predicted variance."""
    rows = []
    for frame in readable(open_sequence(source)):
        member = members[len(rows) % len(members)]
        image, intrinsics = image_tensor(frame), torch.from_numpy(frame.intrinsics)
        with torch.no_grad():
            x, K = member.preprocess(image, intrinsics[None])
            text = member(x)
        depth, k = text.depth[0].float().numpy(), K[0].double().numpy()
        aleatoric_map = text.aleatoric_variance[0].float().numpy() if aleatoric else depth
        truth = truth_at(frame, k, depth.shape)
        rows.append((depth, aleatoric_map, np.zeros_like(depth) if truth is None else truth, frame.T_world_cam, k))
    depths, aleatoric_maps, truths, poses, Ks = (np.stack(column) for column in zip(*rows, strict=True))
    return Clip(name, depths, aleatoric_maps if aleatoric else None, truths, poses, Ks[0])


def estimate(clip: Clip, estimator: nn.Module) -> Map:
    """[N, h, w] variance by a fresh UfM or UfM* [m^2]."""
    K, maps = torch.from_numpy(clip.K)[None], []
    for i, depth in enumerate(clip.depth):
        aleatoric = None if clip.aleatoric is None else torch.from_numpy(clip.aleatoric[i])[None]
        maps.append(
            estimator(torch.from_numpy(depth)[None], torch.from_numpy(clip.pose[i])[None], K, aleatoric).variance[0]
        )
    return torch.stack(maps).numpy()


def judge(clip: Clip, variance: Map, stride: int) -> dict[str, float]:
    """``SequenceMetrics`` over every ``stride``-th pixel of every ``stride``-th row, and "rms", the RMS sigma [m]."""
    metrics = SequenceMetrics()
    part = (slice(None), slice(None, None, stride), slice(None, None, stride))
    metrics.update(*(torch.from_numpy(maps[part].copy()) for maps in (clip.depth, variance, clip.truth)))
    return metrics.compute() | {"rms": float(np.sqrt(variance[clip.has_truth].mean(dtype=np.float64)))}


def line(*words: str) -> None:
    """A row of a Markdown table."""
    print("| " + " | ".join(words) + " |", flush=True)


def shown(value: float) -> str:
    """Three decimals, or the power of ten."""
    return f"{value:.3f}" if abs(value) < 1e3 else f"{value:.0e}"
