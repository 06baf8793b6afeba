"""One frame: p(depth | network, UfM*, anchors), and what the stream learns from it.

At an anchor of depth g the network's error is y = log(g/d). Over the image it is modelled as

    y = b . (1, log d - m_0, u, v) + hats + f,

with b carried from frame to frame as a random walk, three by three coarse bilinear hats, and a Gaussian field f on a
grid whose links loosen across edges of the predicted depth (``grid``, ``field``). An anchor observes it with the
variance

    n = roughness + blur^2 + noise s^2/g^2,

where blur is half the range of log d among the pixel's neighbours, and ``noise`` the factor by which anchors state
their variances too small. The error of an anchor without parallax is normal in 1/g and not in log g: with t the
prediction beyond the anchor, its part of n is divided by (1 - e^-t) e^-t / t, so that a weak anchor pulls what is too
near, and hardly what is too far. Two rounds of Student-t weights (5/(4 + z^2), z from the leave-one-out residual) take
outliers out.

Variance of y at a node:

    local/2 (the field's + roughness) + .03^2 + distance (.02 + unseen) + .45 share V/d^2 + (.03 + .08 share) tail

with share = min(1, distance/.6).

``local`` is the mean z^2 of the leave-one-out residuals of the anchors in the cells around: the error is rougher on one
surface than on another. The distance from evidence is geodesic, in widths of the image, and depth edges lengthen it: on
tours the variance of the error grows in proportion to it. All amplitudes are learnt (``running``) from anchors of three
discs that move over the image: the field is fitted without them, and they count by area and not by number, since
corners cluster on what is well textured. ``unseen`` is what their squared error is beyond the rest, over their
distance. V = M + A + E counts where evidence is far. .03^2 is the common scale of the poses.

``tail`` is the second moment about the posterior depth if the local correction o, hats + f, does not hold, because the
evidence is wrong or lies on another surface. Then y - b . x is normal with the variance a, and the depth log-normal:

    tail = E[(e^(n - o) - 1)^2] = q^2 e^(2 a) - 2 q e^(a/2) + 1,      q = e^-o <= 4,      n ~ N(0, a).

a is .04 and 1.6 times the variance of the anchors' y around, of a Gaussian window. So no pixel is more certain than
contradictory evidence allows, and a depth that was pulled far below the global correction is less certain than one
above it.

A stream that is given anchors of which none was valid so far has that variance without evidence, about the network's
depth: nothing was measured, and nothing reads as certain. A stream without anchors is UfM*'s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ufmstar_torch.anchors.given import AnchorInput
from ufmstar_torch.fixed_order import total
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.posterior.distance import distance
from ufmstar_torch.posterior.field import Field, Observed, Prior
from ufmstar_torch.posterior.grid import Grid
from ufmstar_torch.posterior.model import FEATURES, GLOBALS, MODEL
from ufmstar_torch.posterior.read import read
from ufmstar_torch.posterior.running import RATIOS, Running


class PosteriorUpdate(Protocol):
    """See :func:`update`; ``kernels/posterior_cpu`` is the compiled one."""

    def __call__(
        self, packed: Tensor, frame: FrameInput, anchors: AnchorInput | None, claimed: Tensor, /
    ) -> tuple[Tensor, Posterior]: ...


@dataclass(frozen=True)
class Posterior:
    """Of B streams.

    Attributes:
        depth: [B, H, W] [m]; as predicted before the first anchor. NaN where not valid.
        variance: [B, H, W] [m^2]; UfM*'s where no anchors were ever given.
        calibration: [B] mean z^2 of held-out anchors lately: 1 = as predicted, more = too certain; NaN before any.
        unseen: [B] variance of y a width of the image from evidence.
    """

    depth: Tensor
    variance: Tensor
    calibration: Tensor
    unseen: Tensor


@dataclass(frozen=True)
class _Scene:
    """A frame's nodes and anchors, before they are fitted.

    Attributes:
        grid: the nodes.
        prior: of b and f.
        observed: the anchors.
        stated: [B, N] noise s^2/g^2 of y, as learnt.
        other: [B, N] roughness and blur^2.
        valid: [B, N] bool.
    """

    grid: Grid
    prior: Prior
    observed: Observed
    stated: Tensor
    other: Tensor
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
        other = running.ratio("roughness")[:, None] + (_range(frame, anchors) / 2).square()
        return cls(grid, _prior(grid, running), observed, stated, other, anchors.valid)

    def counted(self, values: Tensor) -> Tensor:
        """[B, N] values, summed over the anchors of the same cell."""
        kept = torch.where(self.valid, values, torch.zeros_like(values))
        nodes = torch.zeros_like(self.grid.log_depth).scatter_add(1, self.observed.node, kept)
        return torch.gather(nodes, 1, self.observed.node)

    def believed(self, near: _Near) -> Tensor:
        """[B, N] by how much an anchor counts for what is learnt: less the noisier it is, 0 where not valid."""
        return torch.where(self.valid, 1 / (1 + near.noise / MODEL.weak**2), torch.zeros_like(near.noise))


@dataclass(frozen=True)
class _Near:
    """What the anchors say of each other.

    Attributes:
        noise: [B, N] n, without parallax as it counts for the present residual.
        left_out: [B, N] residual from the field of the other anchors.
        total: [B, N] variance that is predicted for it.
    """

    noise: Tensor
    left_out: Tensor
    total: Tensor


def update(
    packed: Tensor,
    frame: FrameInput,
    anchors: AnchorInput | None,
    claimed: Tensor,
) -> tuple[Tensor, Posterior]:
    """Process a frame.

    Args:
        packed: [B, running.SIZE] what was learnt; not modified.
        frame: checked.
        anchors: of the frame, or None.
        claimed: [B, H, W] V of UfM* without B [m^2], NaN where not valid.

    Returns:
        What was learnt up to this frame, and the posterior. A stream without a usable anchor keeps its state.
    """
    given = anchors is not None
    anchors = anchors if anchors is not None and anchors.valid.shape[1] else _none(frame)
    running, grid, claimed_share = Running.of(packed), Grid.of(frame), MODEL.claimed * claimed.nan_to_num()
    scene = _Scene.of(grid, frame, anchors, running)
    field, weight, near = _fitted(scene)
    away = _away(scene, anchors.valid & (weight * MODEL.evidence**2 >= 1))
    share = (away / MODEL.far).clamp_max(1)
    after = _learnt(scene, field, weight, near, _relative(claimed_share, frame, anchors), running)
    features, b = grid.features(), field.coefficients
    mean, variance = field.at(torch.arange(features.shape[1], device=b.device).expand_as(share), features)
    offset = mean - (features[..., :GLOBALS] * b[:, None, :GLOBALS]).sum(-1)
    variance = MODEL.inflation * _local(scene, near) * (variance + running.ratio("roughness")[:, None])
    variance = variance + MODEL.common + away * running.growth()[:, None]
    variance = variance + _tail(share, offset, _spread(scene, near, anchors.valid, b[:, 0]))
    nodes = torch.stack([grid.log_depth, offset, variance, share], -1)
    depth, spread = read(frame.depth, frame.valid, claimed_share, nodes, b[:, :GLOBALS], grid.mean, grid.size)
    some = anchors.valid.any(1)
    known = (some | (running.frames > 0) | given)[:, None, None]
    plain = torch.where(frame.valid, frame.depth, torch.nan)
    kept = torch.where(some[:, None], after.packed().to(packed.dtype), packed)
    now = Running.of(kept)
    calibration = torch.where(now.below["calibration"] > 0, now.ratio("calibration"), torch.nan)
    return kept, Posterior(
        torch.where(known, depth, plain), torch.where(known, spread, claimed), calibration, now.growth()
    )


def _none(frame: FrameInput) -> AnchorInput:
    """One anchor a stream that is not valid."""
    b, like = len(frame.depth), frame.intrinsics
    one, zero = like.new_ones(b, 1), like.new_zeros(b, 1)
    index = torch.zeros(b, 1, dtype=torch.int64, device=like.device)
    return AnchorInput(like.new_zeros(b, 1, 2), index, one, one, zero, zero, index.bool())


def _prior(grid: Grid, running: Running) -> Prior:
    """Of b and f, in the frame to come."""
    amplitude = running.ratio("amplitude")[:, None]
    mean, covariance = running.expected(grid.mean)
    b, hats = len(mean), FEATURES - GLOBALS
    P = covariance.new_zeros(b, FEATURES, FEATURES)
    P[:, :GLOBALS, :GLOBALS] = torch.linalg.inv_ex(covariance).inverse
    P[:, GLOBALS:, GLOBALS:] = torch.diag_embed((1 / (MODEL.hat * amplitude)).expand(b, hats))
    return Prior(
        (MODEL.kappa / amplitude).expand_as(grid.log_depth), 1 / (grid.right * amplitude), 1 / (grid.down * amplitude),
        torch.nn.functional.pad(mean, (0, hats)), P, grid.size[1],
    )  # fmt: skip


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


def _fitted(scene: _Scene) -> tuple[Field, Tensor, _Near]:
    """The field, the anchors' weights in it, and what they say of each other."""
    zero = torch.zeros_like(scene.stated)
    weight = torch.where(scene.valid, 1 / (scene.stated + scene.other), zero)
    for round_ in range(MODEL.rounds + 1):
        field = Field.given(scene.prior, scene.observed, weight)
        mean, variance = field.at(scene.observed.node, scene.observed.features)
        left = (1 - weight * variance).clamp_min(MODEL.least_left)
        residual, variance = (scene.observed.value - mean) / left, variance / left
        noise = scene.other + scene.stated / _pull(-residual)
        near = _Near(noise, residual, variance + noise)
        if round_ < MODEL.rounds:
            student = (MODEL.student + 1) / (MODEL.student + residual.square() / near.total)
            weight = torch.where(scene.valid, student / noise, zero)
    return field, weight, near


