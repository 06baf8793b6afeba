"""The picture of docs/anchors.md: a bias that UfM* cannot see, and what anchors make of it.

python docs/draw_anchors.py --tour 'tour:300008?style=hall&frames=60&size=240x320' --out docs/images/anchors.jpg
python docs/draw_anchors.py --root ../shared --clip fr1/xyz --out fr1_xyz.jpg
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from clips import SHARED, Map, demo_networks, readable
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray
from scipy.stats import spearmanr

from ufmstar_torch import AnchorConfig, UfMStar, UfMStarConfig
from ufmstar_torch.anchors import LandmarkTracker
from ufmstar_torch.eval.run.pictures import field_of_view
from ufmstar_torch.eval.sequences.frame import FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.models.load import load_network
from ufmstar_torch.models.network import DepthNetwork

UNKNOWN = "0.8"  # grey of pixels without ground truth
DEPTH, ERROR, RATIO = "viridis", "magma", "RdBu"


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame and everything that is said of it; maps are [h, w], NaN where unknown.

    Attributes:
        image: [H, W, 3] uint8, what the maps show.
        pixel: [N, 2] (u, v) of the anchors in the maps [px].
        measured: [N] relative error r = g/d - 1 at each of them.
        depth, truth: predicted and true [m].
        plain, anchored: sigma of UfM* without and with anchors [m].
        bias: the relative error that anchors lead to expect.
        corrected: depth without it [m].
    """

    image: NDArray[np.uint8]
    pixel: NDArray[np.float64]
    measured: NDArray[np.float64]
    depth: Map
    truth: Map
    plain: Map
    anchored: Map
    bias: Map
    corrected: Map

    @property
    def error(self) -> Map:
        """|d - g| [m]."""
        return np.abs(self.depth - self.truth)


def last_shot(sequence: FrameSequence, network: DepthNetwork) -> Shot:
    """What is said of the last frame, after all those before it; frames that cannot be read are left out."""
    plain, anchored, tracker = UfMStar(), UfMStar(UfMStarConfig(anchors=AnchorConfig())), LandmarkTracker()
    for frame in readable(sequence):
        image, intrinsics = image_tensor(frame), torch.from_numpy(frame.intrinsics)
        with torch.no_grad():
            x, K = network.preprocess(image, intrinsics[None])
            depth = network(x).depth.float()
        landmarks = tracker.update(frame.image, frame.T_world_cam, frame.intrinsics)
        pose, anchors = torch.from_numpy(frame.T_world_cam)[None], landmarks.anchors(frame.intrinsics, K)
        without, out = plain(depth, pose, K), anchored(depth, pose, K, anchors=anchors)
    d, k, pixel = depth[0].numpy(), K[0].double().numpy(), anchors.pixel[0].numpy()
    u, v = np.rint(pixel).astype(int).T
    inside = (u >= 0) & (u < d.shape[1]) & (v >= 0) & (v < d.shape[0])
    truth = truth_at(frame, k, d.shape)
    return Shot(
        image=field_of_view(frame.image, frame.intrinsics, k, d.shape),
        pixel=pixel[inside],
        measured=landmarks.depth[inside] / d[v[inside], u[inside]] - 1,
        depth=d,
        truth=np.where(truth > 0, truth, np.nan),
        plain=without.std[0].numpy(),
        anchored=out.std[0].numpy(),
        bias=out.bias[0].numpy(),
        corrected=out.corrected()[0][0].numpy(),
    )


