"""A frame's nodes and anchors, the field fitted to them, and the resulting variance (model: ``update``).

The nodes are cells of the image with links between neighbours. A link is weaker, the more the predicted depths of its
two nodes differ: across a depth edge, the network may err by another factor.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.posterior.cells import features, local_variance, ranges
from ufmstar_torch.posterior.config import PosteriorConfig
from ufmstar_torch.posterior.field import Field, Observed, Prior, at, conditioned, distance
from ufmstar_torch.posterior.moments import moments
from ufmstar_torch.posterior.nodes import link, scale, spread
from ufmstar_torch.posterior.running import Floats, Running

# Largest number of nodes in a row and in a column (the field's window allows 31 in a row).
SIDE = 28
# Least divisor 1 - w v of a leave-one-out residual: it is 0 for a single anchor.
LEAST_LEFT = 0.05
# Largest probability that the local correction does not hold.
MOST_WRONG = 0.5


class AnchorRows(NamedTuple):
    """The N valid anchors of one stream.

    Attributes:
        pixel: [N, 2] position [px].
        at_pixel: [N] index of the pixel in the flattened image.
        predicted: [N] d at the pixel [m].
        depth: [N] g [m].
        variance: [N] of g [m^2].
        motion: [M, 3] pixels (u, v) [px], and the log likelihood ratio of motion there; None = the anchors hold for
            surfaces that move, too.
    """

    pixel: Floats
    at_pixel: NDArray[np.int64]
    predicted: Floats
    depth: Floats
    variance: Floats
    motion: Floats | None = None


class Grid(NamedTuple):
    """R x C nodes of a depth map.

    Attributes:
        rows, cols: R and C.
        log_depth: [R C] mean of log d over the cell's valid pixels; the mean of all other cells if it has none.
        mean: m_0, mean of ``log_depth``.
        right, down: [R C] variance of the difference of y to the next node in the row, in the column; infinite at the
            border.
        far_right, far_down: [R C] lengths of the same links: size of a cell plus difference of log d times ``jump``.
    """

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
        """The links between cells of mean ``log_depth`` [R C]."""
        links = np.empty((4, rows, cols))
        link(log_depth.reshape(rows, cols), config.jump, config.link_variance, config.edge_variance, *links)
        return cls(rows, cols, log_depth, float(log_depth.mean()), *links.reshape(4, -1))


class Scene(NamedTuple):
    """A frame's nodes and N anchors, before the fit.

    Attributes:
        config: of the posterior.
        grid: the nodes.
        prior: of b and f.
        observed: the anchors.
        stated: [N] noise s^2/g^2 + alone/N.
        noise: [N] n: ``stated`` with roughness and blur^2.
        believed: [N] weight of an anchor in the learnt means: 1/(1 + n/weak_sigma^2).
        by_area: [N] ``believed`` over the number of anchors in the cell.
    """

    config: PosteriorConfig
    grid: Grid
    prior: Prior
    observed: Observed
    stated: Floats
    noise: Floats
    believed: Floats
    by_area: Floats

    def counted(self, values: Floats) -> Floats:
        """[N] sums of ``values`` over the anchors of the same cell."""
        node = self.observed.node
        summed: Floats = np.bincount(node, values, len(self.grid.log_depth)).astype(np.float64)
        return summed[node]


class LeftOut(NamedTuple):
    """Leave-one-out prediction of each anchor.

    Attributes:
        residual: [N] of y.
        total: [N] predicted variance of the residual.
    """

    residual: Floats
    total: Floats


def scene_of(
    grid: Grid, depth: NDArray[Any], valid: NDArray[np.bool_], anchors: AnchorRows, running: Running
) -> Scene:  # fmt: skip
    """The nodes and anchors of a frame.

    Args:
        grid: of the frame.
        depth: [H, W] d [m].
        valid: [H, W].
        anchors: of the frame.
        running: up to the frame before.
    """
    (u, v), log_depth = ((anchors.pixel + 0.5) / depth.shape[::-1]).T.copy(), np.log(anchors.predicted)
    column, row = ((x * n).astype(np.int64).clip(0, n - 1) for x, n in ((u, grid.cols), (v, grid.rows)))
    x = features(log_depth - grid.mean, u, v)
    observed = Observed(row * grid.cols + column, x, np.log(anchors.depth) - log_depth)
    stated = running.ratios["noise"] * anchors.variance / anchors.depth**2
    stated = stated + running.config.alone / max(len(stated), 1)
    noise = stated + running.ratios["roughness"] + (ranges(depth, valid, anchors.at_pixel) / 2) ** 2
    believed, count = 1 / (1 + noise / running.config.weak_sigma**2), np.bincount(observed.node)
    by_area = believed / count[observed.node]
    return Scene(running.config, grid, _prior(grid, running), observed, stated, noise, believed, by_area)


def _prior(grid: Grid, running: Running) -> Prior:
    """The prior of b and f in the next frame."""
    mean, covariance = running.expected(grid.mean)
    amplitude = running.ratios["amplitude"]
    diagonal = np.full(len(grid.log_depth), running.config.precision / amplitude)
    right, down = 1 / (grid.right * amplitude), 1 / (grid.down * amplitude)
    precision: Floats = np.linalg.inv(covariance).astype(np.float64)
    return Prior(diagonal, right, down, mean, precision, grid.cols)


def fitted(scene: Scene) -> tuple[Field, LeftOut, Floats]:
    """The field with robust weights, its leave-one-out predictions, and the anchors' weights [N]."""
    first, left_out = _with_weights(scene, 1 / scene.noise)
    excess = np.maximum(left_out.residual**2 - left_out.total, 0) / (scene.config.degrees_of_freedom + 1)
    weight = 1 / (scene.noise + excess)
    return *_with_weights(scene._replace(prior=_loosened(scene, first)), weight), weight


