"""Triangulation against closed forms, and the tracker of corners."""

from __future__ import annotations

from itertools import islice

import cv2
import numpy as np
import oracle_triangulate
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from landmark_runs import walk
from scipy.spatial.transform import Rotation

from ufmstar_torch.anchors.kernels.epipolar import off_line, on_lines, weighted_quantile
from ufmstar_torch.anchors.kernels.numbers import finite, median
from ufmstar_torch.anchors.kernels.tracks import brightness_ratio, cover, predict
from ufmstar_torch.anchors.kernels.triangulate import triangulate
from ufmstar_torch.anchors.tracker import LandmarkTracker
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.gaussians.camera import resize_intrinsics
from ufmstar_torch.kernels.compile_cpu import reordered

HERE = np.array([1000.0, -500.0, 20.0])  # far from the world's origin
K = np.array([[300.0, 0, 160], [0, 310, 120], [0, 0, 1]])


def views(count, seed, spread=0.5):
    """Poses near the origin that look along z, far from the world's origin."""
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(0.05 * rng.standard_normal((count, 3))).as_matrix()
    T[:, :3, 3] = spread * rng.standard_normal((count, 3)) * [1, 1, 0.3] + HERE
    return T


def seen_from(points, T):
    cam = np.einsum("wji,nwj->nwi", T[:, :3, :3], points[:, None] - T[:, :3, 3])
    return cam[..., :2] / cam[..., 2:] * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]


def world_points(count, seed):
    rng = np.random.default_rng(seed + 1)
    return rng.uniform([-1, -1, 2], [1, 1, 6], (count, 3)) + HERE


@given(st.integers(0, 10**6), st.integers(2, 10))
def test_exact_tracks_give_exact_points(seed, count):
    T, points = views(count, seed), world_points(7, seed)
    seen = np.random.default_rng(seed).random((7, count)) < 0.8
    seen[:, :2] = True
    baseline = np.linalg.norm(T[0, :3, 3] - T[1, :3, 3])
    if baseline < 0.1:
        return
    result = triangulate(seen_from(points, T), seen, T, K)
    np.testing.assert_allclose(result.point, points, atol=1e-7)
    assert result.ahead.all()
    assert result.error.max() < 1e-6
    # The values at unseen views have no effect.
    spoiled = np.where(seen[..., None], seen_from(points, T), 1e4)
    np.testing.assert_allclose(triangulate(spoiled, seen, T, K).point, result.point, atol=1e-9)