def _pull(t: Tensor) -> Tensor:
    """(1 - e^-t) e^-t / t, the weight of an anchor from which the prediction is t beyond in log depth."""
    t = t.clamp(MODEL.nearer, MODEL.farther)
    small = t.abs() < 1e-3
    safe = torch.where(small, torch.ones_like(t), t)
    return torch.where(small, 1 - 1.5 * t, -torch.expm1(-safe) * torch.exp(-safe) / safe)


def _local(scene: _Scene, near: _Near) -> Tensor:
    """[B, n] mean z^2 of the leave-one-out residuals around every node."""
    each = scene.believed(near) / scene.counted(torch.ones_like(near.noise)).clamp_min(1)
    z2 = (near.left_out.square() / near.total).clamp_max(MODEL.clip)
    nodes = torch.zeros(2, *scene.grid.log_depth.shape, dtype=each.dtype, device=each.device)
    nodes = nodes.scatter_add(2, scene.observed.node.expand(2, -1, -1), torch.stack([each * z2, each]))
    side = 2 * MODEL.near + 1
    around = avg_pool2d(nodes.unflatten(2, scene.grid.size), side, 1, MODEL.near, divisor_override=1).flatten(2)
    return (around[0] + MODEL.alone) / (around[1] + MODEL.alone)


