"""The posterior's nodes and anchors on the CPU (``ufmstar_torch.posterior.scene``): one stream, without padding."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.kernels.cells_cpu import features, local_variance, ranges
from ufmstar_torch.kernels.field_cpu import Field, Floats, Observed, Prior, at, conditioned, distance
from ufmstar_torch.posterior.config import PosteriorConfig
from ufmstar_torch.posterior.read import LARGEST
from ufmstar_torch.posterior.running import FEATURES, RATIOS, ratios
from ufmstar_torch.posterior.scene import LEAST_LEFT


class AnchorRows(NamedTuple):
    """The valid anchors of one stream."""

    pixel: Floats
    at_pixel: NDArray[np.int64]
    predicted: Floats
    depth: Floats
    variance: Floats


class Running(NamedTuple):
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
    def of(cls, packed: Floats, config: PosteriorConfig) -> Running:
        names, (value, weight, least, largest) = _priors(config)
        (above, below), rest = packed[2 : 2 + 2 * RATIOS].reshape(2, RATIOS), packed[2 + 2 * RATIOS :]
        b, covariance = rest[:FEATURES], rest[FEATURES:].reshape(FEATURES, FEATURES)
        if packed[0] == 0:
            above, below, covariance = value * weight, weight, np.diag(config.prior_variance)
        values = np.where(below > 0, above / np.maximum(below, 1e-12), value).clip(least, largest)
        by_name = dict(zip(names, values.tolist(), strict=True))
        return cls(config, packed[0], packed[1], above, below, b, covariance, by_name)

    def added(self, sums: dict[str, tuple[float, float]]) -> tuple[Floats, Floats]:
        value, weight, least, largest = _priors(self.config)[1]
        fade, (above, below) = 0.5 ** (1 / self.config.half_life), np.array([sums[name] for name in self.ratios]).T
        n = fade * self.below + (1 - fade) * weight + below
        total = fade * self.above + (1 - fade) * weight * value + above
        return np.minimum(np.maximum(total, least * n), largest * n), n

    def drifted(self, mean: float) -> Floats:
        b, covariance = self.expected(mean)
        return np.concatenate([[self.frames, mean], self.above, self.below, b, covariance.ravel()])

    def expected(self, mean: float) -> tuple[Floats, Floats]:
        T = np.eye(FEATURES)
        T[0, 1] = mean - self.mean if self.frames else 0.0
        transformed = T @ self.covariance @ T.T
        if self.frames:
            remaining = (1 - transformed.diagonal() / self.config.prior_variance).clip(0, 1)
            transformed = transformed + np.diag(self.config.drift**2 * remaining)
        return T @ self.coefficients, transformed


@functools.lru_cache(maxsize=4)  # a posterior has the same config in every frame
def _priors(config: PosteriorConfig) -> tuple[tuple[str, ...], Floats]:
    """Names of the ratios [R], and their values, weights, least and largest values [4, R]."""
    priors = ratios(config)
    return tuple(priors), np.array(list(priors.values())).T


class Grid(NamedTuple):
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
    def of(cls, log_depth: Floats, rows: int, cols: int, config: PosteriorConfig) -> Grid:
        across, along = np.full((2, rows, cols), np.inf)
        across[:, :-1] = np.abs(np.diff(log_depth.reshape(rows, cols), axis=1))
        along[:-1] = np.abs(np.diff(log_depth.reshape(rows, cols), axis=0))
        edges = across.ravel(), along.ravel()
        right, down = (config.link_variance + config.edge_variance * x**2 for x in edges)
        far = (1 / n + edge for n, edge in zip((cols, rows), edges, strict=True))
        return cls(rows, cols, log_depth, float(log_depth.mean()), right, down, *far)


class Scene(NamedTuple):
    """The reference's ``Scene`` of one stream, without padding."""

    config: PosteriorConfig
    grid: Grid
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


class LeftOut(NamedTuple):
    """The reference's ``LeftOut`` of one stream."""

    residual: Floats
    total: Floats


def scene_of(
    grid: Grid, depth: NDArray[Any], valid: NDArray[np.bool_], anchors: AnchorRows, running: Running
) -> Scene:  # fmt: skip
    (u, v), log_depth = ((anchors.pixel + 0.5) / depth.shape[::-1]).T.copy(), np.log(anchors.predicted)
    column, row = ((x * n).astype(np.int64).clip(0, n - 1) for x, n in ((u, grid.cols), (v, grid.rows)))
    x = features(log_depth - grid.mean, u, v)
    observed = Observed(row * grid.cols + column, x, np.log(anchors.depth) - log_depth)
    stated = running.ratios["noise"] * anchors.variance / anchors.depth**2
    stated = stated + running.config.alone / max(len(stated), 1)
    noise = stated + running.ratios["roughness"] + (ranges(depth, valid, anchors.at_pixel) / 2) ** 2
    return Scene(running.config, grid, _prior(grid, running), observed, stated, noise)


