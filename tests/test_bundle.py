"""Pose refinement from tracked corners: against an oracle, on scenes with known poses, and in rendered rooms."""

from __future__ import annotations

import numpy as np
import oracle_bundle
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from landmark_runs import true_depth, walk
from scipy.spatial.transform import Rotation

from ufmstar_torch.anchors.bundle import PoseRefinement
from ufmstar_torch.anchors.dense import DenseEvidence
from ufmstar_torch.anchors.kernels.bundle import between, equations, inverse_depths, move
from ufmstar_torch.anchors.tracker import LandmarkTracker

K = np.array([[260.0, 0, 160], [0, 260, 120], [0, 0, 1]])


def scene(rng, views=8, tracks=120, noise=0.0):
    """True poses [W, 4, 4] of a sideways walk, and corners [N, W, 2] of points 1 to 4 m away [px]."""
    poses = np.tile(np.eye(4), (views, 1, 1))
    poses[:, :3, 3] = np.cumsum(rng.normal([0.05, 0, 0.01], 0.02, (views, 3)), 0)
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.02, (views, 3))).as_matrix()
    z = rng.uniform(1, 4, tracks)
    pixel = rng.uniform([40, 30], [280, 210], (tracks, 2))
    point = np.concatenate([(pixel - K[:2, 2]) / K[0, 0], np.ones((tracks, 1))], 1) * z[:, None]
    cam = (point[:, None] - poses[:, :3, 3])[:, :, None] @ poses[:, :3, :3]
    seen_at = (cam @ K.T)[:, :, 0]
    return poses, seen_at[..., :2] / seen_at[..., 2:] + rng.normal(0, noise, (tracks, views, 2))


def moved(poses, error):
    result = poses.copy()
    move(error, result)
    return result


def relative(poses):
    """Buffers of :func:`between`, filled."""
    views = len(poses)
    result = np.zeros((views - 1, 3, 3)), np.zeros((views - 1, 3)), np.zeros((views, 3, 3))
    between(poses, *result)
    return result


def turned(rng, poses, degrees):
    off = poses.copy()
    off[:, :3, :3] = (
        poses[:, :3, :3] @ Rotation.from_rotvec(np.deg2rad(degrees) * rng.normal(size=(len(poses), 3))).as_matrix()
    )
    return off


def relative_angles(poses, truth):
    """[W - 1] errors of the rotations between the newest view and the others [degrees]."""
    one, other = (p[:-1, :3, :3].swapaxes(1, 2) @ p[-1, :3, :3] for p in (poses, truth))
    return np.rad2deg(Rotation.from_matrix(one @ other.swapaxes(1, 2)).magnitude())


@pytest.mark.numerics
@given(st.integers(0, 2**31))
def test_a_step_is_that_of_the_dense_problem(seed):
    rng = np.random.default_rng(seed)
    poses, pixel = scene(rng, views=4, tracks=9, noise=0.5)
    poses = turned(rng, poses, 0.5)
    ray = (pixel - K[:2, 2]) / K[0, 0]
    precision = rng.uniform(1e5, 1e6, (9, 3)) * (rng.random((9, 3)) < 0.8)
    rho, prior = rng.uniform(0.25, 1, 9), rng.uniform(1e2, 1e4, 24)
    A, b, by_error, alone = np.zeros((24, 24)), np.zeros(24), np.zeros((9, 24)), np.zeros(9)
    buffers = np.zeros((9, 24)), np.zeros((2, 2, 6))
    equations(ray, precision, *relative(poses), rho, 0.5, 4.0, A, b, by_error, alone, *buffers)
    A = np.tril(A) + np.tril(A, -1).T
    error = np.linalg.solve(0.3 * A + np.diag(prior), 0.3 * b)
    expected = oracle_bundle.step(ray, precision, poses, rho, 0.5, 4.0, 0.3, prior)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(error, expected[:24], atol=1e-6 * scale)
    np.testing.assert_allclose(alone - by_error @ error, expected[24:], atol=1e-6 * scale)


