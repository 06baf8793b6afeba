"""The stages of a step between segmentation and regression, of one stream, as one compiled call each (numba)."""

from __future__ import annotations

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, kernel
from ufmstar_torch.kernels.correspond_cpu import matches
from ufmstar_torch.kernels.fuse_cpu import WORK, append, fuse_pairs
from ufmstar_torch.kernels.rigid_cpu import FIELDS, gather, padded, relative, scatter, turn


@kernel
def match(camera, started, first_before, first, mixture, segments, size, thresholds):
    """Step 3 of a stream: M_(i-1) [K] in the camera frame, and its pairs with C_i [C].

    Args:
        camera: whether the frame has no fault, camera-to-world [4, 4] and intrinsics [3, 3].
        started: whether the stream has had a frame.
        first_before, first: camera-to-world [4, 4] of the first camera; the latter is written.
        mixture, segments: mean, covariance and weight.
        size: H, W of the image.
        thresholds: of :func:`matches`: eta, eta_occl, near plane, widening.

    Returns:
        The pairs c [P], k [P] and their overlap [P]; which segments are new [C]; how many segments there are, how many
        of them are matched, how many new; the n occupied slots, which are the first ones; and these by field
        [13, n and more].
    """
    fine, present, K = camera
    mean, covariance, weight = mixture
    mean_c, cov_c, weight_c = segments
    for i in range(4):
        for j in range(4):
            first[i, j] = present[i, j] if fine and not started else first_before[i, j]
    motion, n = empty((3, 4), np.float64), 0
    relative(first, present, motion)
    while n < weight.size and weight[n] > 0:
        n += 1
    here = empty((FIELDS, padded(n)), np.float64)
    segments_here = empty((FIELDS, padded(weight_c.size)), np.float64)
    gather(n, mean, covariance, weight, here)
    turn(motion, here.shape[1], here.shape[1], here)
    gather(weight_c.size, mean_c, cov_c, weight_c, segments_here)
    c, k, overlap = matches(here, n, segments_here, weight_c.size, K, size[0], size[1], thresholds)
    new, found, matched, created = empty(weight_c.size, np.bool_), 0, 0, 0
    for i in range(new.size):
        new[i] = True
    for i in range(c.size):
        new[c[i]] = False
    for i in range(new.size):
        found += weight_c[i] > 0
        matched += not new[i]
        # A Gaussian nearer than the near plane could never be matched again: it is not appended.
        new[i] = new[i] and weight_c[i] > 0 and mean_c[i, 2] > thresholds[2]
        created += new[i]
    return c, k, overlap, new, found, matched, created, n, here


@kernel
def join(present, first, slots, segments, pairs, distance, new, occupied, settings, extra):
    """Step 4 of a stream: the mixture with the pairs fused and what is new appended, and all of it as the
    regression takes it, in the camera frame.

    Args:
        present, first: camera-to-world [4, 4].
        slots: mean, covariance, weight, disagreement, count and features [K, ...] of the mixture; changed.
        segments: mean, covariance, weight and features [C, ...] of C_i.
        pairs: c, k and overlap [P].
        distance: as :func:`fuse_pairs`.
        new: [C] which segments to append, from slot ``occupied`` on.
        settings: ``weighted`` and ``epsilon`` as :func:`fuse_pairs`.
        extra: features of the regression behind the mixture's own. The last one is that of
            ``unmeasured.before_regression``, the others are unset.

    Returns:
        The n components by field [13, n and more], their disagreement [n] and features [n, F] for the regression.
    """
    mean, covariance, weight, disagreement, count, features = slots
    mean_c, cov_c, weight_c, features_c = segments
    c, k, overlap = pairs
    work, motion = empty(WORK, np.float64), empty((3, 4), np.float64)
    moved, turned = empty(mean_c.shape, np.float64), empty(cov_c.shape, np.float64)
    relative(present, first, motion)
    by_field = empty((FIELDS, padded(weight_c.size)), np.float64)
    gather(weight_c.size, mean_c, cov_c, weight_c, by_field)
    turn(motion, by_field.shape[1], by_field.shape[1], by_field)
    scatter(weight_c.size, by_field, moved, turned)
    fuse_pairs(
        mean, covariance, weight, disagreement, count, features, moved, turned, weight_c, features_c, c, k,
        overlap, distance, settings[0], settings[1], work,
    )  # fmt: skip
    n = append(
        mean, covariance, weight, disagreement, count, features, moved, turned, weight_c, features_c, new, occupied
    )
    here = empty((FIELDS, padded(n)), np.float64)
    gather(n, mean, covariance, weight, here)
    relative(first, present, motion)
    turn(motion, here.shape[1], here.shape[1], here)
    m, more = empty(n, np.float64), empty((n, features.shape[1] + extra), np.float64)
    for i in range(n):
        m[i] = disagreement[i]
        for f in range(features.shape[1]):
            more[i, f] = features[i, f]
        more[i, more.shape[1] - 1] = 1.0 if count[i] > 1 else 0.0
    return here, m, more
