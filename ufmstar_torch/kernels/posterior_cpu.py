"""The posterior on the CPU: the reference's update, one stream after the other, float64, without torch.

What takes time is compiled (``field_cpu``, ``cells_cpu``); what is left are a few operations on the anchors.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.given import AnchorInput
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.kernels.cells_cpu import cell_means, features, ranges, read
from ufmstar_torch.kernels.field_cpu import Field, Floats, Observed, Prior, at, distance, given
from ufmstar_torch.kernels.threads_cpu import each
from ufmstar_torch.posterior.model import FEATURES, GLOBALS, MODEL
from ufmstar_torch.posterior.running import RATIOS
from ufmstar_torch.posterior.update import Posterior

_VALUE, _WEIGHT, _LEAST, _LARGEST = np.array(list(RATIOS.values())).T
_NAMES = {name: i for i, name in enumerate(RATIOS)}


def update(
    packed: Tensor, frame: FrameInput, anchors: AnchorInput | None, claimed: Tensor
) -> tuple[Tensor, Posterior]:  # fmt: skip
    """As :func:`ufmstar_torch.posterior.update.update`, for CPU tensors."""
    maps = [x.detach().contiguous().numpy() for x in (packed.double(), frame.depth, frame.valid, claimed)]
    streams = zip(*maps, _anchors(anchors, len(packed)), strict=True)
    results = each(_of_stream, list(streams))
    kept, depth, variance = (np.stack([result[i] for result in results]) for i in range(3))
    sums = [_Running.of(row) for row in kept]
    calibration = [r.ratios["calibration"] if r.below[_NAMES["calibration"]] > 0 else np.nan for r in sums]
    unseen = [r.growth for r in sums]
    outputs = [torch.from_numpy(x) for x in (depth, variance, np.array(calibration), np.array(unseen))]
    return torch.from_numpy(kept).to(packed.dtype), Posterior(*outputs)


class _Anchors(NamedTuple):
    """The valid ones of one stream."""

    pixel: Floats
    at_pixel: NDArray[np.int64]
    predicted: Floats
    depth: Floats
    variance: Floats


_NONE = _Anchors(np.empty((0, 2)), np.empty(0, np.int64), *(np.empty(0) for _ in range(3)))


def _anchors(anchors: AnchorInput | None, streams: int) -> list[_Anchors | None]:
    if anchors is None:
        return [None] * streams
    fields = (anchors.pixel, anchors.index, anchors.predicted, anchors.depth, anchors.variance)
    used = anchors.valid.numpy()
    return [_Anchors(*(x[b].numpy()[used[b]] for x in fields)) for b in range(streams)]


class _Running(NamedTuple):
    """One stream's :class:`ufmstar_torch.posterior.running.Running`."""

    frames: float
    mean: float
    above: Floats
    below: Floats
    coefficients: Floats
    covariance: Floats
    ratios: dict[str, float]

    @classmethod
    def of(cls, packed: Floats) -> _Running:
        n = len(RATIOS)
        above, below = packed[2 : 2 + n], packed[2 + n : 2 + 2 * n]
        b, covariance = packed[2 + 2 * n :][:GLOBALS], packed[2 + 2 * n + GLOBALS :].reshape(GLOBALS, GLOBALS)
        if packed[0] == 0:
            above, below, covariance = _VALUE * _WEIGHT, _WEIGHT, np.diag(MODEL.prior) ** 2
        ratios = np.where(below > 0, above / np.maximum(below, 1e-12), _VALUE).clip(_LEAST, _LARGEST)
        return cls(packed[0], packed[1], above, below, b, covariance, dict(zip(RATIOS, ratios.tolist(), strict=True)))

    @property
    def growth(self) -> float:
        return MODEL.growth + self.ratios["unseen"]

    def added(self, sums: dict[str, tuple[float, float]]) -> tuple[Floats, Floats]:
        above, below = np.array([sums[name] for name in RATIOS]).T
        n = MODEL.memory * self.below + (1 - MODEL.memory) * _WEIGHT + below
        total = MODEL.memory * self.above + (1 - MODEL.memory) * _WEIGHT * _VALUE + above
        return np.minimum(np.maximum(total, _LEAST * n), _LARGEST * n), n

    def expected(self, mean: float) -> tuple[Floats, Floats]:
        T = np.eye(GLOBALS)
        T[0, 1] = mean - self.mean if self.frames else 0.0
        walked, prior = T @ self.covariance @ T.T, np.square(MODEL.prior)
        if self.frames:
            walked = walked + np.diag(np.square(MODEL.drift) * (1 - walked.diagonal() / prior).clip(0, 1))
        return T @ self.coefficients, walked


