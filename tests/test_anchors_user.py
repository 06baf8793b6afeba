"""Anchors from a user: projection of points, ``UncertainDepth``, and resets."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

import scenes
from ufmstar_torch import AnchorConfig, DepthPrediction, UfMStar, UfMStarConfig, UncertainDepth
from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.gaussians.camera import resize_intrinsics

H, W = 48, 64
ON = UfMStarConfig(anchors=AnchorConfig(), unmeasured="paper")  # evidence alone
K = torch.tensor([[60.0, 0.5, 31.5], [0, 58.0, 23.5], [0, 0, 1]], dtype=torch.float64)
NAN, INF = float("nan"), float("inf")


def at(u, v, z):
    """The point at depth z that projects to (u, v)."""
    return (torch.linalg.inv(K) @ torch.tensor([u, v, 1.0], dtype=torch.float64) * z).tolist()


# ---- points into pixels ----


def test_points_project_to_their_pixels_by_each_streams_camera():
    expected = [(3.25, 40.0, 2.0), (0.0, 0.0, 0.5), (63.0, 47.0, 8.0)]
    points = torch.tensor([[at(*w) for w in expected]])
    actual = Anchors.from_points(points, torch.full((1, 3), 0.01, dtype=torch.float64), K, (H, W))
    # float32 points: a relative error of 1e-6
    torch.testing.assert_close(actual.pixel[0], torch.tensor([w[:2] for w in expected]).double(), rtol=0, atol=1e-4)
    torch.testing.assert_close(actual.depth[0], torch.tensor([2.0, 0.5, 8.0]).double(), rtol=1e-6, atol=0)
    assert actual.variance.tolist() == [[0.01] * 3]
    assert actual.valid.all()
    cameras = torch.stack([K, resize_intrinsics(K, (H, W), (2 * H, 2 * W))])
    each = Anchors.from_points(points[:, :1].expand(2, 1, 3), torch.zeros(2, 1), cameras, (2 * H, 2 * W))
    double = torch.tensor([[[3.25, 40.0]], [[7.0, 80.5]]], dtype=torch.float64)
    torch.testing.assert_close(each.pixel, double, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("point", "variance"),
    [
        (at(10.0, 10.0, -2.0), 0.01),  # behind the camera
        ([0.1, 0.1, 0.0], 0.01),
        (at(-0.6, 10.0, 2.0), 0.01),  # outside the image: its pixel would be -1
        (at(63.6, 10.0, 2.0), 0.01),
        (at(10.0, 47.6, 2.0), 0.01),
        ([NAN, 0.0, 2.0], 0.01),
        ([0.0, 0.0, INF], 0.01),
        (at(10.0, 10.0, 2.0), -0.01),
        (at(10.0, 10.0, 2.0), NAN),
        (at(10.0, 10.0, 2.0), INF),
    ],
)
def test_what_cannot_be_seen_or_makes_no_sense_is_not_valid(point, variance):
    points, spread = torch.tensor([[at(63.4, -0.4, 2.0), point]]), torch.tensor([[0.01, variance]])
    result = Anchors.from_points(points, spread, K, (H, W))
    assert result.valid.tolist() == [[True, False]]
    assert all(bool(part.isfinite().all()) for part in (result.pixel, result.depth, result.variance))
    assert result.depth[0, 1] == result.variance[0, 1] == 0


def test_no_point_is_no_anchor():
    assert Anchors.from_points(torch.zeros(2, 0, 3), torch.zeros(2, 0), K, (H, W)).valid.shape == (2, 0)


@pytest.mark.parametrize(
    ("change", "error", "told"),
    [
        ({"points_cam": torch.zeros(4, 3)}, ValueError, r"points_cam must be \[B, N, 3\], got \(4, 3\)"),
        ({"points_cam": torch.zeros(1, 4, 3).long()}, TypeError, "points_cam must have a floating-point dtype"),
        ({"points_cam": np.zeros((1, 4, 3))}, TypeError, "points_cam must be a dense torch.Tensor, got ndarray"),
        ({"variance": torch.zeros(4)}, ValueError, r"variance must have shape \(1, 4\), got"),
        ({"intrinsics": torch.zeros(2, 3, 3)}, ValueError, r"intrinsics must have shape \(3, 3\) or \(1, 3, 3\)"),
    ],
)
def test_wrong_kinds_and_shapes_are_named(change, error, told):
    arguments = {"points_cam": torch.ones(1, 4, 3), "variance": torch.zeros(1, 4), "intrinsics": K, "size": (H, W)}
    with pytest.raises(error, match=told):
        Anchors.from_points(**{**arguments, **change})


def test_moved_to_a_resized_image():
    half = resize_intrinsics(K, (H, W), (H // 2, W // 2))
    anchors = Anchors(torch.tensor([[[10.5, 20.5]]]), torch.ones(1, 1), torch.zeros(1, 1))
    result = anchors.moved(K, half)
    torch.testing.assert_close(result.pixel, torch.tensor([[[5.0, 10.0]]], dtype=torch.float64))
    assert result.depth is anchors.depth
    torch.testing.assert_close(result.moved(half, K).pixel, anchors.pixel.double())
    with pytest.raises(ValueError, match=r"anchors.pixel must be \[B, N, 2\]"):
        Anchors(torch.zeros(4, 2), torch.ones(4), torch.ones(4)).moved(K, half)


# ---- through the pipeline ----


class Biased(nn.Module):
    """Depth that is 20 % too far, from an image that is the depth itself."""

    def forward(self, image):
        return DepthPrediction(1.2 * image[:, 0], torch.full_like(image[:, 0], 0.01))


def half(image, intrinsics):
    """Subsample every second pixel."""
    small = resize_intrinsics(intrinsics, (H, W), (H // 2, W // 2))
    return image[..., ::2, ::2], small


def two_streams(frames=4):
    """Depths [2, H, W], poses [2, 4, 4], K [2, 3, 3] and 40 and 25 true anchors of two walks."""
    depths, poses, K_ = scenes.sequence(2 * frames, H, W, 0.0)
    rng, result = np.random.default_rng(0), []
    for i in range(frames):
        truth = np.stack([depths[i], depths[-1 - i]])
        seen = [rng.permutation(np.argwhere(map_ > 0))[:40] for map_ in truth]
        v, u = np.moveaxis(np.stack(seen), -1, 0)
        depth = torch.tensor(np.stack([truth[s, v[s], u[s]] for s in (0, 1)]))
        pixel = torch.tensor(np.stack([u, v], -1).astype(float))
        valid = torch.arange(40) < torch.tensor([[40], [25]])
        anchors = Anchors(pixel, depth.where(valid, NAN), torch.full((2, 40), 1e-4), valid)
        pose = torch.tensor(np.stack([poses[i], poses[-1 - i]]))
        result.append((torch.tensor(truth).float(), pose, torch.tensor(K_).expand(2, 3, 3), anchors))
    return result


@pytest.mark.parametrize("preprocess", [None, half])
def test_the_pipeline_takes_anchors_in_the_images_pixels(preprocess):
    model, ufm = UncertainDepth(Biased(), ON, posterior=False, preprocess=preprocess), UfMStar(ON)
    for truth, pose, intrinsics, anchors in two_streams():
        image = truth[:, None].expand(2, 3, H, W)
        out = model(image, pose, intrinsics, anchors=anchors)
        x, K_map = (image, intrinsics) if preprocess is None else preprocess(image, intrinsics)
        by_hand = anchors
        if preprocess is not None:  # u' + 1/2 = (u + 1/2)/2
            by_hand = Anchors((anchors.pixel + 0.5) / 2 - 0.5, anchors.depth, anchors.variance, anchors.valid)
        expected = ufm(1.2 * x[:, 0], pose, K_map, torch.full_like(x[:, 0], 0.01), anchors=by_hand)
        for name in ("variance", "anchored", "bias"):
            torch.testing.assert_close(getattr(out, name), getattr(expected, name), equal_nan=True)
        assert torch.equal(out.statistics.anchors_used, expected.statistics.anchors_used)
        of_forty, of_twenty_five = out.statistics.anchors.tolist()
        assert 38 <= of_forty <= 40, "all but the anchors at pixels without depth in the half-size image"
        assert 23 <= of_twenty_five <= 25
    assert float(out.anchored[out.valid].mean()) > 0.05
    with pytest.raises(ValueError, match="anchors"):
        UncertainDepth(Biased(), posterior=False)(image, pose, intrinsics, anchors=anchors)


# ---- a standing camera, and starting again ----


def learnt():
    """UfM* of two streams after four frames of a network that is 20 % off, and the next frame."""
    ufm, frames = UfMStar(ON), two_streams(5)
    for truth, pose, intrinsics, anchors in frames[:4]:
        ufm(1.2 * truth, pose, intrinsics, anchors=anchors)
    truth, pose, intrinsics, _ = frames[4]
    return ufm, (1.2 * truth, pose, intrinsics)


def test_kept_evidence_makes_the_first_frame_see():
    ufm, frame = learnt()
    overall = ufm.overall_evidence.clone()
    ufm.reset(keep_evidence=True)
    assert torch.equal(ufm.overall_evidence, overall)
    assert int(ufm.mixture.components.sum()) == 0
    assert not ufm.started.any()
    assert not ufm.evidence.any()
    out = ufm(*frame)
    relative = (out.anchored / out.depth.square())[out.valid]
    expected = (overall[:, 2] / (overall[:, 0] + ON.anchors.shrinkage)).clamp_min(0)
    torch.testing.assert_close(relative.min(), expected.min(), rtol=1e-4, atol=0)
    assert 0.5 < float(relative.mean()) / (1 / 1.2 - 1) ** 2 < 1.2
    ufm.reset()
    assert not ufm.overall_evidence.any()
    assert bool((ufm(*frame).anchored.nan_to_num(0) == 0).all())


def test_kept_evidence_of_one_stream():
    ufm, frame = learnt()
    overall = ufm.overall_evidence.clone()
    twin = UfMStar(ON)
    twin.load_state_dict(ufm.state_dict())
    ufm.reset([1], keep_evidence=True)
    assert torch.equal(ufm.overall_evidence, overall)
    assert ufm.evidence[0].any()
    assert not ufm.evidence[1].any()
    assert ufm.mixture.components.tolist() == [int(twin.mixture.components[0]), 0]
    a, b = ufm(*frame), twin(*frame)
    torch.testing.assert_close(a.variance[0], b.variance[0], rtol=0, atol=0, equal_nan=True)
    ufm.reset(torch.tensor([True, False]))
    assert ufm.overall_evidence[1].any()
    assert not ufm.overall_evidence[0].any()


def test_kept_evidence_survives_saving_and_needs_anchors():
    ufm, frame = learnt()
    later = UfMStar(ON)
    later.load_state_dict(ufm.state_dict())
    for module in (ufm, later):
        module.reset(keep_evidence=True)
    torch.testing.assert_close(ufm(*frame).variance, later(*frame).variance, rtol=0, atol=0, equal_nan=True)
    with pytest.raises(ValueError, match="keep_evidence needs UfMStarConfig"):
        UfMStar().reset(keep_evidence=True)
    model = UncertainDepth(Biased(), ON, posterior=False)
    model.ufm.load_state_dict(ufm.state_dict())
    model.reset(keep_evidence=True)
    assert torch.equal(model.ufm.overall_evidence, ufm.overall_evidence)
