"""Pinhole geometry: unprojection, poses, projected covariances (resize and crop: test_preprocess.py)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from random_gaussians import covariances, means, mixture
from scipy.spatial.transform import Rotation

import oracle
import scenes
from ufmstar_torch.gaussians import camera

pytestmark = pytest.mark.numerics


def pose(seed: int) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    return torch.from_numpy(T)


def test_unproject_is_the_papers_formula():
    K = torch.tensor(scenes.intrinsics(6, 9), dtype=torch.float64)[None].repeat(2, 1, 1)
    K[1, 0, 2] += 0.7
    depth = 1 + torch.rand(2, 6, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    points = camera.unproject(depth, K)
    for b, v, u in [(0, 0, 0), (0, 5, 8), (1, 2, 7)]:
        d, k = depth[b, v, u], K[b]
        expected = torch.stack([(u - k[0, 2]) / k[0, 0] * d, (v - k[1, 2]) / k[1, 1] * d, d])
        torch.testing.assert_close(points[b, v, u], expected, rtol=0, atol=1e-13)


@given(st.integers(0, 10**6))
def test_relative_pose(seed):
    T_a, T_b = pose(seed), pose(seed + 1)
    R, t = camera.relative_pose(T_a, T_b)
    expected = torch.linalg.inv(T_b) @ T_a
    torch.testing.assert_close(R, expected[:3, :3], rtol=0, atol=1e-13)
    torch.testing.assert_close(t, expected[:3, 3], rtol=0, atol=1e-13)
    torch.testing.assert_close(camera.invert_rigid(T_a) @ T_a, torch.eye(4).double(), rtol=0, atol=1e-14)


def test_relative_pose_keeps_digits_far_from_the_world_origin():
    """Two cameras 10 cm apart, at city-scale coordinates: their relative pose keeps full precision."""
    T_a, T_b = pose(0), pose(0)
    T_a[:3, 3] = torch.tensor([5e6, -3e6, 100.0], dtype=torch.float64)
    T_b[:3, 3] = T_a[:3, 3] + torch.tensor([0.125, 0.0, 0.0], dtype=torch.float64)
    _, t = camera.relative_pose(T_a, T_b)
    assert t.norm().item() == pytest.approx(0.125, abs=1e-15)


@given(st.integers(0, 10**6), st.floats(0, 0.01))
def test_nearest_rotation_is_the_polar_factor(seed, amount):
    R = pose(seed)[:3, :3]
    noise = torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    skewed = R + amount * noise / noise.abs().max()
    U, _, Vh = torch.linalg.svd(skewed)
    torch.testing.assert_close(camera.nearest_rotation(skewed), U @ Vh, rtol=0, atol=1e-14)
    greatest = R * (1.1**0.5)  # the largest accepted deviation
    assert camera.rotation_deviation(greatest).item() == pytest.approx(0.1)
    torch.testing.assert_close(camera.nearest_rotation(greatest), R, rtol=0, atol=1e-14)


@given(st.integers(0, 10**6))
def test_projected_covariance(seed):
    K = torch.tensor(scenes.intrinsics(48, 64))
    mean, cov = means(3, seed), covariances(3, seed)
    mean[:, 2] = mean[:, 2].abs() + 0.5
    image_mean, image_cov = camera.project_gaussian(mean[None], cov[None], K[None])
    for i in range(3):
        m, S = oracle.project(mean[i].numpy(), cov[i].numpy(), K.numpy())
        np.testing.assert_allclose(image_mean[0, i].numpy(), m, rtol=1e-12)
        covariance = image_cov[0, i].numpy() + oracle.PIXEL_VARIANCE * np.eye(2)
        np.testing.assert_allclose(covariance, S, rtol=1e-11, atol=1e-11)


def test_the_usual_camera_is_53_degrees_wide_and_looks_through_the_images_centre():
    assert camera.camera_of((48, 64)).tolist() == [[64, 0, 32], [0, 64, 24], [0, 0, 1]]


def test_a_mixture_in_another_frame_and_its_empty_slots_stay_zero():
    here, (R, t) = mixture(1, 6, 0, empty=2), (pose(0)[None, :3, :3], pose(0)[None, :3, 3])
    there = here.rigid(R, t)
    torch.testing.assert_close(there.mean[0, :4], here.mean[0, :4] @ R[0].T + t[0])
    torch.testing.assert_close(there.covariance, R @ here.covariance @ R.mT)
    assert not there.mean[0, 4:].any()
    assert torch.equal(there.reference, here.reference)
