"""Things that move: tests in images, anchors that are withheld, and motion as an explanation of evidence."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import oracle_field
import oracle_posterior as oracle
import pytest
import torch
from posterior_cases import MODEL, K, checked, scene

from ufmstar_torch import AnchorConfig, PosteriorConfig, UfMStar, UfMStarConfig
from ufmstar_torch.anchors import Anchors, landmark_source
from ufmstar_torch.anchors.motion import LANDMARK, LINE, SEARCH, MotionTest, MotionTests, located, moves
from ufmstar_torch.anchors.tracker import LandmarkTracker, TrackerConfig
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.kernels.compile_cpu import kernel
from ufmstar_torch.posterior import motion as motion_of_nodes
from ufmstar_torch.posterior.running import SIZE
from ufmstar_torch.posterior.update import update

CELL, SHAPE = 10, (120, 160)
at_nodes, probability = kernel(motion_of_nodes.tests_at), kernel(motion_of_nodes.probability)


def searches(failing, seed=0):
    """Searches in every cell; those in columns below ``failing`` fail."""
    rng = np.random.default_rng(seed)
    row, column = np.indices((12, 16)).reshape(2, -1)
    pixel = (np.stack([column, row], 1) + rng.uniform(0.1, 0.9, (192, 2))) * CELL
    return [MotionTest(SEARCH, pixel, pixel[:, 0] < failing * CELL, np.ones(192, bool))]


# --- tests in images -----------------------------------------------------------------------------------------


def test_the_log_ratio_is_the_weighted_sum_of_the_tests_log_ratios():
    tests = MotionTests(0.8)
    pixel = np.array([[45.0, 45.0], [45.0, 45.0], [45.0, 45.0]])
    parts = [MotionTest(kind, pixel[:2], np.array([kind != LINE, True]), np.array([True, False]))
             for kind in (SEARCH, LANDMARK, LINE)]  # fmt: skip
    ratios = tests.log_ratios(parts, SHAPE, CELL)
    failing = (0.8 * 50 * np.array([0.4, 0.06, 0.06]) + [1, 1, 0]) / (0.8 * 50 + 1)
    fails = np.log((failing + (1 - failing) * [0.4, 0.4, 0.1]) / failing)
    expected = 0.22 * fails[0] + 0.43 * fails[1] + 0.87 * np.log(0.9)
    assert ratios[4, 4] == pytest.approx(expected)
    assert ratios[4, 6] == pytest.approx(expected * np.exp(-(2**2) / 1.5**2 / 2))


def test_where_tests_fail_everywhere_nothing_moves_more_than_elsewhere():
    """Blurred images fail all tests: the stream's rate of failures takes this into account."""
    tests = MotionTests(0.8)
    for seed in range(10):
        ratios = tests.log_ratios(searches(16, seed), SHAPE, CELL)
    assert ratios.max() < 0.2


def test_the_state_of_the_tests_goes_on_to_the_bit():
    one, other = MotionTests(0.8), MotionTests(0.8)
    one.log_ratios(searches(4), SHAPE, CELL)
    other.load_state(one.state())
    following = searches(2, seed=1)
    np.testing.assert_array_equal(one.log_ratios(following, SHAPE, CELL), other.log_ratios(following, SHAPE, CELL))
    one.reset()
    np.testing.assert_array_equal(
        one.log_ratios(following, SHAPE, CELL), MotionTests(0.8).log_ratios(following, SHAPE, CELL)
    )


def test_cells_are_located_by_their_centres():
    ratios = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(located(ratios, 10)[:, 2], ratios.ravel())
    np.testing.assert_array_equal(located(ratios, 10)[4], [14.5, 14.5, 4.0])
    assert moves(ratios, np.array([[25.0, 5.0], [5.0, 5.0], [5.0, 19.0]]), 10).tolist() == [True, False, True]


@pytest.fixture(scope="module")
def moving_tour():
    """Frames of a tour with things that move, the landmarks of each, and the source after them."""
    frames, source = list(open_sequence("tour:62?style=hall&frames=26&size=240x320&movers=4")), landmark_source("dense")
    return frames, [source.update(frame.image, frame.T_world_cam, frame.intrinsics) for frame in frames]


