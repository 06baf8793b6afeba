"""Checks and corrections in plain or compiled code on the CPU, against the chains of tensors that they replace."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ufmstar_torch.anchors.check import check_anchor_values as reference_check
from ufmstar_torch.anchors.kernels.learn import check_anchor_values
from ufmstar_torch.frames import frame as reference
from ufmstar_torch.frames.frame import check_frame
from ufmstar_torch.gaussians.camera import inverse_intrinsics, rotation_deviation
from ufmstar_torch.kernels.cpu import check
from ufmstar_torch.posterior.update import finish

K = torch.tensor([[40.0, 0, 31.5], [0, 42.0, 23.5], [0, 0, 1]])
NAMES = ("pixel", "index", "predicted", "depth", "variance", "valid", "rejected", "contradiction")


@pytest.mark.parametrize("off", [1.0, 1e3])
@pytest.mark.parametrize("masked", [False, True])
def test_anchors_are_checked_as_by_the_reference(masked, off):
    rng = np.random.default_rng(int(off))
    depth = torch.from_numpy(rng.uniform(1, 3, (2, 48, 64)))
    depth[:, :5] = torch.nan
    frame = check_frame(depth, torch.eye(4), K, None, None, None, rotation_tolerance=0.01, max_depth=10.0)
    pixel, values = torch.from_numpy(rng.uniform(-3, 66, (2, 300, 2))), torch.from_numpy(rng.uniform(0.5, 4, (2, 300)))
    values[0] *= off  # with 1,000, most anchors of a stream are off by more than a factor of 100
    variance = torch.from_numpy(rng.uniform(0, 3, (2, 300)))
    pixel[0, :6, 0] = torch.tensor([torch.nan, torch.inf, -0.5, 63.5, 0.5, 1.5])
    values[1, :5] = torch.tensor([torch.nan, torch.inf, 0.0, -1.0, 1e200])
    variance[1, 5:9] = torch.tensor([torch.nan, torch.inf, -1.0, 0.0])
    mask = torch.from_numpy(rng.random((2, 300)) < 0.8) if masked else None
    arguments = pixel, values, variance, mask, frame
    for name, found, expected in zip(NAMES, check_anchor_values(*arguments), reference_check(*arguments), strict=True):
        assert found.dtype == expected.dtype, name
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=0, msg=name)
    assert int(expected[0] > 0) == (off > 1)


def test_poses_and_intrinsics_have_the_reference_s_faults():
    poses = [torch.eye(4, dtype=torch.float64) for _ in range(8)]
    poses[1][0, 0], poses[2][3, 0], poses[3][0, 0], poses[5][2, 3] = torch.nan, 0.5, 1.2, 2e9
    poses[4][0, 0], poses[6][1, 3] = -1.0, torch.inf
    poses[7][:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).double()).Q
    cameras = [K.double().clone() for _ in range(6)]
    cameras[1][0, 1], cameras[2][0, 0], cameras[3][1, 1], cameras[4][0, 2], cameras[5][1, 1] = 1, 0, 1e8, 64, torch.nan
    T, cameras_K = torch.stack(poses), torch.stack(cameras)
    expected = reference.pose_fault(T, rotation_deviation(T[:, :3, :3]), 0.01).tolist()
    assert check.camera_faults(T.numpy(), K[None].numpy(), (48, 64), 0.01) == expected
    assert set(expected) >= {0, 1, 2, 3, 4, 7}
    expected = reference.intrinsics_fault(cameras_K, (48, 64)).tolist()
    fine = T[:1].expand(len(cameras), 4, 4).numpy()
    assert check.camera_faults(fine, cameras_K.numpy(), (48, 64), 0.01) == expected
    assert set(expected) == {0, 5, 6, 8, 9}


def test_the_inverse_of_intrinsics():
    camera = np.array([[517.3, 0.7, 318.6], [0, 516.5, 255.3], [0, 0, 1]])
    np.testing.assert_allclose(inverse_intrinsics(camera) @ camera, np.eye(3), rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("shared", "scale", "contradiction"), [(0.0, 0.0, 0.0), (0.01, 0.02, 0.3), (torch.inf, 0.0, 0.0)]
)
def test_common_errors_are_added_as_stated(dtype, shared, scale, contradiction):
    """max(V, floor) + d^2 (contradiction + min(d^2 shared + scale, limit)) of the corrected depth d."""
    generator = torch.Generator().manual_seed(1)
    network, factor, variance, inlier = (torch.rand(9, 7, generator=generator, dtype=dtype) + 0.5 for _ in range(4))
    for value in (factor, variance, inlier):
        value[2] = torch.nan
    depth, limit, floor = network * factor, 0.25, 0.9
    square = depth.double().square()
    added = square * (contradiction + (square * shared + scale).clamp(max=limit))
    expected = [(value.double() * factor.double().square()).clamp_min(floor) + added for value in (variance, inlier)]
    maps = factor.clone(), variance.clone(), inlier.clone()
    finish(network.numpy(), *(x.numpy() for x in maps), (shared, scale, contradiction, limit), floor)
    for value, other in zip(maps, (depth, *expected), strict=True):
        torch.testing.assert_close(value, other.to(dtype), rtol=8 * torch.finfo(dtype).eps, atol=0, equal_nan=True)
