"""Triangulation against closed forms, and the tracker on rendered rooms where every depth is known."""

from __future__ import annotations

import numpy as np
import oracle_triangulate
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ufmstar_torch.anchors import landmark_source
from ufmstar_torch.anchors.tracker import LandmarkTracker, TrackerConfig
from ufmstar_torch.camera import resize_intrinsics
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.kernels.triangulate_cpu import triangulate

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
    # What a view did not see does not matter.
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


def test_the_variance_is_what_noise_makes_of_it():
    T, points = views(6, 3, spread=0.2), np.repeat(world_points(1, 3), 4000, axis=0)
    rng, sigma = np.random.default_rng(0), 0.3
    pixel = seen_from(points, T) + sigma * rng.standard_normal((4000, 6, 2))
    result = triangulate(pixel, np.ones((4000, 6), dtype=bool), T, K)
    spread = np.cov((result.point - points).T)
    np.testing.assert_allclose(sigma**2 * result.covariance.mean(0), spread, atol=0.08 * np.trace(spread))


def test_two_views_side_by_side_in_closed_form():
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 0.1
    pixel = np.array([[[160.0, 120.0], [145.0, 120.0]]])  # a disparity of 15 px: z = f b/15
    result = triangulate(pixel, np.ones((1, 2), dtype=bool), T, K)
    np.testing.assert_allclose(result.point[0], [0, 0, 300 * 0.1 / 15], atol=1e-9)
    # dz = z^2/(f b) d(disparity), whose variance is 2 px^2
    np.testing.assert_allclose(result.covariance[0, 2, 2], 2 * (4 / 30) ** 2, rtol=1e-2)


def test_behind_a_camera_is_told():
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 0.1
    crossed = np.array([[[145.0, 120.0], [160.0, 120.0]]])
    assert not triangulate(crossed, np.ones((1, 2), dtype=bool), T, K).ahead[0]


@pytest.fixture(scope="module")
def tour():
    return list(open_sequence("tour:5?frames=14&size=180x240"))


def true_depth(frame, pixel):
    u, v = np.rint(pixel).astype(int).T
    return frame.depth[v, u]


def test_landmarks_of_a_rendered_room_are_where_they_are(tour):
    tracker, errors, counts, surprises = LandmarkTracker(), [], [], []
    for frame in tour:
        result = tracker.update(frame.image, frame.T_world_cam, frame.intrinsics)
        z = true_depth(frame, result.pixel)
        errors.extend(np.abs(result.depth - z) / z)
        surprises.extend((result.depth - z) / np.sqrt(result.variance))
        counts.append(len(z))
    assert counts[0] == 0, "one view has no parallax"
    assert counts[1] >= 10, "two have"
    assert np.median(counts[4:]) >= 20
    assert np.median(errors) < 0.05
    assert 0.4 < 1.4826 * np.median(np.abs(surprises)) < 2, "the variance is of the errors' size"


@pytest.mark.slow
@pytest.mark.parametrize("source", ["corners", "dense"])
def test_stated_variances_are_those_of_the_errors(source):
    sizes, errors, counts = [], [], []
    for name in ("tour:71?style=mixed&frames=60&size=240x320", "tour:72?frames=60&size=240x320"):
        landmarks = landmark_source(source)
        for frame in open_sequence(name):
            result = landmarks.update(frame.image, frame.T_world_cam, frame.intrinsics)
            z = true_depth(frame, result.pixel)
            sizes.extend(np.abs(1 / result.depth - 1 / z) * result.depth**2 / np.sqrt(result.variance))
            errors.extend(np.abs(result.depth - z) / z)
            counts.append(len(z))
    assert 0.8 < np.median(sizes) / 0.674 < 1.25
    assert np.mean(np.array(sizes) > 5) < {"corners": 0.12, "dense": 0.05}[source]
    assert np.median(errors) < {"corners": 0.06, "dense": 0.015}[source]
    assert np.mean(counts) > {"corners": 80, "dense": 180}[source]


