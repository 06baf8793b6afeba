"""A frame's anchors on the CPU (numba): the inlier test, and the update of the evidence.

Neighbours, and the components near an anchor, are searched in a grid over the image: time and memory grow with the
number of anchors. Shares are summed cell by cell, and within a cell in the order of the anchors, so that padding and
other streams change no bit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.anchors.check import FARTHEST_OFF, FEW, Checked
from ufmstar_torch.anchors.evidence import CLAIM, COUNTS, LEAST_SIGMA, Evidence
from ufmstar_torch.anchors.kernels.neighbours import grid, supported
from ufmstar_torch.anchors.learn import Learnt
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.kernels.compile_cpu import empty, kernel, leaf, part
from ufmstar_torch.kernels.cpu.calls import array, each
from ufmstar_torch.kernels.cpu.regress import Seen, View
from ufmstar_torch.kernels.cpu.regress_cull import FIELDS, cull, limit
from ufmstar_torch.kernels.cpu.regress_vectors import TERMS, add_shares
from ufmstar_torch.kernels.cpu.rigid import padded
from ufmstar_torch.kernels.cpu.sample import folded

_PER_CELL = 16  # mean number of anchors in a cell of the search for components
_NEGLIGIBLE = 1e-30  # smaller means become 0, before single precision loses them


def check_anchor_values(
    pixel: Tensor, depth: Tensor, variance: Tensor, mask: Tensor | None, frame: FrameInput
) -> Checked:  # fmt: skip
    """As :func:`ufmstar_torch.anchors.check.check_anchor_values`, for CPU tensors; the same values."""
    streams, n = depth.shape
    values = [array(x) for x in (pixel, depth, variance)]
    used = np.ones((streams, n), np.bool_) if mask is None else array(mask)
    position, valid, index = (
        np.zeros((streams, n, 2)), np.zeros((streams, n), np.bool_), np.zeros((streams, n), np.int64),
    )  # fmt: skip
    (predicted, out_depth), out_variance = np.ones((2, streams, n)), np.zeros((streams, n))
    rejected, contradiction = np.zeros(streams, np.int64), np.zeros(streams)
    outputs = position, index, predicted, out_depth, out_variance, valid, rejected, contradiction
    inputs = zip(*values, used, array(frame.depth), array(frame.valid), strict=True)
    each(_check, [(*one, *(x[b : b + 1] if x.ndim == 1 else x[b] for x in outputs)) for b, one in enumerate(inputs)])
    a, b, c, d, e, f, g, h = map(torch.from_numpy, outputs)
    return a, b, c, d, e, f, g, h


@kernel
def _check(
    pixel, depth, variance, mask, depth_map, valid_map, position, index, predicted, out_depth, out_variance, valid,
    rejected, contradiction,
):  # fmt: skip
    """One stream of N anchors; writes where they are usable."""
    height, width = depth_map.shape
    fine, square = 0, 0.0
    for i in range(depth.size):
        u, v, d, s2 = np.rint(pixel[i, 0]), np.rint(pixel[i, 1]), depth[i], variance[i]
        if not (mask[i] and 0 < d < np.inf and s2 >= 0 and math.sqrt(s2) < d):
            continue
        if not (u >= 0 and u < width and v >= 0 and v < height):
            continue
        position[i, 0], position[i, 1] = pixel[i, 0], pixel[i, 1]
        index[i] = np.int64(v) * width + np.int64(u)
        z = np.float64(depth_map[np.int64(v), np.int64(u)])
        if not valid_map[np.int64(v), np.int64(u)]:
            continue
        if d <= FARTHEST_OFF * z and z <= FARTHEST_OFF * d:
            predicted[i], out_depth[i], out_variance[i], valid[i] = z, d, s2, True
            fine += 1
        else:
            r = min(d / z - 1, FARTHEST_OFF)
            square += r * r
            rejected[0] += 1
    if rejected[0] > FEW and rejected[0] > fine:
        contradiction[0] = square / rejected[0]


def inliers(anchors: Anchors) -> Tensor:
    """As :func:`ufmstar_torch.anchors.evidence.inliers`, for CPU tensors; the same result."""
    out = np.empty(anchors.mask.shape, np.bool_)
    fields = (anchors.pixel, anchors.predicted, anchors.depth, anchors.variance, anchors.mask)
    each(_inliers, list(zip(*map(array, fields), out, strict=True)))
    return torch.from_numpy(out)


@kernel
def _inliers(pixel, predicted, depth, variance, valid, out):
    """Write ``out`` [N] for the N anchors of one stream."""
    supported(pixel, predicted, depth, variance, valid, out)


def learn_in_view(
    tensors: Mapping[str, Tensor], capacity: int, seen: Sequence[Seen], views: Sequence[View], frame: FrameInput,
    config: UfMStarConfig,
) -> Learnt:  # fmt: skip
    """As :func:`ufmstar_torch.anchors.learn.learn` with the exact sum over the components in view
    (``kernels.cpu.regress.views_of``); the error of the shares is at most twice the regression's.

    Args:
        tensors: of the state, with the evidence of the mixture's first slots; later slots have none.
        capacity: slots of the mixture; the first ones hold each stream's ``seen`` components.
        seen, views: the first two of the last three features receive what was learnt of the components.
        frame, config: as there.
    """
    b, anchors = len(views), frame.anchors
    before, overall_before = array(tensors["evidence"]), array(tensors["overall_evidence"])
    component, overall = np.empty((b, capacity, 3), before.dtype), np.empty((b, 3), before.dtype)
    beyond, stream, used = np.empty((b, capacity, 2)), np.empty((b, 2)), np.zeros((b, 1), np.int64)
    if anchors is None:
        fields = [np.empty((b, 0), np.int64), np.empty((b, 0, 2)), *np.empty((4, b, 0)), np.empty((b, 0), np.bool_)]
    else:
        columns = (anchors.pixel, anchors.predicted, anchors.depth, anchors.variance, anchors.network_variance)
        fields = [array(anchors.index), *map(array, columns), array(anchors.mask)]
    features = [one.features for one in seen]
    assert config.anchors is not None
    settings = frame.size[1], 0.5 ** (1 / config.anchors.half_life), config.anchors.shrinkage
    arrays = zip(views, features, *fields, array(frame.intrinsics), before, overall_before, strict=True)
    out = zip(component, overall, used, beyond, stream, strict=True)
    each(_learn, [(*arguments, *settings, *outputs) for arguments, outputs in zip(arrays, out, strict=True)])
    learnt = Evidence(torch.from_numpy(component), torch.from_numpy(overall))
    return Learnt(learnt, torch.from_numpy(used[:, 0]), torch.from_numpy(beyond), torch.from_numpy(stream))


@kernel
def _learn(
    view, features, index, pixel, predicted, depth, variance, network_variance, valid, K, before, overall_before,
    width, memory, shrinkage, component, overall, used, beyond, stream,
):  # fmt: skip
    """One stream of N anchors and K components; only the components of ``view`` can explain a point."""
    chosen = empty(valid.size, np.bool_)
    rows, column = empty((valid.size, 3), np.float64), empty(valid.size, np.float64)
    sums = empty((component.shape[0], 3), np.float64)
    for k in range(component.shape[0]):
        sums[k, 0] = sums[k, 1] = sums[k, 2] = 0.0
    supported(pixel, predicted, depth, variance, valid, chosen)
    used[0] = _rows(predicted, depth, variance, network_variance, chosen, rows)
    if valid.size > 0:
        _distribute(index, predicted, chosen, rows, K, width, view, sums)
    fade = memory if used[0] > 0 else 1.0
    for c in range(3):  # rounded to the state's dtype
        for i in range(valid.size):
            column[i] = rows[i, c]
        overall[c] = fade * overall_before[c] + folded(column)
    for c in range(2):
        stream[c] = np.float64(overall[c + 1]) / (np.float64(overall[0]) + shrinkage)
    for k in range(component.shape[0]):
        for c in range(3):
            old = np.float64(before[k, c]) if k < before.shape[0] else 0.0
            component[k, c] = fade * old + sums[k, c]
        n = np.float64(component[k, 0])
        for c in range(2):
            value = (np.float64(component[k, c + 1]) - n * stream[c]) / (n + shrinkage)
            beyond[k, c] = value if abs(value) > _NEGLIGIBLE else 0.0
    last = features.shape[1] - 1
    for k in range(features.shape[0]):
        features[k, last - 2], features[k, last - 1] = beyond[k, 0], beyond[k, 1]
    for i in range(view.slot.size):
        k = view.slot[i]
        view.terms[i, TERMS - 1], view.terms[i, TERMS - 2] = beyond[k, 0], beyond[k, 1]


@part
def _rows(predicted, depth, variance, network_variance, supported, rows):
    """Write w (1, r, e) [N, 3] of the anchors, 0 where not supported; return how many are used."""
    n = supported.size
    squares, terms, used, others = empty(n, np.float64), empty(n, np.float64), 0, -1
    for i in range(n):
        squares[i] = terms[i] = 0.0
        if supported[i]:
            others += 1
            r = depth[i] / predicted[i] - 1
            squares[i] = terms[i] = r * r
    total = folded(terms)
    others = max(others, 0)
    for i in range(n):
        rows[i, 0] = rows[i, 1] = rows[i, 2] = 0.0
        if not supported[i]:
            continue
        r = depth[i] / predicted[i] - 1
        claim = (variance[i] + network_variance[i]) / (predicted[i] * predicted[i])
        limit = 1.0
        if others > 0:
            limit = min(others, CLAIM) * max((total - squares[i]) / others, LEAST_SIGMA**2)
        w = min(limit / max(claim, 2.2250738585072014e-308), 1.0)
        w = w * w
        rows[i, 0], rows[i, 1], rows[i, 2] = w, w * r, w * (r * r - claim)
        used += w >= COUNTS
    return used


@part
def _distribute(index, predicted, chosen, rows, K, width, view, sums):
    """Add the rows [N, 3] of the chosen anchors to the components [K, 3] in proportion to their densities there.

    Components are culled for a cell of anchors as the regression culls them for a tile.
    """
    visible, fields, packed, _, among, settings = view
    points, pixel = empty((chosen.size, 3), np.float64), empty((chosen.size, 2), np.float64)
    for i in range(chosen.size):
        u, v, z = np.float64(index[i] % width), np.float64(index[i] // width), predicted[i]
        pixel[i, 0], pixel[i, 1] = u, v
        points[i, 0], points[i, 1], points[i, 2] = (u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z
    start, order = grid(pixel, chosen, _PER_CELL)[4:]
    capacity = packed.shape[1]
    retained, work = empty(visible.size, np.int64), empty(9 + capacity, packed.dtype)
    near, added = empty((FIELDS, capacity), np.float64), empty((3, capacity), np.float64)
    density = empty(capacity, np.float64)
    point, row = empty(3, np.float64), empty(4, np.float64)
    row[3] = settings.prior_weight
    for cell in range(start.size - 1):
        if start[cell] == start[cell + 1]:
            continue
        box = _box(points, order, start[cell], start[cell + 1])
        count = cull(packed, visible.size, limit(settings.epsilon, among), box, settings, work, retained)
        n = padded(count)
        for i in range(count):
            for field in range(FIELDS):
                near[field, i] = fields[retained[i], field]
        for i in range(count, n):  # components of density 0
            for field in range(FIELDS - 1):
                near[field, i] = 0.0
            near[FIELDS - 1, i] = -np.inf
        for axis in range(3):
            for i in range(n):
                added[axis, i] = 0.0
        for position in range(start[cell], start[cell + 1]):
            p = order[position]
            for axis in range(3):
                point[axis], row[axis] = points[p, axis], rows[p, axis]
            add_shares(near, capacity, n, point, row, density, added)
        for i in range(count):
            for axis in range(3):
                sums[visible[retained[i]], axis] += added[axis, i]


@leaf
def _box(points, order, first, last):
    """The least and the greatest corner of the points ``order[first:last]``."""
    a = b = c = np.inf
    d = e = f = -np.inf
    for position in range(first, last):
        x, y, z = points[order[position], 0], points[order[position], 1], points[order[position], 2]
        a, b, c, d, e, f = min(a, x), min(b, y), min(c, z), max(d, x), max(e, y), max(f, z)
    return a, b, c, d, e, f
