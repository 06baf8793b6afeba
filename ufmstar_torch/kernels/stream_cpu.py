"""The stages of a step between segmentation and regression, of one stream, as one compiled call each (numba)."""

from __future__ import annotations

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, kernel, part, zeros
from ufmstar_torch.kernels.correspond_cpu import matches
from ufmstar_torch.kernels.fuse_cpu import append, floored, fuse_pairs
from ufmstar_torch.kernels.reach_cpu import reached
from ufmstar_torch.kernels.rigid_cpu import FIELDS, gather, move, padded, relative, turn
from ufmstar_torch.kernels.segment_image_cpu import write_gaussians


@kernel
def describe(fit, rounded, near, focal, widening, epsilon, mean, covariance, weight, count):
    """Step 2's segments (``segment_cpu.fit``) as slots [C, ...] in float64, their covariances lifted to the floor that
    the reference states (:func:`floored`).

    ``rounded`` are mean, covariance and weight [C, ...] in the dtype to which the values are rounded before.
    """
    kept, gaussians, whole = fit
    write_gaussians(kept, gaussians, whole, *rounded, count)
    m, c, pi = rounded
    for i in range(kept.size):
        weight[i] = pi[i]
        for axis in range(3):
            mean[i, axis] = m[i, axis]
    floored(m[: kept.size], c, pi[: kept.size], near, focal, widening, epsilon, covariance)


@kernel
def match(b, camera, before, after, mixture, segments, size, thresholds, reach):
    """Step 3 of stream ``b``: what the frame can reach of M_(i-1) [B, K] in the camera frame, and its pairs with C_i
    [B, C].

    Args:
        camera: fault [B], camera-to-world [B, 4, 4] and intrinsics [B, 3, 3] of this frame.
        before, after: of the state, camera-to-world [B, 4, 4] of the first camera, started, frames and skipped [B];
            ``after`` is written.
        mixture, segments: mean, covariance and weight.
        size: H, W of the image.
        thresholds: of :func:`matches`: eta, eta_occl, near plane, widening.
        reach: prior weight and epsilon of :func:`reached`.

    Returns:
        The pairs c [P], k [P] and their overlap [P]; which segments are new [C]; how many segments there are, how many
        of them are matched, how many new, and how many components the mixture had; the slots within reach [n], to
        which k refers; and these by field [13, n + C and more], with room for what is new.
    """
    fine, started = camera[0][b] == 0, before[1][b]
    present, K, first = camera[1][b], camera[2][b], after[0][b]
    for i in range(4):
        for j in range(4):
            first[i, j] = present[i, j] if fine and not started else before[0][b, i, j]
    after[1][b], after[2][b], after[3][b] = started or fine, before[2][b] + fine, before[3][b] + (not fine)
    mean, covariance, weight = mixture[0][b], mixture[1][b], mixture[2][b]
    mean_c, cov_c, weight_c = segments[0][b], segments[1][b], segments[2][b]
    motion = relative(first, present)
    near, occupied = reached(motion, mean, covariance, weight, K, size, reach[0], reach[1], weight_c.size)
    here = empty((FIELDS, padded(near.size + weight_c.size)), np.float64)
    segments_here = empty((FIELDS, padded(weight_c.size)), np.float64)
    gather(near, near.size, mean, covariance, weight, here)
    turn(motion, padded(near.size), here.shape[1], here)
    everyone = empty(weight_c.size, np.int64)
    for i in range(everyone.size):
        everyone[i] = i
    gather(everyone, weight_c.size, mean_c, cov_c, weight_c, segments_here)
    c, k, overlap = matches(here, near.size, segments_here, weight_c.size, K, *size, *thresholds)
    new, found, matched, created = empty(weight_c.size, np.bool_), 0, 0, 0
    for i in range(new.size):
        new[i] = True
    for i in range(c.size):
        new[c[i]] = False
    for i in range(new.size):
        found += weight_c[i] > 0
        matched += not new[i]
        # What is nearer than the near plane could never be matched again: it is not remembered.
        new[i] = new[i] and weight_c[i] > 0 and mean_c[i, 2] > thresholds[2]
        created += new[i]
    return c, k, overlap, new, found, matched, created, occupied, near, here


