"""Invalid input of the core: an error that names the argument, or a counted skip; the state stays valid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from modules import CONFIG, POSES, SPGF, H, K, W, frame, same, snapshot, unchanged
from torch import Tensor

import scenes
from ufmstar_torch import PosteriorConfig, SPGFConfig, UfMStar, UfMStarConfig
from ufmstar_torch.gaussians.camera import resize_intrinsics
from ufmstar_torch.gaussians.gaussian import barycenter

INF, NAN = torch.inf, torch.nan
DEPTH, POSE, CAMERA = frame(0)
D, K1 = torch.ones(2, 5, 6), torch.tensor([[5.0, 0, 3], [0, 5, 2], [0, 0, 1]]).expand(2, 3, 3)


def begun() -> UfMStar:
    """A module after one frame."""
    ufm = UfMStar(CONFIG)
    ufm(*frame(0))
    return ufm


settings, segment = UfMStarConfig.from_dict, SPGFConfig.from_dict
# Arguments other than a frame's; a frame's arguments: test_core_arguments.py.
REFUSALS: list[tuple[Callable[[], object], str]] = [
    (lambda: begun().reset([7]), "7"),
    (lambda: begun().reset(torch.tensor([True, False])), "mask"),
    (lambda: UfMStar().warm_up((0, 4)), r"size must be \(H, W\), positive whole numbers, got \(0, 4\)"),
    (lambda: settings({"eta": 0.0}), "eta"),
    (lambda: settings({"eta": 1.5}), "eta"),
    (lambda: settings({"eta_occlusion": -1.0}), "eta_occlusion"),
    (lambda: settings({"prior_weight": 0.0}), "prior_weight"),
    (lambda: settings({"ema_alpha": 0.0}), "ema_alpha"),
    (lambda: settings({"regression": "rtree"}), "regression"),
    (lambda: settings({"backend": "cuda"}), "backend"),
    (lambda: settings({"max_components": 0}), "max_components"),
    (lambda: settings({"variance_floor": NAN}), "variance_floor"),
    (lambda: settings({"variances_in_h": 1}), "variances_in_h"),
    (lambda: settings({"initial_capacity": 1.5}), "initial_capacity"),
    (lambda: settings({"initial_capacity": True}), "initial_capacity"),
    (lambda: settings({"eta_oclusion": 0.7}), "eta_oclusion"),
    (lambda: settings({"segment": {"min_pixel": 7}}), "min_pixel"),
    (lambda: UfMStarConfig(segment=None), "segment"),  # type: ignore[arg-type]
    (lambda: UfMStarConfig(merge=1.0), "merge"),  # type: ignore[arg-type]
    (lambda: UfMStarConfig(posterior=PosteriorConfig()), "posterior needs anchors"),
    (lambda: UfMStarConfig(confidence=True), "confidence needs anchors"),
    (lambda: UfMStarConfig().with_values({"merge": 0.5}), "merge"),
    (lambda: UfMStarConfig().with_values({"merge.los": 0.5}), "los"),
    (lambda: UfMStarConfig().with_values({"eta.low": 0.5}), "eta"),
    (lambda: UfMStarConfig().with_values({"mergers.loss": 0.5}), "mergers"),
    (lambda: setattr(UfMStarConfig(), "eta", 0.3), "assign"),
    (lambda: segment({"noise_floor": 0.5}), "noise_floor"),
    (lambda: SPGFConfig.preset("kitti"), "tum, tartanair_indoor, tartanair_outdoor, got 'kitti'"),
    (lambda: SPGFConfig(min_gaussian_length=1e-6), "SPGFConfig.min_gaussian_length = 1e-06 m"),
    (lambda: resize_intrinsics(K1, (0, 4), (5, 6)), r"old must be \(H, W\), positive whole numbers"),
    (lambda: barycenter(torch.zeros(2, 3), torch.eye(3).expand(2, 3, 3), -torch.ones(2)), "weight must be non-neg"),
]


@pytest.mark.parametrize(("call", "message"), REFUSALS, ids=range(len(REFUSALS)))
def test_it_is_refused_and_named(call, message):
    with pytest.raises((ValueError, TypeError, IndexError, AttributeError), match=message):
        call()


def edited(matrix: Tensor, at: tuple[int, int], value: float) -> Tensor:
    matrix = matrix.clone()
    matrix[(..., *at)] = value
    return matrix


# An edit that makes a frame's camera invalid, and part of the error message.
FAULTS: dict[str, tuple[Callable[[Tensor, Tensor], tuple[Tensor, Tensor]], str]] = {
    "NaN": (lambda T, K: (edited(T, (0, 3), NAN), K), "stream 0: pose holds NaN"),
    "infinite": (lambda T, K: (edited(T, (1, 1), -INF), K), "stream 0: pose holds NaN"),
    "scaled": (lambda T, K: (T * torch.tensor([[1.05], [1.05], [1.05], [1]]), K), "not orthonormal"),
    "sheared": (lambda T, K: (T + edited(torch.zeros(4, 4), (0, 1), 0.2), K), "not orthonormal"),
    "mirrored": (lambda T, K: (T * torch.tensor([-1.0, 1, 1, 1]), K), "reflection"),
    "last row": (lambda T, K: (edited(T, (3, 3), 2.0), K), "last row"),
    "far away": (lambda T, K: (edited(T, (0, 3), 1e12), K), "farther from the origin than 1e9 m"),
    "K NaN": (lambda T, K: (T, edited(K, (0, 0), NAN)), "intrinsics hold NaN"),
    "K negative": (lambda T, K: (T, edited(K, (1, 1), -100.0)), "intrinsics are not .* fx, fy > 0"),
    "K zero": (lambda T, K: (T, edited(K, (1, 1), 0.0)), "intrinsics are not .* fx, fy > 0"),
    "K homogeneous": (lambda T, K: (T, edited(K, (2, 2), 2.0)), "intrinsics are not"),
    "K skewed": (lambda T, K: (T, edited(K, (0, 1), 3.0)), "intrinsics are not"),
    "K too long": (lambda T, K: (T, edited(K, (0, 0), 1e100)), "focal length"),
    "K too short": (lambda T, K: (T, edited(K, (1, 1), 1e-9)), "focal length"),
    "K another image's": (
        lambda T, K: (T, edited(K, (0, 2), 320.0)),
        "principal point outside the depth map; expected the intrinsics of the depth map",
    ),
    "K above": (lambda T, K: (T, edited(K, (1, 2), -3.0)), "principal point outside the depth map"),
}


@pytest.mark.parametrize(("name", "backend"), [("NaN", "torch"), *((name, "numba") for name in FAULTS)])
def test_a_camera_at_fault_is_refused_or_skipped_and_the_state_stays(name, backend):
    """A single stream; and a counted skip, while another stream continues. An invalid first frame does not define its
    stream's world frame."""
    spoil, message = FAULTS[name]
    depth, pose, _ = frame(1)
    config = CONFIG.replace(backend=backend)
    bad_pose, bad_K = spoil(pose.double(), K[None].double())
    ufm, twin = UfMStar(config), UfMStar(config)
    ufm(*frame(0)), twin(*frame(0))
    before = snapshot(ufm)
    with pytest.raises(ValueError, match=message):
        ufm(depth, bad_pose, bad_K)
    assert unchanged(ufm, before)
    expected = twin(*frame(2)).variance
    assert same(ufm(*frame(2)).variance, expected)
    both = UfMStar(config.replace(on_bad_frame="skip"))
    both(*(torch.cat([value] * 2) for value in frame(0)))
    poses, cameras = torch.cat([bad_pose, pose]), torch.cat([bad_K, K[None]])
    out = both(depth.expand(2, H, W), poses, cameras)
    assert (out.statistics.fault > 0).tolist() == [True, False]
    assert out.variance[0].isnan().all()
    assert out.variance[1].isfinite().any()
    last = both(*(torch.cat([value] * 2) for value in frame(2)))
    assert same(last.variance[0], expected[0])
    assert (both.skipped.tolist(), both.frames.tolist()) == ([1, 0], [2, 3])
    late, clean = UfMStar(config.replace(on_bad_frame="skip")), UfMStar(config)
    late(depth, bad_pose, bad_K)
    assert not late.started.item()
    assert same(late(*frame(1)).variance, clean(*frame(1)).variance)


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


