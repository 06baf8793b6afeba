"""The search of dense evidence against NumPy loops and closed forms."""

from __future__ import annotations

import cv2
import numpy as np
import oracle_dense
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from ufmstar_torch.anchors.dense_keyframes import Keyframes, halved
from ufmstar_torch.anchors.kernels.dense import ACROSS, WHOLE, Search, Views, _search, free_pixels, measure
from ufmstar_torch.anchors.kernels.landmarks import Columns, Sighted, settle, sight
from ufmstar_torch.anchors.kernels.reduce import reduce
from ufmstar_torch.kernels.compile_cpu import reordered
from ufmstar_torch.kernels.cpu.vectors import LANES

K = np.array([[90.0, 0, 47.5], [0, 90.0, 35.5], [0, 0, 1]])
SEARCH = Search(start=0.5, low=-0.01, high=2.0, sigmas=3.5, least_score=0.85, rival=1.2)


def plane(seed, T, z=2.0, shape=(72, 96)):
    """Render a textured plane at world depth z from a camera T [4, 4], uint8."""
    texture = gaussian_filter(np.random.default_rng(seed).standard_normal((400, 400)), 4)
    texture = 127 + 45 * texture / texture.std()
    v, u = np.mgrid[: shape[0], : shape[1]]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T @ T[:3, :3].T
    hit = T[:3, 3] + rays * ((z - T[2, 3]) / rays[..., 2])[..., None]
    x, y = 200 + 90 * hit[..., 0], 200 + 90 * hit[..., 1]
    i, j = x.astype(int), y.astype(int)
    a, c = x - i, y - j
    top, bottom = (
        (1 - a) * texture[j, i] + a * texture[j, i + 1],
        (1 - a) * texture[j + 1, i] + a * texture[j + 1, i + 1],
    )
    return np.clip((1 - c) * top + c * bottom + 0.5, 0, 255).astype(np.uint8)


def pose(x=0.0, y=0.0, z=0.0, turned=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turned).as_matrix(), (x, y, z)
    return T


def views(images, poses, T, noise=0.0):
    H = np.stack([K @ p[:3, :3].T @ T[:3, :3] @ np.linalg.inv(K) for p in poses])
    b = np.stack([K @ p[:3, :3].T @ (T[:3, 3] - p[:3, 3]) for p in poses])
    each = np.arange(len(poses))
    return Views(np.stack(images), each, each, H, b, np.full(len(poses), noise))


MOVED = [pose(0.06, 0.01), pose(0.16, -0.03, 0.02, (0.01, -0.02, 0.03)), pose(0.35, 0.02, -0.05, (0.0, 0.03, -0.05))]


@pytest.fixture(scope="module")
def scene():
    image = plane(0, np.eye(4))
    return image, free_pixels(image, 8, np.zeros((0, 2))), [plane(0, T) for T in MOVED]


def test_one_view_agrees_with_the_loops(scene):
    image, pixel, others = scene
    for k in range(3):
        view = views(others[k : k + 1], MOVED[k : k + 1], np.eye(4))
        search = Search(0.5, 0.4, 0.6, 3.5, 0.85, 1.0)
        result = measure(image, pixel, view, search)
        chosen = np.flatnonzero(result.agreed == 1)[:6]
        assert len(chosen) == 6
        for n in chosen:
            rho, score = oracle_dense.along_line(image, others[k], pixel[n], view.H[0], view.b[0], 0.4, 0.6)
            assert score > 0.95
            ends = [oracle_dense.project(pixel[n], r, view.H[0], view.b[0]) for r in (0.4, 0.6)]
            speed = np.linalg.norm(ends[1] - ends[0]) / 0.2
            assert abs(result.rho[n] - rho) * speed < 0.1, "a tenth of a pixel"


def test_the_centre_of_the_texture_agrees_with_the_loops(scene):
    image, pixel, others = scene
    view = views(others[1:2], MOVED[1:2], np.eye(4))
    search = Search(0.5, 0.4, 0.6, 3.5, 0.85, 1.0)
    result = measure(image, pixel, view, search)
    chosen = np.flatnonzero(result.agreed == 1)[:8]
    expected = [oracle_dense.centre_of_texture(image, pixel[n], 0.5, view.H[0], view.b[0]) for n in chosen]
    np.testing.assert_allclose(result.centre[chosen], expected, atol=0.02)
    assert np.linalg.norm(expected, axis=1).max() > 0.5


