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

from ufmstar_torch.anchors.anchors import AnchorInput
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.kernels.cells_cpu import cell_means, features, ranges, read
from ufmstar_torch.kernels.field_cpu import Field, Floats, Observed, Prior, at, distance, given
from ufmstar_torch.kernels.threads_cpu import each
from ufmstar_torch.posterior.config import PosteriorConfig
from ufmstar_torch.posterior.grid import SIDE
from ufmstar_torch.posterior.read import LARGEST
from ufmstar_torch.posterior.running import FEATURES, RATIOS, ratios
from ufmstar_torch.posterior.update import LEAST_LEFT, LEAST_REST, STEPS, Posterior


def update(
    packed: Tensor, frame: FrameInput, anchors: AnchorInput | None, claimed: Tensor, config: PosteriorConfig
) -> tuple[Tensor, Posterior]:
    """As :func:`ufmstar_torch.posterior.update.update`, for CPU tensors."""
    maps = [x.detach().contiguous().numpy() for x in (packed.double(), frame.depth, frame.valid, claimed)]
    streams = zip(*maps, _anchors(anchors, len(packed)), strict=True)
    results = each(functools.partial(_of_stream, config), list(streams))
    kept, depth, variance, outlier = (np.stack([result[i] for result in results]) for i in range(4))
    sums = [_Running.of(row, config) for row in kept]
    calibration = [r.ratios["calibration"] if r.below[-1] > 0 else np.nan for r in sums]
    unseen = [r.ratios["unseen"] for r in sums]
    outputs = [torch.from_numpy(x) for x in (depth, variance, np.array(calibration), np.array(unseen), outlier)]
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

    config: PosteriorConfig
    frames: float
    mean: float
    above: Floats
    below: Floats
    coefficients: Floats
    covariance: Floats
    ratios: dict[str, float]

    @classmethod
    def of(cls, packed: Floats, config: PosteriorConfig) -> _Running:
        above, below, b, covariance = np.split(packed[2:], np.cumsum([RATIOS, RATIOS, FEATURES]))
        covariance, priors = covariance.reshape(FEATURES, FEATURES), ratios(config)
        value, weight, least, largest = np.array(list(priors.values())).T
        if packed[0] == 0:
            above, below, covariance = value * weight, weight, np.diag(config.prior_variance)
        known = np.where(below > 0, above / np.maximum(below, 1e-12), value).clip(least, largest)
        by_name = dict(zip(priors, known.tolist(), strict=True))
        return cls(config, packed[0], packed[1], above, below, b, covariance, by_name)

    def added(self, sums: dict[str, tuple[float, float]]) -> tuple[Floats, Floats]:
        value, weight, least, largest = np.array(list(ratios(self.config).values())).T
        memory, (above, below) = 0.5 ** (1 / self.config.half_life), np.array([sums[name] for name in self.ratios]).T
        n = memory * self.below + (1 - memory) * weight + below
        total = memory * self.above + (1 - memory) * weight * value + above
        return np.minimum(np.maximum(total, least * n), largest * n), n

    def drifted(self, mean: float) -> Floats:
        b, covariance = self.expected(mean)
        return np.concatenate([[self.frames, mean], self.above, self.below, b, covariance.ravel()])

    def expected(self, mean: float) -> tuple[Floats, Floats]:
        T = np.eye(FEATURES)
        T[0, 1] = mean - self.mean if self.frames else 0.0
        walked = T @ self.covariance @ T.T
        if self.frames:
            left = (1 - walked.diagonal() / self.config.prior_variance).clip(0, 1)
            walked = walked + np.diag(self.config.drift**2 * left)
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
    def of(cls, log_depth: Floats, rows: int, cols: int, config: PosteriorConfig) -> _Grid:
        across, along = np.full((2, rows, cols), np.inf)
        across[:, :-1] = np.abs(np.diff(log_depth.reshape(rows, cols), axis=1))
        along[:-1] = np.abs(np.diff(log_depth.reshape(rows, cols), axis=0))
        edges = across.ravel(), along.ravel()
        right, down = (config.link_variance + config.edge_variance * x**2 for x in edges)
        far = (1 / n + edge for n, edge in zip((cols, rows), edges, strict=True))
        return cls(rows, cols, log_depth, float(log_depth.mean()), right, down, *far)


class _Scene(NamedTuple):
    """The reference's ``_Scene`` of one stream, without padding."""

    config: PosteriorConfig
    grid: _Grid
    prior: Prior
    observed: Observed
    stated: Floats
    noise: Floats

    def counted(self, values: Floats) -> Floats:
        node = self.observed.node
        summed: Floats = np.bincount(node, values, len(self.grid.log_depth)).astype(np.float64)
        return summed[node]

    def believed(self) -> Floats:
        return 1 / (1 + self.noise / self.config.weak_sigma**2)


