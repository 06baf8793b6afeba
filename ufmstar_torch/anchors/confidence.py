"""A network's confidence as a variance in metres: a monotone factor of V, learnt from anchors.

A confidence c orders the pixels by quality. Its unit is unknown, and so is whether large values are good or bad. At an
anchor (depth g, variance s^2) of a pixel with prediction d and variance V, the network's squared error is

    y = min((g - d)^2 / (V + s^2), 25),      with the weight w = (V / (V + s^2))^2;

y is 1 on average where V is right, and w is small for an anchor that is noisier than V. The last anchors of a stream
are divided by c into bins of equal size. The mean of each bin includes a prior of kappa anchors with y = 1,

    m = (sum w y + kappa) / (sum w + kappa).

An isotonic regression of m over the bins (Barlow and Brunk 1972), rising or falling, whichever fits better, gives the
factor h(c):

    V' = h(c) V.

Only the order of c counts: a logit, a probability and a standard deviation of the same content give the same V'.

New anchors decide whether c helps, before the map is updated with them. The mean log likelihood of their errors under
V h(c) is compared with that under V, and with that under V times the single factor that the anchors give without c.
Both gains are averaged with exponential forgetting. c is used where both means exceed their standard errors; otherwise
V' = V.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.frames.frame import LARGEST, FrameInput

# Numbers per anchor: c, y, w. Statistics of the gains: the number of frames, and, for the gain over V and over one
# factor, the sum and the sum of squares, all with exponential forgetting.
FIELDS, GAINS = 3, 5
# c is used after this many frames with a gain, and a frame has a gain from this many anchors per bin on. The mean gain
# [nat] must exceed its standard error by USEFUL; a smaller gain is rounding or useless.
FEWEST, FULL, USEFUL = 5, 4, 1e-3
# Constants, chosen on rendered tours (docs/measure_confidence.py): number of last anchors of a stream from which the
# factor is learnt, and of those of one frame at most; bins of equal size; kappa, anchors in a bin with which its factor
# counts half, and 1 the other half; age at which a frame's verdict counts half [frames]; range of the factor, whose
# upper end is the largest squared error over the variance, too.
ANCHORS, EACH, BINS, SHRINKAGE, HALF_LIFE, LEAST, MOST = 1024, 64, 16, 16.0, 20.0, 0.1, 25.0


@dataclass(frozen=True)
class Learnt:
    """Statistics of the confidence of B streams.

    Attributes:
        c, y, w: [B, N] of the last anchors, the newest last; w = 0 marks an empty entry.
        gains: [B, 5] frames, sum and sum of squares of the gain over V, and of that over one factor [nat].
    """

    c: Tensor
    y: Tensor
    w: Tensor
    gains: Tensor

    @classmethod
    def of(cls, packed: Tensor) -> Learnt:
        """From one row of numbers per stream [B, 3 N + 5]; zeros before the first frame."""
        anchors, gains = packed[:, :-GAINS], packed[:, -GAINS:]
        c, y, w = anchors.view(len(packed), FIELDS, -1).unbind(1)
        return cls(c, y, w, gains)

    def packed(self) -> Tensor:
        """[B, 3 N + 5], for :meth:`of`."""
        return torch.cat([torch.stack([self.c, self.y, self.w], 1).flatten(1), self.gains], 1)

    def added(self, c: Tensor, y: Tensor, w: Tensor) -> Learnt:
        """A copy with at most ``EACH`` anchors of a frame [B, n], evenly chosen, in place of the oldest."""
        chosen = evenly(w > 0, EACH)
        pairs = ((self.c, c), (self.y, y), (self.w, w))
        every = [torch.cat([old, torch.where(chosen, new, 0)], 1) for old, new in pairs]
        order = (every[2] > 0).to(torch.int8).argsort(dim=1, stable=True)[:, c.shape[1] :]
        return replace(self, **dict(zip("cyw", (value.gather(1, order) for value in every), strict=True)))

    def judged(self, gains: Sequence[Tensor], fresh: Tensor) -> Learnt:
        """A copy with the frame's mean gains over V and over one factor, each [B], added for the streams ``fresh``."""
        one = torch.stack([torch.ones_like(gains[0]), *(f(g) for g in gains for f in (torch.clone, torch.square))], 1)
        faded = 0.5 ** (1 / HALF_LIFE) * self.gains + one.to(self.gains)
        return replace(self, gains=torch.where(fresh[:, None], faded, self.gains))

    def gain(self) -> Tensor:
        """[B] gain in log likelihood of new anchors over the better of V and one factor, less its standard error and
        ``USEFUL`` [nat]. The confidence is used where it is positive. -inf before enough frames."""
        frames = self.gains[:, 0]
        n = frames.clamp_min(1)
        least = torch.full_like(n, torch.inf)
        for total, square in (self.gains[:, 1:3].unbind(1), self.gains[:, 3:5].unbind(1)):
            mean = total / n
            least = torch.minimum(least, mean - ((square / n - mean.square()).clamp_min(0) / n).sqrt())
        return torch.where(frames >= FEWEST * (1 - 1e-3), least - USEFUL, -torch.inf)


def evenly(valid: Tensor, limit: int) -> Tensor:
    """[B, n] True for every k-th valid entry, with the smallest k that selects at most ``limit``."""
    stride = (valid.sum(1, keepdim=True) + limit - 1) // limit
    return valid & ((valid.cumsum(1) - 1) % stride.clamp_min(1) == 0)


