"""Measures the posterior on things that move, and what they cost on what stands still.

    python docs/measure_movers.py --weights fastdepth_nyu.onnx

runs FastDepth, dense anchors and the posterior on ten tours with six moving things each, and on the same tours without
them; with --exact instead of --weights, a network of the true depth times 1.35. It prints, for each kind of motion, for
all moving pixels and for those that stand still: number of pixels; median ratio of posterior and true depth; root mean
square z; the share of pixels beyond 4 sigma; the share with a stated sigma below a tenth of the depth and an error
above half of the truth; delta1; NLL; and NLL of the mixture. The last row has the still pixels in the tours without
things that move. The first frames are left out, because they have no parallax. A second table has the pixels of all
tours by ``posterior_outlier``: the share beyond three standard deviations of the inliers, as the mixture states it and
as found.
"""

from __future__ import annotations

import argparse
import math
from collections import defaultdict
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch import AnchorConfig, PosteriorConfig, UfMStar, UfMStarConfig
from ufmstar_torch.anchors import landmark_source
from ufmstar_torch.eval.report import style
from ufmstar_torch.eval.report.figures_calibration import OUTLIER, draw_shares
from ufmstar_torch.eval.report.style import LineStyle
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.sequences.ground_truth import resample_nearest, truth_at
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.eval.tour import make_movers, make_tour, tour_path, tour_sequence
from ufmstar_torch.eval.tour.movers import Mover, with_movers
from ufmstar_torch.eval.tour.view import cast, intrinsics
from ufmstar_torch.gaussians.camera import resize_intrinsics
from ufmstar_torch.models.load import load_network
from ufmstar_torch.models.network import DepthNetwork

PROBABILITIES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 1.01)  # bounds of the table of outliers
TOURS = tuple(zip(range(951, 961), ("home", "hall", "mixed", "blank", "scales") * 2, strict=True))
SIZE, HALF, MOVERS, FIRST, STRIDE = (240, 320), (120, 160), 6, 5, 2
# The exact network's error, and its depth over this error where nothing is [m].
OFF, NOWHERE = 1.35, 3.0
Array = NDArray[np.float64]


def things(seed: int, style: str, frames: int) -> tuple[tuple[Mover, ...], list[NDArray[np.int64]]]:
    """The things of a tour; and for each frame, [H, W] the number of the one that a pixel shows, from 1, 0 = none."""
    tour, K = make_tour(seed, style), torch.from_numpy(intrinsics(*SIZE))
    poses = tour_path(tour, frames)
    movers, maps = make_movers(tour, poses, K, SIZE, MOVERS), []
    for i in range(frames):
        surface = cast(with_movers(tour, movers, i), poses[i], K, *SIZE)[1].numpy()
        present = [(k, len(m.surfaces.kind)) for k, m in enumerate(movers, 1) if exists(m, i)]
        ends = np.cumsum([len(tour.surfaces.kind), *(n for _, n in present)])
        maps.append(np.array([0, *(k for k, _ in present)])[np.searchsorted(ends, surface, side="right")])
    return movers, maps


def exists(mover: Mover, index: int) -> bool:
    """Whether a thing exists in a frame."""
    return 0 <= index - mover.start < len(mover.position)


def prediction(frame: Frame, network: DepthNetwork | None) -> tuple[torch.Tensor, torch.Tensor]:
    """Depth [1, h, w] and K [1, 3, 3]; without a network, ``OFF`` times the true depth at half of the image's size."""
    if network is None:
        K = resize_intrinsics(torch.from_numpy(frame.intrinsics), SIZE, HALF)
        truth = truth_at(frame, K.numpy(), HALF)
        return torch.from_numpy(np.where(truth > 0, OFF * truth, OFF * NOWHERE)).float()[None], K[None]
    with torch.no_grad():
        x, K = network.preprocess(image_tensor(frame), torch.from_numpy(frame.intrinsics)[None])
        return network(x).depth.float(), K.double()


def posterior(frames: list[Frame], network: DepthNetwork | None) -> Iterator[tuple[Array, NDArray[np.float64]]]:
    """For each frame, [h, w, 5] depth, variance, inlier variance, probability of an outlier and truth; and K [3, 3]."""
    source = landmark_source("dense")
    ufm = UfMStar(UfMStarConfig(anchors=AnchorConfig(), posterior=PosteriorConfig()))
    for frame in frames:
        assert frame.image is not None
        depth, K = prediction(frame, network)
        marks = source.update(frame.image, frame.T_world_cam, frame.intrinsics).anchors(frame.intrinsics, K)
        out = ufm(depth, torch.from_numpy(frame.T_world_cam)[None], K, anchors=marks)
        maps = out.depth, out.variance, out.posterior_inlier_variance, out.posterior_outlier
        truth = truth_at(frame, K[0].numpy(), (depth.shape[1], depth.shape[2]))
        yield np.stack([*(x[0].double().numpy() for x in maps if x is not None), truth], -1), K[0].numpy()


def row(name: str, pixels: list[Array]) -> str:
    """A row of the table from [P, 5] values."""
    d, v, v1, p, g = np.concatenate(pixels).T
    z2, off, v2 = (g - d) ** 2 / v, np.abs(d - g), outlier_variance(v, v1, p)
    parts = [np.exp(-((g - d) ** 2) / x / 2) / np.sqrt(2 * np.pi * x) for x in (v1, v2)]
    mixture = -np.log(np.maximum((1 - p) * parts[0] + p * parts[1], 1e-30)).mean()
    nll = (z2 + np.log(2 * np.pi * v)).mean() / 2
    confident = (v < 0.01 * d * d) & (off > 0.5 * g)
    figures = [f"{np.median(d / g):.2f}", f"{z2.mean() ** 0.5:.2f}", f"{(z2 > 16).mean():.3f}"]
    figures += [f"{confident.mean():.4f}", f"{(off <= 0.25 * g).mean():.4f}", f"{nll:.3f}", f"{mixture:.3f}"]
    return f"| {name} | {len(d)} | " + " | ".join(figures) + " |"