class _LeftOut(NamedTuple):
    """The reference's ``_LeftOut`` of one stream."""

    residual: Floats
    total: Floats


def _of_stream(
    config: PosteriorConfig, packed: Floats, depth: NDArray[Any], valid: NDArray[np.bool_], claimed: NDArray[Any],
    given_: _Anchors | None,
) -> tuple[Floats, NDArray[Any], NDArray[Any], NDArray[Any]]:  # fmt: skip
    """The memory after the frame; depth, variance and the probability of another surface."""
    running, anchors = _Running.of(packed, config), _NONE if given_ is None else given_
    some = len(anchors.depth) > 0
    if given_ is None and not running.frames:
        return packed, np.where(valid, depth, np.nan).astype(depth.dtype), claimed, np.full_like(depth, np.nan)
    with np.errstate(all="ignore"):  # what is not valid is not read
        logs = np.log(depth)
    rows, cols = (min(SIDE, n) for n in depth.shape)
    grid = _Grid.of(cell_means(logs, valid, rows, cols), rows, cols, config)
    scene = _scene(grid, depth, valid, anchors, running)
    field, left_out, weight = _fitted(scene)
    away = _away(scene, weight * config.weak_sigma**2 >= 1)
    if some:
        kept = _learnt(scene, field, weight, left_out, _relative(claimed, anchors), running)
    else:
        kept = running.drifted(grid.mean) if running.frames and valid.any() else packed
    node = np.arange(rows * cols)
    x = features(grid.log_depth - grid.mean, (node % cols + 0.5) / cols, (node // cols + 0.5) / rows)
    mean, variance = at(field, node, x)
    b = field.coefficients
    share, offset = away / config.reach, mean - (x * b).sum(1)
    variance = variance + running.ratios["roughness"] + away * running.ratios["unseen"]
    variance = _total(scene, variance, share, offset, _spread(scene, np.ones(len(scene.noise), np.bool_), b[0]))
    nodes = np.stack([grid.log_depth, offset, variance, share], 1)
    return kept, *read(depth, valid, logs, claimed, nodes, b, grid.mean, (rows, cols), config)


def _scene(
    grid: _Grid, depth: NDArray[Any], valid: NDArray[np.bool_], anchors: _Anchors, running: _Running
) -> _Scene:  # fmt: skip
    (u, v), log_depth = ((anchors.pixel + 0.5) / depth.shape[::-1]).T.copy(), np.log(anchors.predicted)
    column, row = ((x * n).astype(np.int64).clip(0, n - 1) for x, n in ((u, grid.cols), (v, grid.rows)))
    x = features(log_depth - grid.mean, u, v)
    observed = Observed(row * grid.cols + column, x, np.log(anchors.depth) - log_depth)
    stated = running.ratios["noise"] * anchors.variance / anchors.depth**2
    stated = stated + running.config.alone / max(len(stated), 1)
    noise = stated + running.ratios["roughness"] + (ranges(depth, valid, anchors.at_pixel) / 2) ** 2
    return _Scene(running.config, grid, _prior(grid, running), observed, stated, noise)


def _prior(grid: _Grid, running: _Running) -> Prior:
    mean, covariance = running.expected(grid.mean)
    amplitude = running.ratios["amplitude"]
    diagonal = np.full(len(grid.log_depth), running.config.precision / amplitude)
    right, down = 1 / (grid.right * amplitude), 1 / (grid.down * amplitude)
    precision: Floats = np.linalg.inv(covariance).astype(np.float64)
    return Prior(diagonal, right, down, mean, precision, grid.cols)


def _fitted(scene: _Scene) -> tuple[Field, _LeftOut, Floats]:
    _, left_out = _with_weights(scene, 1 / scene.noise)
    excess = np.maximum(left_out.residual**2 - left_out.total, 0) / (scene.config.degrees_of_freedom + 1)
    weight = 1 / (scene.noise + excess)
    return *_with_weights(scene, weight), weight


def _with_weights(scene: _Scene, weight: Floats) -> tuple[Field, _LeftOut]:
    field = given(scene.prior, scene.observed, weight)
    mean, variance = at(field, scene.observed.node, scene.observed.features)
    left = np.maximum(1 - weight * variance, LEAST_LEFT)
    return field, _LeftOut((scene.observed.value - mean) / left, variance / left + scene.noise)


def _spread(scene: _Scene, used: NDArray[np.bool_], mean: float) -> Floats:
    each = np.where(used, scene.believed() / scene.counted(np.ones(len(scene.noise))), 0.0)
    grid, y, width = scene.grid, scene.observed.value, scene.config.radius
    sums = [np.bincount(scene.observed.node, x, grid.rows * grid.cols) for x in (each, each * y, each * y**2)]
    nodes = np.stack(sums).reshape(3, grid.rows, grid.cols)
    weight, first, second = (_window(grid.rows, width) @ nodes @ _window(grid.cols, width)).reshape(3, -1)
    middle = (first + mean) / (weight + 1)
    moment = (second + mean**2 + scene.config.prior_sigma**2) / (weight + 1)
    spread: Floats = np.maximum(moment - middle**2, 0)
    return spread


@functools.lru_cache(maxsize=4)  # the sizes of the grid hardly change
def _window(count: int, width: float) -> Floats:
    at_ = np.arange(count) / count
    return np.exp(-(((at_[:, None] - at_) / width) ** 2) / 2)


def _total(scene: _Scene, variance: Floats, share: Floats, offset: Floats, spread: Floats) -> Floats:
    config, q = scene.config, np.exp(np.minimum(-offset, LARGEST))
    own, wide = (np.minimum(v, config.widest) for v in (variance, config.spread * spread))
    tail = q * q * np.exp(2 * wide) - 2 * q * np.exp(wide / 2) + 1
    p = config.wrong + config.other * share
    return (1 - p) * (np.exp(2 * own) - 2 * np.exp(own / 2) + 1) + p * tail


def _away(scene: _Scene, evidence: NDArray[np.bool_]) -> Floats:
    grid = scene.grid
    source = np.zeros(len(grid.log_depth), np.bool_)
    source[scene.observed.node[evidence]] = True
    return distance(source, grid.far_right, grid.far_down, grid.cols, scene.config.reach)


def _relative(claimed: NDArray[Any], anchors: _Anchors) -> Floats:
    V = claimed.ravel()[anchors.at_pixel].astype(np.float64)
    return np.where(np.isnan(V), 0.0, V) / anchors.predicted**2


def _learnt(
    scene: _Scene, field: Field, weight: Floats, left_out: _LeftOut, claimed: Floats, running: _Running
) -> Floats:  # fmt: skip
    """Packed."""
    above, below = running.added(_of_neighbours(scene, left_out, running) | _of_discs(scene, weight, claimed, running))
    first = [running.frames + 1, scene.grid.mean]
    return np.concatenate([first, above, below, field.coefficients, field.covariance.ravel()])


def _of_neighbours(scene: _Scene, left_out: _LeftOut, running: _Running) -> dict[str, tuple[float, float]]:
    variance = left_out.total
    excess = np.minimum(left_out.residual**2, scene.config.clip * variance) - variance
    once = 1 / scene.counted(np.ones(len(variance)))
    sums = {}
    for name, part in (("roughness", np.full(len(variance), running.ratios["roughness"])), ("noise", scene.stated)):
        w = once * (part / variance) ** 2
        unit = running.ratios[name] / np.maximum(part, 1e-12)
        sums[name] = float((w * (part + excess) * unit).sum()), float(w.sum())
    return sums


def _of_discs(scene: _Scene, weight: Floats, claimed: Floats, running: _Running) -> dict[str, tuple[float, float]]:
    held = _discs(scene, running.frames)
    rest = ~held
    held = held & (np.count_nonzero(rest) >= LEAST_REST)
    field = given(scene.prior, scene.observed, weight * rest)
    node, x = scene.observed.node[held], scene.observed.features[held]
    mean, variance = at(field, node, x)
    away, noise = _away(scene, rest)[node], scene.noise[held]
    error, field_variance, variance = (scene.observed.value[held] - mean) ** 2, variance, variance + noise
    square = np.minimum(error, scene.config.clip * variance)
    believed = np.where(held, scene.believed(), 0.0)
    area = (believed / np.maximum(scene.counted(believed), 1e-12))[held]
    share, b = away / scene.config.reach, field.coefficients
    stated, spread = variance + away * running.ratios["unseen"], _spread(scene, rest, b[0])[node]
    stated = _total(scene, stated, share, mean - (x * b).sum(1), spread) + share * claimed[held]
    sums = {
        "amplitude": (
            area * (square - noise) / variance,
            area * field_variance / variance / running.ratios["amplitude"],
        ),
        "unseen": (area * (error - variance), area * away),
        "calibration": (area * error / stated, area),
    }
    return {name: (float(above.sum()), float(below.sum())) for name, (above, below) in sums.items()}


def _discs(scene: _Scene, frames: float) -> NDArray[np.bool_]:
    at_, discs = (scene.observed.features[:, 2:4] + 1) / 2, scene.config.discs
    inside = np.zeros(len(at_), np.bool_)
    for disc in range(discs):
        centre = np.array([((frames * discs + disc + 1) * step) % 1 for step in STEPS])
        inside |= ((at_ - centre) ** 2).sum(1) < scene.config.radius**2
    return inside