def test_a_blank_pixel_beside_an_edge_measures_the_edge():
    """Two pixels to the right of a vertical edge, the mean of the matched texture lies to the left."""
    u = np.arange(96.0)
    image, shifted = (np.tile(np.clip(60 + 100 / (1 + np.exp((u - at) * 3)), 0, 255), (72, 1)) for at in (40.5, 36.0))
    image, other = image.round().astype(np.uint8), shifted.round().astype(np.uint8)
    result = measure(image, np.array([[42.5, 36.0]]), views([other], [pose(0.1)], np.eye(4)), SEARCH)
    assert result.agreed[0] == 1
    assert -2.3 < result.centre[0, 0] < -0.7
    assert abs(result.centre[0, 1]) < 0.3


def test_a_plane_is_where_it_is_and_as_uncertain_as_stated(scene):
    image, pixel, others = scene
    result = measure(image, pixel, views(others, MOVED, np.eye(4)), SEARCH)
    fine = (result.agreed >= 2) & (result.contradicted == 0)
    assert fine.mean() > 0.5
    error = result.rho[fine] - 0.5
    assert np.median(np.abs(error)) < 0.004
    assert np.abs(error / np.sqrt(result.variance[fine])).max() < 8
    assert np.nanmedian(np.abs(result.each[fine, :, ACROSS])) < 0.1, "the poses are exact"


def test_the_variance_is_the_smallest_of_the_views_and_follows_the_poses_noise(scene):
    image, pixel, others = scene
    each = [
        measure(image, pixel, views([o], [T], np.eye(4)), Search(0.5, 0.4, 0.6, 3.5, 0.85, 1.0))
        for o, T in zip(others, MOVED, strict=True)
    ]
    together = measure(image, pixel, views(others, MOVED, np.eye(4)), Search(0.5, 0.4, 0.6, 3.5, 0.85, 1.0))
    all_agree = (together.agreed == 3) & np.all([one.agreed > 0 for one in each], axis=0)
    assert all_agree.sum() > 20
    smallest = np.min([np.where(one.agreed > 0, one.variance, np.inf) for one in each], axis=0)
    # the patch is warped at the current depth estimate, so residuals differ slightly
    np.testing.assert_allclose(together.variance[all_agree], smallest[all_agree], rtol=0.5)
    noisy = measure(image, pixel, views(others[2:], MOVED[2:], np.eye(4), noise=0.25), SEARCH)
    clean = measure(image, pixel, views(others[2:], MOVED[2:], np.eye(4)), SEARCH)
    both = (noisy.agreed > 0) & (clean.agreed > 0)
    speed = 90 * 0.35  # [px m]
    assert (noisy.variance - clean.variance)[both].min() > 0.8 * 0.25 / speed**2


def test_poses_that_are_wrong_show_across_the_line(scene):
    image, pixel, others = scene
    wrong = [T.copy() for T in MOVED]
    for T in wrong:
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec([0.008, 0, 0]).as_matrix()  # .7 px, across
    result = measure(image, pixel, views(others, wrong, np.eye(4)), SEARCH)
    assert 0.4 < np.nanmedian(np.abs(result.each[result.agreed > 0, :, ACROSS])) < 1.0


def test_a_view_that_might_show_the_match_outside_of_it_is_no_first_one(scene):
    """The camera moves to the right: surfaces at the right border are outside of the earlier view, whose best matching
    window is elsewhere."""
    image, _, _ = scene
    moved = pose(-0.5)
    first = views([plane(0, moved)], [moved], np.eye(4))
    pixel = np.array([[u, 30.0] for u in range(12, 84, 4)])
    found = measure(image, pixel, first, SEARCH).agreed > 0
    far, near = pixel[:, 0], pixel[:, 0] + 90 * 0.5 * WHOLE * SEARCH.start
    whole = (np.minimum(far, near) >= 3.5) & (np.maximum(far, near) <= 95 - 3.5)
    assert 0 < whole.sum() < len(whole)
    assert not found[~whole].any()
    assert found[whole].mean() > 0.5
    both = views([plane(0, MOVED[0]), first.image[0]], [MOVED[0], moved], np.eye(4))
    assert (measure(image, pixel, both, SEARCH).agreed[~whole] > 1).any(), "a depth from another view is verified there"


