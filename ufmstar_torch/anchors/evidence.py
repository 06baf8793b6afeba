"""The network's recent error at anchors, by component and overall.

An anchor with the depth g and the variance s^2 measures the relative error r = (g - d)/d of the predicted depth d. If
the network's variance A + E covered all of its error, E[r^2] would be (A + E + s^2)/d^2. The excess

    e = r^2 - (s^2 + A + E)/d^2

is the relative mean square error that the network does not predict. It may be negative at one anchor. Its mean over
many anchors is unbiased, since expectations are linear. M already contains a part of d^2 e, the disagreement of views.
Therefore only the part beyond M is added,

    B = max(0, d^2 mean(e) - M),        M + B = max(M, d^2 mean(e)),

with the current M of the pixel. Nothing is counted twice: A, E and the anchors' noise are subtracted before the mean, M
after it. (Subtracting M at each anchor would fail where M is 0 because it is not measured yet: on a surface seen once,
and at a point that no component explains.)

No single anchor may outweigh all others. Its r is bounded, since its neighbours must support it. Its e is not bounded:
where the claimed variance c = (s^2 + A + E)/d^2 far exceeds the error, e is -c. The weight of an anchor is therefore

    w = min(1, l/c)^2,      l = min(4, n - 1) max(.02^2, mean of r^2 at the frame's n - 1 other anchors),

so that w c is at most l and vanishes for large c; l = 1 where n = 1. The weight depends on c and not on the anchor's r.
For a calibrated network, the mean of w e is therefore 0, as that of e is.

Sums of w (1, r, e) are stored for every slot of the mixture and for the stream as a whole. An anchor contributes to a
component by the component's share in explaining the predicted point, w_k = pi_k N_k / (sum pi N + pi_0). A frame with
new evidence multiplies the old evidence by a factor below 1; other frames leave it unchanged. Means shrink. The
stream's shrinks towards 0, sum/(n + kappa), so that a single anchor does not decide for all; a component's towards the
stream's, (sum_k + kappa mean)/(n_k + kappa). A point that no component explains gets the stream's mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.gaussians.fixed_order import total

SUMS = 3  # entries of a row of sums: w, w r and w e
# A wrong track differs from its neighbours. An anchor is used if at least SUPPORT of its NEIGHBOURS nearest anchors in
# the image have a similar ratio g/d. The frame's median is no reference: a network may be wrong by another factor on
# each surface, and anchors must detect a small region that differs from the rest.
NEIGHBOURS, SUPPORT = 8, 3
# [px^2] Added to the squared distance of each anchor times its index, to break ties. It exceeds the rounding of a
# squared distance in an image and is too small to change other comparisons.
TIE = 1e-6
# Logarithms of similar ratios g/d differ by at most 2.5 sigma. sigma is estimated from the lower quartile of all such
# differences of neighbours, .4506 sigma for normal errors. With 30 % wrong tracks, half of the pairs still consist of
# two right ones.
SIMILAR_SIGMAS, LOWER_QUARTILE = 2.5, 0.4506
# A claimed variance above CLAIM times the mean square error of the frame's other anchors reduces the anchor's weight.
# Anchors with a weight below COUNTS are not reported as used.
CLAIM, COUNTS = 4.0, 0.5
# Least sigma of log g/d: tracked landmarks err by about 2 %, whatever variance they state.
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
        """Pad the components to ``capacity`` slots, for a mixture that has grown."""
        missing = capacity - self.component.shape[1]
        return Evidence(torch.nn.functional.pad(self.component, (0, 0, 0, max(missing, 0))), self.overall)


def inliers(anchors: Anchors) -> Tensor:
    """[B, N] True for valid anchors that enough of their neighbours in the image support.

    A stream with at most ``SUPPORT`` valid anchors uses all of them.
    """
    n = anchors.mask.shape[1]
    few = anchors.mask.sum(1, keepdim=True) <= SUPPORT
    if n <= SUPPORT:
        return anchors.mask
    log_ratio = (anchors.depth / anchors.predicted).log()
    u, v = anchors.pixel.unbind(-1)
    distance2 = (u[:, :, None] - u[:, None]).square_().add_((v[:, :, None] - v[:, None]).square_())
    # The first of equally near neighbours wins; the choice of topk depends on the padding of a row.
    distance2 += TIE * torch.arange(n, dtype=distance2.dtype, device=few.device)
    distance2.masked_fill_(~anchors.mask[:, None], torch.inf).diagonal(dim1=1, dim2=2).fill_(torch.inf)
    distance, neighbour = distance2.topk(min(NEIGHBOURS, n - 1), dim=2, largest=False)
    paired = (distance < torch.inf) & anchors.mask[:, :, None]
    difference = (log_ratio[:, :, None] - _take(log_ratio, neighbour)).abs()
    quartile = torch.where(paired, difference, torch.nan).flatten(1).nanquantile(0.25, dim=1).nan_to_num(0.0)
    noise = anchors.variance / anchors.depth.square()  # variance of log g
    sigma2 = (quartile / LOWER_QUARTILE).square()[:, None, None] + 2 * LEAST_SIGMA**2
    similar = difference <= SIMILAR_SIGMAS * (sigma2 + noise[:, :, None] + _take(noise, neighbour)).sqrt()
    return anchors.mask & (few | ((similar & paired).sum(2) >= SUPPORT))


def _take(value: Tensor, index: Tensor) -> Tensor:
    """value[b, index[b, i, j]] of [B, N] and [B, N, M]."""
    return torch.gather(value, 1, index.flatten(1)).view(index.shape)


def observe(
    evidence: Evidence, anchors: Anchors, distribute: Callable[[Tensor], Tensor], memory: float,
    supported_by_neighbours: Callable[[Anchors], Tensor] = inliers,
) -> tuple[Evidence, Tensor]:  # fmt: skip
    """Fade the old evidence and add that of a frame.

    Args:
        evidence: of the frames before.
        anchors: of the frame.
        distribute: sums rows [B, N, 3] at the anchors' points by component to [B, K, 3], weighted by the component's
            share in explaining the point.
        memory: factor in (0, 1] of a stream's old evidence in a frame with new evidence.
        supported_by_neighbours: an implementation of :func:`inliers`.

    Returns:
        The evidence, and [B, N] True for used anchors: supported by their neighbours, with a weight of at least .5.
    """
    supported = supported_by_neighbours(anchors)
    r = anchors.depth / anchors.predicted - 1
    claim = (anchors.variance + anchors.network_variance) / anchors.predicted.square()
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
    """[B, N] w in [0, 1] from the r^2 and the claimed variance c of each anchor, and the mask of supported anchors."""
    r2 = torch.where(supported, r2, torch.zeros_like(r2))
    others = (supported.sum(1, keepdim=True) - 1).clamp_min(0)
    mean = (total(r2, 1)[:, None] - r2) / others.clamp_min(1)
    limit = others.clamp_max(CLAIM) * mean.clamp_min(LEAST_SIGMA**2)
    limit = torch.where(others > 0, limit, torch.ones_like(limit))
    return (limit / claim.clamp_min(torch.finfo(claim.dtype).tiny)).clamp_max(1).square()


def means(evidence: Evidence, shrinkage: float) -> tuple[Tensor, Tensor]:
    """Compute the mean errors of the stream, and those of each component less the stream's.

    Args:
        evidence: sums so far.
        shrinkage: kappa, in anchors: the weight of the stream's mean in a component's mean, and of 0 in the stream's.

    Returns:
        [B, K, 2] mean r and e of the components less the stream's; [B, 2] the stream's, 0 before the first anchor.
    """
    overall = evidence.overall.double()
    stream = overall[..., 1:] / (overall[..., :1] + shrinkage)
    component = evidence.component.double()
    beyond = component[..., 1:] - component[..., :1] * stream[:, None]
    return beyond / (component[..., :1] + shrinkage), stream