class _Grid(NamedTuple):
    """One stream's :class:`ufmstar_torch.posterior.grid.Grid`."""

    rows: int
    cols: int
    log_depth: Floats
    mean: float
    right: Floats
    down: Floats
    far_right: Floats
    far_down: Floats

    @classmethod
    def of(cls, log_depth: Floats, rows: int, cols: int) -> _Grid:
        across, along = np.full((2, rows, cols), np.inf)
        across[:, :-1] = np.abs(np.diff(log_depth.reshape(rows, cols), axis=1))
        along[:-1] = np.abs(np.diff(log_depth.reshape(rows, cols), axis=0))
        edges = across.ravel(), along.ravel()
        right, down = (MODEL.flat + MODEL.edge * x**2 for x in edges)
        climbs = (MODEL.climb * np.maximum(x - MODEL.smooth, 0) for x in edges)
        far = (1 / n + climb for n, climb in zip((cols, rows), climbs, strict=True))
        return cls(rows, cols, log_depth, float(log_depth.mean()), right, down, *far)


class _Scene(NamedTuple):
    """The reference's ``_Scene`` of one stream, without padding."""

    grid: _Grid
    prior: Prior
    observed: Observed
    stated: Floats
    other: Floats

    def counted(self, values: Floats) -> Floats:
        node = self.observed.node
        summed: Floats = np.bincount(node, values, len(self.grid.log_depth)).astype(np.float64)
        return summed[node]

    def believed(self, near: _Near) -> Floats:
        return 1 / (1 + near.noise / MODEL.weak**2)


class _Near(NamedTuple):
    """The reference's ``_Near`` of one stream."""

    noise: Floats
    left_out: Floats
    total: Floats