def draw(shot: Shot) -> Figure:
    """Above, the relative error: measured at anchors, expected from them, true. Below, sigma beside the true error."""
    height = 2 * 2.3 * shot.image.shape[0] / shot.image.shape[1] + 0.9  # [inches]
    figure, axes = plt.subplots(2, 4, figsize=(10.6, height), layout="constrained")
    known, relative = np.isfinite(shot.error), shot.truth / shot.depth - 1
    apart = np.percentile(np.abs(relative[known]), 95)
    ratio = {"cmap": RATIO, "vmin": -apart, "vmax": apart}
    with_anchors(axes[0][0], shot, ratio)
    panel(axes[0][1], shot, np.where(known, shot.bias, np.nan), "expected from them", **ratio)
    ratios = panel(axes[0][2], shot, relative, "true relative error", **ratio)
    bar(axes[0][2], ratios, "(true − predicted) / predicted")
    most = np.percentile(shot.depth, 99)
    shades = panel(axes[0][3], shot, shot.depth, "predicted depth", cmap=DEPTH, vmin=0, vmax=most)
    bar(axes[0][3], shades, "m")

    metres = {"cmap": ERROR, "vmin": 0, "vmax": np.percentile(shot.error[known], 98)}
    for axis, sigma, name in ((axes[1][0], shot.plain, "σ of UfM*"), (axes[1][1], shot.anchored, "σ with anchors")):
        rank = spearmanr(sigma[known], shot.error[known]).statistic
        words = f"{name}: {rms(sigma, known)}\nrank correlation {rank:.2f}"
        panel(axis, shot, np.where(known, sigma, np.nan), words, **metres)
    errors = panel(axes[1][2], shot, shot.error, f"true error: {rms(shot.error, known)}", **metres)
    left = np.abs(shot.corrected - shot.truth)
    panel(axes[1][3], shot, left, f"error of corrected depth: {rms(left, known)}", **metres)
    for axis in axes[1][2:]:
        bar(axis, errors, "m")
    return figure


def panel(axes: Axes, shot: Shot, values: NDArray[Any], title: str, **scale: Any) -> AxesImage:
    """A map in the image's proportions; what is unknown is grey."""
    axes.set_facecolor(UNKNOWN)
    axes.set_title(title, fontsize=9)
    axes.set(xticks=[], yticks=[], box_aspect=shot.image.shape[0] / shot.image.shape[1])
    return axes.imshow(values, aspect="auto", **scale)


def bar(axes: Axes, shown: AxesImage, label: str) -> None:
    """The colours of a panel, beside it."""
    beside = axes.inset_axes((1.03, 0, 0.04, 1))
    axes.figure.colorbar(shown, cax=beside)
    beside.set_ylabel(label, fontsize=8)
    beside.tick_params(labelsize=8)


def with_anchors(axes: Axes, shot: Shot, ratio: dict[str, Any]) -> None:
    """The image, pale, and what each anchor has measured."""
    pale = 0.5 * shot.image.mean(-1, keepdims=True).repeat(3, -1) + 0.5 * 255
    h, w = shot.depth.shape
    title = f"relative error at {len(shot.measured)} anchors"
    panel(axes, shot, pale.astype(np.uint8), title, extent=(-0.5, w - 0.5, h - 0.5, -0.5))
    axes.scatter(*shot.pixel.T, c=shot.measured, s=22, edgecolors="k", linewidths=0.5, **ratio)


def rms(values: Map, known: NDArray[np.bool_]) -> str:
    """In metres, for a title."""
    return f"RMS {np.sqrt(np.mean(np.square(values[known]))):.2f} m"


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--root", type=Path, help="folder that holds data/ and weights/: FastDepth on a recording")
    source.add_argument("--tour", help="name of a tour: a network of the demo on rendered rooms")
    parser.add_argument("--clip", choices=SHARED, default="fr1/xyz", help="of --root")
    parser.add_argument("--out", type=Path, required=True, help="picture")
    options = parser.parse_args()
    if options.root is None:
        network, sequence = demo_networks()[0], open_sequence(options.tour)
    else:
        network = load_network("fastdepth", options.root / "weights" / "fastdepth_nyu.onnx").eval()
        sequence = open_sequence(str(options.root / "data" / SHARED[options.clip]))
    draw(last_shot(sequence, network)).savefig(options.out, dpi=110)


if __name__ == "__main__":
    main()