@pytest.mark.parametrize("size", [(360, 540), (97, 333), (375, 1242), (2, 330), (300, 321), (700, 320)])
def test_a_reduced_image_is_that_of_opencv_to_the_bit(size):
    image = np.random.default_rng(0).integers(0, 256, size).astype(np.uint8)
    small = np.empty((max(round(size[0] * 0.6), 1), 160 if size[1] > 320 else 319), np.uint8)
    reduce(image, small)
    np.testing.assert_array_equal(small, cv2.resize(image, small.shape[::-1], interpolation=cv2.INTER_AREA))


def test_the_pixel_of_a_cell_has_the_largest_gradient():
    image = np.random.default_rng(3).integers(0, 255, (40, 48)).astype(np.uint8)
    pixel, x = free_pixels(image, 8, np.zeros((0, 2))).reshape(5, 6, 2).astype(int), image.astype(int)
    for j in range(5):
        for i in range(6):
            inside = [
                ((x[v, u + 1] - x[v, u - 1]) ** 2 + (x[v + 1, u] - x[v - 1, u]) ** 2, u, v)
                for v in range(max(8 * j, 6), min(8 * j + 8, 34))
                for u in range(max(8 * i, 6), min(8 * i + 8, 42))
            ]
            assert (max(inside)[0], *pixel[j, i]) in inside
    occupied = np.array([[9.0, 9.0], [-3.0, 20.0], [20.0, 41.0]])  # the last two lie outside
    np.testing.assert_array_equal(free_pixels(image, 8, occupied), np.delete(pixel.reshape(-1, 2), 7, 0))


def stored(image, pixel):
    """Landmarks at pixels [n, 2] of an image, on the plane, in a memory of three."""
    shapes = (3, 3), (3, 4, 4), 3, (3, 8, 8), 3, 3, 3, 3
    kinds = float, float, float, np.float32, bool, int, int, int
    landmarks = Columns(*map(np.zeros, shapes, kinds))
    n, none = len(pixel), np.zeros((0, 2))
    new = Sighted(np.zeros(0, int), pixel.copy(), np.zeros(n), np.ones(n), np.arange(n), none, np.zeros(0, bool))
    measured = np.full(n, 2), np.ones(n, bool), np.full(n, 0.5), np.full(n, 0.005**2 - (0.005 * 0.5) ** 2)
    settle(landmarks, 1, image, np.eye(4), np.linalg.inv(K), new, *measured, True, 0.8, np.array([1e-4, 2.0]))
    return landmarks


def test_a_landmark_is_sighted_where_it_projects_and_not_behind_something(scene):
    image, _, others = scene
    pixel = np.array([[40.0, 30.0], [60.0, 44.0]])
    point = np.concatenate([pixel, np.ones((2, 1))], 1) @ np.linalg.inv(K).T * 2.0
    landmarks = stored(image, pixel)
    np.testing.assert_allclose(landmarks.point[:2], point, atol=1e-12)
    np.testing.assert_allclose(np.square(landmarks.patch[:2]).sum((1, 2)), 1, atol=1e-6)
    for view, T in zip(others, MOVED, strict=True):
        seen = sight(landmarks, 2, view, T, K, 8)
        cam = (point - T[:3, 3]) @ T[:3, :3]
        np.testing.assert_allclose(seen.pixel[:2], cam[:, :2] / cam[:, 2:] * 90 + K[:2, 2], atol=1e-9)
        np.testing.assert_allclose(seen.rho[:2], 1 / cam[:, 2], atol=1e-12)
        sigma = 0.01 * np.abs(point @ T[:3, 2]) / cam[:, 2] ** 2
        np.testing.assert_allclose(seen.variance[:2], sigma**2, atol=1e-12)
        np.testing.assert_array_equal(seen.compared, seen.pixel[:2])
        assert seen.hidden.tolist() == [False, False]
        assert seen.slot.tolist() == [0, 1]
        due = [n for n, z in enumerate(cam[:, 2]) if np.linalg.norm(T[:3, 3]) >= 0.04 * z]
        assert seen.searched.tolist() == [*due, *range(2, len(seen.pixel))]
        assert (seen.rho[2:].tolist(), seen.variance[2:].tolist()) == (
            [0] * (len(seen.rho) - 2),
            [1] * (len(seen.rho) - 2),
        )
        np.testing.assert_array_equal(seen.pixel[2:], free_pixels(view, 8, seen.pixel[:2]))
    hidden = others[0].copy()
    hidden[20:60, 30:50] = plane(9, np.eye(4))[20:60, 30:50]
    seen = sight(landmarks, 3, hidden, MOVED[0], K, 8)
    assert (seen.hidden.tolist(), seen.slot.tolist()) == ([True, False], [1])
    assert landmarks.failed.tolist() == [1, 0, 0]
    assert landmarks.seen.tolist() == [2, 3, 0]
    turned = sight(landmarks, 4, others[0], pose(turned=(0, np.pi, 0)), K, 8)
    assert len(turned.compared) == 0, "behind the camera"
    for frame in range(5, 9):
        sight(landmarks, frame, hidden, MOVED[0], K, 8)
    assert landmarks.used.tolist() == [False, True, False]