@pytest.mark.numerics
def test_inverse_depths_alone_are_those_of_the_scene():
    poses, pixel = scene(np.random.default_rng(0))
    ray = (pixel - K[:2, 2]) / K[0, 0]
    rho, (rotation, translation, _) = np.zeros(len(ray)), relative(poses)
    inverse_depths(ray, np.full((len(ray), len(poses) - 1), 1e8), rotation, translation, 0.5, 4.0, 20, rho)
    for positions, q in zip(ray, rho, strict=True):
        again = [oracle_bundle.projected(positions[-1], q, poses[-1], view) for view in poses[:-1]]
        np.testing.assert_allclose(again, positions[:-1], atol=1e-6)


@pytest.mark.numerics
@given(st.integers(0, 2**31))
def test_moving_is_the_exponential_map(seed):
    rng = np.random.default_rng(seed)
    poses, _ = scene(rng, views=3)
    error = rng.normal(0, 0.3, 18)
    error[:3] = 0
    expected = [oracle_bundle.moved(p, e) for p, e in zip(poses, error.reshape(3, 6), strict=True)]
    np.testing.assert_allclose(moved(poses, error), expected, atol=1e-12)


def learnt(seed, degrees, frames=25):
    """Ratio of the refined poses' errors to the input poses' errors, after some frames of a walk with noisy
    rotations."""
    rng, refinement, ratios, correlated = np.random.default_rng(seed), PoseRefinement(), [], []
    for _ in range(frames):
        truth, pixel = scene(rng, noise=0.2)
        given_poses = turned(rng, truth, degrees)
        seen = rng.random(pixel.shape[:2]) < 0.9
        seen[:, -1] = True
        poses = refinement.refine(pixel, seen, given_poses, K, 2.0)
        before, after = (np.sqrt(np.square(relative_angles(p, truth)).mean()) for p in (given_poses, poses))
        ratios.append(after / max(before, 1e-9))
        correlated.append(refinement.correlated)
    return refinement, ratios, correlated, after


@pytest.mark.parametrize("seed", range(3))
def test_noisy_rotations_become_four_times_smaller_and_their_noise_is_learnt(seed):
    refinement, ratios, correlated, _ = learnt(seed, 0.3)
    assert np.median(ratios[-8:]) < 0.25
    noise = np.deg2rad(0.3) * K[0, 0]
    assert 0.5 * noise < refinement.pose_variance**0.5 < 2 * noise
    assert np.median(correlated) < 0.3 * noise**2, "the errors of successive poses are independent"


@pytest.mark.parametrize("seed", range(3))
def test_right_poses_hardly_move(seed):
    refinement, _, _, after = learnt(seed, 0.0)
    assert after < 0.01
    assert refinement.pose_variance**0.5 < 0.15


@pytest.mark.parametrize("seed", range(3))
def test_the_noise_of_the_first_poses_is_learnt_faster_than_that_of_later_ones(seed):
    """After four exact poses, a fifth of the prior's variance remains."""
    rng, refinement = np.random.default_rng(seed), PoseRefinement()
    first = refinement.pose_variance
    for _ in range(4):
        truth, pixel = scene(rng, noise=0.1)
        refinement.refine(pixel, np.ones(pixel.shape[:2], bool), truth, K, 2.0)
    assert refinement.pose_variance < 0.35 * first


def test_poses_that_lag_behind_have_correlated_errors():
    rng, refinement = np.random.default_rng(0), PoseRefinement()
    for _ in range(25):
        truth, pixel = scene(rng, noise=0.2)
        late = truth.copy()
        late[-1, :3, :3] = truth[-1, :3, :3] @ Rotation.from_rotvec([0, np.deg2rad(1.0), 0]).as_matrix()
        refinement.refine(pixel, np.ones(pixel.shape[:2], bool), late, K, 2.0)
    assert refinement.correlated**0.5 > 0.3 * np.deg2rad(1.0) * K[0, 0]


def test_too_few_corners_or_views_leave_the_poses_as_they_are():
    poses, pixel = scene(np.random.default_rng(0))
    seen = np.ones(pixel.shape[:2], bool)
    for few in (np.arange(len(pixel)) < 7, np.zeros(len(pixel), bool)):
        refinement = PoseRefinement()
        np.testing.assert_array_equal(refinement.refine(pixel, seen & few[:, None], poses, K, 2.0), poses)
    only_two = seen & (np.arange(len(poses)) >= len(poses) - 2)
    np.testing.assert_array_equal(PoseRefinement().refine(pixel, only_two, poses, K, 2.0), poses)


