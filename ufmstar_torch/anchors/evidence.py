"""The network's recent error at anchors, by component and overall.

At an anchor (depth g, variance s^2) the prediction d has the relative error r = (g - d)/d. Were the network's own
variance A + E all there is, E[r^2] = (A + E + s^2)/d^2. What is left over,

    e = r^2 - (s^2 + A + E)/d^2,

is the relative mean square error that the network does not state itself. It may be negative at one anchor; its mean
over many is unbiased, since expectations are linear. Part of d^2 e is what views disagree about, and M states that
already: only what is beyond M is added,

    B = max(0, d^2 mean(e) - M),        M + B = max(M, d^2 mean(e)),

with M as it is now at the pixel. So nothing is counted twice: A, E and the anchors' noise are taken off before, M
after. (M before, anchor by anchor, would leave nothing where M has not been measured yet: a surface seen once has M = 0
because nothing was compared, and so has a point that no component explains.)

One anchor must not outweigh all others. Its r is bounded, since its neighbours must support it; its e is not: where the
network claims a variance of c = (s^2 + A + E)/d^2 far beyond what it errs by, e is -c. An anchor's weight is therefore

    w = min(1, l/c)^2,      l = min(4, n - 1) max(.02^2, mean of r^2 at the frame's n - 1 other anchors),

so that w c is at most l, and 0 in the limit; l = 1 where n = 1. The weight follows the claim and not the anchor's own
r: with a network that is calibrated, w e is 0 on average as e is.

Sums of w (1, r, e) live beside the mixture, one row a component, and one for the stream as a whole. A component takes
an anchor by its share in explaining the predicted point, w_k = pi_k N_k / (sum pi N + pi_0). Old evidence fades by a
factor with every frame that brings new; without new evidence what was learnt stays. Means shrink: the stream's towards
0, sum/(n + kappa), so that a single anchor does not decide for all; a component's towards the stream's,
(sum_k + kappa mean)/(n_k + kappa). Where no component explains a point, the stream's mean is the answer: what the
network has been getting wrong lately, not nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ufmstar_torch.anchors.anchors import AnchorInput
from ufmstar_torch.fixed_order import total

# Entries of a row of sums.
COUNT, BIAS, EXCESS = 0, 1, 2
SUMS = 3
# A wrong track stands alone: an anchor is used where at least SUPPORT of its NEIGHBOURS nearest ones in the image
# have a similar ratio g/d. Not a distance from the frame's median: a network may be wrong by another factor on each
# surface, and a small region that differs from the rest is what anchors are to find.
NEIGHBOURS, SUPPORT = 8, 3
# [px^2] By which an anchor counts as farther away than the one given before it: more than the rounding of a squared
# distance in an image, less than can be distinguished.
TIE = 1e-6
# "Similar" is within 2.5 sigma of what neighbours differ by; sigma is from the lower quartile of all such differences,
# .4506 sigma for normal errors; with 30 % wrong tracks half of the pairs are still clean, so it is not blown up.
SIMILAR_SIGMAS, LOWER_QUARTILE = 2.5, 0.4506
# Claims of more than so many times the mean square error of the frame's other anchors count less; an anchor with less
# than COUNTS of its weight is not reported as used.
CLAIM, COUNTS = 4.0, 0.5
# Least sigma of log g/d: tracked landmarks are right to some 2 %, whatever variance they state.
LEAST_SIGMA = 0.02


@dataclass(frozen=True)
class Evidence:
    """Fading sums over anchors of w (1, r, e).

    Attributes:
        component: [B, K, 3], row k of the mixture's slot k.
        overall: [B, 3] of the stream.
    """

    component: Tensor
    overall: Tensor

    def padded(self, capacity: int) -> Evidence:
        """With room for a mixture that has grown."""
        missing = capacity - self.component.shape[1]
        return Evidence(torch.nn.functional.pad(self.component, (0, 0, 0, max(missing, 0))), self.overall)


def inliers(anchors: AnchorInput) -> Tensor:
    """[B, N] True for valid anchors that enough of their neighbours in the image support.

    With too few anchors for that many neighbours, all valid ones are used.
    """
    n = anchors.valid.shape[1]
    few = anchors.valid.sum(1, keepdim=True) <= SUPPORT
    if n <= SUPPORT:
        return anchors.valid
    log_ratio = (anchors.depth / anchors.predicted).log()
    u, v = anchors.pixel.unbind(-1)
    apart = (u[:, :, None] - u[:, None]).square_().add_((v[:, :, None] - v[:, None]).square_())
    # The first of equally near neighbours counts: topk's choice between them depends on the padding of a row.
    apart += TIE * torch.arange(n, dtype=apart.dtype, device=few.device)
    apart.masked_fill_(~anchors.valid[:, None], torch.inf).diagonal(dim1=1, dim2=2).fill_(torch.inf)
    distance, neighbour = apart.topk(min(NEIGHBOURS, n - 1), dim=2, largest=False)
    requested = (distance < torch.inf) & anchors.valid[:, :, None]
    differ = (log_ratio[:, :, None] - _take(log_ratio, neighbour)).abs()
    quartile = torch.where(requested, differ, torch.nan).flatten(1).nanquantile(0.25, dim=1).nan_to_num(0.0)
    noise = anchors.variance / anchors.depth.square()  # of log g: no reason for mistrust
    sigma2 = (quartile / LOWER_QUARTILE).square()[:, None, None] + 2 * LEAST_SIGMA**2
    similar = differ <= SIMILAR_SIGMAS * (sigma2 + noise[:, :, None] + _take(noise, neighbour)).sqrt()
    return anchors.valid & (few | ((similar & requested).sum(2) >= SUPPORT))


def _take(value: Tensor, index: Tensor) -> Tensor:
    """value[b, index[b, i, j]] of [B, N] and [B, N, M]."""
    return torch.gather(value, 1, index.flatten(1)).view(index.shape)


def observe(
    evidence: Evidence,
    anchors: AnchorInput,
    distribute: Callable[[Tensor], Tensor],
    memory: float,
    supported_by_neighbours: Callable[[AnchorInput], Tensor] = inliers,
) -> tuple[Evidence, Tensor]:
    """Let old evidence fade and add a frame's.

    Args:
        evidence: up to the frame before.
        anchors: of the frame.
        distribute: sums rows [B, N, 3] at the anchors' points by component, [B, K, 3], each row by the component's
            share in explaining the point.
        memory: in (0, 1], by which the old evidence of a stream is multiplied when there is new.
        supported_by_neighbours: an implementation of :func:`inliers`.

    Returns:
        The evidence, and [B, N] which anchors were used: supported by their neighbours, with half their weight or more.
    """
    supported = supported_by_neighbours(anchors)
    r = anchors.depth / anchors.predicted - 1
    claim = (anchors.variance + anchors.own_variance) / anchors.predicted.square()
    w = _weight(r.square(), claim, supported)
    rows = torch.stack([w, w * r, w * (r.square() - claim)], dim=-1)
    rows = torch.where(supported[..., None], rows, torch.zeros_like(rows))
    used = supported & (w >= COUNTS)
    dtype = evidence.overall.dtype
    fresh = used.any(1, keepdim=True).double()
    fade = memory * fresh + (1 - fresh)
    component = fade[..., None] * evidence.component.double() + distribute(rows)
    overall = fade * evidence.overall.double() + total(rows, 1)
    return Evidence(component.to(dtype), overall.to(dtype)), used


def _weight(r2: Tensor, claim: Tensor, supported: Tensor) -> Tensor:
    """[B, N] w in [0, 1] from each anchor's r^2, the variance c that is claimed there, and which anchors count."""
    r2 = torch.where(supported, r2, torch.zeros_like(r2))
    others = (supported.sum(1, keepdim=True) - 1).clamp_min(0)
    mean = (total(r2, 1)[:, None] - r2) / others.clamp_min(1)
    limit = others.clamp_max(CLAIM) * mean.clamp_min(LEAST_SIGMA**2)
    limit = torch.where(others > 0, limit, torch.ones_like(limit))
    return (limit / claim.clamp_min(torch.finfo(claim.dtype).tiny)).clamp_max(1).square()


def means(evidence: Evidence, shrinkage: float) -> tuple[Tensor, Tensor]:
    """Mean errors of each component beyond the stream's, and of the stream.

    Args:
        evidence: so far.
        shrinkage: kappa, the number of anchors for which the stream's mean counts in a component's, and 0 in its own.

    Returns:
        [B, K, 2] mean r and e of the components less the stream's; [B, 2] the stream's, 0 before the first anchor.
    """
    overall = evidence.overall.double()
    stream = overall[..., 1:] / (overall[..., :1] + shrinkage)
    component = evidence.component.double()
    beyond = component[..., 1:] - component[..., :1] * stream[:, None]
    return beyond / (component[..., :1] + shrinkage), stream