def test_tests_fail_on_things_that_move_and_their_anchors_are_withheld_and_counted(moving_tour):
    moving, still = [], []
    for frame, landmarks in list(zip(*moving_tour, strict=True))[10:]:
        u, v = np.rint(landmarks.motion[:, :2]).astype(int).T
        moving.append(landmarks.motion[frame.moving[v, u], 2])
        still.append(landmarks.motion[~frame.moving[v, u], 2])
    moving, still = np.concatenate(moving), np.concatenate(still)
    assert moving.mean() > still.mean() + 0.5
    assert np.mean(moving > 1.9) > 5 * np.mean(still > 1.9)
    assert np.mean(still > 1.9) < 0.04
    assert sum(landmarks.moving for landmarks in moving_tour[1]) > 50


def test_the_count_of_withheld_depths_is_in_the_statistics(moving_tour):
    frame, landmarks = moving_tour[0][20], moving_tour[1][20]
    ufm = UfMStar(UfMStarConfig(anchors=AnchorConfig(), posterior=PosteriorConfig()))
    camera = torch.from_numpy(frame.intrinsics)[None]
    anchors = landmarks.anchors(frame.intrinsics, camera)
    out = ufm(torch.from_numpy(frame.depth)[None], torch.from_numpy(frame.T_world_cam)[None], camera, anchors=anchors)
    assert out.statistics.anchors_moving.tolist() == [landmarks.moving]
    np.testing.assert_allclose(anchors.motion[0], landmarks.motion)


def test_positions_of_tests_move_with_the_pixels_of_a_resized_image(moving_tour):
    frame, landmarks = moving_tour[0][20], moving_tour[1][20]
    half = np.diag([0.5, 0.5, 1.0]) @ frame.intrinsics
    motion = landmarks.anchors(frame.intrinsics, torch.from_numpy(half)).motion[0].numpy()
    np.testing.assert_allclose(motion[:, :2], landmarks.motion[:, :2] / 2)
    np.testing.assert_array_equal(motion[:, 2], landmarks.motion[:, 2])


def test_most_corners_on_large_things_do_not_contradict_the_poses():
    """Half of the corners lie on things of a fifth of the image, before walls with little texture."""
    source, counts = landmark_source("dense"), []
    for frame in islice(open_sequence("tour:960?style=scales&frames=60&size=240x320&movers=6"), 10):
        counts.append(len(source.update(frame.image, frame.T_world_cam, frame.intrinsics).depth))
    assert min(counts[4:]) > 50


def test_the_refined_poses_do_not_follow_large_things_that_move():
    """Things cover two fifths of the image and have more than half of the corners. The input poses are exact; with all
    corners they were changed by up to .3 degrees and 3 cm."""
    tracker, turns, shifts = LandmarkTracker(TrackerConfig(max_points=150)), [], []
    for frame in islice(open_sequence("tour:971?style=home&frames=60&size=240x320&movers=6"), 13):
        tracker.update(frame.image, frame.T_world_cam, frame.intrinsics)
        change = np.linalg.inv(frame.T_world_cam) @ tracker.pose
        turns.append(np.degrees(np.linalg.norm(change[:3, :3] - np.eye(3)) / 2**0.5))
        shifts.append(np.linalg.norm(change[:3, 3]))
        assert not tracker.contradicted
    assert max(turns) < 0.2
    assert max(shifts) < 0.02


def test_poses_without_a_group_of_corners_that_fits_contradict_the_images():
    source, rng, counts = landmark_source("dense"), np.random.default_rng(0), []
    for frame in islice(open_sequence("tour:960?style=scales&frames=60&size=240x320&movers=6"), 10):
        T = frame.T_world_cam.copy()
        T[:3, :3] = T[:3, :3] @ rotation(rng.normal(0, np.deg2rad(4), 3))
        counts.append(len(source.update(frame.image, T, frame.intrinsics).depth))
    assert np.median(counts[2:]) == 0


def rotation(w):
    """[3, 3] from a vector of angles [rad]."""
    w = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    return torch.linalg.matrix_exp(torch.from_numpy(w)).numpy()


