"""A rendered walk for the tests of landmark sources, and the errors of their landmarks."""

from __future__ import annotations

import functools

import numpy as np

from ufmstar_torch.eval.sequences.open import open_sequence


@functools.cache
def walk():
    """14 frames of 180 x 240. Tests must not change them."""
    return list(open_sequence("tour:5?frames=14&size=180x240"))


@functools.cache
def long_walk(n):
    """60 frames of 240 x 320, of the first or the second tour."""
    return list(open_sequence(("tour:71?style=mixed&frames=60&size=240x320", "tour:72?frames=60&size=240x320")[n]))


def true_depth(frame, pixel):
    u, v = np.rint(pixel).astype(int).T
    return frame.depth[v, u]


def surprise(frame, result):
    """[N] absolute errors of inverse depths over their standard deviations."""
    z = true_depth(frame, result.pixel)
    return np.abs(1 / result.depth - 1 / z) * result.depth**2 / np.sqrt(result.variance)


def run(source, frames, poses=None, images=None):
    poses = [f.T_world_cam for f in frames] if poses is None else poses
    images = [f.image for f in frames] if images is None else images
    return [source.update(i, T, f.intrinsics) for i, T, f in zip(images, poses, frames, strict=True)]