@given(st.integers(0, 10**6))
@settings(max_examples=15)
def test_the_compiled_twin_agrees(seed):
    T, points = views(5, seed), world_points(9, seed)
    rng = np.random.default_rng(seed)
    seen = rng.random((9, 5)) < 0.7
    seen[:, :2] = True
    if np.linalg.norm(T[0, :3, 3] - T[1, :3, 3]) < 0.1:
        return
    pixel = seen_from(points, T) + 0.5 * rng.standard_normal((9, 5, 2))
    skewed = K + np.array([[0, 3.0, 0], [0, 0, 0], [0, 0, 0]])
    slow, fast = (f(pixel, seen, T, skewed) for f in (oracle_triangulate.triangulate, triangulate))
    np.testing.assert_allclose(fast.point, slow.point, rtol=0, atol=1e-7)
    np.testing.assert_allclose(fast.covariance, slow.covariance, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(fast.error, slow.error, rtol=1e-7)
    np.testing.assert_array_equal(fast.ahead, slow.ahead)


def test_two_views_side_by_side_in_closed_form():
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 0.1
    pixel = np.array([[[160.0, 120.0], [145.0, 120.0]]])  # a disparity of 15 px: z = f b/15
    result = triangulate(pixel, np.ones((1, 2), dtype=bool), T, K)
    np.testing.assert_allclose(result.point[0], [0, 0, 300 * 0.1 / 15], atol=1e-9)
    # dz = z^2/(f b) d(disparity), whose variance is 2 px^2
    np.testing.assert_allclose(result.covariance[0, 2, 2], 2 * (4 / 30) ** 2, rtol=1e-2)
    assert result.ahead[0]
    assert not triangulate(pixel[:, ::-1], np.ones((1, 2), dtype=bool), T, K).ahead[0], "behind the cameras"


def test_every_reason_for_no_landmark():
    tracker, frame = LandmarkTracker(), walk()[0]
    arguments = frame.T_world_cam, frame.intrinsics
    assert tracker.update(frame.image, *arguments).none == "no corner followed from the frame before"
    assert tracker.update(frame.image, *arguments).none == "no parallax, or no track that fits the poses"
    assert tracker.update(0 * frame.image, *arguments).none == "no corner followed from the frame before"


def test_anchors_lie_on_the_depth_map():
    tracker = LandmarkTracker()
    for frame in walk()[:8]:
        result = tracker.update(frame.image, frame.T_world_cam, frame.intrinsics)
    small = resize_intrinsics(torch.from_numpy(frame.intrinsics), (180, 240), (90, 120))
    anchors = result.anchors(frame.intrinsics, small)
    assert anchors.valid.sum() == len(result.depth)
    np.testing.assert_allclose(anchors.pixel[0].numpy(), (result.pixel + 0.5) / 2 - 0.5, atol=1e-9)
    np.testing.assert_array_equal(anchors.variance[0].numpy(), result.variance)


@pytest.mark.parametrize("turned", [0.0, 0.2])
def test_matches_lie_on_the_part_of_the_line_where_points_of_the_scene_are(turned):
    rng, T, before = np.random.default_rng(0), np.eye(4), np.eye(4)
    before[:3, :3], before[0, 3] = Rotation.from_rotvec([0, turned, 0]).as_matrix(), 0.2
    points = rng.uniform([-1, -1, 2], [1, 1, 6], (50, 3))
    now, then = seen_from(points, np.stack([T, before])).transpose(1, 0, 2)

    def off(match):
        cameras = T, before, K, np.linalg.inv(K), 0.1, 30.0
        distance, rho, baseline = np.array([off_line(*one, *cameras) for one in zip(now, match, strict=True)]).T
        np.testing.assert_allclose(baseline, 0.2)
        return np.median(distance), rho

    distance, rho = off(then)
    assert distance < 1e-6
    np.testing.assert_allclose(rho, 1 / points[:, 2], rtol=1e-9)
    assert abs(off(then + np.array([0, 1.5]))[0] - 1.5) < 0.3, "across the line, nearly"
    assert off(2 * seen_from(1e9 * points, before[None])[:, 0] - then)[0] > 5, "backwards: a baseline of 7 to 30 px"
    assert off(seen_from(1e9 * points, before[None])[:, 0])[0] > 1.5, "no motion except the rotation's"


def test_few_corners_of_a_camera_that_turns_are_none():
    """With a baseline of 2 cm most corners have too little parallax; larger parallax is due to errors."""
    tracker, used = LandmarkTracker(), []
    for frame in islice(open_sequence("tour:832?style=blank&pan=1&frames=30&size=240x320"), 18):
        marks = tracker.update(frame.image, frame.T_world_cam, frame.intrinsics)
        u, v = np.rint(marks.pixel).astype(int).T
        truth = frame.depth[v, u]
        used.append(len(truth))
        if len(truth):
            assert abs(np.median(np.log(marks.depth / truth)[truth > 0])) < 0.3
    assert used[:3] == [0, 0, 0]
    assert max(used) > 20


@pytest.mark.parametrize("count", [1, 2, 7, 60])
def test_weighted_quantiles_and_medians_are_those_of_a_sort(count):
    rng = np.random.default_rng(count)
    for _ in range(20):
        values, weight, chosen = rng.normal(size=count), rng.uniform(0.1, 1, count), rng.random(count) < 0.7
        chosen[0] = True
        order = np.argsort(values[chosen])
        below = np.cumsum(weight[chosen][order])
        for share in (0.1, 0.3, 0.5, 1.0):
            expected = values[chosen][order][min(np.searchsorted(below, share * below[-1]), chosen.sum() - 1)]
            assert weighted_quantile(values, weight, chosen, share, np.zeros(count, int)) == expected
        assert median(values.copy(), count) == np.median(values)


def test_most_of_the_area_decides_which_matches_fit_though_a_thing_that_moves_has_most_corners():
    rng = np.random.default_rng(0)
    still, thing = rng.uniform([0, 0], [320, 240], (60, 2)), rng.uniform([100, 80], [140, 110], (100, 2))
    pixel = np.concatenate([still, thing])
    distance = np.abs(np.concatenate([rng.normal(0, 0.3, 60), rng.normal(4, 0.3, 100)]))
    fits, weight, order = np.zeros(160, bool), np.zeros(160), np.zeros(160, int)
    on_lines(distance, pixel, (320, 240), 0.1, fits, weight, order)
    np.testing.assert_array_equal(fits, np.arange(160) < 60)
    cells = (pixel * 6 / [320, 240]).astype(int) @ [1, 6]
    np.testing.assert_allclose(weight, 1 / np.bincount(cells)[cells])


def test_corners_are_predicted_by_their_points_or_by_the_median_depth():
    rng, last, T = np.random.default_rng(0), np.eye(4), np.eye(4)
    last[:3, :3], last[:3, 3] = Rotation.from_rotvec([0.1, 0.2, 0]).as_matrix(), (0.1, 0.2, 0)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.1, 0.25, 0.02]).as_matrix(), (0.2, 0.2, 0.05)
    inside, depth = rng.uniform([20, 20], [300, 200], (20, 2)), rng.uniform(1, 4, 20)
    depth[12:] = np.median(depth[:12])
    rays = np.concatenate([inside, np.ones((20, 1))], 1) @ np.linalg.inv(K).T
    points = (depth[:, None] * rays) @ last[:3, :3].T + last[:3, 3]
    goal, expected = seen_from(points, T[None])[:, 0], np.zeros((20, 2))
    points[12:] = np.nan
    cameras = last, T, K, np.linalg.inv(K)
    assert predict(inside, points, *cameras, expected)
    np.testing.assert_allclose(expected, goal, atol=1e-9)
    points[4:] = np.nan
    assert not predict(inside, points, *cameras, expected), "four points are too few"