# --- the posterior -------------------------------------------------------------------------------------------


def points(value, size=(12, 16), region=None):
    """A test at every second pixel: ``value`` in the region (rows, columns), else 0."""
    v, u = (np.indices((size[0] // 2, size[1] // 2)) * 2.0 + 0.3).reshape(2, -1)
    inside = np.ones(len(u), bool) if region is None else (v < region[0]) & (u < region[1])
    return np.stack([u, v, np.where(inside, value, 0.0)], 1)


def test_values_with_motion_against_the_oracle():
    state, packed = oracle_field.start(), torch.zeros(1, SIZE, dtype=torch.float64)
    for seed, value in enumerate((2.0, 1.0)):
        depth, _, claimed, *anchors = scene(seed, (12, 16), 40)
        anchors[1][:4] *= 12  # a ratio that no surface has; in the first frame the ratio of most surfaces is unknown
        motion = points(value, region=(7, 9))
        state, *expected = oracle.update(state, depth, claimed, *anchors, motion=motion)
        frame, rows = checked(depth, *anchors)
        rows = replace(rows, motion=torch.from_numpy(motion)[None])
        packed, out = update(packed, frame, rows, torch.from_numpy(claimed)[None], MODEL)
        for name, value in zip(("depth", "variance", "inlier", "outlier"), expected, strict=True):
            np.testing.assert_allclose(getattr(out, name)[0], value, rtol=1e-7, err_msg=name)


def test_tests_at_nodes_are_means_of_the_points_around_them():
    points = np.array([[3.5, 3.5, 2.0], [3.5, 3.5, 4.0], [11.5, 3.5, 1.0], [np.nan, 0, 5]])
    np.testing.assert_allclose(at_nodes(points, 16, 16, 2, 2), [3.0, 1.0, 0.0, 0.0])


def test_a_ratio_that_no_other_surface_has_is_explained_by_motion_and_a_usual_one_is_not():
    n = 28 * 28
    offset, logs, zero = np.zeros((28, 28)), np.zeros((28, 28)), np.zeros(n)
    offset[8:20, 8:16], logs[8:20, 8:16] = 0.7, -0.8
    arguments = offset.ravel(), logs.ravel(), zero, zero, zero
    P = probability(*arguments, 0.05**2, 28, 28).reshape(28, 28)
    assert P[10:18, 10:14].min() > 0.4
    assert P[offset == 0].max() < 0.1, "the depth edge bounds the region"
    assert probability(*arguments, 0.5**2, 28, 28).max() < 0.15, "in this stream surfaces differ that much"
    far = probability(offset.ravel(), logs.ravel(), zero + 1, zero, zero, 0.05**2, 28, 28)
    assert far.max() < 0.06, "without evidence there is nothing to explain"


def test_motion_that_passes_the_tests_makes_a_surface_look_farther():
    n = 28 * 28
    e, logs, zero = np.zeros((28, 28)), np.zeros((28, 28)), np.zeros(n)
    e[8:20, 8:16], logs[8:20, 8:16] = 0.7, -0.8
    inside, passed = (e > 0).ravel(), np.full(n, -4.0)
    P = probability(e.ravel(), logs.ravel(), zero, passed, zero, 0.05**2, 28, 28)
    nearer = probability(-e.ravel(), logs.ravel(), zero, passed, zero, 0.05**2, 28, 28)
    assert P[inside].max() > 0.3
    assert nearer[inside].max() < P[inside].max() / 2
    P, nearer = (probability(x.ravel(), logs.ravel(), zero, zero + 3, zero, 0.05**2, 28, 28) for x in (e, -e))
    assert nearer[inside].min() > P[inside].min() - 0.1, "tests that fail show motion on either side"


def walked_beside(far, frames=6):
    """The posteriors of a network's frames, and where a board is whose anchors say ``far`` times its distance from the
    second frame on. The wall behind it has anchors at the image's border only, at the network's depth."""
    rng, packed = np.random.default_rng(0), torch.zeros(1, SIZE, dtype=torch.float64)
    board, outs = np.zeros((48, 64), bool), []
    board[16:32, 24:40] = True
    depth = np.where(board, 2.0, 3.0)
    for i in range(frames):
        pixel = (rng.uniform(0.02, 0.96, (300, 2)) * [64, 48]).round()
        u, v = pixel.astype(int).T
        kept = board[v, u] | (np.maximum(np.abs(u / 64 - 0.5), np.abs(v / 48 - 0.5)) > 0.4)
        pixel, on, z = pixel[kept], board[v, u][kept], depth[v, u][kept] * np.exp(rng.normal(0, 0.05, kept.sum()))
        z = np.where(on & (i > 0), far, 1.0) * z
        frame, rows = checked(depth, pixel, z, np.where(on, 0.3, 0.05) ** 2 * z**2)
        rows = replace(rows, motion=torch.from_numpy(points(-1.0, (48, 64)))[None])
        packed, out = update(packed, frame, rows, torch.zeros(1, 48, 64, dtype=torch.float64), MODEL)
        outs.append(out)
    return depth, board, outs


def test_a_thing_that_seems_to_be_at_infinity_does_not_take_the_wall_with_it():
    """A thing that walks ahead at the camera's speed has no parallax."""
    depth, board, outs = walked_beside(30.0)
    ratio = outs[-1].depth[0].numpy() / depth
    assert np.abs(np.log(ratio[~board])).max() < 0.25
    assert (outs[-1].outlier[0].numpy()[board] > 0.5).all(), "the thing moves, or its matches are wrong"
    assert np.median(walked_beside(1.6)[2][-1].depth[0].numpy()[board]) > 1.3 * 2, "a ratio that surfaces may have"


def test_a_ratio_that_most_anchors_have_is_never_discarded():
    """After a change of the network's unit the posterior follows the anchors, whatever the ratio was before."""
    packed = torch.zeros(1, SIZE, dtype=torch.float64)
    for i in range(8):
        depth, _, claimed, pixel, z, variance = scene(i, (36, 48))
        unit = 1.0 if i < 4 else 1 / 40
        frame, rows = checked(depth * unit, pixel, z, variance)
        rows = replace(rows, motion=torch.from_numpy(points(-1.0, (36, 48)))[None])
        packed, out = update(packed, frame, rows, torch.from_numpy(claimed)[None], MODEL)
        u, v = pixel.round().astype(int).T
        error = np.log(out.depth[0].numpy()[v, u] / z)
    assert np.median(np.abs(error)) < 0.3


def approached(said, noise, frames=12):
    """Frames of an exact network, whose depths are 1.35 times too large, and of anchors that say ``said`` times the
    distance of a board that grows from a twentieth to nearly half of the image; ``noise`` is relative. Yields the
    network's depth, the board's mask, the posterior's depth and |z|."""
    rng, packed = np.random.default_rng(0), torch.zeros(1, SIZE, dtype=torch.float64)
    for share in np.linspace(0.22, 0.68, frames):
        depth, half = np.full((48, 64), 4.0), np.array([48, 64]) * share / 2
        depth += np.linspace(0, 1, 64)
        (top, left), (bottom, right) = (([24, 32] + sign * half).astype(int) for sign in (-1, 1))
        board = np.zeros((48, 64), bool)
        board[top:bottom, left:right] = True
        depth[board] = 1.5
        pixel = (rng.uniform(0.02, 0.96, (400, 2)) * [64, 48]).round()
        u, v = pixel.astype(int).T
        factor = np.where(board[v, u], said, 1.0) * np.exp(rng.normal(0, noise, 400)) / 1.35
        frame, rows = checked(depth, pixel, depth[v, u] * factor, (noise * depth[v, u]) ** 2)
        rows = replace(rows, motion=torch.from_numpy(points(-4.0, (48, 64)))[None])
        packed, out = update(packed, frame, rows, torch.zeros(1, 48, 64, dtype=torch.float64), MODEL)
        found = out.depth[0].numpy()
        yield depth, board, found, np.abs(found - depth / 1.35) / out.variance[0].sqrt().numpy()


def test_a_thing_that_walks_ahead_neither_shifts_the_scale_nor_escapes_however_large_it_becomes():
    on_board = []
    for depth, board, found, z in approached(2.0, 0.02):
        on_board.append(z[board])
        assert np.median(found[board] * 1.35 / depth[board]) > 1.9, "the evidence's depth is stated"
        assert np.sqrt(np.mean(z[~board] ** 2)) < 1.5
    assert np.sqrt(np.mean(np.concatenate(on_board[3:]) ** 2)) < 4


def test_what_comes_nearer_by_little_is_covered():
    """Precise anchors of an exact network say .95 times the distance: no test fails."""
    on_board = [z[board] for _, board, _, z in approached(0.95, 0.005)][3:]
    assert np.sqrt(np.mean(np.concatenate(on_board) ** 2)) < 3


def test_an_exact_network_s_posterior_covers_what_moves_in_a_tour(moving_tour):
    """And an outlier of the inliers' sigma is as probable there as stated."""
    ufm, moving, still = UfMStar(UfMStarConfig(anchors=AnchorConfig(), posterior=PosteriorConfig())), [], []
    probabilities, outliers = [], []
    for i, (frame, landmarks) in enumerate(zip(*moving_tour, strict=True)):
        camera, seen = torch.from_numpy(frame.intrinsics)[None], frame.depth > 0
        depth = np.where(seen, 1.35 * frame.depth, 3.0)
        pose, anchors = torch.from_numpy(frame.T_world_cam)[None], landmarks.anchors(frame.intrinsics, camera)
        out = ufm(torch.from_numpy(depth)[None], pose, camera, anchors=anchors)
        z2 = ((out.depth[0].numpy() - frame.depth) / out.std[0].numpy()) ** 2
        if i >= 8:
            moving.append(z2[seen & frame.moving])
            still.append(z2[seen & ~frame.moving])
            error2 = (out.depth[0].numpy() - frame.depth)[seen] ** 2
            outliers.append(error2 > 9 * out.posterior_inlier_variance[0].numpy()[seen])
            probabilities.append(out.posterior_outlier[0].numpy()[seen])
    moving, still = np.concatenate(moving), np.concatenate(still)
    assert moving.mean() ** 0.5 < 2
    assert np.mean(moving > 16) < 0.03
    assert still.mean() ** 0.5 < 1
    p, outlier = np.concatenate(probabilities), np.concatenate(outliers)
    assert p[outlier].mean() > 5 * p[~outlier].mean()
    high = p > 0.5
    assert outlier[high].mean() > 0.15
    assert outlier[p < 0.05].mean() < 0.05


def test_motion_widens_the_variance_and_a_range_sensor_s_anchors_need_none():
    depth, _, claimed, *anchors = scene(0)
    frame, rows = checked(depth, *anchors)
    start, claimed = torch.zeros(1, SIZE, dtype=torch.float64), torch.from_numpy(claimed)[None]
    outs = {}
    for value in (None, 0.0, 3.0):
        motion = None if value is None else torch.from_numpy(points(value, (36, 48)))[None]
        outs[value] = update(start, frame, replace(rows, motion=motion), claimed, MODEL)[1]
    valid = frame.valid
    assert (outs[3.0].outlier[valid] > 0.3).all()
    assert (outs[3.0].variance >= outs[None].variance)[valid].all()
    assert (outs[3.0].variance > 2 * outs[None].variance)[valid].double().mean() > 0.9
    for out in outs.values():
        torch.testing.assert_close(out.depth, outs[None].depth, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize(("motion", "kind", "text"), [
    (torch.zeros(1, 4, 2), ValueError, "anchors.motion must be \\[1, M, 3\\]"),
    (torch.zeros(2, 4, 3), ValueError, "anchors.motion must be \\[1, M, 3\\]"),
    (torch.zeros(1, 4, 3, dtype=torch.int64), TypeError, "anchors.motion"),
])  # fmt: skip
def test_malformed_tests_are_refused(motion, kind, text):
    one = torch.ones(1, 1)
    anchors = Anchors(torch.ones(1, 1, 2), one, 0.01 * one, motion=motion)
    ufm = UfMStar(UfMStarConfig(anchors=AnchorConfig()))
    with pytest.raises(kind, match=text):
        ufm(torch.ones(1, 12, 16), torch.eye(4)[None], K[None], anchors=anchors)