def _of_stream(
    packed: Floats, depth: NDArray[Any], valid: NDArray[np.bool_], claimed: NDArray[Any], given_: _Anchors | None
) -> tuple[Floats, NDArray[Any], NDArray[Any]]:
    """What is known after the frame; depth and variance."""
    running, anchors = _Running.of(packed), _NONE if given_ is None else given_
    some = len(anchors.depth) > 0
    if given_ is None and not running.frames:
        return packed, np.where(valid, depth, np.nan).astype(depth.dtype), claimed
    with np.errstate(all="ignore"):  # what is not valid is not read
        logs = np.log(depth)
    rows, cols = (min(MODEL.side, n) for n in depth.shape)
    grid = _Grid.of(cell_means(logs, valid, rows, cols), rows, cols)
    scene = _scene(grid, depth, valid, anchors, running)
    field, weight, near = _fitted(scene)
    away = _away(scene, weight * MODEL.evidence**2 >= 1)
    kept = _learnt(scene, field, weight, near, _relative(claimed, anchors), running) if some else packed
    node = np.arange(rows * cols)
    x = features(grid.log_depth - grid.mean, (node % cols + 0.5) / cols, (node // cols + 0.5) / rows, MODEL.hats)
    mean, variance = at(field, node, x)
    b = field.coefficients[:GLOBALS]
    variance = MODEL.inflation * _local(scene, near) * (variance + running.ratios["roughness"])
    share, offset = np.minimum(away / MODEL.far, 1), mean - (x[:, :GLOBALS] * b).sum(1)
    variance = variance + MODEL.common + away * running.growth
    variance = variance + _tail(share, offset, _spread(scene, near, np.ones(len(near.noise), np.bool_), b[0]))
    nodes = np.stack([grid.log_depth, offset, variance, share], 1)
    return kept, *read(depth, valid, logs, claimed, nodes, b, grid.mean, (rows, cols), MODEL)


def _scene(
    grid: _Grid, depth: NDArray[Any], valid: NDArray[np.bool_], anchors: _Anchors, running: _Running
) -> _Scene:  # fmt: skip
    (u, v), log_depth = ((anchors.pixel + 0.5) / depth.shape[::-1]).T.copy(), np.log(anchors.predicted)
    column, row = ((x * n).astype(np.int64).clip(0, n - 1) for x, n in ((u, grid.cols), (v, grid.rows)))
    x = features(log_depth - grid.mean, u, v, MODEL.hats)
    observed = Observed(row * grid.cols + column, x, np.log(anchors.depth) - log_depth)
    stated = running.ratios["noise"] * anchors.variance / anchors.depth**2
    other = running.ratios["roughness"] + (ranges(depth, valid, anchors.at_pixel) / 2) ** 2
    return _Scene(grid, _prior(grid, running), observed, stated, other)


def _prior(grid: _Grid, running: _Running) -> Prior:
    amplitude = running.ratios["amplitude"]
    mean, (coefficients, covariance) = np.zeros(FEATURES), running.expected(grid.mean)
    mean[:GLOBALS] = coefficients
    P = np.diag(np.full(FEATURES, 1 / (MODEL.hat * amplitude)))
    P[:GLOBALS, :GLOBALS] = np.linalg.inv(covariance)
    diagonal = np.full(len(grid.log_depth), MODEL.kappa / amplitude)
    right, down = 1 / (grid.right * amplitude), 1 / (grid.down * amplitude)
    return Prior(diagonal, right, down, mean, P, grid.cols)


def _fitted(scene: _Scene) -> tuple[Field, Floats, _Near]:
    weight = 1 / (scene.stated + scene.other)
    for round_ in range(MODEL.rounds + 1):
        field = given(scene.prior, scene.observed, weight)
        mean, variance = at(field, scene.observed.node, scene.observed.features)
        left = np.maximum(1 - weight * variance, MODEL.least_left)
        residual, variance = (scene.observed.value - mean) / left, variance / left
        noise = scene.other + scene.stated / _pull(-residual)
        near = _Near(noise, residual, variance + noise)
        if round_ < MODEL.rounds:
            weight = (MODEL.student + 1) / (MODEL.student + residual**2 / near.total) / noise
    return field, weight, near


def _pull(t: Floats) -> Floats:
    t = t.clip(MODEL.nearer, MODEL.farther)
    small = np.abs(t) < 1e-3
    safe = np.where(small, 1.0, t)
    return np.where(small, 1 - 1.5 * t, -np.expm1(-safe) * np.exp(-safe) / safe)


def _local(scene: _Scene, near: _Near) -> Floats:
    each = scene.believed(near) / scene.counted(np.ones(len(near.noise)))
    z2 = np.minimum(near.left_out**2 / near.total, MODEL.clip)
    grid, reach = scene.grid, MODEL.near
    padded = np.zeros((2, grid.rows + 2 * reach, grid.cols + 2 * reach))
    for sums, values in zip(padded, (each * z2, each), strict=True):
        nodes = np.bincount(scene.observed.node, values, grid.rows * grid.cols)
        sums[reach:-reach, reach:-reach] = nodes.reshape(grid.rows, grid.cols)
    columns = np.sum([padded[:, i : i + grid.rows] for i in range(2 * reach + 1)], 0)
    around = np.sum([columns[:, :, i : i + grid.cols] for i in range(2 * reach + 1)], 0)
    z2, weight = around.reshape(2, -1) + MODEL.alone
    return z2 / weight


def _spread(scene: _Scene, near: _Near, used: NDArray[np.bool_], mean: float) -> Floats:
    each = np.where(used, scene.believed(near) / scene.counted(np.ones(len(near.noise))), 0.0)
    grid, y = scene.grid, scene.observed.value
    sums = [np.bincount(scene.observed.node, x, grid.rows * grid.cols) for x in (each, each * y, each * y**2)]
    nodes = np.stack(sums).reshape(3, grid.rows, grid.cols)
    weight, first, second = (_window(grid.rows, MODEL.window) @ nodes @ _window(grid.cols, MODEL.window)).reshape(3, -1)
    total = weight + MODEL.few
    middle = (first + MODEL.few * mean) / total
    moment = (second + MODEL.few * (mean**2 + MODEL.prior[0] ** 2)) / total
    spread: Floats = np.maximum(moment - middle**2, 0)
    return spread


@functools.lru_cache(maxsize=4)  # the sizes of the grid hardly change
def _window(count: int, width: float) -> Floats:
    at_ = np.arange(count) / count
    return np.exp(-(((at_[:, None] - at_) / width) ** 2) / 2)


def _tail(share: Floats, offset: Floats, spread: Floats) -> Floats:
    a, q = MODEL.least_spread + MODEL.spread * spread, np.exp(np.minimum(-offset, MODEL.most))
    return (MODEL.wrong + MODEL.other * share) * (q * q * np.exp(2 * a) - 2 * q * np.exp(a / 2) + 1)


def _away(scene: _Scene, evidence: NDArray[np.bool_]) -> Floats:
    grid = scene.grid
    source = np.zeros(len(grid.log_depth), np.bool_)
    source[scene.observed.node[evidence]] = True
    return distance(source, grid.far_right, grid.far_down, grid.cols, MODEL.limit)


def _relative(claimed: NDArray[Any], anchors: _Anchors) -> Floats:
    V = claimed.ravel()[anchors.at_pixel].astype(np.float64)
    return MODEL.claimed * np.where(np.isnan(V), 0.0, V) / anchors.predicted**2


def _learnt(
    scene: _Scene, field: Field, weight: Floats, near: _Near, claimed: Floats, running: _Running
) -> Floats:  # fmt: skip
    """Packed."""
    above, below = running.added(
        _of_neighbours(scene, near, running) | _of_discs(scene, weight, near, claimed, running)
    )
    b, covariance = field.coefficients[:GLOBALS], field.covariance[:GLOBALS, :GLOBALS]
    return np.concatenate([[running.frames + 1, scene.grid.mean], above, below, b, covariance.ravel()])


def _of_neighbours(scene: _Scene, near: _Near, running: _Running) -> dict[str, tuple[float, float]]:
    square = np.minimum(near.left_out**2, MODEL.clip * near.total) / MODEL.clipped
    excess, once = square - near.total, 1 / scene.counted(np.ones(len(square)))
    roughness = np.full(len(square), running.ratios["roughness"])
    sums = {}
    for name, part in (("roughness", roughness), ("noise", scene.stated)):
        w = once * (part / near.total) ** 2
        unit = running.ratios[name] / np.maximum(part, 1e-12)
        sums[name] = float((w * (part + excess) * unit).sum()), float(w.sum())
    return sums


def _of_discs(
    scene: _Scene, weight: Floats, near: _Near, claimed: Floats, running: _Running
) -> dict[str, tuple[float, float]]:
    held = _discs(scene, running.frames)
    rest = ~held
    held = held & (np.count_nonzero(rest) >= MODEL.left)
    field = given(scene.prior, scene.observed, weight * rest)
    mean, variance = at(field, scene.observed.node[held], scene.observed.features[held])
    away, noise = _away(scene, rest)[scene.observed.node[held]], near.noise[held]
    tot, error = variance + noise, (scene.observed.value[held] - mean) ** 2
    square = np.minimum(error, MODEL.clip * tot) / MODEL.clipped
    believed = np.where(held, scene.believed(near), 0.0)
    area, claimed = (believed / np.maximum(scene.counted(believed), 1e-12))[held], claimed[held]
    final = MODEL.inflation * variance + noise + MODEL.common + away * running.growth
    share, b = np.minimum(away / MODEL.far, 1), field.coefficients[:GLOBALS]
    offset = mean - (scene.observed.features[held, :GLOBALS] * b).sum(1)
    spread = _spread(scene, near, rest, b[0])[scene.observed.node[held]]
    final = final + share * claimed + _tail(share, offset, spread)
    sums = {
        "amplitude": (area * (square - noise) / tot, area * variance / tot / running.ratios["amplitude"]),
        "unseen": (area * (np.minimum(error, MODEL.square) - tot), area * away),
        "calibration": (area * error / final, area),
    }
    return {name: (float(above.sum()), float(below.sum())) for name, (above, below) in sums.items()}


def _discs(scene: _Scene, frames: float) -> NDArray[np.bool_]:
    at_ = (scene.observed.features[:, 2:4] + 1) / 2
    inside = np.zeros(len(at_), np.bool_)
    for disc in range(MODEL.discs):
        number = frames * MODEL.discs + disc + 1
        centre = np.array([(number * step) % 1 for step in (MODEL.step_u, MODEL.step_v)])
        inside |= ((at_ - centre) ** 2).sum(1) < MODEL.radius**2
    return inside
