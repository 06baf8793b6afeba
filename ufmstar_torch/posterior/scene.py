"""A frame's nodes and anchors, the field fitted to them, and the resulting variance (model: ``update``)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad, unfold

from ufmstar_torch.anchors.anchors import AnchorInput
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.posterior.config import PosteriorConfig
from ufmstar_torch.posterior.distance import distance
from ufmstar_torch.posterior.field import Field, Observed, Prior
from ufmstar_torch.posterior.grid import Grid
from ufmstar_torch.posterior.read import LARGEST
from ufmstar_torch.posterior.running import Running

# Least divisor 1 - w v of a leave-one-out residual: it is 0 for a single anchor.
LEAST_LEFT = 0.05
# Largest probability that the local correction does not hold.
MOST_WRONG = 0.5


@dataclass(frozen=True)
class Scene:
    """A frame's nodes and anchors, before the fit.

    Attributes:
        config: of the posterior.
        grid: the nodes.
        prior: of b and f.
        observed: the anchors.
        stated: [B, N] noise s^2/g^2 + alone/N.
        noise: [B, N] n: ``stated`` with roughness and blur^2.
        valid: [B, N] bool.
    """

    config: PosteriorConfig
    grid: Grid
    prior: Prior
    observed: Observed
    stated: Tensor
    noise: Tensor
    valid: Tensor

    @classmethod
    def of(cls, grid: Grid, frame: FrameInput, anchors: AnchorInput, running: Running) -> Scene:
        node = grid.node(anchors.pixel, frame.size)
        log_depth = anchors.predicted.log()
        observed = Observed(
            node, grid.features_at(anchors.pixel, log_depth, frame.size),
            torch.where(anchors.valid, anchors.depth.log() - log_depth, torch.zeros_like(log_depth)),
        )  # fmt: skip
        stated = running.ratio("noise")[:, None] * anchors.variance / anchors.depth.square()
        stated = stated + running.config.alone / anchors.valid.sum(1, keepdim=True).clamp_min(1).to(stated)
        noise = stated + running.ratio("roughness")[:, None] + (_range(frame, anchors) / 2).square()
        return cls(running.config, grid, _prior(grid, running), observed, stated, noise, anchors.valid)

    def counted(self, values: Tensor) -> Tensor:
        """[B, N] sums of ``values`` over the anchors of the same cell."""
        masked = torch.where(self.valid, values, torch.zeros_like(values))
        nodes = torch.zeros_like(self.grid.log_depth).scatter_add(1, self.observed.node, masked)
        return torch.gather(nodes, 1, self.observed.node)

    def believed(self) -> Tensor:
        """[B, N] weight of an anchor in the learnt means: 1/(1 + n/weak_sigma^2), 0 where not valid."""
        return torch.where(self.valid, 1 / (1 + self.noise / self.config.weak_sigma**2), torch.zeros_like(self.noise))


@dataclass(frozen=True)
class LeftOut:
    """Leave-one-out prediction of each anchor.

    Attributes:
        residual: [B, N] of y.
        total: [B, N] predicted variance of the residual.
    """

    residual: Tensor
    total: Tensor


def _prior(grid: Grid, running: Running) -> Prior:
    """The prior of b and f in the next frame."""
    mean, covariance = running.expected(grid.mean)
    amplitude = running.ratio("amplitude")[:, None]
    diagonal = (running.config.precision / amplitude).expand_as(grid.log_depth)
    right, down = 1 / (grid.right * amplitude), 1 / (grid.down * amplitude)
    return Prior(diagonal, right, down, mean, torch.linalg.inv_ex(covariance).inverse, grid.size[1])


def _range(frame: FrameInput, anchors: AnchorInput) -> Tensor:
    """[B, N] largest less smallest log d of the valid pixels among an anchor's pixel and its eight neighbours."""
    height, width = frame.size
    low = high = anchors.predicted.log()
    depth, valid = frame.depth.flatten(1), frame.valid.flatten(1)
    row, column = anchors.index // width, anchors.index % width
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            index = (row + down).clamp(0, height - 1) * width + (column + right).clamp(0, width - 1)
            usable = torch.gather(valid, 1, index) & anchors.valid
            log_depth = torch.where(usable, torch.gather(depth, 1, index).double(), anchors.predicted).log()
            low, high = torch.minimum(low, log_depth), torch.maximum(high, log_depth)
    return high - low


def fitted(scene: Scene) -> tuple[Field, LeftOut, Tensor]:
    """The field with robust weights, its leave-one-out predictions, and the anchors' weights."""
    zero = torch.zeros_like(scene.noise)
    first, left_out = _with_weights(scene, torch.where(scene.valid, 1 / scene.noise, zero))
    excess = (left_out.residual.square() - left_out.total).clamp_min(0) / (scene.config.degrees_of_freedom + 1)
    weight = torch.where(scene.valid, 1 / (scene.noise + excess), zero)
    return *_with_weights(replace(scene, prior=_loosened(scene, first)), weight), weight


def _loosened(scene: Scene, field: Field) -> Prior:
    """The prior with Student-t weights on the links: a link across a jump of ``field`` is weaker."""
    nu, prior = scene.config.degrees_of_freedom, scene.prior
    f = field.offset.unflatten(1, scene.grid.size)
    right, down = pad(f.diff(dim=2), (0, 1)).flatten(1), pad(f.diff(dim=1), (0, 0, 0, 1)).flatten(1)
    right, down = (w * (nu + 1) / (nu + w * x.square()) for w, x in ((prior.right, right), (prior.down, down)))
    return replace(prior, right=right, down=down)


