"""The stages between segmentation and regression for one stream, one compiled call each (numba)."""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, kernel
from ufmstar_torch.kernels.cpu.correspond import matches
from ufmstar_torch.kernels.cpu.fuse import WORK, append, floor_covariance, fuse_pairs
from ufmstar_torch.kernels.cpu.rigid import FIELDS, gather, padded, relative, scatter, turn


@kernel
def lift(mean, covariance, weight, near, focal, widening, epsilon):
    """Lift the covariances of the occupied slots, which are the first ones, to the floor of a segment (``step``), in
    place: the variance across one pixel, and ``epsilon`` times the trace for storage."""
    work = empty(WORK, np.float64)
    for n in range(weight.size):
        if not weight[n] > 0:
            break
        S, across = covariance[n], max(mean[n, 2], near) / focal
        floor_covariance(S, max(across * across * widening, epsilon * (S[0, 0] + S[1, 1] + S[2, 2])), work)


@kernel
def match(camera, started, first_before, first, mixture, segments, size, thresholds):
    """Step 3 for one stream: transform M_(i-1) [K] into the camera frame and match it with C_i [C].

    Args:
        camera: True for a frame without fault, camera-to-world [4, 4] and intrinsics [3, 3].
        started: whether the stream has had a frame.
        first_before, first: camera-to-world [4, 4] of the first camera; the latter is written.
        mixture, segments: mean, covariance and weight.
        size: H, W of the image.
        thresholds: of :func:`matches`: eta, eta_occl, near plane, widening.

    Returns:
        The pairs c [P], k [P] and their overlap [P]; the mask of new segments [C]; the numbers of segments, of matched
        and of new ones; the number n of occupied slots, which are the first ones; and the occupied slots by field
        [13, n and more] in the camera frame.
    """
    valid, pose, K = camera
    mean, covariance, weight = mixture
    mean_c, cov_c, weight_c = segments
    for i in range(4):
        for j in range(4):
            first[i, j] = pose[i, j] if valid and not started else first_before[i, j]
    motion, n = empty((3, 4), np.float64), 0
    relative(first, pose, motion)
    while n < weight.size and weight[n] > 0:
        n += 1
    components = empty((FIELDS, padded(n)), np.float64)
    segment_fields = empty((FIELDS, padded(weight_c.size)), np.float64)
    gather(n, mean, covariance, weight, components)
    turn(motion, components.shape[1], components.shape[1], components)
    gather(weight_c.size, mean_c, cov_c, weight_c, segment_fields)
    c, k, overlap = matches(components, n, segment_fields, weight_c.size, K, size[0], size[1], thresholds)
    new, count, matched, created = empty(weight_c.size, np.bool_), 0, 0, 0
    for i in range(new.size):
        new[i] = True
    for i in range(c.size):
        new[c[i]] = False
    for i in range(new.size):
        count += weight_c[i] > 0
        matched += not new[i]
        # A Gaussian nearer than the near plane could never be matched again: it is not appended.
        new[i] = new[i] and weight_c[i] > 0 and mean_c[i, 2] > thresholds[2]
        created += new[i]
    return c, k, overlap, new, count, matched, created, n, components


@kernel
def join(pose, first, member, slots, segments, pairs, distance, new, occupied, settings, extra):
    """Step 4 for one stream: fuse the pairs, append the new components, and transform the mixture into the camera frame
    for the regression.

    Args:
        pose, first: camera-to-world [4, 4] of this frame and of the first.
        member: index of the network.
        slots: mean, covariance, weight, disagreement, compared, views, reference and features [K, ...] of the
            mixture; changed.
        segments: mean, covariance, weight and features [C, ...] of C_i.
        pairs: c, k and overlap [P].
        distance: as :func:`fuse_pairs`.
        new: [C] which segments to append, from slot ``occupied`` on.
        settings: as :func:`fuse_pairs`: whether weighted by overlap, epsilon, b_0 (0 = the paper) and near plane.
        extra: number of columns after the mixture's features. The last one is the feature of
            ``regress.with_measured_share``; the others are not written.

    Returns:
        The n components by field [13, n and more], their disagreement [n] and features [n, F] for the regression.
    """
    mean, covariance, weight, disagreement, compared, views, references, features = slots
    mean_c, cov_c, weight_c, features_c = segments
    c, k, overlap = pairs
    work, motion = empty(WORK, np.float64), empty((3, 4), np.float64)
    moved, turned = empty(mean_c.shape, np.float64), empty(cov_c.shape, np.float64)
    relative(pose, first, motion)
    by_field = empty((FIELDS, padded(weight_c.size)), np.float64)
    gather(weight_c.size, mean_c, cov_c, weight_c, by_field)
    turn(motion, by_field.shape[1], by_field.shape[1], by_field)
    scatter(weight_c.size, by_field, moved, turned)
    view = empty(4, np.float64)
    for i in range(3):
        view[i] = motion[i, 3]
    view[3] = member
    fuse_pairs(
        mean, covariance, weight, disagreement, compared, views, references, features, moved, turned, weight_c,
        features_c, c, k, overlap, distance, view, settings, empty(weight.size, np.float64), work,
    )  # fmt: skip
    n = append(
        mean, covariance, weight, disagreement, compared, views, references, features, moved, turned, weight_c,
        features_c, new, occupied, view, settings[2],
    )  # fmt: skip
    components = empty((FIELDS, padded(n)), np.float64)
    gather(n, mean, covariance, weight, components)
    relative(first, pose, motion)
    turn(motion, components.shape[1], components.shape[1], components)
    m, columns = empty(n, np.float64), empty((n, features.shape[1] + extra), np.float64)
    for i in range(n):
        m[i] = disagreement[i]
        for f in range(features.shape[1]):
            columns[i, f] = features[i, f]
        columns[i, columns.shape[1] - 1] = -math.expm1(-np.float64(views[i]))
    return components, m, columns
