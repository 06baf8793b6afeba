"""UfM, the pointwise baseline, against loops written from its description, closed forms and properties."""

from __future__ import annotations

import copy
import io

import numpy as np
import oracle_ufm
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from modules import same, snapshot, unchanged

import scenes
from ufmstar_torch.eval.methods.ufm import UfM, UfMConfig

H, W, FRAMES = 15, 20, 36
CAP = 420
DEPTHS, POSES, K_ = scenes.sequence(FRAMES, H, W, 0.05)
K = torch.tensor(K_)


def variances(seed=0):
    """A per frame [H, W] [m^2], with a few entries that no network should hand over."""
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


def agree(ufm, b, oracle, tolerance=1e-9):
    """The points of stream b, in order, against the oracle's (which stand in the present camera)."""
    cloud, T = ufm.clouds()[b], np.linalg.inv(oracle.pose) @ ufm.T_world_first[b].numpy()
    mean = cloud.mean.numpy() @ T[:3, :3].T + T[:3, 3]
    cov = T[:3, :3] @ cloud.covariance.numpy() @ T[:3, :3].T
    assert cloud.count.tolist() == [point["count"] for point in oracle.points]
    np.testing.assert_allclose(mean, [point["mean"] for point in oracle.points], rtol=0, atol=tolerance)
    np.testing.assert_allclose(cov, [point["cov"] for point in oracle.points], rtol=0, atol=tolerance)


# ---- against the oracle ----


@pytest.mark.parametrize("cap", [None, CAP, H * W - 30], ids=["all", "pruned", "first frame too large"])
def test_agrees_with_the_loops(cap):
    ufm, oracle = UfM(UfMConfig(max_points=cap), dtype=torch.float64), oracle_ufm.UfM(cap)
    pruned = 0
    for i, s2 in enumerate(variances()):
        out, want = ufm(*frame(i, s2)), expected(oracle, i, s2)
        np.testing.assert_allclose(out.variance[0].numpy(), want, rtol=0, atol=1e-9)
        assert out.statistics.points.tolist() == [len(oracle.points)]
        pruned += int(out.statistics.dropped)
    agree(ufm, 0, oracle)
    assert (pruned > 0) == (cap is not None)
    assert int(ufm.clouds()[0].count.max()) > 2, "points must have been seen again"


def test_a_batch_of_streams_equals_each_stream_alone():
    """Streams of different lengths, with frames skipped in one of them."""
    config = UfMConfig(max_points=CAP, on_bad_frame="skip")
    ufm, oracles = UfM(config, dtype=torch.float64), [oracle_ufm.UfM(CAP) for _ in range(3)]
    maps, broken = variances(), torch.full((4, 4), torch.nan, dtype=torch.float64)
    for i in range(30):
        indices = (i, (2 * i) % FRAMES, FRAMES - 1 - i)
        skip = {1} if i in (0, 4, 5, 17) else set()
        inputs = [frame(n, maps[n]) for n in indices]
        poses = torch.cat([broken[None] if b in skip else inputs[b][1] for b in range(3)])
        out = ufm(torch.cat([x[0] for x in inputs]), poses, K, torch.cat([x[3] for x in inputs]))
        for b, n in enumerate(indices):
            if b in skip:
                assert out.variance[b].isnan().all()
                assert int(out.statistics.fault[b]) == 1
            else:
                np.testing.assert_allclose(out.variance[b].numpy(), expected(oracles[b], n, maps[n]), rtol=0, atol=1e-9)
    for b in range(3):
        agree(ufm, b, oracles[b])
    assert ufm.skipped.tolist() == [0, 4, 0]
    assert ufm.frames.tolist() == [30, 26, 30]


def test_rotations_that_are_not_quite_orthonormal_are_projected():
    ufm, oracle = UfM(dtype=torch.float64), oracle_ufm.UfM()
    rng = np.random.default_rng(3)
    for i in range(8):
        s2, bent = np.full((H, W), 0.01), POSES[i].copy()
        bent[:3, :3] *= 1 + 4e-3 * rng.random((3, 3))
        u, _, v = np.linalg.svd(bent[:3, :3])
        exact = POSES[i].copy()
        exact[:3, :3] = u @ v
        depth, _, intrinsics, a = frame(i, s2)
        out = ufm(depth, torch.tensor(bent)[None], intrinsics, a)
        np.testing.assert_allclose(out.variance[0].numpy(), expected(oracle, i, s2, exact), rtol=0, atol=1e-9)
        assert 0 < float(out.statistics.rotation_deviation) < 0.01


def test_single_precision_stays_close_to_double():
    single, double = UfM(), UfM(dtype=torch.float64)
    for i, s2 in enumerate(variances()):
        a, b = single(*frame(i, s2, torch.float32)), double(*frame(i, s2))
    # A landing point within 1e-6 px of a border may go either way: hardly any pixel.
    close = torch.isclose(a.variance.double(), b.variance, rtol=1e-3, atol=1e-6, equal_nan=True)
    assert close.double().mean() > 0.99
    assert a.variance.dtype == torch.float32