@kernel
def join(b, present, first, before, after, segments, pairs, distance, new, occupied, near, here, settings, extra):
    """Step 4 of stream ``b``: the mixture with the pairs fused and what is new appended, and what of it is within reach
    as the regression takes it, in the camera frame.

    Args:
        present, first: camera-to-world [B, 4, 4].
        before, after: mean, covariance, weight, disagreement, count and features [B, K, ...] of the mixture; ``after``,
            which may have more slots, is written.
        segments: mean, covariance, weight and features [B, C, ...] of C_i.
        pairs: c, k and overlap [P].
        distance: as :func:`fuse_pairs`.
        new: [C] which segments to append, from slot ``occupied`` on.
        near, here: the slots within reach [n], and they by field [13, n + C and more], as :func:`match` returns them;
            what has changed of the latter is written, and what is new behind it.
        settings: ``weighted`` and ``epsilon`` as :func:`fuse_pairs`.
        extra: features of the regression behind the mixture's own. The last one is that of
            ``unmeasured.before_regression``, the others are unset.

    Returns:
        The slots within reach [n], with those of the new components, their disagreement [n] and features [n, F] for the
        regression, and how many components the mixture has.
    """
    weighted, epsilon = settings
    mean_c, cov_c, weight_c, features_c = segments[0][b], segments[1][b], segments[2][b], segments[3][b]
    mean, covariance, weight, disagreement, count, features = (
        after[0][b], after[1][b], after[2][b], after[3][b], after[4][b], after[5][b],
    )  # fmt: skip
    _extend(before[0][b].reshape(-1), mean.reshape(-1))
    _extend(before[1][b].reshape(-1), covariance.reshape(-1))
    _extend(before[2][b], weight)
    _extend(before[3][b], disagreement)
    _extend(before[4][b], count)
    _extend(before[5][b].reshape(-1), features.reshape(-1))
    moved, turned = zeros(mean_c.shape, np.float64), zeros(cov_c.shape, np.float64)
    move(relative(present[b], first[b]), mean_c, cov_c, weight_c, moved, turned)
    slots, given = (mean, covariance, weight, disagreement, count, features), (moved, turned, weight_c, features_c)
    c, k, overlap = pairs
    fuse_pairs(*slots, *given, c, _at(near, k), overlap, distance, weighted, epsilon)
    components = append(*slots, *given, new, occupied)
    slots_near = empty(near.size + components - occupied, np.int64)
    for i in range(slots_near.size):
        slots_near[i] = near[i] if i < near.size else occupied + i - near.size
    _renew(relative(first[b], present[b]), slots_near, k, near.size, mean, covariance, weight, here)
    m, more = empty(slots_near.size, np.float64), empty((slots_near.size, features.shape[1] + extra), np.float64)
    for i in range(slots_near.size):
        k = slots_near[i]
        m[i] = disagreement[k]
        for f in range(features.shape[1]):
            more[i, f] = features[k, f]
        more[i, more.shape[1] - 1] = 1.0 if count[k] > 1 else 0.0
    return slots_near, m, more, components


@part
def _at(values, index):
    """``values[index]``, which takes longer to compile."""
    out = empty(index.size, np.int64)
    for i in range(index.size):
        out[i] = values[index[i]]
    return out


@part
def _extend(before, after):
    """Copy numbers, and fill those behind them with zeros."""
    for i in range(before.size):
        after[i] = before[i]
    for i in range(before.size, after.size):
        after[i] = 0


@part
def _renew(motion, slots, fused, old, mean, covariance, weight, here):
    """Write the ``fused`` columns [P] by field in the camera frame again, and those from ``old`` on."""
    columns = empty(fused.size + slots.size - old, np.int64)
    for i in range(columns.size):
        columns[i] = fused[i] if i < fused.size else old + i - fused.size
    changed = empty((FIELDS, padded(columns.size)), np.float64)
    gather(_at(slots, columns), columns.size, mean, covariance, weight, changed)
    turn(motion, changed.shape[1], changed.shape[1], changed)
    for field in range(FIELDS):
        for i in range(columns.size):
            here[field, columns[i]] = changed[field, i]


@kernel
def tally(valid, measured, half):
    """How many pixels are valid, and how many shares of what was measured are below one half."""
    pixels = below = 0
    for i in range(valid.size):
        pixels += valid[i]
    for i in range(measured.size):
        below += measured[i] < half
    return pixels, below