def test_a_patch_without_contrast_is_zero_and_never_shown():
    """Its values are grey levels, so that their product with a window would exceed any correlation."""
    image = np.full((72, 96), 100, np.uint8)
    image[36, 48] = 108
    landmarks = stored(image, np.array([[48.0, 36.0]]))
    assert not landmarks.patch.any()
    seen = sight(landmarks, 2, plane(0, np.eye(4)), np.eye(4), K, 8)
    assert seen.hidden.tolist() == [True]


@pytest.mark.parametrize("better", ["confirmed", "sigma"])
def test_a_cell_keeps_the_landmark_that_is_known_best(scene, better):
    image, _, others = scene
    landmarks = stored(image, np.array([[40.0, 30.0], [42.0, 31.0]]))
    if better == "confirmed":
        landmarks.confirmed[1] = 1
    else:
        landmarks.sigma[1] /= 2
    seen = sight(landmarks, 2, others[0], MOVED[0], K, 48)
    assert seen.hidden.tolist() == [False, False]
    assert seen.slot.tolist() == [1]
    assert landmarks.used.tolist() == [False, True, False]


def test_a_search_along_the_last_rows_finds_the_window_there():
    @reordered
    def searched(patch, pixels, line, windows, sums, scores, match):
        return _search(patch, pixels, 1, width, height, *line, windows, sums, scores, match)

    height, width = 12, 24
    images = np.random.default_rng(0).integers(0, 256, (2, height, width), dtype=np.uint8)
    sums, scores, match = np.empty((9, 3, LANES), np.float32), np.empty(9, np.float32), np.empty(4)
    patch = images[1, -8:, 7:15].astype(np.float32).ravel()
    patch = (patch - patch.mean()) / np.linalg.norm(patch - patch.mean())
    line = (6.5, height - 4.5, 1.0, np.array([8.0, 0.0, 0.0]), 0.0, 1.0)
    assert searched(patch, images.ravel(), line, np.empty((2, 9), np.int64), sums, scores, match)
    assert match[:2].tolist() == [10.5, height - 4.5]
    assert match[2] == pytest.approx(1, abs=1e-5)


def test_images_of_half_the_size_are_those_of_the_stored_keyframes():
    """Also when the ring has replaced an image, when a state is loaded, and when images have another size."""
    keyframes, states = Keyframes(2), []

    def stored_values():
        return [(int(keyframes._image[i, 0, 0]), int(keyframes._half[i, 0, 0])) for i in range(3)]

    for i in range(4):
        image = np.full((8, 8), 10 * i, np.uint8)
        keyframes.add(image, halved(image), pose(x=i), 2.0, i)
        states.append(keyframes.state())
    assert stored_values() == [(30, 30), (10, 10), (20, 20)]
    keyframes.load_state(states[1])
    assert stored_values() == [(0, 0), (10, 10), (0, 0)]
    keyframes.reset()
    image = np.full((6, 6), 7, np.uint8)
    keyframes.add(image, halved(image), np.eye(4), 2.0, 0)
    assert keyframes._half[0].tolist() == [[7] * 3] * 3


