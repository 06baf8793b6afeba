"""One frame: p(depth | network, UfM*, anchors), and what the stream learns from it.

At an anchor of depth g the network's error is y = log(g/d). Over the image it is modelled as

    y = b . (1, log d - m_0, u, v) + f,

with b carried from frame to frame as a random walk and a Gaussian field f on a grid whose links loosen across edges of
the predicted depth (``grid``, ``field``). An anchor observes y with the variance

    n = roughness + blur^2 + noise s^2/g^2,

where blur is half the range of log d among the pixel's neighbours, and ``noise`` the factor by which anchors state
their variances too small, and ``alone`` over the number of anchors is added: few anchors do not confirm each other. An
anchor is distributed about the prediction of the others as Student's t. What (nu + z^2)/(nu + 1) adds to that
prediction's variance, with z from the leave-one-out residual, is counted as its noise: this takes outliers out.

Variance over the squared depth at a node, with v the field's variance + roughness + unseen distance, and
share = min(1, distance/reach):

    (1 - p) m(v) + p tail + share V/d^2,      p = wrong + other share,      m(v) = E[(e^n - 1)^2],      n ~ N(0, v).

The error of the depth is log-normal, so m exceeds v where v is large. p is the probability that the depth is of another
surface than its evidence: ``outlier``.

The distance from evidence is geodesic, in widths of the image, and differences of log d lengthen it: on tours the
variance of the error grows in proportion to it. ``unseen``, and the amplitude of f, are learnt (``running``) from
anchors of discs that move over the image: the field is fitted without them, and they count by area and not by number,
since corners cluster on what is well textured. ``unseen`` is what their squared error is beyond the rest, over their
distance. V = M + A + E counts where evidence is far.

``tail`` is the second moment about the posterior depth if the local correction f does not hold, because the evidence is
wrong or lies on another surface. Then y - b . x is normal with the variance v, and the depth log-normal:

    tail = E[(e^(n - f) - 1)^2] = q^2 e^(2 v) - 2 q e^(v/2) + 1,      q = e^-f <= 100,      n ~ N(0, v).

v is ``spread`` times the variance of the anchors' y around, of a Gaussian window, and neither v exceeds ``widest``. So
no pixel is more certain than
contradictory evidence allows, and a depth that was pulled far below the global correction is less certain than one
above it.

A stream that is given anchors of which none was valid so far has that variance without evidence, about the network's
depth: nothing was measured, and nothing reads as certain. A stream without anchors is UfM*'s.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ufmstar_torch.anchors.anchors import AnchorInput
from ufmstar_torch.fixed_order import total
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.posterior.config import PosteriorConfig
from ufmstar_torch.posterior.distance import distance
from ufmstar_torch.posterior.field import Field, Observed, Prior
from ufmstar_torch.posterior.grid import Grid
from ufmstar_torch.posterior.read import LARGEST, read
from ufmstar_torch.posterior.running import Running, ratios

# Least share of 1 - w v, by which a residual is divided to leave its anchor out: an anchor alone would divide by 0.
LEAST_LEFT = 0.05
# With fewer anchors beside the discs, nothing is held out: the field would be the prior.
LEAST_REST = 5
# The frame's number moves the discs along this sequence of low discrepancy (R2, Roberts).
STEPS = (0.7548776662466927, 0.5698402909980532)


@dataclass(frozen=True)
class Posterior:
    """The posterior of B streams.

    Attributes:
        depth: [B, H, W] [m]; as predicted before the first anchor. NaN where not valid.
        variance: [B, H, W] [m^2]; UfM*'s where no anchors were ever given.
        calibration: [B] mean z^2 of held-out anchors lately: 1 = as predicted, more = too certain; NaN before any.
        unseen: [B] variance of y a width of the image from evidence.
        outlier: [B, H, W] probability in [0, 1] that a pixel lies on another surface than its evidence; NaN where not
            valid or no anchors were ever given.
    """

    depth: Tensor
    variance: Tensor
    calibration: Tensor
    unseen: Tensor
    outlier: Tensor


# As :func:`update`; ``kernels/posterior_cpu`` has the compiled one.
PosteriorUpdate = Callable[[Tensor, FrameInput, AnchorInput | None, Tensor, PosteriorConfig], tuple[Tensor, Posterior]]


@dataclass(frozen=True)
class _Scene:
    """A frame's nodes and anchors, before they are fitted.

    Attributes:
        config: of the posterior.
        grid: the nodes.
        prior: of b and f.
        observed: the anchors.
        stated: [B, N] noise s^2/g^2 of y, as learnt.
        noise: [B, N] n, with roughness and blur^2.
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
    def of(cls, grid: Grid, frame: FrameInput, anchors: AnchorInput, running: Running) -> _Scene:
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
        """[B, N] values, summed over the anchors of the same cell."""
        kept = torch.where(self.valid, values, torch.zeros_like(values))
        nodes = torch.zeros_like(self.grid.log_depth).scatter_add(1, self.observed.node, kept)
        return torch.gather(nodes, 1, self.observed.node)

    def believed(self) -> Tensor:
        """[B, N] by how much an anchor counts for what is learnt: less the noisier it is, 0 where not valid."""
        return torch.where(self.valid, 1 / (1 + self.noise / self.config.weak_sigma**2), torch.zeros_like(self.noise))


