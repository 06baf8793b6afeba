"""The posterior on the CPU: the reference's update for one stream after the other, float64, in NumPy.

The expensive parts are compiled (``field_cpu``, ``cells_cpu``).
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.anchors import AnchorInput
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.kernels.cells_cpu import cell_means, features, read
from ufmstar_torch.kernels.field_cpu import Floats, at
from ufmstar_torch.kernels.posterior_learn_cpu import learnt
from ufmstar_torch.kernels.posterior_scene_cpu import (
    AnchorRows,
    Grid,
    Running,
    away_from,
    elsewhere_variance,
    fitted,
    inlier_factor,
    local_scale,
    scene_of,
    second_moments,
    spread_around,
    steepness,
    wrong_factor,
)
from ufmstar_torch.kernels.threads_cpu import each
from ufmstar_torch.posterior.config import PosteriorConfig
from ufmstar_torch.posterior.grid import SIDE
from ufmstar_torch.posterior.scene import MOST_WRONG
from ufmstar_torch.posterior.update import Posterior

_NONE = AnchorRows(np.empty((0, 2)), np.empty(0, np.int64), *(np.empty(0) for _ in range(3)))


def update(
    packed: Tensor, frame: FrameInput, anchors: AnchorInput | None, claimed: Tensor, config: PosteriorConfig
) -> tuple[Tensor, Posterior]:
    """As :func:`ufmstar_torch.posterior.update.update`, for CPU tensors."""
    maps = [x.detach().contiguous().numpy() for x in (packed.double(), frame.depth, frame.valid, claimed)]
    streams = zip(*maps, _anchors(anchors, len(packed)), strict=True)
    results = each(functools.partial(_of_stream, config), list(streams))
    memory, depth, variance, outlier, inlier = (np.stack([result[i] for result in results]) for i in range(5))
    memories = [result[5] for result in results]
    calibration = [one.ratios["calibration"] if one.below[-1] > 0 else np.nan for one in memories]
    unseen = [one.ratios["unseen"] for one in memories]
    outputs = [torch.from_numpy(x) for x in (depth, variance, np.array(calibration), np.array(unseen), outlier, inlier)]
    return torch.from_numpy(memory).to(packed.dtype), Posterior(*outputs)


def _anchors(anchors: AnchorInput | None, streams: int) -> list[AnchorRows | None]:
    if anchors is None:
        return [None] * streams
    fields = (anchors.pixel, anchors.index, anchors.predicted, anchors.depth, anchors.variance)
    used = anchors.valid.numpy()
    return [AnchorRows(*(x[b].numpy()[used[b]] for x in fields)) for b in range(streams)]


def _of_stream(
    config: PosteriorConfig, packed: Floats, depth: NDArray[Any], valid: NDArray[np.bool_], claimed: NDArray[Any],
    anchor_rows: AnchorRows | None,
) -> tuple[Floats, NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], Running]:  # fmt: skip
    """The memory after the frame; depth, variance, probability of another surface and inlier variance; and the unpacked
    memory."""
    running, anchors = Running.of(packed, config), _NONE if anchor_rows is None else anchor_rows
    has_valid = len(anchors.depth) > 0
    if anchor_rows is None and not running.frames:
        predicted = np.where(valid, depth, np.nan).astype(depth.dtype)
        return packed, predicted, claimed, np.full_like(depth, np.nan), claimed, running
    with np.errstate(all="ignore"):  # invalid pixels are not read
        logs = np.log(depth)
    rows, cols = (min(SIDE, n) for n in depth.shape)
    grid = Grid.of(cell_means(logs, valid, rows, cols), rows, cols, config)
    scene = scene_of(grid, depth, valid, anchors, running)
    field, left_out, weight = fitted(scene)
    away = away_from(scene, weight * config.weak_sigma**2 >= 1)
    if has_valid:
        memory = learnt(scene, field, weight, left_out, running)
    else:
        memory = running.drifted(grid.mean) if running.frames and valid.any() else packed
    node = np.arange(rows * cols)
    x = features(grid.log_depth - grid.mean, (node % cols + 0.5) / cols, (node // cols + 0.5) / rows)
    mean, variance = at(field, node, x)
    b, updated = field.coefficients, Running.of(memory, config)
    offset, all_anchors = mean - (x * b).sum(1), np.ones(len(scene.noise), np.bool_)
    unseen = away * updated.ratios["unseen"]
    variance = inlier_factor(updated, away) * (variance + updated.ratios["roughness"] + unseen)
    wide = elsewhere_variance(config, spread_around(scene, all_anchors, b[0]), unseen)
    scale = local_scale(scene, left_out, all_anchors)
    p = np.minimum(updated.ratios["wrong"] * wrong_factor(config, away, scale), MOST_WRONG)
    variance, inlier = second_moments(config, scale * (variance + steepness(grid, field.offset)), p, offset, wide)
    nodes = np.stack([grid.log_depth, offset, variance, inlier, p, away / config.reach], 1)
    depth, spread, inlier, p = read(depth, valid, logs, claimed, nodes, b, grid.mean, (rows, cols), config)
    return memory, depth, spread, p, inlier, updated