def test_a_new_keyframe_leaves_those_of_the_state_before_unchanged():
    keyframes = Keyframes(3)
    for i in range(9):
        state, snapshot = keyframes.state(), keyframes.snapshot()
        image = np.full((8, 8), 10 * i, np.uint8)
        keyframes.add(image, halved(image), pose(x=i), 2.0, i)
        assert keyframes._added == i + 1
        keyframes.restore(snapshot)
        if i > 0:
            newest = [(i - 1 - k) % 4 for k in range(min(i, 3))]
            np.testing.assert_array_equal(keyframes._image[newest], state["images"][newest])
            assert all(
                np.array_equal(state[name], value) for name, value in keyframes.state().items() if name != "images"
            )
        keyframes.add(image, halved(image), pose(x=i), 2.0, i)


@pytest.mark.parametrize("seed", range(5))
def test_keyframes_are_chosen_by_baseline_and_overlap(seed):
    """A ring of 7 of 10 keyframes on a way, some of which look elsewhere."""
    rng, keyframes, poses = np.random.default_rng(seed), Keyframes(7), []
    for i in range(10):
        turned = rng.normal([0, 1.5 * (i % 4 == 1), 0], 0.02)
        poses.append(pose(0.12 * i + rng.uniform(0, 0.02), rng.normal(0, 0.01), rng.normal(0, 0.01), turned))
        keyframes.add(np.zeros((72, 96), np.uint8), np.zeros((36, 48), np.uint8), poses[-1], 2.0, i)
    baselines, T = np.array([0.04, 0.1, 0.22, 0.45]), pose(1.2, 0.03, 0.02, (0.01, 0.02, -0.01))
    views, half, longest = keyframes.compared(T, K, 2.0, baselines)
    expected = oracle_dense.chosen(poses[3:], T, K, (72, 96), 2.0, baselines)
    assert [(int(s), int(n)) for s, n in zip(views.share, views.slot, strict=True)] == [
        (s, (n + 3) % 8) for s, n in expected
    ]
    assert len(expected) >= 2
    assert longest == pytest.approx(np.linalg.norm(poses[3 + expected[-1][1]][:3, 3] - T[:3, 3]))
    for k, (_, n) in enumerate(expected):
        relative = np.linalg.inv(poses[n + 3]) @ T
        np.testing.assert_allclose(views.H[k], K @ relative[:3, :3] @ np.linalg.inv(K), atol=1e-9)
        np.testing.assert_allclose(views.b[k], K @ relative[:3, 3], atol=1e-9)
        for u in rng.uniform(0, 90, (5, 2)):
            at = oracle_dense.project(2 * u + 0.5, 0.5, views.H[k], views.b[k])
            fine = oracle_dense.project(u, 0.5, half.H[k], half.b[k])
            np.testing.assert_allclose(2 * fine + 0.5, at, atol=1e-9)


def measured_again(rho, variance=0.005**2, storable=True, frame=3):
    """The memory and the numbers after the second landmark, at .5 / m, and a new pixel were measured."""
    image = plane(0, np.eye(4))
    landmarks = stored(image, np.array([[40.0, 30.0], [60.0, 44.0]]))
    pixel = np.array([[40.0, 30.0], [60.0, 44.0], [20.0, 20.0]])
    before = np.array([0.5, 0.5, 0]), np.array([0.005**2, 0.005**2, 1])
    seen = Sighted(np.array([0, 1]), pixel, *before, np.array([1, 2]), np.zeros((0, 2)), np.zeros(0, bool))
    measured = np.full(2, 2 if storable else 1), np.ones(2, bool), np.array([rho, 1.0]), np.array([variance, 0.05])
    numbers = np.array([1e-4, 2.0])
    camera = np.eye(4), np.linalg.inv(K)
    count, refuted = settle(landmarks, frame, image, *camera, seen, *measured, True, 0.8, numbers)
    return landmarks, seen, count, refuted


def test_a_measurement_that_agrees_confirms_a_landmark_and_is_merged_with_it():
    landmarks, seen, count, refuted = measured_again(0.505)
    assert (count, refuted, landmarks.confirmed[:2].tolist(), landmarks.failed[:2].tolist()) == (3, 0, [0, 1], [0, 0])
    noise = 0.005**2 + (0.005 * 0.505) ** 2
    merged = np.average([0.5, 0.505], weights=[1 / 0.005**2, 1 / noise])
    np.testing.assert_allclose(seen.rho, [0.5, merged, 1.0])
    np.testing.assert_allclose(seen.variance, [0.005**2, 0.005**2, 0.05 + 0.005**2])
    np.testing.assert_allclose(landmarks.point[1], np.linalg.inv(K) @ [60, 44, 1] / merged)
    np.testing.assert_allclose(landmarks.sigma[1], 0.005 / merged)
    assert landmarks.used.tolist() == [True, True, True]
    assert landmarks.seen.tolist() == [1, 3, 3]


