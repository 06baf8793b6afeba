"""Errors of poses and camera in dense evidence, and anchors near depth edges: against NumPy loops and closed forms."""

from __future__ import annotations

import numpy as np
import oracle_dense
import pytest
from scipy.spatial.transform import Rotation

from ufmstar_torch.anchors.dense_poses import PoseErrors
from ufmstar_torch.anchors.kernels.check import check_anchors, confirmed, farther
from ufmstar_torch.anchors.kernels.dense import Measured, Views
from ufmstar_torch.anchors.kernels.pose_equations import linearised, rotated, solve

K = np.array([[250.0, 0, 159.5], [0, 252.0, 119.5], [0, 0, 1]])


def scene(seed, count=40, moved=0.3):
    """Pixels, inverse depths and three views of them."""
    rng = np.random.default_rng(seed)
    pixel, rho = rng.uniform([10, 10], [310, 230], (count, 2)), rng.uniform(0.3, 1.2, count)
    R = Rotation.from_rotvec(rng.normal(0, 0.05, (3, 3))).as_matrix()
    t = rng.normal(0, moved, (3, 3)) * np.array([[0.2], [0.5], [1]])
    H, image = K @ R @ np.linalg.inv(K), np.zeros((3, 240, 320), np.uint8)
    return pixel, rho, Views(image, np.arange(3), np.arange(3), H, t @ K.T, np.zeros(3))


def lines(pixel, rho, views):
    """Directions of the lines [N, V, 2] and speeds [N, V]."""
    step = 1e-5
    ends = np.array([
        [oracle_dense.project(p, r + d, H, b) for H, b in zip(views.H, views.b, strict=True) for d in (-step, step)]
        for p, r in zip(pixel, rho, strict=True)
    ]).reshape(len(rho), 3, 2, 2)  # fmt: skip
    way = (ends[:, :, 1] - ends[:, :, 0]) / (2 * step)
    speed = np.linalg.norm(way, axis=-1)
    return way / speed[..., None], speed


def measured(pixel, rho, views, error, noise, rng):
    """The result of a search with the errors ``error`` [3, 10] of poses and camera, and with noise [px]."""
    along, speed = lines(pixel, rho, views)
    off = np.zeros((*speed.shape, 2))
    for n, k in np.ndindex(speed.shape):
        geometry = pixel[n], rho[n], views.H[k], views.b[k]
        off[n, k] = oracle_dense.displaced(*geometry, K, error[k]) - oracle_dense.project(*geometry)
    off = off + rng.normal(0, noise, off.shape)
    normal = np.stack([-along[..., 1], along[..., 0]], -1)
    value, same = rho[:, None] + (off * along).sum(-1) / speed, np.full(speed.shape, noise**2)
    n = len(rho)
    columns = value, same, along[..., 0], along[..., 1], speed, np.zeros(speed.shape), (off * normal).sum(-1), same
    each = np.ascontiguousarray(np.stack(columns, -1))
    return Measured(value.mean(1), np.ones(n), np.full(n, 3), *np.zeros((2, n), np.int64), each, np.zeros((n, 2)))


def corrected(errors, pixel, found, views, trusted=True):
    """Inverse depths, their variances and the distances from the lines after a frame, all pixels accepted."""
    return errors.corrected(pixel, np.ones(len(pixel), np.bool_), found, views, K, 2.0, trusted)