def _spread(scene: _Scene, near: _Near, used: Tensor, mean: Tensor) -> Tensor:
    """[B, n] variance of y among the anchors of the mask [B, N] around every node, with a prior about ``mean`` [B]."""
    each = torch.where(used, scene.believed(near) / scene.counted(torch.ones_like(near.noise)).clamp_min(1), 0.0)
    y, (rows, cols) = scene.observed.value, scene.grid.size
    nodes = torch.zeros(3, *scene.grid.log_depth.shape, dtype=each.dtype, device=each.device)
    values = torch.stack([each, each * y, each * y.square()])
    nodes = nodes.scatter_add(2, scene.observed.node.expand(3, -1, -1), values).unflatten(2, (rows, cols))
    around = (_window(rows, mean) @ nodes @ _window(cols, mean)).flatten(2)
    centre, prior = mean[:, None], MODEL.prior[0] ** 2
    total = around[0] + MODEL.few
    middle = (around[1] + MODEL.few * centre) / total
    return ((around[2] + MODEL.few * (centre.square() + prior)) / total - middle.square()).clamp_min(0)


def _window(count: int, like: Tensor) -> Tensor:
    """[count, count] weight of a row of nodes, or column, for another one."""
    at = torch.arange(count, dtype=like.dtype, device=like.device) / count
    return (-((at[:, None] - at) / MODEL.window).square() / 2).exp()


def _tail(share: Tensor, offset: Tensor, spread: Tensor) -> Tensor:
    """Variance over the squared depth by what the local correction ``offset`` may have wrong."""
    a, q = MODEL.least_spread + MODEL.spread * spread, (-offset).clamp_max(MODEL.most).exp()
    second = q.square() * (2 * a).exp() - 2 * q * (a / 2).exp() + 1
    return (MODEL.wrong + MODEL.other * share) * second


