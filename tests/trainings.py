"""Trainings of a second or two: frames whose brightness encodes the depth, and jobs on them."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
from layouts import write_depth_png, write_image

from ufmstar_torch.models import NetworkSpec
from ufmstar_torch.train import AugmentationConfig, DataConfig, FitSettings, Job, Recipe
from ufmstar_torch.train.member import read_checkpoint, trained_network

SIZE = (32, 32)
SPEC = NetworkSpec(widths=0.05, positive="softplus", size=SIZE, preprocess="resize")
# Three steps an epoch: 12 frames of 16 are trained on, the last four are held back.
RECIPE = Recipe(SPEC, epochs=3, batch_size=4, learning_rate=0.01, average=0.9, clip=5.0, warmup_steps=2)


def scenes(count, size=SIZE, noisy=False):
    """Images [N, H, W, 3] uint8, their depth [N, H, W] [m], the mask of missing depth, and the mask of the red half.

    Depth is smooth, 1 to 3 m, the image's grey 80 times the depth; a fifth of the depth is missing. If ``noisy``, the
    right half of even images and the left one of odd ones is red, the other half has no red.
    """
    rng = np.random.default_rng(7)
    rows, columns = np.mgrid[0 : size[0], 0 : size[1]] / size[0]
    drawn = [(*rng.uniform(-1, 1, 3), rng.uniform(size=size) < rng.uniform(0, 0.4)) for _ in range(count)]
    depths = np.stack([2 + np.tanh(a + 2 * b * (rows - 0.5) + 2 * c * (columns - 0.5)) for a, b, c, _ in drawn])
    images = np.repeat((80 * depths).round().astype(np.uint8)[..., None], 3, axis=-1)
    red = (columns >= 0.5) ^ (np.arange(count) % 2 == 1)[:, None, None]
    if noisy:
        images[..., 0] = np.where(red, 255, 0)
    return images, depths, np.stack([hole for *_, hole in drawn]), red


def write_frames(root, frames=16, size=SIZE, noise=0.0, seed=0):
    """Images and depth of :func:`scenes`, without poses: a training would check them. With ``noise`` [m], the stored
    depth of the red half is too large or too small by that much, at random with ``seed``."""
    images, depths, holes, red = scenes(frames, size, noisy=noise > 0)
    sign = np.random.default_rng(seed).choice([-1, 1], depths.shape)
    stored = np.where(holes, 0, depths + np.where(red, noise * sign, 0))
    for i in range(frames):
        write_image(root / "images" / f"{i:03}.png", images[i])
        write_depth_png(root / "depth" / f"{i:03}.png", stored[i], 1000)
    np.savetxt(root / "K.txt", [[30, 0, 15.5], [0, 30, 15.5], [0, 0, 1]])
    return root


def tiny_job(frames, out, recipe=RECIPE, augment=True, **settings):
    """A job on :func:`write_frames`'s folder."""
    data = DataConfig(
        kind="sequences",
        paths=(str(frames),),
        part="0:12",
        validation_part="12:16",
        augmentation=AugmentationConfig() if augment else None,
    )
    quiet = {"tensorboard": False, "progress": False, "accelerator": "cpu", "log_every": 1}
    return Job(recipe, data, FitSettings(out=out, **{**quiet, **settings}))


def trained(job, member=0):
    """A member of a finished training."""
    return trained_network(job, member, read_checkpoint(job, member))


def logged(out, name, member=0):
    """All logged values of a metric, in the order of their steps, over all sessions of a training."""
    found = []
    for file in sorted((out / f"member_{member}").glob("version_*/metrics.csv")):
        with file.open(newline="") as rows:
            found += [float(row[name]) for row in csv.DictReader(rows) if row.get(name)]
    return found


def with_network(recipe=RECIPE, **changes):
    """The recipe with changed settings of the network."""
    return replace(recipe, network=replace(recipe.network, **changes))
