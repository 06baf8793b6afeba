"""Draws the pictures of docs/gallery.md from a run, its exports and its recording.

ufmstar run DIR/data/hololens_office --model fastdepth --weights DIR/weights/fastdepth_nyu.onnx --out OUT
ufmstar export OUT --to cloud --sequence DIR/data/hololens_office --max-relative-sigma .1
PYTHONPATH=examples python docs/draw_gallery.py OUT DIR/data/hololens_office docs/images
"""

from __future__ import annotations

import argparse
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from measure_clouds import read_vertices
from numpy.typing import NDArray
from PIL import Image

from ufmstar_torch.anchors import DenseEvidence
from ufmstar_torch.eval.run.colours import DEPTH_MAP, ColourScale, robust_range
from ufmstar_torch.eval.run.export import gated_frames
from ufmstar_torch.eval.sequences import FrameSequence, open_sequence
from ufmstar_torch.eval.sequences.ground_truth import truth_at

Points = NDArray[np.float64]
Picture = NDArray[np.uint8]
WIDTH = 720  # [px] of a picture, half of the moving one's
EVERY = 5  # a frame of the moving picture is the run's every fifth
BINS = 8  # of sigma / depth


def anchors(sequence: FrameSequence, number: int) -> Picture:
    """The image ``number``, with the anchors that are searched for it in earlier ones, coloured by depth."""
    source, frames = DenseEvidence(), list(islice(sequence, number + 1))
    found = [source.update(frame.image, frame.T_world_cam, frame.intrinsics) for frame in frames][-1]
    image = frames[-1].image
    assert image is not None
    picture = (0.45 * image + 0.55 * image.mean(2, keepdims=True)).astype(np.uint8)
    scale = ColourScale(*robust_range([found.depth.astype(np.float32)], from_zero=False), DEPTH_MAP)
    colours = scale.rgb(found.depth[None].astype(np.float32))[0]
    for (u, v), colour in zip(found.pixel.round().astype(int), colours, strict=True):
        picture[max(v - 4, 0) : v + 5, max(u - 4, 0) : u + 5] = 0
        picture[max(v - 3, 0) : v + 4, max(u - 3, 0) : u + 4] = colour
    return picture


def seen_from(points: Points, colours: Picture, T_world_cam: Points, size: int = 2, height: int = 480) -> Picture:
    """Points [P, 3] [m] with colours [P, 3], from behind and above a camera; nearer points hide farther ones. A
    point is ``size`` pixels wide."""
    back = T_world_cam[:3, 3] - 1.2 * T_world_cam[:3, 2] - 0.5 * T_world_cam[:3, 1]
    x, y, z = ((points - back) @ T_world_cam[:3, :3]).T
    focal, front = 0.75 * WIDTH, z > 0.2
    u, v = (np.rint(focal * a[front] / z[front]).astype(int) for a in (x, y))
    u, v = u + WIDTH // 2, v + height // 2
    picture = np.full((height, WIDTH, 3), 255, np.uint8)
    order = np.argsort(-z[front])
    for right, down in np.ndindex(size, size):
        a, b = u[order] + right, v[order] + down
        inside = (a >= 0) & (b >= 0) & (a < WIDTH) & (b < height)
        picture[b[inside], a[inside]] = colours[front][order][inside]
    return picture


def coverage(out: Path, sequence: FrameSequence) -> Any:
    """A figure: where sigma is stated as a share of the depth, how large is the error, and how often within 2 sigma?"""
    from ufmstar_torch.eval.report import style

    stated, error = [], []
    for frame in gated_frames(out, np.inf, np.inf):
        truth = truth_at(sequence[frame.index], frame.intrinsics, frame.depth.shape)
        if truth is None:
            continue
        judged = (truth > 0) & np.isfinite(frame.depth) & (frame.sigma > 0)
        stated.append((frame.sigma / frame.depth)[judged])
        error.append((np.abs(frame.depth - truth) / frame.depth)[judged])
    sigma, off = np.concatenate(stated), np.concatenate(error)
    edges = np.quantile(sigma, np.linspace(0, 1, BINS + 1))
    groups = [(sigma >= low) & (sigma <= high) for low, high in pairwise(edges)]
    centre = [float(np.median(sigma[group])) for group in groups]
    figure = style.new_figure(8.0, 3.4, "A larger sigma means a larger error")
    left, right = figure.subplots(1, 2)
    left.plot(centre, [float(np.sqrt(np.mean(off[group] ** 2))) for group in groups], marker="o", color="#0072B2")
    left.plot(centre, centre, linestyle="--", color="#888888")
    left.set(xscale="log", yscale="log")
    style.finish(left, title="dashed: as stated", x="stated sigma / depth", y="root mean squared error / depth")
    within = [float(np.mean(off[group] <= 2 * sigma[group])) for group in groups]
    right.plot(centre, within, marker="o", color="#0072B2")
    right.axhline(0.954, linestyle="--", color="#888888")
    right.set(xscale="log", ylim=(0, 1))
    style.finish(right, title="dashed: a Gaussian's 95 %", x="stated sigma / depth", y="share within 2 sigma")
    return figure


def moving(out: Path, target: Path) -> None:
    """Every ``EVERY``-th frame of a run's preview.mp4 as a moving picture (WebP)."""
    import imageio.v3 as iio

    frames = [Image.fromarray(frame) for frame in islice(iio.imiter(out / "preview.mp4"), 0, None, EVERY)]
    width = 2 * WIDTH
    small = [frame.resize((width, round(width * frame.height / frame.width))) for frame in frames]
    small[0].save(target, save_all=True, append_images=small[1:], duration=160, loop=0, quality=45, method=4)


def main(out: Path, recording: str, folder: Path) -> None:
    """Write the pictures into ``folder``."""
    from tsdf import VOXEL, fuse, points_of, surface

    from ufmstar_torch.eval.report.style import save_figure

    sequence, frames = open_sequence(recording), list(gated_frames(out, np.inf, np.inf))
    middle = len(frames) // 2
    moving(out, folder / "preview.webp")
    save(anchors(sequence, middle), folder / "anchors.jpg")
    view = frames[middle].T_world_cam
    vertices = read_vertices(out / "export" / "cloud.ply")
    points, colours = (np.stack([vertices[name] for name in of], 1) for of in ("xyz", ("red", "green", "blue")))
    save(seen_from(points, colours, view), folder / "cloud.jpg")
    extent = points_of(frames)
    low, high = np.quantile(extent, [0.002, 0.998], axis=0)
    shape = tuple(np.ceil((high - low) / VOXEL).astype(int) + 2)
    points = surface(*fuse(frames, low, shape)["1/sigma^2"], low)
    depth = (points - view[:3, 3]) @ view[:3, 2]
    colours = ColourScale(*np.quantile(depth[depth > 0], [0.01, 0.95]), DEPTH_MAP).rgb(depth[None].astype(np.float32))[
        0
    ]
    save(seen_from(points, colours, view, size=6), folder / "tsdf.jpg")
    save_figure(coverage(out, sequence), folder / "coverage.png")


def save(picture: Picture, path: Path) -> None:
    """Write a picture of at most ``WIDTH`` pixels."""
    image = Image.fromarray(picture)
    image.thumbnail((WIDTH, WIDTH))
    image.save(path, quality=80)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="the folder of `ufmstar run`, with its export of a cloud")
    parser.add_argument("recording", help="of the run")
    parser.add_argument("folder", type=Path, help="for the pictures")
    main(**vars(parser.parse_args()))
