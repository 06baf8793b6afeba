"""The stages of a step between segmentation and regression, of one stream, as one compiled call each (numba)."""

from __future__ import annotations

import numpy as np

from ufmstar_torch.kernels.compile_cpu import kernel, part
from ufmstar_torch.kernels.correspond_cpu import matches
from ufmstar_torch.kernels.fuse_cpu import append, floored, fuse_pairs
from ufmstar_torch.kernels.reach_cpu import reached
from ufmstar_torch.kernels.rigid_cpu import move, relative
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
def match(b, camera, before, after, mixture, segments, size, thresholds, reach, mean_cam, covariance_cam):
    """Step 3 of stream ``b``: what the frame can reach of M_(i-1) [B, K] into the camera frame, written to ``mean_cam``
    and ``covariance_cam``, and its pairs with C_i [B, C].

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
        of them are matched, how many new, and how many components the mixture had; the slots within reach [n].
    """
    fine, started = camera[0][b] == 0, before[1][b]
    present, K, first = camera[1][b], camera[2][b], after[0][b]
    for i in range(4):
        for j in range(4):
            first[i, j] = present[i, j] if fine and not started else before[0][b, i, j]
    after[1][b], after[2][b], after[3][b] = started or fine, before[2][b] + fine, before[3][b] + (not fine)
    mean, covariance, weight = mixture[0][b], mixture[1][b], mixture[2][b]
    mean_c, cov_c, weight_c = segments[0][b], segments[1][b], segments[2][b]
    moved, turned = mean_cam[b], covariance_cam[b]
    motion, pi, chosen = relative(first, present), np.zeros(weight.size), np.zeros(weight.size, np.bool_)
    near, occupied = reached(motion, mean, covariance, weight, K, size, reach[0], reach[1], weight_c.size)
    for k in near:
        pi[k], chosen[k] = weight[k], True
    for k in range(weight.size):
        for i in range(3):
            moved[k, i] = 0.0
            for j in range(3):
                turned[k, i, j] = 0.0
    move(motion, mean, covariance, weight, weight.size, chosen, moved, turned)
    c, k, overlap = matches(near, moved, turned, pi, mean_c, cov_c, weight_c, K, *size, *thresholds)
    new, found, matched, created = np.ones(weight_c.size, np.bool_), 0, 0, 0
    for i in range(c.size):
        new[c[i]] = False
    for i in range(new.size):
        found += weight_c[i] > 0
        matched += not new[i]
        # What is nearer than the near plane could never be matched again: it is not remembered.
        new[i] = new[i] and weight_c[i] > 0 and mean_c[i, 2] > thresholds[2]
        created += new[i]
    return c, k, overlap, new, found, matched, created, occupied, near


@kernel
def join(b, present, first, before, after, segments, pairs, distance, new, occupied, near, settings, regressed):
    """Step 4 of stream ``b``: the mixture with the pairs fused and what is new appended, and the same in float64 as the
    regression takes it, in the camera frame.

    Args:
        present, first: camera-to-world [B, 4, 4].
        before, after: mean, covariance, weight, disagreement, count and features [B, K, ...] of the mixture; ``after``,
            which may have more slots, is written.
        segments: mean, covariance, weight and features [B, C, ...] of C_i.
        pairs: c, k and overlap [P].
        distance: as :func:`fuse_pairs`.
        new: [C] which segments to append, from slot ``occupied`` on.
        near: the slots within reach [n] of :func:`match`.
        settings: ``weighted`` and ``epsilon`` as :func:`fuse_pairs`; the disagreement [m^2] of what was seen from one
            view, negative for its own.
        regressed: mean, covariance, weight, disagreement and features [B, K, ...] for the regression, the last feature
            as ``unmeasured.before_regression``, others behind the mixture's own unset. Its mean and covariance are
            those of :func:`match`; what has changed is written, and the rest of the fields.

    Returns:
        The slots within reach, with those of the new components, and how many components the mixture has.
    """
    weighted, epsilon, stated = settings
    mean_c, cov_c, weight_c, features_c = segments[0][b], segments[1][b], segments[2][b], segments[3][b]
    mean, covariance, weight, disagreement, count, features = (
        after[0][b], after[1][b], after[2][b], after[3][b], after[4][b], after[5][b],
    )  # fmt: skip
    _extend(before[0][b], mean)
    _extend(before[1][b].reshape(-1, 9), covariance.reshape(-1, 9))
    _extend(before[5][b], features)
    for k in range(weight.size):
        old = k < before[2].shape[1]
        weight[k] = before[2][b, k] if old else 0
        disagreement[k] = before[3][b, k] if old else 0
        count[k] = before[4][b, k] if old else 0
    moved, turned = np.zeros(mean_c.shape), np.zeros(cov_c.shape)
    move(relative(present[b], first[b]), mean_c, cov_c, weight_c, 0, np.empty(0, np.bool_), moved, turned)
    changed = np.zeros(weight.size, np.bool_)
    slots, given = (mean, covariance, weight, disagreement, count, features), (moved, turned, weight_c, features_c)
    fuse_pairs(*slots, *given, *pairs, distance, weighted, epsilon, changed)
    dropped = append(*slots, *given, new, occupied)
    motion = relative(first[b], present[b])
    move(motion, mean, covariance, weight, occupied, changed, regressed[0][b], regressed[1][b])
    more, last = regressed[4][b], features.shape[1]
    for k in range(weight.size):
        seen_again = count[k] > 1
        regressed[2][b, k] = weight[k]
        regressed[3][b, k] = disagreement[k] if seen_again or stated < 0 else stated
        for f in range(last):
            more[k, f] = features[k, f]
        more[k, more.shape[1] - 1] = 1.0 if seen_again else 0.0
    components = occupied - dropped
    for c in range(new.size):
        components += new[c]
    slots_near = np.empty(near.size + components - occupied, np.int64)
    for i in range(slots_near.size):
        slots_near[i] = near[i] if i < near.size else occupied + i - near.size
    return slots_near, components


@part
def _extend(before, after):
    """Copy the slots [K, n], and fill the others with zeros."""
    for k in range(after.shape[0]):
        for i in range(after.shape[1]):
            after[k, i] = before[k, i] if k < before.shape[0] else 0


@kernel
def tally(valid, measured, half):
    """How many pixels are valid, and how many shares of what was measured are below one half."""
    pixels = below = 0
    for i in range(valid.size):
        pixels += valid[i]
    for i in range(measured.size):
        below += measured[i] < half
    return pixels, below