@dataclass(frozen=True)
class _LeftOut:
    """Each anchor, predicted by the field of the others.

    Attributes:
        residual: [B, N] of y.
        total: [B, N] variance that is predicted for it.
    """

    residual: Tensor
    total: Tensor


def update(
    packed: Tensor,
    frame: FrameInput,
    anchors: AnchorInput | None,
    claimed: Tensor,
    config: PosteriorConfig,
) -> tuple[Tensor, Posterior]:
    """Process a frame.

    Args:
        packed: [B, running.SIZE] what was learnt; not modified.
        frame: checked.
        anchors: of the frame, or None.
        claimed: [B, H, W] V of UfM* without B [m^2], NaN where not valid.
        config: the constants.

    Returns:
        The statistics up to this frame, and the posterior. A stream without a usable anchor learns nothing; its
        coefficients drift.
    """
    given = anchors is not None
    anchors = anchors if anchors is not None and anchors.valid.shape[1] else _none(frame)
    running, grid, known_claim = Running.of(packed, config), Grid.of(frame, config), claimed.nan_to_num()
    scene = _Scene.of(grid, frame, anchors, running)
    field, left_out, weight = _fitted(scene)
    away = _away(scene, anchors.valid & (weight * config.weak_sigma**2 >= 1))
    after = _learnt(scene, field, weight, left_out, _relative(known_claim, anchors), running)
    features, b = grid.features(), field.coefficients
    mean, variance = field.at(torch.arange(features.shape[1], device=b.device).expand_as(away), features)
    offset, share = mean - (features * b[:, None]).sum(-1), away / config.reach
    variance = variance + running.ratio("roughness")[:, None] + away * running.ratio("unseen")[:, None]
    variance = _total(scene, variance, share, offset, _spread(scene, anchors.valid, b[:, 0]))
    nodes = torch.stack([grid.log_depth, offset, variance, share], -1)
    maps = frame.depth, frame.valid, known_claim
    depth, spread, outlier = read(*maps, nodes, b, grid.mean, grid.size, config)
    some = anchors.valid.any(1)
    known = (some | (running.frames > 0) | given)[:, None, None]
    plain = torch.where(frame.valid, frame.depth, torch.nan)
    drifted = torch.where(frame.valid.flatten(1).any(1)[:, None], running.drifted(grid.mean), packed)
    kept = torch.where(some[:, None], after.packed(), drifted).to(packed.dtype)
    now = Running.of(kept, config)
    calibration = torch.where(now.below["calibration"] > 0, now.ratio("calibration"), torch.nan)
    return kept, Posterior(
        torch.where(known, depth, plain), torch.where(known, spread, claimed), calibration, now.ratio("unseen"),
        torch.where(known, outlier, torch.nan),
    )  # fmt: skip