def test_a_measurement_that_differs_refutes_a_landmark():
    landmarks, seen, count, refuted = measured_again(0.7)
    assert (count, refuted, landmarks.confirmed.tolist()) == (2, 1, [0, 0, 0])
    np.testing.assert_allclose(seen.rho[:2], [0.5, 1.0])
    assert seen.pixel[:2].tolist() == [[40, 30], [20, 20]]
    np.testing.assert_allclose(landmarks.point[1], np.linalg.inv(K) @ [20, 20, 1], err_msg="its slot is free again")


def test_an_uncertain_match_of_one_view_is_an_anchor_but_no_landmark():
    landmarks, _, count, _ = measured_again(0.5, storable=False)
    assert (count, landmarks.used.tolist()) == (3, [True, True, False]), (
        "sigma is more than a fifth of the inverse depth"
    )


def test_a_new_landmark_replaces_the_one_not_seen_for_longest(scene):
    image, pixel, _ = scene
    landmarks, camera = stored(image, pixel[:3]), (np.eye(4), np.linalg.inv(K))
    landmarks.seen[:], landmarks.confirmed[:] = [5, 4, 6], 3
    new = Sighted(np.zeros(0, int), pixel[3:4].copy(), np.zeros(1), np.ones(1), np.zeros(1, int), np.zeros((0, 2)),
                  np.zeros(0, bool))  # fmt: skip
    measured = np.full(1, 2), np.ones(1, bool), np.full(1, 0.25), np.full(1, 1e-5)
    settle(landmarks, 7, image, *camera, new, *measured, True, 0.8, np.array([1e-4, 2.0]))
    assert (landmarks.seen.tolist(), landmarks.confirmed.tolist()) == ([5, 7, 6], [3, 0, 3])
    np.testing.assert_allclose(landmarks.point[1], np.linalg.inv(K) @ [*pixel[3], 1] * 4)


def test_poses_that_contradict_the_images_measure_nothing():
    landmarks = stored(plane(0, np.eye(4)), np.array([[40.0, 30.0]]))
    seen = Sighted(np.zeros(1, int), np.full((1, 2), 30.0), np.full(1, 0.5), np.full(1, 1e-4), np.zeros(1, int),
                   np.zeros((0, 2)), np.zeros(0, bool))  # fmt: skip
    measured = np.full(1, 2), np.ones(1, bool), np.full(1, 0.7), np.full(1, 1e-5)
    camera = np.eye(4), np.linalg.inv(K)
    numbers = np.array([1e-4, 2.0])
    assert settle(landmarks, 2, plane(0, np.eye(4)), *camera, seen, *measured, False, 0.8, numbers) == (0, 0)
    assert landmarks.failed[0] == 0


def test_the_spread_beyond_the_stated_one_is_learnt_from_landmarks():
    """Landmarks whose inverse depths are measured again with 3 % more noise than stated."""
    rng, image = np.random.default_rng(0), plane(0, np.eye(4))
    n = 400
    shapes, kinds = (
        ((n, 3), (n, 4, 4), n, (n, 8, 8), n, n, n, n),
        (float, float, float, np.float32, bool, int, int, int),
    )
    landmarks, numbers = Columns(*map(np.zeros, shapes, kinds)), np.array([0.0, 2.0])
    rho = 0.5 * rng.normal(1, 0.03, n)
    for frame in range(20):
        seen = Sighted(np.arange(n), np.full((n, 2), 30.0), np.full(n, 0.5), np.full(n, 1e-6), np.arange(n),
                       np.zeros((0, 2)), np.zeros(0, bool))  # fmt: skip
        measured = np.full(n, 2), np.ones(n, bool), rho, np.full(n, 1e-6)
        camera = np.eye(4), np.linalg.inv(K)
        settle(landmarks, frame, image, *camera, seen, *measured, True, 0.5, numbers)
    assert numbers[0] == pytest.approx(0.03**2, rel=0.2)
