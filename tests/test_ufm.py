"""UfM, the point-cloud baseline: against loops written from its description, closed forms and properties."""

from __future__ import annotations

import numpy as np
import oracle_ufm
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import scenes
from ufmstar_torch.eval.methods.ufm import UfM

H, W, FRAMES = 15, 20, 36
CAP = 420
DEPTHS, POSES, K_ = scenes.sequence(FRAMES, H, W, 0.05)
K = torch.tensor(K_)


def variances(seed=0):
    """A per frame [H, W] [m^2], with a few invalid entries."""
    rng = np.random.default_rng(seed)
    maps = [np.exp(rng.normal(-4, 1, (H, W))) for _ in range(FRAMES)]
    for map_ in maps:
        map_[rng.random((H, W)) < 0.01] = np.nan
        map_[rng.random((H, W)) < 0.01] = -1.0
    return maps


def frame(i, s2=None, dtype=torch.float64):
    out = [torch.tensor(DEPTHS[i], dtype=dtype)[None], torch.tensor(POSES[i])[None], K[None]]
    return out if s2 is None else [*out, torch.tensor(s2, dtype=dtype)[None]]


def usable(depth, s2):
    with np.errstate(invalid="ignore"):
        return np.isfinite(depth) & (depth > 0) & np.isfinite(s2) & (s2 >= 0)


def expected(oracle, i, s2, pose=None):
    return oracle.step(DEPTHS[i], s2, usable(DEPTHS[i], s2), POSES[i] if pose is None else pose, K_)


def agree(ufm, oracle, tolerance=1e-9):
    """Compare the points, in order, with the oracle's, which are in the current camera frame."""
    cloud, T = ufm.clouds[0], np.linalg.inv(oracle.pose) @ ufm.T_world_first[0].numpy()
    mean = cloud.mean.numpy() @ T[:3, :3].T + T[:3, 3]
    cov = T[:3, :3] @ cloud.covariance.numpy() @ T[:3, :3].T
    assert cloud.count.tolist() == [point["count"] for point in oracle.points]
    np.testing.assert_allclose(mean, [point["mean"] for point in oracle.points], rtol=0, atol=tolerance)
    np.testing.assert_allclose(cov, [point["cov"] for point in oracle.points], rtol=0, atol=tolerance)


# ---- against the oracle ----


@pytest.mark.parametrize(("cap", "parts"), [(None, 0), (CAP, 1), (H * W - 30, 2)])
def test_agrees_with_the_loops(cap, parts):
    """All points, some pruned, and a first frame too large; with depth alone, with A and with A + E."""
    ufm, oracle = UfM(cap, dtype=torch.float64), oracle_ufm.UfM(cap)
    seen = 0
    for i, drawn in enumerate(variances()):
        out = ufm(*frame(i), *[torch.tensor(drawn / max(parts, 1))[None]] * parts)
        want = expected(oracle, i, drawn if parts else np.zeros((H, W)))
        np.testing.assert_allclose(out.variance[0].numpy(), want, rtol=0, atol=1e-9)
        assert len(ufm.clouds[0].count) == len(oracle.points)
        seen = max(seen, len(ufm.clouds[0].count))
    agree(ufm, oracle)
    assert (seen <= (cap or 0)) == (cap is not None)
    assert int(ufm.clouds[0].count.max()) > 2, "points must have been seen again"


def test_single_precision_stays_close_to_double():
    single, double = UfM(), UfM(dtype=torch.float64)
    for i, s2 in enumerate(variances()):
        a, b = single(*frame(i, s2, torch.float32)), double(*frame(i, s2))
    # A projection within 1e-6 px of a pixel border may be rounded either way; this affects few pixels.
    close = torch.isclose(a.variance.double(), b.variance, rtol=1e-3, atol=1e-6, equal_nan=True)
    assert close.double().mean() > 0.99
    assert a.variance.dtype == torch.float32


# ---- closed forms ----