def _none(frame: FrameInput) -> AnchorInput:
    """One anchor a stream that is not valid."""
    b, like = len(frame.depth), frame.intrinsics
    one, zero = like.new_ones(b, 1), like.new_zeros(b, 1)
    index = torch.zeros(b, 1, dtype=torch.int64, device=like.device)
    return AnchorInput(like.new_zeros(b, 1, 2), index, one, one, zero, zero, index.bool())


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
            fine = torch.gather(valid, 1, index) & anchors.valid
            near = torch.where(fine, torch.gather(depth, 1, index).double(), anchors.predicted).log()
            low, high = torch.minimum(low, near), torch.maximum(high, near)
    return high - low


def _fitted(scene: _Scene) -> tuple[Field, _LeftOut, Tensor]:
    """The field, how well it predicts each anchor from the others, and the anchors' weights in it."""
    zero = torch.zeros_like(scene.noise)
    _, left_out = _with_weights(scene, torch.where(scene.valid, 1 / scene.noise, zero))
    excess = (left_out.residual.square() - left_out.total).clamp_min(0) / (scene.config.degrees_of_freedom + 1)
    weight = torch.where(scene.valid, 1 / (scene.noise + excess), zero)
    return *_with_weights(scene, weight), weight


def _with_weights(scene: _Scene, weight: Tensor) -> tuple[Field, _LeftOut]:
    field = Field.given(scene.prior, scene.observed, weight)
    mean, variance = field.at(scene.observed.node, scene.observed.features)
    left = (1 - weight * variance).clamp_min(LEAST_LEFT)
    return field, _LeftOut((scene.observed.value - mean) / left, variance / left + scene.noise)


def _spread(scene: _Scene, used: Tensor, mean: Tensor) -> Tensor:
    """[B, n] variance of y among the anchors of the mask [B, N] around every node, and one anchor of the prior variance
    about ``mean`` [B]."""
    each = torch.where(used, scene.believed() / scene.counted(torch.ones_like(scene.noise)).clamp_min(1), 0.0)
    y, (rows, cols) = scene.observed.value, scene.grid.size
    nodes = torch.zeros(3, *scene.grid.log_depth.shape, dtype=each.dtype, device=each.device)
    values = torch.stack([each, each * y, each * y.square()])
    nodes = nodes.scatter_add(2, scene.observed.node.expand(3, -1, -1), values).unflatten(2, (rows, cols))
    width = scene.config.radius
    weight, first, second = (_window(rows, width, mean) @ nodes @ _window(cols, width, mean)).flatten(2)
    centre, prior = mean[:, None], scene.config.prior_sigma**2
    middle = (first + centre) / (weight + 1)
    return ((second + centre.square() + prior) / (weight + 1) - middle.square()).clamp_min(0)


def _window(count: int, width: float, like: Tensor) -> Tensor:
    """[count, count] weight of a row of nodes, or column, for another one."""
    at = torch.arange(count, dtype=like.dtype, device=like.device) / count
    return (-((at[:, None] - at) / width).square() / 2).exp()


def _total(scene: _Scene, variance: Tensor, share: Tensor, offset: Tensor, spread: Tensor) -> Tensor:
    """Variance over the squared depth: of y's ``variance``, and where the local correction ``offset`` does not hold."""
    config, q = scene.config, (-offset).clamp_max(LARGEST).exp()
    own, wide = (v.clamp_max(config.widest) for v in (variance, config.spread * spread))
    tail = q.square() * (2 * wide).exp() - 2 * q * (wide / 2).exp() + 1
    p = config.wrong + config.other * share
    return (1 - p) * ((2 * own).exp() - 2 * (own / 2).exp() + 1) + p * tail


def _away(scene: _Scene, evidence: Tensor) -> Tensor:
    """[B, n] how far every node is from the anchors of the mask [B, N], in widths of the image."""
    grid = scene.grid
    source = torch.zeros_like(grid.log_depth).scatter_add(1, scene.observed.node, evidence.to(grid.log_depth)) > 0
    return distance(source, grid.far_right, grid.far_down, grid.size[1], scene.config.reach)