def test_bad_pixels_are_left_out_and_counted():
    depth = DEPTH.nan_to_num(2.0)
    a = torch.full_like(depth, 0.1)
    depth[0, 0, :4] = torch.tensor([NAN, INF, 0.0, -1.0])
    a[0, 1, :3] = torch.tensor([NAN, -0.1, INF])
    valid = torch.ones_like(depth, dtype=torch.bool)
    valid[0, 2, :2] = False
    out = UfMStar(CONFIG)(depth, POSE, CAMERA, aleatoric=a, valid=valid)
    assert out.statistics.valid_pixels.item() == H * W - 9
    assert torch.equal(out.variance.isnan(), ~out.valid)


def test_all_invalid_depth_is_a_frame_without_segments():
    ufm, twin = begun(), begun()
    depth, pose, intrinsics = frame(1)
    out = ufm(torch.full_like(depth, NAN), pose, intrinsics)
    assert out.variance.isnan().all()
    assert out.statistics.segments.item() == 0
    assert same(ufm(*frame(2)).variance, twin(*frame(2)).variance)


def test_one_pixel_image():
    for config in (UfMStarConfig(segment=replace(SPGF, prune="none", sparse=0)), UfMStarConfig()):
        ufm = UfMStar(config)
        for _ in range(2):
            out = ufm(torch.full((1, 1, 1), 2.0), torch.eye(4), torch.eye(3))
            assert out.variance.shape == (1, 1, 1)
            assert out.variance.isfinite().all()


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