def test_a_standing_and_a_turning_camera_have_no_anchors(tour):
    frame = tour[3]
    tracker = LandmarkTracker()
    for _ in range(6):
        still = tracker.update(frame.image, frame.T_world_cam, frame.intrinsics)
    assert len(still.depth) == 0
    assert still.tracked > 20, "there was something to follow"
    turning = LandmarkTracker()
    rng = np.random.default_rng(0)
    pixel = rng.uniform([20, 20], [220, 160], (50, 2))
    rays = np.concatenate([pixel, np.ones((50, 1))], 1) @ np.linalg.inv(frame.intrinsics).T
    for step in range(5):  # the tracker's own memory, filled as a turning camera would
        R = Rotation.from_rotvec([0, 0.01 * step, 0]).as_matrix()
        cam = rays @ R
        turning._view = step
        turning._poses[step] = np.block([[R, np.zeros((3, 1))], [np.zeros((1, 3)), 1]])
        turning._pixel[:50, step] = (cam / cam[:, 2:] @ frame.intrinsics.T)[:, :2] + 0.2 * rng.standard_normal((50, 2))
        turning._seen[:50, step] = True
    turning._K = frame.intrinsics
    assert len(turning._landmarks(50).depth) == 0


def test_what_is_far_away_is_not_left_out():
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    rng, tracker = np.random.default_rng(1), LandmarkTracker()
    point = np.concatenate([rng.uniform(-0.5, 0.5, (100, 2)), np.repeat([1.0, 5.0], 50)[:, None]], axis=1)
    for step in range(5):
        centre = np.array([0.02 * step, 0.0, 0.0])
        seen = (point - centre) @ K.T
        tracker._view = step
        tracker._poses[step, :3, 3] = centre
        tracker._pixel[:100, step] = seen[:, :2] / seen[:, 2:] + rng.standard_normal((100, 2))
        tracker._seen[:100, step] = True
    tracker._K = K
    result = tracker._landmarks(100)
    far = result.depth > 2
    assert far.sum() > 25, "noise of 1 px makes some 15 % of 5 m here"
    assert (~far).sum() > 40
    sigma = np.sqrt(result.variance[far]) / result.depth[far]
    assert 0.08 < np.median(sigma) < 0.5, "errors that add up from view to view are allowed for; these are independent"
    surprise = (1 / result.depth[far] - 1 / 5) / (np.sqrt(result.variance[far]) / result.depth[far] ** 2)
    assert np.median(np.abs(surprise)) < 1.5


def test_poses_that_contradict_the_images_give_no_anchors(tour):
    rng, believing = np.random.default_rng(0), TrackerConfig(min_share=0.0)
    noisy, by_chance, right = LandmarkTracker(), LandmarkTracker(believing), LandmarkTracker()
    counts = np.zeros(3, dtype=int)
    for i, frame in enumerate(tour):
        T = frame.T_world_cam.copy()
        if i > 1:  # two views alone can be wrong together
            T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(rng.normal(0, np.deg2rad(4), 3)).as_matrix()
        arguments = ((noisy, T), (by_chance, T), (right, frame.T_world_cam))
        result = [len(t.update(frame.image, pose, frame.intrinsics).depth) for t, pose in arguments]
        counts += result if i > 3 else 0  # before, most have two views
    assert counts[1] >= 20, "some tracks fit by chance"
    assert counts[0] == 0
    assert counts[2] > 200


def test_memory_does_not_grow_and_reset_forgets(tour):
    tracker = LandmarkTracker(TrackerConfig(max_points=40, window=4))
    sizes = set()
    first = [tracker.update(f.image, f.T_world_cam, f.intrinsics) for f in tour]
    for frame in tour:
        assert len(tracker.update(frame.image, frame.T_world_cam, frame.intrinsics).depth) <= 40
        sizes.add((tracker._pixel.shape, tracker._seen.shape, tracker._poses.shape))
    assert len(sizes) == 1
    tracker.reset()
    again = [tracker.update(f.image, f.T_world_cam, f.intrinsics) for f in tour]
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.depth, b.depth)