def _relative(claimed: Tensor, anchors: AnchorInput) -> Tensor:
    """[B, N] V/d^2 at the anchors."""
    at = torch.gather(claimed.flatten(1), 1, anchors.index).double()
    return torch.where(anchors.valid, at / anchors.predicted.square(), torch.zeros_like(at))


def _learnt(
    scene: _Scene, field: Field, weight: Tensor, left_out: _LeftOut, claimed: Tensor, running: Running,
) -> Running:  # fmt: skip
    """The memory after the frame."""
    sums = _of_neighbours(scene, left_out, running) | _of_discs(scene, weight, claimed, running)
    added = {name: running.added(name, *sums[name]) for name in ratios(scene.config)}
    above, below = ({name: pair[i] for name, pair in added.items()} for i in range(2))
    after = running.frames + 1, scene.grid.mean, above, below, field.coefficients, field.covariance
    return Running(scene.config, *after)


def _of_neighbours(scene: _Scene, left_out: _LeftOut, running: Running) -> dict[str, tuple[Tensor, Tensor]]:
    """Sums for roughness and noise from leave-one-out residuals: what they are beyond the rest of their variance, each
    weighted by the squared share that the quantity has in it."""
    variance = left_out.total
    excess = torch.minimum(left_out.residual.square(), scene.config.clip * variance) - variance
    once = torch.where(scene.valid, 1 / scene.counted(torch.ones_like(excess)), 0.0)
    sums = {}
    for name, part in (("roughness", running.ratio("roughness")[:, None]), ("noise", scene.stated)):
        w = once * (part / variance).square()
        unit = running.ratio(name)[:, None] / part.clamp_min(1e-12)
        sums[name] = (total(w * (part + excess) * unit, 1), total(w, 1))
    return sums


def _of_discs(scene: _Scene, weight: Tensor, claimed: Tensor, running: Running) -> dict[str, tuple[Tensor, Tensor]]:
    """Sums for amplitude, unseen and calibration from anchors whose whole region is left out."""
    held = _discs(scene, running.frames) & scene.valid
    rest = scene.valid & ~held
    held = held & (rest.sum(1, keepdim=True) >= LEAST_REST)
    field = Field.given(scene.prior, scene.observed, weight * rest)
    mean, variance = field.at(scene.observed.node, scene.observed.features)
    away = torch.gather(_away(scene, rest), 1, scene.observed.node)
    error, field_variance, variance = (scene.observed.value - mean).square(), variance, variance + scene.noise
    square = torch.minimum(error, scene.config.clip * variance)
    believed = torch.where(held, scene.believed(), 0.0)
    area = believed / scene.counted(believed).clamp_min(1e-12)
    share, b = away / scene.config.reach, field.coefficients
    offset = mean - (scene.observed.features * b[:, None]).sum(-1)
    spread = torch.gather(_spread(scene, rest, b[:, 0]), 1, scene.observed.node)
    stated = variance + away * running.ratio("unseen")[:, None]
    stated = _total(scene, stated, share, offset, spread) + share * claimed
    return {
        "amplitude": (
            total(area * (square - scene.noise) / variance, 1),
            total(area * field_variance / variance, 1) / running.ratio("amplitude"),
        ),
        "unseen": (total(area * (error - variance), 1), total(area * away, 1)),
        "calibration": (total(area * error / stated, 1), total(area, 1)),
    }


def _discs(scene: _Scene, frames: Tensor) -> Tensor:
    """[B, N] whether an anchor lies in one of the frame's discs."""
    at, discs = (scene.observed.features[..., 2:4] + 1) / 2, scene.config.discs
    inside = torch.zeros_like(scene.valid)
    for disc in range(discs):
        centre = torch.stack([((frames * discs + disc + 1) * step) % 1 for step in STEPS], -1)
        inside = inside | ((at - centre[:, None]).square().sum(-1) < scene.config.radius**2)
    return inside