def factors(learnt: Learnt) -> tuple[Tensor, Tensor, Tensor]:
    """The map h: edges [B, K - 1] of the bins in c, factors [B, K], and the single factor without c [B, 1].

    Bin k holds the values c that have k edges at or below them. The edges are quantiles of the anchors' c.
    """
    learnt_from = learnt.w > 0
    ordered = torch.where(learnt_from, learnt.c, torch.inf).sort(1).values
    step = torch.arange(1, BINS, device=ordered.device) * learnt_from.sum(1, keepdim=True) // BINS
    edges = ordered.gather(1, step)
    at = torch.searchsorted(edges.contiguous(), learnt.c.contiguous(), right=True)
    w, wy = (torch.zeros_like(ordered[:, :BINS]).scatter_add(1, at, v) for v in (learnt.w, learnt.w * learnt.y))
    weight, mean = w + SHRINKAGE, (wy + SHRINKAGE) / (w + SHRINKAGE)
    rising, falling = isotonic(*(torch.cat([v, v.flip(1)]) for v in (mean, weight))).chunk(2)
    falling = falling.flip(1)
    misfit = [(weight * (mean - fitted).square()).sum(1, keepdim=True) for fitted in (rising, falling)]
    h = torch.where(misfit[0] <= misfit[1], rising, falling)
    one = (wy.sum(1, keepdim=True) + SHRINKAGE) / (w.sum(1, keepdim=True) + SHRINKAGE)
    return edges, h.clamp(LEAST, MOST), one.clamp(LEAST, MOST)


def isotonic(value: Tensor, weight: Tensor) -> Tensor:
    """The non-decreasing sequence nearest to ``value`` [B, K] by weighted squares: max over i <= k of min over j >= k
    of the weighted mean from i to j."""
    k = value.shape[1]
    upto = torch.nn.functional.pad(torch.stack([value * weight, weight]).cumsum(-1), (1, 0))
    total, weights = upto[..., None, 1:] - upto[..., :-1, None]  # [B, i, j]
    upper = torch.ones(k, k, dtype=torch.bool, device=value.device).triu()
    means = torch.where(upper, total / weights.clamp_min(torch.finfo(value.dtype).tiny), torch.inf)
    least = means.flip(-1).cummin(-1).values.flip(-1)
    return torch.where(upper, least, -torch.inf).amax(-2)


def read(c: Tensor, edges: Tensor, h: Tensor) -> Tensor:
    """h(c) at c [B, n]; 1 where c is NaN."""
    bins = torch.searchsorted(edges, c.contiguous(), right=True)
    return torch.where(c.isnan(), 1.0, h.gather(1, bins))


def after_frame(packed: Tensor, frame: FrameInput, variance: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Test the map at the frame's anchors, update it with them, and apply it.

    Args:
        packed: [B, S] the statistics of the frames before (:class:`Learnt`).
        frame: with a confidence.
        variance: V before the map [B, H, W] [m^2]; None = the map is applied but not updated.

    Returns:
        The statistics, h(c) [B, H, W], and the gain [B] (:meth:`Learnt.gain`); h is 1 where the gain is not positive.
    """
    assert frame.confidence is not None
    learnt = Learnt.of(packed)
    if variance is not None and frame.anchors is not None:
        learnt = _taught(learnt, frame.confidence, frame.anchors, variance)
    edges, h, _ = factors(learnt)
    gain = learnt.gain()
    h = torch.where(gain[:, None] > 0, h, torch.ones_like(h))
    factor = read(frame.confidence.flatten(1).to(edges), edges, h).view_as(frame.confidence)
    return learnt.packed(), factor, gain


def _taught(learnt: Learnt, confidence: Tensor, anchors: Anchors, variance: Tensor) -> Learnt:
    """The statistics after a frame's anchors."""
    dtype = learnt.c.dtype
    c = confidence.flatten(1).gather(1, anchors.index).to(dtype)
    V = variance.detach().flatten(1).gather(1, anchors.index).double()
    usable = anchors.mask & V.isfinite() & (V > 0) & ~c.isnan()
    V = torch.where(usable, V, torch.ones_like(V))
    spread = V + anchors.variance
    y = ((anchors.depth - anchors.predicted).square() / spread).clamp_max(MOST).to(dtype)
    w = torch.where(usable, (V / spread).square(), torch.zeros_like(V)).to(dtype)
    edges, h, one = factors(learnt)
    likelihood = [-0.5 * (y / f + f.log()) for f in (read(c, edges, h), torch.ones_like(one), one)]
    weight = w.sum(1)
    gains = [(w * (likelihood[0] - other)).sum(1) / weight.clamp_min(1e-6) for other in likelihood[1:]]
    enough = (learnt.w > 0).sum(1) >= FULL * BINS
    return learnt.judged(gains, enough & (weight > 0)).added(c.nan_to_num(), y, w)


SIZE = FIELDS * ANCHORS + GAINS  # numbers per stream of the statistics


def require(packed: Tensor) -> None:
    """Raise a ValueError if no anchors can have led to the statistics."""
    learnt = Learnt.of(packed)
    bad = (learnt.w < 0) | (learnt.w > 1) | (learnt.y < 0) | (learnt.y > MOST)
    if bool(bad.any()) or bool((learnt.gains[:, ::2] < 0).any()) or bool((learnt.gains.abs() > LARGEST).any()):
        raise ValueError("confidence holds impossible errors, weights or gains")
