"""Trainings of a second or two: frames whose depth can be read off their brightness, and jobs on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from layouts import write_depth_png, write_image

from ufmstar_torch.models.spec import NetworkSpec
from ufmstar_torch.train.augment import AugmentationConfig
from ufmstar_torch.train.data import DataConfig
from ufmstar_torch.train.member import Job
from ufmstar_torch.train.presets import Recipe
from ufmstar_torch.train.settings import FitSettings

SIZE = (32, 32)
SPEC = NetworkSpec(widths=0.05, positive="softplus", size=SIZE, preprocess="resize")
# Three steps an epoch: 12 frames of 16 are trained on, the last four are held back.
RECIPE = Recipe(SPEC, epochs=3, batch_size=4, learning_rate=0.01, average=0.9, clip=5.0, warmup_steps=2)


def write_frames(root, frames=16):
    """A generic sequence: smooth depth from 1 to 3 m, grey 100 times the depth, a fifth of the depth missing."""
    rng = np.random.default_rng(7)
    rows, columns = np.mgrid[0 : SIZE[0], 0 : SIZE[1]] / SIZE[0]
    for i in range(frames):
        a, b, c = rng.uniform(-1, 1, 3)
        depth = 2 + np.tanh(a + 2 * b * (rows - 0.5) + 2 * c * (columns - 0.5))
        image = np.repeat((80 * depth).round().astype(np.uint8)[..., None], 3, axis=-1)
        hole = rng.uniform(size=SIZE) < rng.uniform(0, 0.4)
        write_image(root / "images" / f"{i:03}.png", image)
        write_depth_png(root / "depth" / f"{i:03}.png", np.where(hole, 0, depth), 1000)
    np.savetxt(root / "K.txt", [[30, 0, 15.5], [0, 30, 15.5], [0, 0, 1]])
    np.savetxt(root / "poses.txt", [np.eye(4).ravel()] * frames)
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
    quiet = {"examples": 0, "tensorboard": False, "progress": False, "accelerator": "cpu", "log_every": 1}
    return Job(recipe, data, FitSettings(out=out, **{"checkpoint_every": 2, **quiet, **settings}))


def with_network(recipe=RECIPE, **changes):
    """The recipe with another network."""
    return replace(recipe, network=replace(recipe.network, **changes))
