"""Small frames with anchors for tests of the posterior."""

from __future__ import annotations

import numpy as np
import oracle_field
import torch

from ufmstar_torch import PosteriorConfig
from ufmstar_torch.anchors import Anchors
from ufmstar_torch.anchors.check import check_anchors
from ufmstar_torch.frames.frame import check_frame
from ufmstar_torch.posterior.running import RATIOS, SIZE, priors, views, write_ratios
from ufmstar_torch.posterior.update import update

MODEL = PosteriorConfig()
K = torch.tensor([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]])


def scene(seed, size=(36, 48), n=60):
    """Depth [H, W] with a step and a hole, the true factor g/d at every pixel, V, and anchors."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: size[0], : size[1]] / np.array(size)[:, None, None]
    depth = np.where((u > 0.4) & (v < 0.7), 1.2, 3.0) + 0.3 * v
    factor = np.exp(0.3 + 0.2 * u - 0.1 * np.cos(5 * v) + np.where(depth < 2, 0.2, 0))
    depth[3:6, 5:7] = 0
    rows, cols = np.nonzero(depth)
    chosen = rng.permutation(len(rows))[:n]
    rows, cols = rows[chosen], cols[chosen]
    g = depth[rows, cols] * factor[rows, cols] * np.exp(0.02 * rng.standard_normal(n))
    g[: n // 20] *= 2.5  # outliers
    pixel = np.stack([cols, rows], -1) + rng.uniform(-0.4, 0.4, (n, 2))
    return depth, factor, np.full(size, 0.04), pixel, g, (rng.uniform(0.01, 0.3, n) * g) ** 2


LEVEL = np.eye(4)


def checked(depth, pixel, g, variance, pose=LEVEL):
    frame = check_frame(torch.from_numpy(depth)[None], torch.from_numpy(pose)[None], K[None], None, None, None,
                        rotation_tolerance=0.01)  # fmt: skip
    anchors = Anchors(*(torch.from_numpy(x)[None] for x in (pixel, g, variance)))
    return frame, check_anchors(anchors, frame)


def turned(degrees):
    """Pose of a camera that has turned to the right."""
    c, s, pose = np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), np.eye(4)
    pose[[0, 0, 2, 2], [0, 2, 0, 2]] = c, s, -s, c
    return pose


def moved_by(x):
    """Pose of a camera that has moved to the right [m]."""
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def ratios(packed):
    """Those of a memory [SIZE], by name."""
    values = np.empty(RATIOS)
    write_ratios(views(packed.numpy()), priors(MODEL), values)
    return dict(zip(oracle_field.START, values.tolist(), strict=True))


def updated(depth, anchors, claimed=None, packed=None, config=MODEL):
    """State and posterior after a frame of one stream."""
    packed = torch.zeros(1, SIZE, dtype=torch.float64) if packed is None else packed
    claimed = np.zeros_like(depth) if claimed is None else claimed
    return update(packed, *checked(depth, *anchors), torch.from_numpy(claimed)[None], config)


def relative(out, name="variance"):
    return (getattr(out, name) / out.depth.square())[0]
