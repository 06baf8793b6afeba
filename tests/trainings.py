"""Trainings of a second or two: frames whose depth can be read off their brightness, and jobs on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from layouts import write_depth_png, write_image

from ufmstar_torch.models.spec import NetworkSpec
from ufmstar_torch.train.augment import AugmentationConfig
from ufmstar_torch.train.data_config import DataConfig
from ufmstar_torch.train.presets import Recipe
from ufmstar_torch.train.settings import FitSettings, Job

SIZE = (32, 32)
SPEC = NetworkSpec(widths=0.05, positive="softplus", size=SIZE, preprocess="resize")
# Three steps an epoch: 12 frames of 16 are trained on, the last four are held back.
RECIPE = Recipe(SPEC, epochs=3, batch_size=4, learning_rate=0.01, average=0.9, clip=5.0, warmup_steps=2)


def write_frames(root, frames=16, size=SIZE, noise=0.0, seed=0):
    """A generic sequence: smooth depth from 1 to 3 m, grey 80 times the depth, a fifth of the depth missing.

    With ``noise``, one half of each image is red (without red in the other one), and there the stored depth is too
    large or too small by that much [m], at random with ``seed``; the scenes are the same for every seed.
    """
    rng, coin = np.random.default_rng(7), np.random.default_rng(seed)
    for i in range(frames):
        depth = smooth_depth(rng, size)
        image = np.repeat((80 * depth).round().astype(np.uint8)[..., None], 3, axis=-1)
        hole = rng.uniform(size=size) < rng.uniform(0, 0.4)
        if noise:
            red = red_half(i, size)
            image[..., 0] = np.where(red, 255, 0)
            depth = depth + np.where(red, noise * coin.choice([-1, 1], size), 0)
        write_image(root / "images" / f"{i:03}.png", image)
        write_depth_png(root / "depth" / f"{i:03}.png", np.where(hole, 0, depth), 1000)
    np.savetxt(root / "K.txt", [[30, 0, 15.5], [0, 30, 15.5], [0, 0, 1]])
    np.savetxt(root / "poses.txt", [np.eye(4).ravel()] * frames)
    return root


def smooth_depth(rng, size):
    """[H, W] depth [m] of the next scene."""
    rows, columns = np.mgrid[0 : size[0], 0 : size[1]] / size[0]
    a, b, c = rng.uniform(-1, 1, 3)
    return 2 + np.tanh(a + 2 * b * (rows - 0.5) + 2 * c * (columns - 0.5))


def red_half(number, size):
    """[H, W] True in the half of a frame that is noisy: right in even frames, left in odd ones."""
    right = np.broadcast_to(np.arange(size[1]) >= size[1] / 2, size)
    return ~right if number % 2 else right


def tiny_job(frames, out, recipe=RECIPE, augment=True, **settings):
    """A job on :func:`write_frames`'s folder."""
    data = DataConfig(
        kind="sequences",
        paths=(str(frames),),
        part="0:12",
        validation_part="12:16",
        augmentation=AugmentationConfig() if augment else None,
    )
    quiet = {"examples": 0, "tensorboard": False, "progress": False, "accelerator": "cpu", "log_every": 1}
    return Job(recipe, data, FitSettings(out=out, **{"checkpoint_every": 2, **quiet, **settings}))


def with_network(recipe=RECIPE, **changes):
    """The recipe with another network."""
    return replace(recipe, network=replace(recipe.network, **changes))