def test_corners_are_expected_where_their_depths_and_the_poses_say(tour):
    tracker, loaded = LandmarkTracker(), LandmarkTracker()
    for frame in tour[:5]:
        tracker.update(frame.image, frame.T_world_cam, frame.intrinsics)
    followed, T = tracker._seen[:, tracker._view], tour[5].T_world_cam
    expected, position = tracker._expected(followed, T), tracker._pixel[followed, tracker._view]
    rays = np.concatenate([position, np.ones((len(position), 1))], axis=1) @ np.linalg.inv(frame.intrinsics).T
    world = true_depth(frame, position)[:, None] * rays @ frame.T_world_cam[:3, :3].T + frame.T_world_cam[:3, 3]
    cam = (world - T[:3, 3]) @ T[:3, :3] @ frame.intrinsics.T
    truth = cam[:, :2] / cam[:, 2:]
    moved, off = (np.median(np.linalg.norm(truth - x, axis=1)) for x in (position, expected))
    assert off < 0.3 * moved
    loaded.load_state(tracker.state())
    np.testing.assert_array_equal(loaded._expected(followed, T), expected)


def test_every_reason_for_no_landmark(tour):
    tracker, frame = LandmarkTracker(), tour[0]
    arguments = frame.T_world_cam, frame.intrinsics
    assert tracker.update(frame.image, *arguments).none == "no corner followed from the frame before"
    assert tracker.update(frame.image, *arguments).none == "no parallax, or no track that fits the poses"
    assert tracker.update(0 * frame.image, *arguments).none == "no corner followed from the frame before"


def test_a_state_shares_the_image_and_stays_as_it_was(tour):
    tracker = LandmarkTracker()
    for frame in tour[:3]:
        tracker.update(frame.image, frame.T_world_cam, frame.intrinsics)
    state = tracker.state()
    before = {name: value.clone() for name, value in state.items()}
    assert state["gray"].data_ptr() == tracker._gray.ctypes.data
    expected = [tracker.update(f.image, f.T_world_cam, f.intrinsics).depth for f in tour[3:6]]
    assert all(torch.equal(state[name], value) for name, value in before.items())
    tracker.load_state(state)
    for frame, depth in zip(tour[3:6], expected, strict=True):
        np.testing.assert_array_equal(tracker.update(frame.image, frame.T_world_cam, frame.intrinsics).depth, depth)


def test_anchors_lie_on_the_depth_map(tour):
    tracker = LandmarkTracker()
    for frame in tour[:8]:
        result = tracker.update(frame.image, frame.T_world_cam, frame.intrinsics)
    small = resize_intrinsics(torch.from_numpy(frame.intrinsics), (180, 240), (90, 120))
    anchors = result.anchors(frame.intrinsics, small, capacity=300)
    n = len(result.depth)
    assert anchors.depth.shape == (1, 300)
    assert anchors.valid.sum() == n
    np.testing.assert_allclose(anchors.pixel[0, :n].numpy(), (result.pixel + 0.5) / 2 - 0.5, atol=1e-9)
    np.testing.assert_array_equal(anchors.variance[0, :n].numpy(), result.variance)
    with pytest.raises(ValueError, match="capacity must be at least"):
        result.anchors(frame.intrinsics, small, capacity=n - 1)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"image": np.zeros((180, 240, 3))}, "image must be uint8"),
        ({"image": np.zeros((90, 120, 3), dtype=np.uint8)}, r"call reset\(\) first"),
        ({"T_world_cam": np.full((4, 4), np.nan)}, "T_world_cam must be a finite 4x4"),
        ({"K": np.zeros((3, 3))}, "K must be a finite 3x3"),
        ({"K": np.diag([200.0, 200, 1])}, r"call reset\(\) first"),
    ],
)
def test_wrong_input_leaves_the_tracker_as_it_was(tour, change, told):
    one, other = LandmarkTracker(), LandmarkTracker()
    for frame in tour[:6]:
        arguments = {"image": frame.image, "T_world_cam": frame.T_world_cam, "K": frame.intrinsics}
        expected = one.update(**arguments)
        if frame.index > 0:
            with pytest.raises(ValueError, match=told):
                other.update(**{**arguments, **change})
        np.testing.assert_array_equal(other.update(**arguments).depth, expected.depth)


def test_config_refuses_the_impossible():
    for values in (
        {"max_points": 0},
        {"window": 1},
        {"min_views": 11},
        {"pixel_noise": 0.0},
        {"spacing": True},
        {"min_share": 2},
    ):
        with pytest.raises(ValueError, match="TrackerConfig"):
            TrackerConfig(**values)
    with pytest.raises(TypeError):
        TrackerConfig.from_dict({"windows": 3})
    assert TrackerConfig.from_dict(TrackerConfig(window=5).to_dict()) == TrackerConfig(window=5)