@pytest.mark.parametrize("metres", [1, 1e6, 1e12, 1e150, 1e300])
def test_absurd_corners_and_poses_give_finite_poses(metres):
    rng = np.random.default_rng(0)
    poses, pixel = scene(rng)
    poses[:, :3, 3] *= metres
    for scale in (0, 1e3, 1e9, 1e15):
        refinement, seen = PoseRefinement(), np.ones(pixel.shape[:2], bool)
        with np.errstate(all="ignore"):
            refined = refinement.refine(pixel + rng.normal(0, scale, pixel.shape), seen, poses, K, 2.0)
        assert np.isfinite(refined).all()
        assert all(np.isfinite(value).all() for value in map(np.asarray, refinement.state().values()))


@pytest.mark.parametrize("kind", [LandmarkTracker, DenseEvidence])
def test_depths_survive_noisy_poses(kind):
    """Half a degree of noise moves corners by 2 px. Without pose refinement all depths are rejected."""
    frames, rng = walk(), np.random.default_rng(0)
    noisy = turned(rng, np.stack([f.T_world_cam for f in frames]), 0.5)
    source, errors, found = kind(), [], 0
    for frame, T in zip(frames, noisy, strict=True):
        result = source.update(frame.image, T, frame.intrinsics)
        found += len(result.depth) > 20
        errors.extend(np.abs(np.log(result.depth / true_depth(frame, result.pixel))))
    assert found >= 6
    assert np.median(errors) < 0.12
    assert result.pose_error > 1, "the input poses' error is reported"


def test_a_pose_that_jumps_once_starts_a_new_trajectory_and_teaches_nothing():
    rng, refinement, jumps = np.random.default_rng(0), PoseRefinement(), []
    for i in range(20):
        truth, pixel = scene(rng, noise=0.2)
        off = truth.copy()
        if i == 12:
            off[-1, :3, 3] += [0.1, 0, 0]
            before = {name: value.clone() for name, value in refinement.state().items()}
        poses = refinement.refine(pixel, np.ones(pixel.shape[:2], bool), off, K, 2.0)
        jumps.append(refinement.jumped)
        if i == 12:
            np.testing.assert_array_equal(poses, off)
            assert refinement.state()["given_pose_variance"].equal(before["given_pose_variance"])
    assert jumps == [i == 12 for i in range(20)]


@pytest.mark.parametrize(("recent", "jumped", "kept"), [(60.0, True, 496), (110.0, False, 496), (1e3, False, 800)])
def test_only_an_error_far_above_the_recent_ones_is_a_jump(recent, jumped, kept):
    """The error's score is 496."""
    refinement = PoseRefinement()
    refinement.load_state(refinement.state() | {"surprise_lately": torch.tensor(recent, dtype=torch.float64)})
    poses, pixel = scene(np.random.default_rng(0), noise=0.2)
    poses[-1, 0, 3] += 0.5
    refinement.refine(pixel, np.ones(pixel.shape[:2], bool), poses, K, 2.0)
    assert refinement.jumped == jumped
    assert refinement.state()["surprise_lately"].item() == pytest.approx(kept, rel=0.01)


@pytest.mark.parametrize("kind", [LandmarkTracker, DenseEvidence])
def test_depths_are_right_again_soon_after_the_poses_have_jumped(kind):
    frames, source, after = walk(), kind(), []
    for i, frame in enumerate(frames):
        T = frame.T_world_cam.copy()
        T[:3, 3] += [0.1, 0, 0] if i >= 10 else 0
        result = source.update(frame.image, T, frame.intrinsics)
        if i >= 10:
            after.append(np.abs(np.log(result.depth / true_depth(frame, result.pixel))))
    assert len(after[0]) == 0, "nothing is measured across the jump"
    assert all(len(errors) < 20 or np.median(errors) < 0.1 for errors in after), "later depths are right"
    assert len(after[-1]) > 20