def _prior(grid: Grid, running: Running) -> Prior:
    mean, covariance = running.expected(grid.mean)
    amplitude = running.ratios["amplitude"]
    diagonal = np.full(len(grid.log_depth), running.config.precision / amplitude)
    right, down = 1 / (grid.right * amplitude), 1 / (grid.down * amplitude)
    precision: Floats = np.linalg.inv(covariance).astype(np.float64)
    return Prior(diagonal, right, down, mean, precision, grid.cols)


def fitted(scene: Scene) -> tuple[Field, LeftOut, Floats]:
    first, left_out = _with_weights(scene, 1 / scene.noise)
    excess = np.maximum(left_out.residual**2 - left_out.total, 0) / (scene.config.degrees_of_freedom + 1)
    weight = 1 / (scene.noise + excess)
    return *_with_weights(scene._replace(prior=_loosened(scene, first)), weight), weight


def _loosened(scene: Scene, field: Field) -> Prior:
    nu, grid, prior = scene.config.degrees_of_freedom, scene.grid, scene.prior
    f = field.offset.reshape(grid.rows, grid.cols)
    right, down = np.diff(f, axis=1, append=f[:, -1:]).ravel(), np.diff(f, axis=0, append=f[-1:]).ravel()
    right, down = (w * (nu + 1) / (nu + w * x**2) for w, x in ((prior.right, right), (prior.down, down)))
    return prior._replace(right=right, down=down)


def _with_weights(scene: Scene, weight: Floats) -> tuple[Field, LeftOut]:
    field = conditioned(scene.prior, scene.observed, weight)
    mean, variance = at(field, scene.observed.node, scene.observed.features)
    divisor = np.maximum(1 - weight * variance, LEAST_LEFT)
    return field, LeftOut((scene.observed.value - mean) / divisor, variance / divisor + scene.noise)


def spread_around(scene: Scene, used: NDArray[np.bool_], mean: float) -> Floats:
    y = scene.observed.value
    weight, first, second = _around(scene, used, scene.config.radius, y, y**2)
    middle = (first + mean) / (weight + 1)
    moment = (second + mean**2 + scene.config.prior_sigma**2) / (weight + 1)
    spread: Floats = np.maximum(moment - middle**2, 0)
    return spread


def local_scale(scene: Scene, left_out: LeftOut, used: NDArray[np.bool_]) -> Floats:
    z2 = np.minimum(left_out.residual**2 / left_out.total, scene.config.clip)
    weight, first = _around(scene, used, scene.config.near, z2)
    scale: Floats = (first + 1) / (weight + 1)
    return scale


def _around(scene: Scene, used: NDArray[np.bool_], width: float, *values: Floats) -> Floats:
    weight = np.where(used, scene.believed() / scene.counted(np.ones(len(scene.noise))), 0.0)
    grid, terms = scene.grid, (weight, *(weight * x for x in values))
    nodes = np.stack([np.bincount(scene.observed.node, x, grid.rows * grid.cols) for x in terms])
    nodes = nodes.reshape(-1, grid.rows, grid.cols)
    sums: Floats = (_window(grid.rows, width) @ nodes @ _window(grid.cols, width)).reshape(len(nodes), -1)
    return sums


@functools.lru_cache(maxsize=8)  # two widths; the sizes of the grid hardly change
def _window(count: int, width: float) -> Floats:
    position = np.arange(count) / count
    return np.exp(-(((position[:, None] - position) / width) ** 2) / 2)


def wrong_factor(config: PosteriorConfig, away: Floats, scale: Floats) -> Floats:
    factor: Floats = scale ** np.maximum(1 - away / config.radius, 0)
    return factor


def inlier_factor(running: Running, away: Floats) -> Floats:
    factor: Floats = 1 + (running.ratios["inlier"] - 1) * np.maximum(1 - away / (2 * running.config.radius), 0)
    return factor


def steepness(grid: Grid, f: Floats) -> Floats:
    return local_variance(f.reshape(grid.rows, grid.cols)).ravel()


def elsewhere_variance(config: PosteriorConfig, around: Floats, unseen: Floats) -> Floats:
    return np.minimum(around + config.elsewhere * unseen, config.widest)


def second_moments(
    config: PosteriorConfig, variance: Floats, p: Floats, offset: Floats, wide: Floats
) -> tuple[Floats, Floats]:  # fmt: skip
    inlier_variance, q = np.minimum(variance, config.widest), np.exp(np.minimum(-offset, LARGEST))
    tail = q * q * np.exp(2 * wide) - 2 * q * np.exp(wide / 2) + 1
    inlier: Floats = np.exp(2 * inlier_variance) - 2 * np.exp(inlier_variance / 2) + 1
    return (1 - p) * inlier + p * tail, inlier


def away_from(scene: Scene, evidence: NDArray[np.bool_]) -> Floats:
    grid = scene.grid
    source = np.zeros(len(grid.log_depth), np.bool_)
    source[scene.observed.node[evidence]] = True
    return distance(source, grid.far_right, grid.far_down, grid.cols, scene.config.reach)