def _loosened(scene: Scene, field: Field) -> Prior:
    """The prior with Student-t weights on the links: a link across a jump of ``field`` is weaker."""
    nu, grid, prior = scene.config.degrees_of_freedom, scene.grid, scene.prior
    f = field.offset.reshape(grid.rows, grid.cols)
    right, down = np.diff(f, axis=1, append=f[:, -1:]).ravel(), np.diff(f, axis=0, append=f[-1:]).ravel()
    right, down = (w * (nu + 1) / (nu + w * x**2) for w, x in ((prior.right, right), (prior.down, down)))
    return prior._replace(right=right, down=down)


def _with_weights(scene: Scene, weight: Floats) -> tuple[Field, LeftOut]:
    """The field for anchors of precision ``weight`` [N]."""
    field = conditioned(scene.prior, scene.observed, weight)
    mean, variance = at(field, scene.observed.node, scene.observed.features)
    divisor = np.maximum(1 - weight * variance, LEAST_LEFT)
    return field, LeftOut((scene.observed.value - mean) / divisor, variance / divisor + scene.noise)


def spread_around(scene: Scene, used: NDArray[np.bool_], mean: float) -> Floats:
    """[n] variance of y around every node, over the anchors of the mask ``used`` [N], weighted ``by_area`` and by a
    Gaussian window, and one virtual anchor of the prior variance about ``mean``."""
    out, grid = np.empty(len(scene.grid.log_depth)), scene.grid
    windows = (_window(count, scene.config.radius) for count in (grid.rows, grid.cols))
    observed, prior = scene.observed, scene.config.prior_sigma**2
    spread(observed.node, scene.by_area, used, observed.value, *windows, mean, prior, out)
    return out


def local_scale(scene: Scene, left_out: LeftOut, used: NDArray[np.bool_]) -> Floats:
    """[n] factor by which errors around every node exceed the field's prediction: the mean leave-one-out z^2 of the
    anchors of the mask ``used`` [N] and of one virtual anchor with z^2 = 1. Gaussian windows and weights as in
    :func:`spread_around`."""
    out, grid = np.empty(len(scene.grid.log_depth)), scene.grid
    windows = (_window(count, scene.config.near) for count in (grid.rows, grid.cols))
    scale(scene.observed.node, scene.by_area, used, *left_out, scene.config.clip, *windows, out)
    return out


@functools.lru_cache(maxsize=8)  # two widths; the sizes of the grid hardly change
def _window(count: int, width: float) -> Floats:
    """[count, count] Gaussian weights between the rows, or columns, of nodes."""
    position = np.arange(count) / count
    return np.exp(-(((position[:, None] - position) / width) ** 2) / 2)