def still(depth, s2, frames, K=None):
    """A resting camera with one constant or one map [H, W] per frame."""
    ufm = UfM(dtype=torch.float64)
    K = K if K is not None else torch.tensor(scenes.intrinsics(4, 6))
    for n in range(frames):
        d, a = (torch.as_tensor(x[n]).expand(1, 4, 6).double() for x in (depth, s2))
        out = ufm(d, torch.eye(4, dtype=torch.float64), K, a)
    return ufm, out


def test_a_still_camera_gives_the_mean_variance_plus_the_spread_of_the_depths():
    """mu' and S' are the running mean and covariance: S_zz = mean s^2 + var(d), the law of total variance."""
    rng = np.random.default_rng(0)
    d, s2 = 2 + 0.1 * rng.random(9), 0.01 * rng.random(9)
    ufm, out = still(d, s2, 9)
    assert torch.allclose(out.variance, torch.full((1, 4, 6), s2.mean() + d.var(), dtype=torch.float64), atol=1e-12)
    assert ufm.clouds[0].count.tolist() == [9] * 24


def moved(x, y=0.0, z=0.0):
    T = torch.eye(4, dtype=torch.float64)
    T[:3, 3] = torch.tensor([x, y, z])
    return T


def plane(value, height=1, width=4):
    return torch.full((1, height, width), value, dtype=torch.float64)


K1 = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1]], dtype=torch.float64)


def test_halves_are_rounded_to_even():
    """The camera moves half a pixel: the points of columns 0 to 3 land at -.5, .5, 1.5, 2.5, so on 0, 0, 2, 2."""
    ufm = UfM(dtype=torch.float64)
    ufm(plane(1.0), torch.eye(4, dtype=torch.float64), K1)
    ufm(plane(1.0), moved(0.5), K1)
    assert ufm.clouds[0].count.tolist() == [2, 2, 2, 2, 1, 1]
    x = ufm.clouds[0].mean[4:, 0]
    assert x.tolist() == [1.5, 3.5], "no point lands on columns 1 and 3"


def test_points_out_of_view_are_pruned_first_and_the_oldest_of_them():
    ufm = UfM(9, dtype=torch.float64)
    for x in (0.0, 100.0, 200.0):  # three disjoint views of four points each
        ufm(plane(1.0), moved(x), K1)
    assert ufm.clouds[0].mean[:, 0].tolist() == [3, 100, 101, 102, 103, 200, 201, 202, 203]
    ufm(plane(1.0), moved(0.0), K1)  # the oldest is in view again, the others are not
    assert ufm.clouds[0].mean[:, 0].tolist() == [3, 103, 200, 201, 202, 203, 0, 1, 2]


def test_memory_per_point_is_as_documented():
    for dtype, size in ((torch.float32, 40), (torch.float64, 76)):
        ufm = UfM(dtype=dtype)
        ufm(*frame(0))
        cloud = ufm.clouds[0]
        assert cloud.bytes_per_point == size
        assert cloud.moments.nbytes + cloud.count.nbytes == size * len(cloud.count)


def test_streams_do_not_affect_each_other():
    together, alone = UfM(None), [UfM(None) for _ in range(2)]
    for i in range(4):
        each = [frame(j, dtype=torch.float32) for j in (i, 7 + 2 * i)]
        out = together(*(torch.cat(values) for values in zip(*each, strict=True)))
        for s, ufm in enumerate(alone):
            assert torch.equal(out.variance[s].nan_to_num(-1), ufm(*each[s]).variance[0].nan_to_num(-1))
            assert torch.equal(together.clouds[s].moments, ufm.clouds[0].moments)
    assert len(together.clouds[0].count) != len(together.clouds[1].count)


# ---- bad input ----


def test_invalid_pixels_are_left_out_and_points_there_left_alone():
    ufm, _ = still([2.0, 3.0], [0.01, 0.01], 2)
    before = ufm.clouds[0]
    valid = torch.ones(1, 4, 6, dtype=torch.bool)
    valid[0, 1, 2] = False
    eye, K4 = torch.eye(4, dtype=torch.float64), torch.tensor(scenes.intrinsics(4, 6))
    out = ufm(torch.full((1, 4, 6), 4.0).double(), eye, K4, torch.full((1, 4, 6), 0.01).double(), valid=valid)
    after = ufm.clouds[0]
    assert out.variance.isnan().equal(~valid)
    assert torch.equal(after.moments[8], before.moments[8])
    assert after.count.tolist() == [2 if n == 8 else 3 for n in range(24)]


