"""Bad input of UfMStar: an error that names the argument, or a counted skip; the state stays whole."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from modules import CONFIG, POSES, H, K, W, frame, same, snapshot, unchanged

import scenes
from ufmstar_torch import SPGFConfig, UfMStar, UfMStarConfig

pytestmark = pytest.mark.numerics


def break_pose(pose, how):
    pose = pose.clone()
    if how == "nan":
        pose[0, 0, 3] = torch.nan
    elif how == "inf":
        pose[0, 1, 1] = -torch.inf
    elif how == "scaled":
        pose[0, :3, :3] *= 1.05
    elif how == "sheared":
        pose[0, 0, 1] += 0.2
    elif how == "mirrored":
        pose[0, :3, 0] *= -1
    elif how == "row":
        pose[0, 3] = torch.tensor([0.0, 0, 0, 2])
    return pose


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("nan", "stream 0: pose holds NaN"),
        ("inf", "stream 0: pose holds NaN"),
        ("scaled", "not orthonormal"),
        ("sheared", "not orthonormal"),
        ("mirrored", "reflection"),
        ("row", "last row"),
    ],
)
def test_bad_poses_raise_and_leave_the_state(how, message):
    ufm, twin = UfMStar(CONFIG), UfMStar(CONFIG)
    ufm(*frame(0)), twin(*frame(0))
    before = snapshot(ufm)
    depth, pose, intrinsics = frame(1)
    with pytest.raises(ValueError, match=message):
        ufm(depth, break_pose(pose, how), intrinsics)
    assert unchanged(ufm, before)
    assert same(ufm(*frame(2)).variance, twin(*frame(2)).variance)


@pytest.mark.parametrize("how", ["nan", "inf", "scaled", "mirrored", "row"])
def test_bad_poses_can_be_skipped_and_are_counted(how):
    config = CONFIG.replace(on_bad_frame="skip")
    ufm, single = UfMStar(config), UfMStar(config)
    poses = [torch.cat([frame(i)[1]] * 2) for i in range(3)]
    poses[1] = torch.cat([break_pose(frame(1)[1], how), frame(1)[1]])
    outputs = [ufm(frame(i)[0].expand(2, H, W), poses[i], K) for i in range(3)]
    assert outputs[1].statistics.fault.tolist()[0] > 0
    assert outputs[1].statistics.fault.tolist()[1] == 0
    assert outputs[1].variance[0].isnan().all()
    assert outputs[1].variance[1].isfinite().any()
    assert ufm.skipped.tolist() == [1, 0]
    assert ufm.frames.tolist() == [2, 3]
    single(*frame(0))
    assert same(outputs[2].variance[0], single(*frame(2)).variance[0])


def test_a_first_frame_at_fault_does_not_anchor_the_stream():
    config = CONFIG.replace(on_bad_frame="skip")
    ufm, clean = UfMStar(config), UfMStar(config)
    ufm(frame(0)[0], break_pose(frame(0)[1], "nan"), K)
    assert not ufm.started.item()
    assert same(ufm(*frame(1)).variance, clean(*frame(1)).variance)


def test_slightly_skewed_rotations_are_projected_and_reported():
    """7-Scenes' rotations have determinants near 0.9995."""
    exact, skewed = UfMStar(CONFIG), UfMStar(CONFIG)
    for i in range(4):
        depth, pose, intrinsics = frame(i)
        worse = pose.clone()
        worse[:, :3, :3] *= 0.9995 ** (1 / 3)
        a, b = exact(depth, pose, intrinsics), skewed(depth, worse, intrinsics)
        torch.testing.assert_close(a.std, b.std, rtol=0, atol=1e-4, equal_nan=True)
        assert b.statistics.rotation_deviation.item() == pytest.approx(1 - 0.9995 ** (2 / 3), rel=1e-3)