def _with_weights(scene: Scene, weight: Tensor) -> tuple[Field, LeftOut]:
    field = Field.conditioned(scene.prior, scene.observed, weight)
    mean, variance = field.at(scene.observed.node, scene.observed.features)
    divisor = (1 - weight * variance).clamp_min(LEAST_LEFT)
    return field, LeftOut((scene.observed.value - mean) / divisor, variance / divisor + scene.noise)


def spread_around(scene: Scene, used: Tensor, mean: Tensor) -> Tensor:
    """[B, n] variance of y around every node, over the anchors of the mask ``used`` [B, N] and one virtual anchor of
    the prior variance about ``mean`` [B]."""
    y = scene.observed.value
    weight, first, second = _around(scene, used, scene.config.radius, y, y.square())
    centre, prior = mean[:, None], scene.config.prior_sigma**2
    middle = (first + centre) / (weight + 1)
    return ((second + centre.square() + prior) / (weight + 1) - middle.square()).clamp_min(0)


def local_scale(scene: Scene, left_out: LeftOut, used: Tensor) -> Tensor:
    """[B, n] factor by which errors around every node exceed the field's prediction: the mean leave-one-out z^2 of the
    anchors of the mask ``used`` [B, N] and of one virtual anchor with z^2 = 1."""
    z2 = (left_out.residual.square() / left_out.total).clamp_max(scene.config.clip)
    weight, first = _around(scene, used, scene.config.near, z2)
    return (first + 1) / (weight + 1)


def _around(scene: Scene, used: Tensor, width: float, *values: Tensor) -> Tensor:
    """[1 + k, B, n] sums of 1 and of the k values [B, N] over the anchors of the mask ``used`` [B, N], weighted by a
    Gaussian window around every node, by ``believed``, and by 1/(anchors in the cell)."""
    weight = torch.where(used, scene.believed() / scene.counted(torch.ones_like(scene.noise)).clamp_min(1), 0.0)
    rows, cols = scene.grid.size
    terms = torch.stack([weight, *(weight * x for x in values)])
    nodes = torch.zeros(len(terms), *scene.grid.log_depth.shape, dtype=weight.dtype, device=weight.device)
    nodes = nodes.scatter_add(2, scene.observed.node.expand_as(terms), terms).unflatten(2, (rows, cols))
    return (_window(rows, width, weight) @ nodes @ _window(cols, width, weight)).flatten(2)


def _window(count: int, width: float, like: Tensor) -> Tensor:
    """[count, count] Gaussian weights between the rows, or columns, of nodes."""
    position = torch.arange(count, dtype=like.dtype, device=like.device) / count
    return (-((position[:, None] - position) / width).square() / 2).exp()


def wrong_factor(config: PosteriorConfig, away: Tensor, scale: Tensor) -> Tensor:
    """[B, n] factor on ``wrong``: the local ``scale`` [B, n] of errors at the evidence, 1 from the distance ``radius``
    on; ``away`` [B, n] is the distance."""
    return scale ** (1 - away / config.radius).clamp_min(0)


def wrong(running: Running, factor: Tensor) -> Tensor:
    """[B, n] probability that the local correction does not hold, from :func:`wrong_factor`."""
    return (running.ratio("wrong")[:, None] * factor).clamp_max(MOST_WRONG)


def inlier_factor(running: Running, away: Tensor) -> Tensor:
    """[B, n] factor on the variance of y on the evidence's surface, at distances ``away`` [B, n]: ``inlier`` at the
    evidence, 1 from a disc's diameter on. Held-out anchors are no farther from the others."""
    near = (1 - away / (2 * running.config.radius)).clamp_min(0)
    return 1 + (running.ratio("inlier")[:, None] - 1) * near


def steepness(grid: Grid, f: Tensor) -> Tensor:
    """[B, n] variance of the field's mean ``f`` [B, n] over a node and its eight neighbours: the grid locates a depth
    edge, where y changes, to one node only."""
    padded = pad(f.unflatten(1, grid.size)[:, None], (1, 1, 1, 1), mode="replicate")
    return unfold(padded, 3).var(1, correction=0)


def elsewhere_variance(config: PosteriorConfig, around: Tensor, unseen: Tensor) -> Tensor:
    """Variance of y on another surface than the evidence's: the variance ``around`` of the anchors' y plus
    ``elsewhere`` times the variance ``unseen`` from the distance; at most ``widest``."""
    return (around + config.elsewhere * unseen).clamp_max(config.widest)


def second_moments(
    config: PosteriorConfig, variance: Tensor, p: Tensor, offset: Tensor, wide: Tensor
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Variances over the squared depth: in total, and if the local correction holds. With probability ``p`` the local
    correction ``offset`` does not hold, and y has the variance ``wide`` instead of ``variance``."""
    inlier_variance, q = variance.clamp_max(config.widest), (-offset).clamp_max(LARGEST).exp()
    tail = q.square() * (2 * wide).exp() - 2 * q * (wide / 2).exp() + 1
    inlier = (2 * inlier_variance).exp() - 2 * (inlier_variance / 2).exp() + 1
    return (1 - p) * inlier + p * tail, inlier


def away_from(scene: Scene, evidence: Tensor) -> Tensor:
    """[B, n] geodesic distance of every node from the anchors of the mask ``evidence`` [B, N], in image widths."""
    grid = scene.grid
    source = torch.zeros_like(grid.log_depth).scatter_add(1, scene.observed.node, evidence.to(grid.log_depth)) > 0
    return distance(source, grid.far_right, grid.far_down, grid.size[1], scene.config.reach)