def test_brightness_around_corners_is_that_of_a_blurred_image():
    rng = np.random.default_rng(0)
    before = cv2.GaussianBlur(rng.integers(0, 256, (60, 80)).astype(np.uint8), (0, 0), 3)
    after = (before * 0.8).astype(np.uint8)
    position, found = (rng.uniform(0, [79, 59], (40, 2)) for _ in range(2))
    position[:2], found[:2] = [[0, 0], [79, 59]], [[79, 0], [0, 59]]
    fine = rng.random(40) < 0.8
    means = []
    for image, corners in ((before, position), (after, found)):
        u, v = np.rint(corners).astype(int).T
        means.append(cv2.blur(image, (17, 17))[v, u].astype(float))
    assert brightness_ratio(before, after, position, found, fine) == np.median((means[1] / means[0])[fine])
    assert brightness_ratio(before, after * 0, position, found, fine) == 1.0, "a black image has no usable mean"


@pytest.mark.parametrize("factor", [1, 2])
def test_corners_are_covered_by_discs(factor):
    rng, free = np.random.default_rng(0), np.full((60, 80), 255, np.uint8)
    followed, expected = rng.uniform(0, factor * np.array([79, 59]), (12, 2)), free.copy()
    followed[0] = 0
    disc = cv2.circle(np.zeros((11, 11), np.uint8), (5, 5), 5, 1, -1)
    cover(free, disc, followed, factor)
    for u, v in np.rint((followed + 0.5) / factor - 0.5).astype(int).tolist():
        cv2.circle(expected, (u, v), 5, 0, -1)
    np.testing.assert_array_equal(free, expected)


def test_a_sum_that_is_not_a_number_is_not_finite_in_compiled_code():
    @reordered
    def sums(values, out):
        for i in range(len(values)):
            total = 0.0
            for j in range(values.shape[1]):
                total += values[i, j]
            out[i] = finite(total)

    out = np.zeros(4, bool)
    sums(np.array([[1.0, 2.0], [1.0, np.nan], [np.inf, 1.0], [np.inf, -np.inf]]), out)
    assert out.tolist() == [True, False, False, False]