def _away(scene: _Scene, evidence: Tensor) -> Tensor:
    """[B, n] how far every node is from the anchors of the mask [B, N], in widths of the image."""
    grid = scene.grid
    source = torch.zeros_like(grid.log_depth).scatter_add(1, scene.observed.node, evidence.to(grid.log_depth)) > 0
    return distance(source, grid.far_right, grid.far_down, grid.size[1], MODEL.limit)


def _relative(claimed: Tensor, frame: FrameInput, anchors: AnchorInput) -> Tensor:
    """[B, N] V/d^2 at the anchors."""
    at = torch.gather(claimed.flatten(1), 1, anchors.index).double()
    return torch.where(anchors.valid, at / anchors.predicted.square(), torch.zeros_like(at))


def _learnt(
    scene: _Scene, field: Field, weight: Tensor, near: _Near, claimed: Tensor, running: Running,
) -> Running:  # fmt: skip
    """What is known after the frame."""
    sums = _of_neighbours(scene, near, running) | _of_discs(scene, weight, near, claimed, running)
    added = {name: running.added(name, *sums[name]) for name in RATIOS}
    return Running(
        running.frames + 1, scene.grid.mean,
        {name: above for name, (above, _) in added.items()}, {name: below for name, (_, below) in added.items()},
        field.coefficients[:, :GLOBALS], field.covariance[:, :GLOBALS, :GLOBALS],
    )  # fmt: skip


def _of_neighbours(scene: _Scene, near: _Near, running: Running) -> dict[str, tuple[Tensor, Tensor]]:
    """Sums for roughness and noise from leave-one-out residuals: what they are beyond the rest of their variance, each
    weighted by the squared share that the quantity has in it."""
    square = torch.minimum(near.left_out.square(), MODEL.clip * near.total) / MODEL.clipped
    excess, once = square - near.total, torch.where(scene.valid, 1 / scene.counted(torch.ones_like(square)), 0.0)
    sums = {}
    for name, part in (("roughness", running.ratio("roughness")[:, None]), ("noise", scene.stated)):
        w = once * (part / near.total).square()
        unit = running.ratio(name)[:, None] / part.clamp_min(1e-12)
        sums[name] = (total(w * (part + excess) * unit, 1), total(w, 1))
    return sums


def _of_discs(
    scene: _Scene, weight: Tensor, near: _Near, claimed: Tensor, running: Running
) -> dict[str, tuple[Tensor, Tensor]]:
    """Sums for amplitude, unseen and calibration from anchors whose whole region is left out."""
    held = _discs(scene, running.frames) & scene.valid
    rest = scene.valid & ~held
    held = held & (rest.sum(1, keepdim=True) >= MODEL.left)
    field = Field.given(scene.prior, scene.observed, weight * rest)
    mean, variance = field.at(scene.observed.node, scene.observed.features)
    away = torch.gather(_away(scene, rest), 1, scene.observed.node)
    tot = variance + near.noise
    error = (scene.observed.value - mean).square()
    square = torch.minimum(error, MODEL.clip * tot) / MODEL.clipped
    believed = torch.where(held, scene.believed(near), 0.0)
    area = believed / scene.counted(believed).clamp_min(1e-12)
    final = MODEL.inflation * variance + near.noise + MODEL.common + away * running.growth()[:, None]
    b, share = field.coefficients, (away / MODEL.far).clamp_max(1)
    offset = mean - (scene.observed.features[..., :GLOBALS] * b[:, None, :GLOBALS]).sum(-1)
    spread = torch.gather(_spread(scene, near, rest, b[:, 0]), 1, scene.observed.node)
    final = final + share * claimed + _tail(share, offset, spread)
    return {
        "amplitude": (
            total(area * (square - near.noise) / tot, 1),
            total(area * variance / tot, 1) / running.ratio("amplitude"),
        ),
        "unseen": (total(area * (error.clamp_max(MODEL.square) - tot), 1), total(area * away, 1)),
        "calibration": (total(area * error / final, 1), total(area, 1)),
    }


def _discs(scene: _Scene, frames: Tensor) -> Tensor:
    """[B, N] whether an anchor lies in one of the frame's discs."""
    at = (scene.observed.features[..., 2:4] + 1) / 2
    inside = torch.zeros_like(scene.valid)
    for disc in range(MODEL.discs):
        centre = torch.stack(
            [((frames * MODEL.discs + disc + 1) * step) % 1 for step in (MODEL.step_u, MODEL.step_v)], -1
        )
        inside = inside | ((at - centre[:, None]).square().sum(-1) < MODEL.radius**2)
    return inside