@pytest.mark.parametrize(
    "bad",
    [
        [[100.0, 0, 20], [0, -100, 15], [0, 0, 1]],
        [[torch.nan, 0, 20], [0, 100, 15], [0, 0, 1]],
        [[100.0, 0, 20], [0, 0, 15], [0, 0, 1]],
        [[100.0, 0, 20], [0, 100, 15], [0, 0, 2]],
        [[100.0, 3, 20], [0, 100, 15], [0, 0, 1]],
    ],
)
def test_bad_intrinsics(bad):
    depth, pose, _ = frame(0)
    with pytest.raises(ValueError, match="intrinsics"):
        UfMStar(CONFIG)(depth, pose, torch.tensor(bad))


def test_bad_pixels_are_left_out_and_counted():
    depth, pose, intrinsics = frame(0)
    depth = depth.nan_to_num(2.0)
    a = torch.full_like(depth, 0.1)
    depth[0, 0, :4] = torch.tensor([torch.nan, torch.inf, 0.0, -1.0])
    a[0, 1, :3] = torch.tensor([torch.nan, -0.1, torch.inf])
    valid = torch.ones_like(depth, dtype=torch.bool)
    valid[0, 2, :2] = False
    out = UfMStar(CONFIG)(depth, pose, intrinsics, aleatoric=a, valid=valid)
    assert out.statistics.valid_pixels.item() == H * W - 9
    assert torch.equal(out.variance.isnan(), ~out.valid)


def test_all_invalid_depth_is_a_frame_without_segments():
    ufm, twin = UfMStar(CONFIG), UfMStar(CONFIG)
    ufm(*frame(0)), twin(*frame(0))
    depth, pose, intrinsics = frame(1)
    out = ufm(torch.full_like(depth, torch.nan), pose, intrinsics)
    assert out.variance.isnan().all()
    assert out.statistics.segments.item() == 0
    assert same(ufm(*frame(2)).variance, twin(*frame(2)).variance)


def test_one_pixel_image():
    ufm = UfMStar(UfMStarConfig(segment=SPGFConfig(prune="none", sparse=0, scale_with_image=False)))
    for _ in range(2):
        out = ufm(torch.full((1, 1, 1), 2.0), torch.eye(4), torch.eye(3))
        assert out.variance.shape == (1, 1, 1)
        assert out.variance.isfinite().all()
        plain = UfMStar()(torch.full((1, 1, 1), 2.0), torch.eye(4), torch.eye(3))
        assert plain.variance.isfinite().all()


def test_intrinsics_and_size_may_change_in_the_middle():
    ufm = UfMStar(CONFIG)
    for i in range(3):
        ufm(*frame(i))
    K_small = scenes.intrinsics(H - 6, W - 8, 60)
    depth = torch.tensor(scenes.render(POSES[3], K_small, H - 6, W - 8)).float()[None]
    out = ufm(depth, torch.tensor(POSES[3]), torch.tensor(K_small))
    assert out.variance.shape == depth.shape
    assert out.statistics.matched.item() > 0
    assert ufm.smoothed.shape == depth.shape


@given(st.data())
@settings(max_examples=25)
def test_any_depth_map_gives_a_variance_or_nan(data):
    """Whatever lies in a depth map: finite non-negative variance where valid, NaN elsewhere, no crash."""
    values = st.one_of(
        st.floats(0.0625, 30, width=32),
        st.sampled_from([0.0, -1.0, float("nan"), float("inf"), -float("inf"), 1e-30, 1e30, 20.0]),
    )
    height, width = data.draw(st.integers(1, 9)), data.draw(st.integers(1, 9))
    ufm = UfMStar(UfMStarConfig(segment=SPGFConfig(prune="none", sparse=0, scale_with_image=False)))
    for i in range(3):
        cells = data.draw(st.lists(values, min_size=height * width, max_size=height * width))
        depth = torch.tensor(cells, dtype=torch.float32).view(1, height, width)
        pose = torch.tensor(scenes.look((0.05 * i, 0, 0), 0.02 * i))
        out = ufm(depth, pose, torch.tensor(scenes.intrinsics(height, width)))
        expected = (depth >= 1e-6) & (depth <= 20)  # the accepted range and segment.max_depth
        assert torch.equal(out.valid, expected)
        assert torch.equal(out.variance.isnan(), ~expected)
        assert (out.variance[expected] >= 0).all()
        assert out.variance[expected].isfinite().all()