def with_pose(T):
    return {"pose": torch.as_tensor(T)[None]}


BAD = {
    "pose not finite": (with_pose(np.full((4, 4), np.nan)), ValueError, "pose holds NaN"),
    "pose not rigid": (with_pose(np.diag([2.0, 2, 2, 1])), ValueError, "not orthonormal"),
    "intrinsics": ({"intrinsics": torch.zeros(1, 3, 3)}, ValueError, "fx, fy > 0"),
    "depth's type": ({"depth": torch.ones(1, H, W, dtype=torch.int64)}, TypeError, "depth must have a floating"),
    "depth's shape": ({"depth": torch.ones(H, W)}, ValueError, "depth must be"),
    "aleatoric's shape": ({"aleatoric": torch.ones(1, 2, 2)}, ValueError, "aleatoric must have"),
    "valid's type": ({"valid": torch.ones(1, H, W)}, TypeError, "valid must be a torch.bool"),
    "streams": (
        {
            "depth": torch.ones(2, H, W),
            "pose": torch.eye(4).repeat(2, 1, 1),
            "intrinsics": torch.eye(3).repeat(2, 1, 1),
        },
        ValueError,
        "of 1 streams as before",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_named_and_leaves_the_state(name):
    change, error, message = BAD[name]
    ufm = UfM(dtype=torch.float64)
    ufm(*frame(0))
    before = ufm.clouds[0]
    good = dict(zip(("depth", "pose", "intrinsics"), frame(1), strict=True))
    with pytest.raises(error, match=message):
        ufm(**{**good, **change})
    assert ufm.clouds[0] is before


def test_reset_forgets_all_frames():
    ufm, fresh = UfM(), UfM()
    ufm(*frame(5, dtype=torch.float32))
    ufm.reset()
    assert torch.equal(*(one(*frame(0)).variance.nan_to_num(-1) for one in (ufm, fresh)))


# ---- properties ----


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6), world=st.integers(0, 10**6))
def test_the_world_frame_does_not_matter(seed, world):
    rng = np.random.default_rng(world)
    T = scenes.camera_pose(rng.normal(0, 50, 3), rng.uniform(-3, 3), rng.uniform(-1, 1))
    start = seed % (FRAMES - 4)
    original, shifted = UfM(dtype=torch.float64), UfM(dtype=torch.float64)
    for i in range(start, start + 4):
        depth, pose, intrinsics = frame(i)
        a = original(depth, pose, intrinsics, torch.full_like(depth, 0.01)).variance
        b = shifted(depth, torch.tensor(T) @ pose, intrinsics, torch.full_like(depth, 0.01)).variance
    assert torch.isclose(a, b, atol=1e-8, equal_nan=True).double().mean() > 0.99  # roundings to a pixel may differ


@settings(max_examples=20)
@given(st.integers(1, 400), st.integers(0, 10**6))
def test_the_cap_holds_and_covariances_stay_positive(cap, seed):
    rng = np.random.default_rng(seed)
    ufm = UfM(cap, dtype=torch.float64)
    for i in rng.integers(0, FRAMES, 4):
        out = ufm(*frame(i, rng.random((H, W)) * 0.1))
        cloud = ufm.clouds[0]
        assert len(cloud.count) <= cap
        assert (out.variance[out.valid] >= 0).all()
        assert torch.linalg.eigvalsh(cloud.covariance).min() > -1e-12


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device, torch sees none")
def test_gpu_equals_cpu():
    maps = variances()
    a, b = UfM(CAP, dtype=torch.float64), UfM(CAP, dtype=torch.float64)
    for i in range(12):
        x = a(*frame(i, maps[i])).variance
        y = b(*(value.cuda() for value in frame(i, maps[i]))).variance
        assert torch.allclose(x, y.cpu(), atol=1e-9, equal_nan=True)