def outlier_variance(v: Array, v1: Array, p: Array) -> Array:
    """V_2 of the mixture with the total variance v, the inliers' variance v1 and the outliers' probability p."""
    return np.maximum((v - (1 - p) * v1) / np.maximum(p, 1e-12), v1)


def outliers(pixels: Array) -> Array:
    """[bins, 4] by ``posterior_outlier``, of [P, 5] values: share of the pixels, mean probability, and the share beyond
    three standard deviations of the inliers, as the mixture states it and as found."""
    _, v, v1, p, _ = pixels.T
    far = 3 * torch.from_numpy(np.sqrt(v1 / outlier_variance(v, v1, p)))  # in standard deviations of the outliers
    stated = (1 - p) * math.erfc(3 / math.sqrt(2)) + p * torch.erfc(far / math.sqrt(2)).numpy()
    used = [(p >= low) & (p < high) for low, high in pairwise(PROBABILITIES)]
    columns = p, stated, beyond_inliers(pixels)
    return np.array([(k.mean(), *(column[k].mean() for column in columns)) for k in used])


def beyond_inliers(pixels: Array) -> NDArray[np.bool_]:
    """[P] whether the error of [P, 5] values is beyond three standard deviations of the inliers."""
    d, _, v1, _, g = pixels.T
    return (g - d) ** 2 > 9 * v1


def print_outliers(every: Array, still: Array, figure: Path | None) -> None:
    """Print, and draw, outliers stated against found over ``every`` pixel, and the ratio of mean probabilities also for
    the ``still`` ones."""
    table = outliers(every)
    print("\n| posterior_outlier | share | mean | beyond 3 sigma of inliers: stated | found |\n|---|---|---|---|---|")
    for (low, high), (share, *figures) in zip(pairwise(PROBABILITIES), table, strict=True):
        print(f"| {low:g} to {min(high, 1):g} | {share:.2f} | " + " | ".join(f"{x:.3f}" for x in figures) + " |")
    for name, pixels in (("all", every), ("in the tours without", still)):
        beyond = beyond_inliers(pixels)
        means = pixels[beyond, 3].mean(), pixels[~beyond, 3].mean()
        print(f"{name}: mean probability {means[0]:.3f} beyond, {means[1]:.3f} within, ratio {means[0] / means[1]:.2f}")
    if figure is not None:
        canvas, names = style.new_figure(4.2, 4.2, ""), ("pixels", "probability", "stated", "found")
        kind = OUTLIER._replace(stated="stated", found="found", pixels="pixels")
        curves = dict(zip(names, table.T, strict=True))
        draw_shares(canvas.subplots(), kind, {LineStyle("posterior", "#D55E00", "o"): curves}, "")
        style.save_figure(canvas, figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--weights", type=Path, help="FastDepth's")
    source.add_argument("--exact", action="store_true", help="the true depth times 1.35 instead of a network")
    parser.add_argument("--frames", type=int, default=60, help="of a tour")
    parser.add_argument("--tours", type=int, default=len(TOURS), help="number of tours")
    parser.add_argument("--figure", type=Path, help="PNG or SVG of outliers")
    arguments = parser.parse_args()
    network = None if arguments.exact else load_network("fastdepth", arguments.weights).eval()
    found: dict[str, list[Array]] = defaultdict(list)
    for seed, rooms in TOURS[: arguments.tours]:
        options = {"frames": arguments.frames, "size": SIZE, "style": rooms}
        movers, ids = things(seed, rooms, arguments.frames)
        for count in (MOVERS, 0):
            frames = list(tour_sequence(seed, movers=count, **options))
            for i, (values, K_map) in enumerate(posterior(frames, network)):
                if i < FIRST:
                    continue
                shown = resample_nearest(ids[i], frames[i].intrinsics, K_map, values.shape[:2])
                values, shown = values[::STRIDE, ::STRIDE], shown[::STRIDE, ::STRIDE]
                usable = (values[..., 4] > 0) & np.isfinite(values[..., 0])
                found["still" if count else "still, in the tours without"].append(values[usable & (shown == 0)])
                for k, mover in enumerate(movers, 1):
                    if count and (shown == k).any():
                        found[mover.motion].append(values[usable & (shown == k)])
        print(f"tour {seed}, {rooms}: {len(movers)} things", flush=True)
    still = [found.pop(name) for name in ("still", "still, in the tours without")]
    print("| | pixels | ratio | rms z | beyond 4 sigma | confident and wrong | delta1 | NLL | mixture: NLL |")
    print("|---" * 9 + "|")
    for motion in sorted(found):
        print(row(motion, found[motion]))
    others = [pixels for motion, rows in found.items() if motion != "along, half" for pixels in rows]
    print(row("all but along, half", others))
    print(row("all moving", [pixels for rows in found.values() for pixels in rows]))
    print(row("still", still[0]))
    print(row("still, in the tours without", still[1]))
    every = np.concatenate([pixels for rows in (*found.values(), *still) for pixels in rows])
    print_outliers(every, np.concatenate(still[1]), arguments.figure)


if __name__ == "__main__":
    main()