def wrong_factor(config: PosteriorConfig, away: Floats, scale: Floats) -> Floats:
    """[n] factor on ``wrong``: the local ``scale`` [n] of errors at the evidence, 1 from the distance ``radius`` on;
    ``away`` [n] is the distance."""
    factor: Floats = scale ** np.maximum(1 - away / config.radius, 0)
    return factor


def slopes_away(config: PosteriorConfig, x: Floats, away: Floats, slopes: Floats, mean: Floats) -> Floats:
    """[n] change of y at nodes with features ``x`` [n, 4] and distances ``away`` [n] from evidence, where the ``mean``
    slopes [3] of the stream replace those of the frame: what its anchors show is no evidence far from them."""
    share = away**2 / (away**2 + config.slope_reach**2)
    change: Floats = share * (x[:, 1:] @ (mean - slopes))
    return change


def unmeasured(config: PosteriorConfig, variance: float) -> float:
    """Share in [0, 1] of the prior that is left: the squared share of the ``variance`` of b's constant in that before
    the first anchor."""
    return min(variance / config.prior_sigma**2, 1.0) ** 2


def misscaled(config: PosteriorConfig, share: float, p: Floats, wide: Floats) -> tuple[Floats, Floats]:
    """The probabilities [n] of another surface and the variances [n] of y there, raised towards ``misscaled`` and
    ``widest`` by the ``share`` that is ``unmeasured``."""
    return p + share * np.maximum(config.misscaled - p, 0), wide + share * (config.widest - wide)


def inlier_factor(running: Running, away: Floats) -> Floats:
    """[n] factor on the variance of y on the evidence's surface, at distances ``away`` [n]: ``inlier`` at the evidence,
    1 from a disc's diameter on. Held-out anchors are no farther from the others."""
    factor: Floats = 1 + (running.ratios["inlier"] - 1) * np.maximum(1 - away / (2 * running.config.radius), 0)
    return factor


def steepness(grid: Grid, f: Floats) -> Floats:
    """[n] variance of the field's mean ``f`` [n] over a node and its eight neighbours: the grid locates a depth edge,
    where y changes, to one node only."""
    return local_variance(f.reshape(grid.rows, grid.cols)).ravel()


def elsewhere_variance(config: PosteriorConfig, around: Floats, unseen: Floats) -> Floats:
    """Variance of y on another surface than the evidence's: the variance ``around`` of the anchors' y plus
    ``elsewhere`` times the variance ``unseen`` from the distance; at most ``widest``."""
    return np.minimum(around + config.elsewhere * unseen, config.widest)


def at_pixels(
    config: PosteriorConfig, factor: Floats, field: Floats, roughness: float, unseen: Floats, steep: Floats,
    share: float = 0.0,
) -> Floats:  # fmt: skip
    """Variance of y at pixels on the evidence's surface, before the local scale: the parts that held-out anchors show,
    times factors from anchors to pixels. ``factor`` is h; the ``share`` that is ``unmeasured`` of the field's variance
    has no factor."""
    of_field = config.pixel_field + (1 - config.pixel_field) * share
    parts = of_field * field + config.pixel_roughness * roughness + config.pixel_unseen * unseen
    return factor * parts + config.pixel_steepness * steep


def second_moments(
    config: PosteriorConfig, variance: Floats, p: Floats, offset: Floats, wide: Floats
) -> tuple[Floats, Floats]:  # fmt: skip
    """Variances over the squared depth: in total, and if the local correction holds. With probability ``p`` the local
    correction ``offset`` does not hold, and y has the variance ``wide`` instead of ``variance``. All arguments are
    [n]."""
    limit = math.log(config.farthest)
    total, inlier = np.empty((2, len(variance)))
    moments(variance, p, offset, wide, limit, config.widest, total, inlier)
    return total, inlier


def away_from(scene: Scene, evidence: NDArray[np.bool_]) -> Floats:
    """[n] geodesic distance of every node from the anchors of the mask ``evidence`` [N], in image widths."""
    grid = scene.grid
    source = np.zeros(len(grid.log_depth), np.bool_)
    source[scene.observed.node[evidence]] = True
    return distance(source, grid.far_right, grid.far_down, grid.cols, scene.config.reach)
