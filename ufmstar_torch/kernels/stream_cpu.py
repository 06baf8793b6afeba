"""The stages of a step between segmentation and regression, of one stream, as one compiled call each (numba)."""

from __future__ import annotations

import numpy as np

from ufmstar_torch.kernels.compile_cpu import kernel
from ufmstar_torch.kernels.correspond_cpu import matches
from ufmstar_torch.kernels.fuse_cpu import append, floored, fuse_pairs
from ufmstar_torch.kernels.occlude_cpu import visible
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
def match(
    first, present, mean, covariance, weight, mean_c, cov_c, weight_c, K, depth, thresholds, reach, mean_cam,
    covariance_cam,
):  # fmt: skip
    """Step 3: what the frame can reach of M_(i-1) [K] into the camera frame, written to ``mean_cam`` and
    ``covariance_cam``, and its pairs with C_i [C].

    Args:
        first, present: [4, 4] camera-to-world of the stream's first camera and of this one.
        depth: [H, W], 0 where there is none.
        thresholds: of :func:`matches`: eta, eta_occl, near plane, widening.
        reach: prior weight, epsilon of :func:`reached`, and ratio of :func:`visible` (infinite: nothing is hidden).

    Returns:
        The pairs c [P], k [P] and their overlap [P]; which segments are new [C]; how many segments there are, how many
        of them are matched, how many new, and how many components the mixture had; the slots within reach [n].
    """
    motion, pi, chosen = relative(first, present), np.zeros(weight.size), np.zeros(weight.size, np.bool_)
    near, occupied = reached(motion, mean, covariance, weight, K, depth.shape, reach[0], reach[1], weight_c.size)
    for k in near:
        pi[k], chosen[k] = weight[k], True
    move(motion, mean, covariance, weight, weight.size, chosen, mean_cam, covariance_cam)
    if reach[2] < np.inf:
        near = visible(near, pi, mean_cam, covariance_cam, K, depth, reach[2], reach[0])
    c, k, overlap = matches(near, mean_cam, covariance_cam, pi, mean_c, cov_c, weight_c, K, *depth.shape, *thresholds)
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
def join(first, present, slots, segments, pairs, distance, new, occupied, weighted, epsilon, mean_cam, covariance_cam):
    """Step 4 in place: fuse the pairs, append what is new, and bring into the camera frame what has changed.

    Args:
        first, present, mean_cam, covariance_cam: as :func:`match`.
        slots: mean, covariance, weight, disagreement, count and features [K, ...] of the mixture.
        segments: mean, covariance, weight and features [C, ...] of C_i.
        pairs: c, k and overlap [P].
        distance, weighted, epsilon: as :func:`fuse_pairs`.
        new: [C] which segments to append, from slot ``occupied`` on.

    Returns:
        How many segments found no free slot.
    """
    mean_c, cov_c, weight_c, features_c = segments
    moved, turned = np.zeros(mean_c.shape), np.zeros(cov_c.shape)
    move(relative(present, first), mean_c, cov_c, weight_c, 0, np.empty(0, np.bool_), moved, turned)
    changed = np.zeros(slots[2].size, np.bool_)
    given = (moved, turned, weight_c, features_c)
    fuse_pairs(*slots, *given, *pairs, distance, weighted, epsilon, changed)
    dropped = append(*slots, *given, new, occupied)
    mean, covariance, weight = slots[:3]
    move(relative(first, present), mean, covariance, weight, occupied, changed, mean_cam, covariance_cam)
    return dropped