# ---- closed forms ----


def still(depth, s2, frames, config=None, K=None):
    """A camera that does not move; constant maps or [H, W] arrays, one per frame."""
    ufm = UfM(config, dtype=torch.float64)
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
    assert ufm.points.tolist() == [24]
    assert ufm.count.unique().tolist() == [9]


def test_full_mode_adds_both_variances_and_each_can_be_left_out():
    depth, A, E = (torch.full((1, 4, 6), x) for x in (2.0, 0.3, 0.5))
    args = (depth, torch.eye(4), torch.tensor(scenes.intrinsics(4, 6)), A, E)
    for config, want in (
        (UfMConfig(), 0.8),
        (UfMConfig(add_epistemic=False), 0.3),
        (UfMConfig(add_aleatoric=False), 0.5),
        (UfMConfig(add_aleatoric=False, add_epistemic=False), 0.0),
    ):
        assert torch.allclose(UfM(config)(*args).variance, torch.tensor(want))


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
    out = ufm(plane(1.0), moved(0.5), K1)
    assert ufm.clouds()[0].count.tolist()[:4] == [2, 2, 2, 2]
    assert out.statistics.new.tolist() == [2]
    x = ufm.clouds()[0].mean[4:, 0]
    assert x.tolist() == [1.5, 3.5], "columns 1 and 3 met nobody"


def test_the_newest_point_wins_a_collision():
    """Seen from twice the distance, the points of columns 0 and 1 share a pixel; both fuse, the later one is shown."""
    ufm = UfM(dtype=torch.float64)
    s2 = torch.tensor([[[0.1, 0.2, 0.4, 0.8]]], dtype=torch.float64)
    ufm(plane(1.0), torch.eye(4, dtype=torch.float64), K1, s2)
    out = ufm(plane(2.0), moved(0, 0, -1.0), K1, plane(0.0))
    # Columns 0 to 3 land at 0, .5, 1, 1.5: pixels 0, 0, 1, 2.
    assert ufm.clouds()[0].count.tolist() == [2, 2, 2, 2, 1]
    # S' = S/2 + A/2 + (p - mu)(p - mu)^T / 4 with equal depths: half of the point's own s^2.
    assert torch.allclose(out.variance[0, 0, :3], torch.tensor([0.1, 0.2, 0.4], dtype=torch.float64))


def test_no_occlusion_test_and_nothing_behind_the_camera():
    ufm = UfM(dtype=torch.float64)
    ufm(plane(2.0), torch.eye(4, dtype=torch.float64), K1)
    out = ufm(
        plane(0.5), torch.eye(4, dtype=torch.float64), K1
    )  # a wall in front: the points behind it fuse all the same
    assert out.statistics.fused.tolist() == [4]
    out = ufm(plane(1.0), moved(0, 0, 10.0), K1)
    assert out.statistics.fused.tolist() == [0]
    assert out.statistics.new.tolist() == [4]


def test_negative_covariances_are_kept():
    """Corners of a wide view have off-diagonal entries of both signs; the release would zero half of them."""
    _, out = still([2.0], [0.01], 1)
    ufm, _ = still([2.0], [0.01], 1)
    assert out.variance.isfinite().all()
    off = ufm.clouds()[0].covariance[:, 0, 2]
    assert (off < 0).any()
    assert (off > 0).any()


def test_points_out_of_view_are_pruned_first_and_the_oldest_of_them():
    ufm = UfM(UfMConfig(max_points=9), dtype=torch.float64)
    for x in (0.0, 100.0, 200.0):  # three views that share nothing, of four points each
        out = ufm(plane(1.0), moved(x), K1)
    assert out.statistics.dropped.tolist() == [3]
    assert ufm.clouds()[0].mean[:, 0].tolist() == [3, 100, 101, 102, 103, 200, 201, 202, 203]
    ufm(plane(1.0), moved(0.0), K1)  # the oldest is in view again, the others are not
    assert ufm.clouds()[0].mean[:, 0].tolist() == [3, 103, 200, 201, 202, 203, 0, 1, 2]


def test_memory_per_point_is_as_documented():
    out = UfM()(*frame(0, dtype=torch.float32))
    assert out.statistics.memory.tolist() == [40 * int(out.statistics.points)]
    ufm = UfM(dtype=torch.float64)
    out = ufm(*frame(0))
    assert out.statistics.memory.tolist() == [76 * int(out.statistics.points)]
    assert ufm.moments.nbytes + ufm.count.nbytes == int(out.statistics.memory)


# ---- bad input ----