def test_derivatives_agree_with_differences():
    pixel, rho, views = scene(0, 12)
    along, _ = lines(pixel, rho, views)
    slope = np.random.default_rng(1).normal(0, 0.5, along.shape[:2])
    R, t, change, on_line, across = np.zeros((3, 3)), np.zeros(3), np.zeros((2, 10)), *np.zeros((2, 12, 3, 10))
    for k in range(3):
        rotated(views.H[k], views.b[k], K, np.linalg.inv(K), R, t)
        for n in range(12):
            each = along[n, k], slope[n, k], R, t, K, change, on_line[n, k], across[n, k]
            linearised(pixel[n], rho[n], *each)
            J = oracle_dense.by_errors(pixel[n], rho[n], views.H[k], views.b[k], K)
            e, p = along[n, k], np.array([-along[n, k, 1], along[n, k, 0]])
            np.testing.assert_allclose(across[n, k], p @ J, rtol=1e-5, atol=1e-5)
            np.testing.assert_allclose(on_line[n, k], (e + slope[n, k] * p) @ J, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_errors_and_depths_agree_with_the_whole_system(seed):
    rng, n = np.random.default_rng(seed), 9
    change, across_change = rng.normal(size=(2, n, 3, 10))
    value, across = rng.normal(size=(2, n, 3))
    variance, across_variance = rng.uniform(0.1, 2, (2, n, 3))
    variance[rng.random((n, 3)) < 0.3] = np.inf
    variance[:, 0] = 1
    across_variance[rng.random((n, 3)) < 0.3] = np.inf
    root = rng.normal(size=(22, 22))
    measurements = change, value, variance, across_change, across, across_variance
    prior = root @ root.T + np.eye(22), rng.normal(size=22)
    rho, error, covariance, mean_change = np.zeros(n), np.zeros(22), np.zeros((22, 22)), np.zeros((22, n))
    buffers = (np.zeros(shape) for shape in ((2, 10, n), (4, n), (22, 22), 22, (22, n)))
    weights = change, value, 1 / variance, across_change, across, 1 / across_variance
    by_view = (np.moveaxis(x, 0, -1) for x in weights)
    results = error, covariance, mean_change, rho, *np.zeros((2, 3, n))
    assert solve(*by_view, prior[0], prior[0] @ prior[1], *results, *buffers)
    common = (mean_change * (covariance @ mean_change)).sum(0)
    expected_error, expected_covariance, expected_rho, spread = oracle_dense.errors_and_depths(*measurements, *prior)
    np.testing.assert_allclose(error, expected_error, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(covariance, expected_covariance, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(rho, expected_rho, rtol=1e-8, atol=1e-10)
    assert (common <= spread).all(), "the rest comes from the match alone"


def filtered(frames=1, seed=0, noise=0.05, **wrong):
    """The filter after frames with pose and camera errors, the last measurement, its correction, and the true rho."""
    rng, errors = np.random.default_rng(seed), PoseErrors(3, 0.8)
    for i in range(frames):
        pixel, rho, views = scene([seed, i])
        error = np.zeros((3, 10))
        error[:, 6:] = wrong.get("camera", 0)
        error[:, :6] = rng.normal(0, 1, (3, 6)) * np.repeat([wrong.get("turned", 0), wrong.get("moved", 0)], 3)
        found = measured(pixel, rho, views, error, noise, rng)
        errors.positions(K, 320, 2.0)
        fit = corrected(errors, pixel, found, views)
    return errors, found, fit, rho


def test_wrong_poses_are_corrected_and_what_remains_is_stated():
    better, normalised = [], []
    for seed in range(10):
        _, found, (fitted, variance, _), rho = filtered(8, seed, turned=0.002, moved=0.004)
        better.append(np.median(np.abs(fitted - rho)) / np.median(np.abs(found.rho - rho)))
        normalised.append(np.median(np.abs(fitted - rho) / np.sqrt(variance)) / 0.674)
    assert np.median(better) < 0.6
    assert 0.5 < np.median(normalised) < 2.2, "few frames, which also estimate the usual pose errors"


def test_what_remains_of_wrong_poses_is_stated_beyond_first_order():
    """The poses' usual errors and the camera are known here: 8 mm of some 10 cm between the nearest views."""
    sizes = []
    for seed in range(40):
        rng, errors, error = np.random.default_rng(seed), PoseErrors(3, 0.8), np.zeros((3, 10))
        pixel, rho, views = scene(seed)
        draws = np.sqrt(0.5) * (rng.normal(size=6) + rng.normal(size=(3, 6)))
        error[:, :6] = draws * np.repeat([0.002, 0.008], 3)
        errors.positions(K, 320, 2.0)
        errors._variance[:], errors._unexplained[:] = np.square([0.002, 0.008]), 0
        errors._covariance *= 1e-4
        found = measured(pixel, rho, views, error, 0.02, rng)
        fitted, variance, _ = corrected(errors, pixel, found, views)
        sizes.append(np.abs(fitted - rho) / np.sqrt(variance))
    assert 0.65 < np.median(sizes) / 0.674 < 1.3
    assert np.quantile(sizes, 0.9) / 1.645 < 1.5


def test_a_wrong_camera_is_learnt():
    errors, *_ = filtered(20, camera=np.array([0.004, 1.0, -0.8, 0.0]))
    # The views' K is not corrected here, so the estimates add up until the prior limits them.
    assert np.sign(errors.camera(K) - K)[[0, 0, 1], [0, 2, 2]].tolist() == [1, 1, -1]
    assert errors.camera(K)[0, 0] > 1.002 * K[0, 0]


def test_frames_that_contradict_their_poses_teach_nothing_of_the_camera():
    errors, found, *_ = filtered(3, camera=np.array([0.004, 1.0, -0.8, 0.0]))
    pixel, _, views = scene(5)
    before = errors.camera(K)
    corrected(errors, pixel, found, views, trusted=False)
    np.testing.assert_array_equal(errors.camera(K), before)


def test_nothing_measured_leaves_what_is_believed_of_the_poses():
    errors, found, *_ = filtered(3)
    pixel, _, views = scene(5)
    empty = Measured(*(np.full_like(x, np.nan) if x.dtype == float and x.ndim > 1 else np.zeros_like(x) for x in found))
    before = errors.positions(K, 320, 2.0)
    _, variance, _ = corrected(errors, pixel, empty, views)
    assert np.isinf(variance).all()
    np.testing.assert_allclose(errors.positions(K, 320, 2.0), before, rtol=1e-6)


def around(rho_right, rho_here):
    """A vertical grey edge in the middle; anchors on a grid, the middle one on the edge."""
    image = np.full((120, 120), 60, np.uint8)
    image[:, 61:] = 180
    v, u = np.mgrid[5:120:10, 5:120:10]
    pixel = np.stack([u.ravel(), v.ravel()], 1).astype(float)
    rho = np.where(pixel[:, 0] > 60, rho_right, 1.0)
    middle = int(np.flatnonzero((pixel == [65, 65]).all(1))[0])
    pixel[middle], rho[middle] = (60.0, 65.0), rho_here
    return image, pixel, rho, middle


@pytest.mark.parametrize(("rho_here", "to"), [(2.0, 62.0), (1.0, 58.0)])
def test_an_anchor_on_an_edge_moves_to_its_own_surface(rho_here, to):
    image, pixel, rho, middle = around(2.0, rho_here)
    surface, alone = check_anchors(image, pixel, rho, np.full(len(rho), 1e-4), 10)
    np.testing.assert_allclose(surface[middle], [to, 65], atol=1e-6)
    assert alone[middle] < 0.1 * (2.0 - 1.0) ** 2
    flat = np.abs(pixel[:, 0] - 60) > 20
    np.testing.assert_array_equal(surface[flat], pixel[flat])


def test_an_anchor_that_differs_from_those_around_it_is_as_uncertain_as_the_oracle_states():
    rng = np.random.default_rng(0)
    image, pixel, rho, middle = around(1.0, 3.0)
    rho = rho * rng.uniform(0.9, 1.1, len(rho))
    variance = rng.uniform(1e-4, 1e-3, len(rho))
    _, alone = check_anchors(image, pixel, rho, variance, 10)
    np.testing.assert_allclose(alone, oracle_dense.alone(pixel, rho, variance, 10), rtol=1e-12)
    assert alone[middle] > 0.5
    assert np.delete(alone, middle).max() < 0.1 * alone[middle]


def test_matches_of_one_view_hold_where_the_oracle_finds_support():
    rng, seen = np.random.default_rng(0), []
    for _ in range(20):
        _, pixel, _, _ = around(1.0, 1.0)
        n = len(pixel)
        surface = np.where(pixel[:, 0] + pixel[:, 1] > rng.uniform(40, 200), 1.0, 0.5)
        rho = np.where(rng.random(n) < 0.03, rng.uniform(0.2, 2, n), surface * rng.normal(1, 0.02, n))
        variance = np.square(rho * rng.choice([0.01, 0.05, 0.3], n, p=[0.5, 0.48, 0.02]))
        agreed, contradicted = rng.choice([0, 1, 1, 2, 3], n), rng.choice([0, 0, 0, 0, 1], n)
        each = np.full((n, 3, 8), np.nan), np.zeros((n, 2))
        result, counts = confirmed(pixel, Measured(rho, variance, agreed, contradicted, agreed, *each), 10)
        expected = oracle_dense.confirmed(pixel, rho, variance, agreed, contradicted, 10)
        np.testing.assert_array_equal(result, expected)
        several = agreed + contradicted > 1
        assert counts == (several.sum(), (several & expected).sum(), (contradicted > 0).sum())
        seen.append([np.mean(result[agreed == 1]), np.mean(~result[(agreed == 1) & (contradicted == 0)])])
    assert np.mean(seen, 0).min() > 0.1, "some measurements are accepted and some are not"


@pytest.mark.parametrize("count", [0, 1, 30])
def test_pixels_far_from_all_others(count):
    rng = np.random.default_rng(0)
    pixel, others = rng.uniform(0, 100, (40, 2)), rng.uniform(0, 100, (count, 2))
    nearest = np.linalg.norm(pixel[:, None] - others, axis=2).min(1, initial=np.inf)
    np.testing.assert_array_equal(farther(pixel, others, 9.0), nearest > 9.0)


def test_nothing_is_confirmed_where_nothing_was_measured():
    none = np.zeros(0)
    empty = Measured(none, none, *[none.astype(int)] * 3, np.zeros((0, 3, 8)), np.zeros((0, 2)))
    reliable, counts = confirmed(np.zeros((0, 2)), empty, 10)
    assert (len(reliable), counts) == (0, (0, 0, 0))
