"""The stages between segmentation and regression for one stream of a batch, one compiled call each (numba)."""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, kernel
from ufmstar_torch.kernels.cpu.correspond import matches
from ufmstar_torch.kernels.cpu.fuse import WORK, append, fuse_pairs
from ufmstar_torch.kernels.cpu.rigid import FIELDS, gather, padded, relative, scatter, turn

# Names of a step's counts by stream, and their rows.
COUNTS = ("segments", "matched", "pairs", "new", "dropped", "components", "single_view", "unmeasured")
SEGMENTS, MATCHED, PAIRS, NEW, DROPPED, COMPONENTS, SINGLE_VIEW, UNMEASURED = range(8)


@kernel
def match(b, camera, stream, mixture, segments, size, thresholds, counts):
    """Step 3 for stream ``b``: transform M_(i-1) [K] into the camera frame and match it with C_i [C].

    Args:
        camera: fault [B], camera-to-world [B, 4, 4] and intrinsics [B, 3, 3] of the frame.
        stream: T_world_first [B, 4, 4], started, frames and skipped [B] of the state; changed.
        mixture, segments: mean, covariance and weight.
        size: H, W of the image.
        thresholds: of :func:`matches`: eta, eta_occl, near plane, widening.
        counts: [8, B] its first five rows are written; the new segments are those that find a place.

    Returns:
        The pairs c and k [2, P] and their overlap [P]; the mask of new segments [C]; and the number of occupied slots,
        which are the first ones.
    """
    faults, poses, cameras = camera
    firsts, started, frames, skipped = stream
    valid, pose, first = faults[b] == 0, poses[b], firsts[b]
    mean, covariance, weight = mixture[0][b], mixture[1][b], mixture[2][b]
    mean_c, cov_c, weight_c = segments[0][b], segments[1][b], segments[2][b]
    for i in range(4):
        for j in range(4):
            first[i, j] = pose[i, j] if valid and not started[b] else first[i, j]
    started[b] = started[b] or valid
    frames[b] += valid
    skipped[b] += not valid
    motion, n = empty((3, 4), np.float64), 0
    relative(first, pose, motion)
    while n < weight.size and weight[n] > 0:
        n += 1
    components = empty((FIELDS, padded(n)), np.float64)
    segment_fields = empty((FIELDS, padded(weight_c.size)), np.float64)
    gather(n, mean, covariance, weight, components)
    turn(motion, components.shape[1], components.shape[1], components)
    gather(weight_c.size, mean_c, cov_c, weight_c, segment_fields)
    pairs, overlap = matches(components, n, segment_fields, weight_c.size, cameras[b], size[0], size[1], thresholds)
    new, count, matched, created = empty(weight_c.size, np.bool_), 0, 0, 0
    for i in range(new.size):
        new[i] = True
    for i in range(overlap.size):
        new[pairs[0, i]] = False
    for i in range(new.size):
        count += weight_c[i] > 0
        matched += not new[i]
        # A Gaussian nearer than the near plane could never be matched again: it is not appended.
        new[i] = new[i] and weight_c[i] > 0 and mean_c[i, 2] > thresholds[2]
        created += new[i]
    counts[SEGMENTS, b], counts[MATCHED, b], counts[PAIRS, b] = count, matched, overlap.size
    counts[NEW, b], counts[DROPPED, b] = created, count - matched - created
    return pairs, overlap, new, n


@kernel
def join(b, camera, first, members, slots, segments, matched, settings, width, counts):
    """Step 4 for stream ``b``: fuse the pairs, append the new components, and transform the mixture into the camera
    frame for the regression.

    Args:
        camera: fault [B], camera-to-world [B, 4, 4] and intrinsics [B, 3, 3] of the frame.
        first: camera-to-world [B, 4, 4] of the first frame.
        members: [B] index of the network.
        slots: mean, covariance, weight, disagreement, compared, views, reference and features [B, K, ...] of the
            mixture; changed.
        segments: mean, covariance, weight and features [B, C, ...] of C_i.
        matched: the result of :func:`match`.
        settings: as :func:`fuse_pairs`: whether weighted by overlap, epsilon, b_0 (0 = the paper) and near plane.
        width: number of features for the regression: the mixture's, some that are not written, and the last, that of
            ``regress.with_measured_share``.
        counts: [8, B] rows of components and of those seen in one view are written.

    Returns:
        The fields of :class:`Seen`.
    """
    pairs, overlap, new, occupied = matched
    mean, covariance, weight, disagreement = slots[0][b], slots[1][b], slots[2][b], slots[3][b]
    compared, views, references, features = slots[4][b], slots[5][b], slots[6][b], slots[7][b]
    mean_c, cov_c, weight_c, features_c = segments[0][b], segments[1][b], segments[2][b], segments[3][b]
    pose = camera[1][b]
    work, motion = empty(WORK, np.float64), empty((3, 4), np.float64)
    moved, turned = empty(mean_c.shape, np.float64), empty(cov_c.shape, np.float64)
    relative(pose, first[b], motion)
    by_field = empty((FIELDS, padded(weight_c.size)), np.float64)
    gather(weight_c.size, mean_c, cov_c, weight_c, by_field)
    turn(motion, by_field.shape[1], by_field.shape[1], by_field)
    scatter(weight_c.size, by_field, moved, turned)
    view = empty(4, np.float64)
    for i in range(3):
        view[i] = motion[i, 3]
    view[3] = members[b]
    fuse_pairs(
        mean, covariance, weight, disagreement, compared, views, references, features, moved, turned, weight_c,
        features_c, pairs[0], pairs[1], overlap, view, settings, empty(weight.size, np.float64), work,
    )  # fmt: skip
    n = append(
        mean, covariance, weight, disagreement, compared, views, references, features, moved, turned, weight_c,
        features_c, new, occupied, view, settings[2],
    )  # fmt: skip
    components, m, columns = empty((FIELDS, padded(n)), np.float64), empty(n, np.float64), empty((n, width), np.float64)
    gather(n, mean, covariance, weight, components)
    relative(first[b], pose, motion)
    turn(motion, components.shape[1], components.shape[1], components)
    alone = 0
    for i in range(n):
        m[i] = disagreement[i]
        for f in range(features.shape[1]):
            columns[i, f] = features[i, f]
        columns[i, width - 1] = -math.expm1(-np.float64(views[i]))
        alone += views[i] == 0
    counts[COMPONENTS, b], counts[SINGLE_VIEW, b] = n, alone
    return components, m, columns