def test_invalid_pixels_are_left_out_and_points_there_left_alone():
    ufm, _ = still([2.0, 3.0], [0.01, 0.01], 2)
    before = ufm.clouds()[0]
    valid = torch.ones(1, 4, 6, dtype=torch.bool)
    valid[0, 1, 2] = False
    eye, K4 = torch.eye(4, dtype=torch.float64), torch.tensor(scenes.intrinsics(4, 6))
    out = ufm(torch.full((1, 4, 6), 4.0).double(), eye, K4, torch.full((1, 4, 6), 0.01).double(), valid=valid)
    after = ufm.clouds()[0]
    assert out.variance.isnan().equal(~valid)
    assert out.statistics.valid_pixels.tolist() == [23]
    assert torch.equal(after.moments[8], before.moments[8])
    assert after.count.tolist() == [2 if n == 8 else 3 for n in range(24)]


def with_pose(T):
    return {"pose": torch.as_tensor(T)[None]}


BAD = {
    "pose not finite": (with_pose(np.full((4, 4), np.nan)), ValueError, "stream 0: pose holds NaN"),
    "pose not rigid": (with_pose(np.diag([2.0, 2, 2, 1])), ValueError, "not orthonormal"),
    "intrinsics": ({"intrinsics": torch.zeros(1, 3, 3)}, ValueError, "fx, fy > 0"),
    "depth's type": ({"depth": torch.ones(1, H, W, dtype=torch.int64)}, TypeError, "depth must have a floating"),
    "depth's shape": ({"depth": torch.ones(H, W)}, ValueError, "depth must be"),
    "aleatoric's shape": ({"aleatoric": torch.ones(1, 2, 2)}, ValueError, "aleatoric must have"),
    "valid's type": ({"valid": torch.ones(1, H, W)}, TypeError, "valid must be a torch.bool"),
    "streams": ({"depth": torch.ones(2, H, W)}, ValueError, "call reset"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_named_and_leaves_the_state(name):
    change, error, message = BAD[name]
    ufm = UfM(dtype=torch.float64)
    ufm(*frame(0))
    before = snapshot(ufm)
    good = dict(zip(("depth", "pose", "intrinsics"), frame(1), strict=True))
    with pytest.raises(error, match=message):
        ufm(**{**good, **change})
    assert unchanged(ufm, before)


@pytest.mark.parametrize(
    "change",
    [
        {"max_points": 0},
        {"max_points": True},
        {"max_points": 1e5},
        {"add_aleatoric": 1},
        {"rotation_tolerance": 0.2},
        {"rotation_tolerance": float("nan")},
        {"on_bad_frame": "ignore"},
    ],
    ids=str,
)
def test_impossible_settings_are_refused(change):
    (name,) = change
    with pytest.raises(ValueError, match=f"UfMConfig.{name}"):
        UfMConfig(**change)


# ---- the state ----


def test_saved_state_continues_bit_for_bit():
    whole, first = UfM(UfMConfig(max_points=CAP)), UfM(UfMConfig(max_points=CAP))
    maps = variances()
    for i in range(12):
        whole(*frame(i, maps[i]))
    for i in range(6):
        first(*frame(i, maps[i]))
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second = UfM(UfMConfig(max_points=CAP))
    second.load_state_dict(torch.load(file, weights_only=True))
    for i in range(6, 12):
        second(*frame(i, maps[i]))
    assert unchanged(second, whole.state_dict())
    with pytest.warns(UserWarning, match=f"max_points was {CAP}, is 100000"):
        UfM().load_state_dict(second.state_dict())
    restored = UfM.from_state_dict(second.state_dict())
    assert restored.config == second.config
    assert unchanged(restored, whole.state_dict())


def put(index, value):
    def edit(tensor):
        tensor[index] = value
        return tensor

    return edit


SPOILT = {
    "rows": ("moments", lambda v: v[:-1]),
    "a number": ("moments", lambda v: v[0, 0]),
    "columns": ("moments", lambda v: v[:, :8]),
    "NaN": ("moments", put((0, 4), torch.nan)),
    "no variance": ("moments", put((0, 3), -1.0)),
    "no covariance": ("moments", put((0, 4), 9.0)),
    "streams": ("T_world_first", lambda v: v.repeat(2, 1, 1)),
    "not rigid": ("T_world_first", lambda v: 2 * v),
    "no observation": ("count", put(0, 0)),
    "sum": ("points", lambda v: v + 1),
    "negative": ("frames", lambda v: v - 100),
    "floats": ("count", lambda v: v.float()),
    "no tensor": ("started", lambda _: [True]),
    "config": ("_extra_state", lambda v: v[:-1]),
}


@pytest.mark.parametrize("name", SPOILT)
def test_a_bad_state_is_refused_before_anything_is_replaced(name):
    whole, ufm = UfM(), UfM()
    for i in range(3):
        whole(*frame(i, variances()[i]))
    ufm(*frame(3))
    before = {key: value.clone() for key, value in ufm.state_dict().items()}
    key, edit = SPOILT[name]
    with pytest.raises(RuntimeError, match=rf"UfM keeps its state: .*({key.strip('_')}|count must have shape)"):
        ufm.load_state_dict(whole.state_dict() | {key: edit(whole.state_dict()[key].clone())})
    assert unchanged(ufm, before)
    small = UfM(UfMConfig(max_points=5))
    with pytest.raises(RuntimeError, match="exceed max_points = 5"):
        small.load_state_dict(whole.state_dict())
    ufm.load_state_dict(whole.state_dict())
    assert unchanged(ufm, whole.state_dict())


def test_reset_of_all_and_of_some_streams():
    maps, fresh = variances(), UfM()
    ufm = UfM()
    for i in (0, 5):
        depth, pose, _, a = (
            torch.cat([x, y]) for x, y in zip(frame(i, maps[i]), frame(i + 1, maps[i + 1]), strict=True)
        )
        ufm(depth, pose, K, a)
    kept = ufm.clouds()[1]
    ufm.reset([0])
    assert [len(c.count) for c in ufm.clouds()] == [0, len(kept.count)]
    assert torch.equal(ufm.clouds()[1].moments, kept.moments)
    assert ufm.started.tolist() == [False, True]
    depth, pose, _, a = (torch.cat([x, y]) for x, y in zip(frame(0, maps[0]), frame(9, maps[9]), strict=True))
    out = ufm(depth, pose, K, a)
    assert same(out.variance[:1], fresh(*frame(0, maps[0])).variance)
    with pytest.raises(ValueError, match="mask must have shape"):
        ufm.reset(torch.ones(3, dtype=torch.bool))
    ufm.reset()
    assert ufm(*frame(0, maps[0])).statistics.points.shape == (1,)


def test_deepcopy_casts_and_inference_mode():
    ufm = UfM()
    with torch.inference_mode():
        ufm(*frame(0))
    twin = copy.deepcopy(ufm).half()
    assert twin.moments.dtype == torch.float32
    assert twin.T_world_first.dtype == torch.float64
    assert same(twin(*frame(1)).variance, ufm(*frame(1)).variance)
    assert "max_points=100000" in repr(ufm)


def test_layouts_and_half_precision_depth():
    depth, pose, intrinsics = frame(0, dtype=torch.float32)
    out = UfM()(depth[:, None].half(), pose, intrinsics)
    assert out.variance.shape == (1, 1, H, W)
    assert out.std.shape == out.valid.shape == out.depth.shape
    assert out.variance.dtype == torch.float32


# ---- properties ----


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6), world=st.integers(0, 10**6))
def test_the_world_frame_does_not_matter(seed, world):
    """The same views, poses told in another world: the same variances."""
    rng = np.random.default_rng(world)
    T = scenes.look(rng.normal(0, 50, 3), rng.uniform(-3, 3), rng.uniform(-1, 1))
    start = seed % (FRAMES - 4)
    here, present = UfM(dtype=torch.float64), UfM(dtype=torch.float64)
    for i in range(start, start + 4):
        depth, pose, intrinsics = frame(i)
        a = here(depth, pose, intrinsics, torch.full_like(depth, 0.01)).variance
        b = present(depth, torch.tensor(T) @ pose, intrinsics, torch.full_like(depth, 0.01)).variance
    assert torch.isclose(a, b, atol=1e-8, equal_nan=True).double().mean() > 0.99  # roundings to a pixel may differ


@settings(max_examples=20)
@given(st.integers(1, 400), st.integers(0, 10**6))
def test_the_cap_holds_and_covariances_stay_positive(cap, seed):
    rng = np.random.default_rng(seed)
    ufm = UfM(UfMConfig(max_points=cap), dtype=torch.float64)
    for i in rng.integers(0, FRAMES, 4):
        out = ufm(*frame(i, rng.random((H, W)) * 0.1))
        (cloud,) = ufm.clouds()
        assert int(out.statistics.points) == len(cloud.count) <= cap
        assert (out.variance[out.valid] >= 0).all()
        assert torch.linalg.eigvalsh(cloud.covariance).min() > -1e-12
        assert int(out.statistics.fused + out.statistics.new) >= int(out.statistics.valid_pixels)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_gpu_equals_cpu():
    maps = variances()
    a, b = UfM(UfMConfig(max_points=CAP), dtype=torch.float64), UfM(UfMConfig(max_points=CAP), dtype=torch.float64)
    for i in range(12):
        x = a(*frame(i, maps[i])).variance
        y = b(*(value.cuda() for value in frame(i, maps[i]))).variance
        assert torch.allclose(x, y.cpu(), atol=1e-9, equal_nan=True)
