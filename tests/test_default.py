"""``UncertainDepth`` by default: dense evidence and the posterior, and what happens where they cannot be had."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ufmstar_torch import AnchorConfig, DepthPrediction, UfMStar, UfMStarConfig, UncertainDepth
from ufmstar_torch.anchors import Anchors, landmarks
from ufmstar_torch.eval.sequences.frame import in_memory
from ufmstar_torch.eval.sequences.open import open_sequence

BIAS = 1.3
ALONE = "UfM* alone, without anchors"


@cache
def walk():
    """The first 12 of 16 rendered frames, 120x160. Tests must not change them."""
    return tuple(in_memory(open_sequence("tour:5?frames=16&size=120x160")))[:12]


class TooFar(torch.nn.Module):
    """The true depth of the walk's next frame, 30 % too far, for every stream."""

    def __init__(self):
        super().__init__()
        self.calls = 0

    def forward(self, image):
        depth = BIAS * torch.from_numpy(walk()[self.calls].depth)
        self.calls += 1
        return DepthPrediction(depth.expand(len(image), *depth.shape).clone())


def followed(model, images=lambda frame: frame.image, frames=slice(None)):
    return [model(images(f), f.T_world_cam, f.intrinsics) for f in walk()[frames]]


def error(depth, frame):
    """Median relative error."""
    truth = torch.from_numpy(frame.depth)
    return float((depth[0] / truth - 1)[truth > 0].abs().nanmedian())


def alone(caplog):
    return [text for text in caplog.messages if ALONE in text]


def test_depth_and_std_are_the_posteriors_and_the_networks_stay_where_they_were(caplog):
    outs = followed(UncertainDepth(TooFar()))
    by_name = followed(UncertainDepth(TooFar(), posterior=True, anchors="dense"))
    for out, same in zip(outs, by_name, strict=True):
        torch.testing.assert_close(out.std, out.variance.sqrt(), rtol=0, atol=0, equal_nan=True)
        torch.testing.assert_close(out.depth, same.depth, rtol=0, atol=0, equal_nan=True)
        assert torch.equal(out.prediction.depth, out.network_depth)
        alone_again = out.ufm
        assert torch.equal(alone_again.depth, out.network_depth)
        assert torch.equal(alone_again.variance.nan_to_num(), out.ufm_variance.nan_to_num())
        for mine, posterior in zip(out.posterior(), alone_again.posterior(), strict=True):
            assert mine is posterior
    assert error(outs[-1].prediction.depth, walk()[-1]) == pytest.approx(BIAS - 1, abs=1e-3)
    assert error(outs[-1].depth, walk()[-1]) < 0.06
    assert not alone(caplog)


def test_without_the_posterior_it_is_ufm_star_alone():
    model, ufm, network = UncertainDepth(TooFar(), posterior=False), UfMStar(), TooFar()
    for out, frame in zip(followed(model, frames=slice(3)), walk(), strict=False):
        expected = ufm(network(torch.zeros(1, 3, 120, 160)).depth, frame.T_world_cam, frame.intrinsics)
        torch.testing.assert_close(out.variance, expected.variance, rtol=0, atol=0, equal_nan=True)
        assert torch.equal(out.depth, expected.depth)
        assert out.posterior_outlier is out.anchored is None
        with pytest.raises(ValueError, match="posterior needs"):
            out.posterior()
    assert model.landmarks is None
    anchored = UncertainDepth(TooFar(), posterior=False, anchors="corners")
    out = followed(anchored, frames=slice(4))[-1]
    assert out.anchored is not None
    assert torch.equal(out.depth, out.prediction.depth)


def test_every_stream_of_a_batch_has_its_own_evidence():
    one, two = UncertainDepth(TooFar()), UncertainDepth(TooFar())
    dark = np.zeros_like(walk()[0].image)
    single = followed(one, frames=slice(4))
    both = followed(two, lambda frame: np.stack([frame.image, dark]), slice(4))
    for out, batch in zip(single, both, strict=True):
        torch.testing.assert_close(batch.depth[:1], out.depth, rtol=0, atol=0, equal_nan=True)
        torch.testing.assert_close(batch.variance[:1], out.variance, rtol=0, atol=0, equal_nan=True)
        assert torch.equal(batch.depth[1].nan_to_num(), batch.prediction.depth[1].nan_to_num())  # no anchor in the dark
    again = UncertainDepth(TooFar())
    again.load_stream_state(two.stream_state())
    again.networks[0].calls = 4
    frame = walk()[4]
    images = np.stack([frame.image, dark])
    kept, loaded = (model(images, frame.T_world_cam, frame.intrinsics) for model in (two, again))
    torch.testing.assert_close(loaded.variance, kept.variance, rtol=0, atol=0, equal_nan=True)
    two.reset()
    two.networks[0].calls = 0
    assert len(followed(two, frames=slice(1))[0].depth) == 1


def test_another_number_of_streams_is_refused_and_changes_nothing():
    model, same = UncertainDepth(TooFar()), UncertainDepth(TooFar())
    for each in (model, same):
        followed(each, frames=slice(3))
    frame = walk()[3]
    with pytest.raises(ValueError, match="depth has 2 streams but the state holds 1"):
        model(np.stack([frame.image] * 2), frame.T_world_cam, frame.intrinsics)
    model.networks[0].calls = 3
    outs = [each(frame.image, frame.T_world_cam, frame.intrinsics) for each in (model, same)]
    torch.testing.assert_close(outs[0].variance, outs[1].variance, rtol=0, atol=0, equal_nan=True)


def test_without_opencv_one_line_names_what_is_missed(caplog, monkeypatch):
    def failing():
        raise ModuleNotFoundError("landmarks of images need OpenCV")

    monkeypatch.setattr(landmarks, "opencv", failing)
    model = UncertainDepth(TooFar(), check_poses=0)
    model.warm_up((32, 48))
    assert model.ufm.config.posterior is model.ufm.config.anchors is None
    followed(model, frames=slice(2))
    assert [text.partition(": ")[2] for text in alone(caplog)] == ["landmarks of images need OpenCV"]


def test_without_images_one_line_names_what_is_missed(caplog):
    assert UncertainDepth(None).ufm.config.posterior is None
    assert [text.partition(": ")[2] for text in alone(caplog)] == ["UncertainDepth(None) sees no images"]
    caplog.clear()
    assert UncertainDepth(None, UfMStarConfig(anchors=AnchorConfig())).ufm.config.posterior is not None  # anchors come
    assert UncertainDepth(None, posterior=False).ufm.config.posterior is None
    assert not caplog.messages


def test_predictions_from_elsewhere_are_corrected_by_the_anchors_that_come_with_them():
    model, network = UncertainDepth(None, UfMStarConfig(anchors=AnchorConfig())), TooFar()
    for frame in walk()[:4]:
        v, u = (index.ravel() for index in np.mgrid[4:120:8, 4:160:8])
        depth = torch.from_numpy(frame.depth[v, u]).double()[None]
        anchors = Anchors(torch.from_numpy(np.stack([u, v], -1)).double()[None], depth, 1e-4 * depth**2)
        prediction = network(torch.zeros(1, 3, 120, 160))
        out = model.update(prediction, frame.T_world_cam, frame.intrinsics, anchors=anchors)
    assert torch.equal(out.prediction.depth, prediction.depth)
    assert out.member is None
    np.testing.assert_array_equal(out.intrinsics[0].numpy(), frame.intrinsics)
    assert error(out.depth, frame) < 0.01


def test_normalised_images_are_not_searched(caplog):
    def normalised(frame):
        return torch.from_numpy(frame.image).permute(2, 0, 1) / 64.0 - 2

    outs = followed(UncertainDepth(TooFar(), preprocess=None), normalised, slice(4))
    plain = followed(UncertainDepth(TooFar(), preprocess=None, posterior=False), normalised, slice(4))
    for out, expected in zip(outs, plain, strict=True):
        assert torch.equal(out.depth, expected.depth)
        torch.testing.assert_close(out.ufm_variance, expected.variance, rtol=0, atol=0, equal_nan=True)
    assert [text.partition(": ")[2] for text in alone(caplog)] == [
        "the images must be bytes, or floats in [0, 1] (logged once)"
    ]


def test_anchors_that_are_passed_replace_the_search():
    model = UncertainDepth(TooFar())
    for frame in walk()[:8]:
        v, u = (index.ravel() for index in np.mgrid[4:120:8, 4:160:8])
        depth = torch.from_numpy(frame.depth[v, u]).double()[None]
        pixel = torch.from_numpy(np.stack([u, v], -1)).double()[None]
        out = model(frame.image, frame.T_world_cam, frame.intrinsics, anchors=Anchors(pixel, depth, 1e-4 * depth**2))
        assert int(out.statistics.anchors[0]) == int((depth > 0).sum())
    assert error(out.depth, frame) < 0.01
    named = UncertainDepth(TooFar(), anchors="corners")
    with pytest.raises(ValueError, match="anchors come from the source"):
        named(walk()[0].image, frame.T_world_cam, frame.intrinsics, anchors=Anchors(pixel, depth, depth))


def test_the_mean_uncertainty_stays_plain_unless_a_source_is_named():
    models = [UncertainDepth(TooFar(), **how) for how in ({}, {"posterior": False}, {"anchors": "dense"})]
    for frame in walk()[:5]:
        means = [model.mean_uncertainty(frame.image, frame.T_world_cam, frame.intrinsics) for model in models]
        assert torch.equal(means[0].mean, means[1].mean)
    assert float(means[2].anchored.mean) > 0
    assert float(means[2].mean) > float(means[0].mean)


def test_an_image_of_another_camera_restarts_the_evidence_with_one_warning(caplog):
    model = UncertainDepth(TooFar())
    for i, frame in enumerate(walk()[:8]):
        K = frame.intrinsics if i < 4 else frame.intrinsics * [[1.0 + i / 1000], [1.0], [1.0]]
        out = model(frame.image, frame.T_world_cam, K)
    assert model.landmarks.restarts == 4
    assert len([text for text in caplog.messages if "another size or camera" in text]) == 1
    assert error(out.depth, frame) < 0.2  # with what was learnt before


def test_after_a_jump_of_the_poses_the_depth_is_right_again_within_three_images():
    model, shift = UncertainDepth(TooFar()), np.eye(4)
    shift[:3, :3] = Rotation.from_euler("y", 8, degrees=True).as_matrix()
    shift[:3, 3] = 0.6, 0.0, 0.3
    outs = []
    for i, frame in enumerate(walk()):
        T = frame.T_world_cam if i < 8 else shift @ frame.T_world_cam
        outs.append(model(frame.image, T, frame.intrinsics))
    used = [int(out.statistics.anchors_used[0]) for out in outs]
    assert used[8] < 0.1 * used[7]
    assert used[11] > 0.7 * used[7]
    assert error(outs[11].depth, walk()[11]) < 0.1
    for i in range(8, 12):
        truth = torch.from_numpy(walk()[i].depth)
        z = ((outs[i].depth[0] - truth) / outs[i].std[0])[truth > 0]
        assert float((z.abs() > 3).double().mean()) < 0.03


class Scaled(torch.nn.Module):
    """A function of the true depth of the walk's next frame."""

    def __init__(self, change):
        super().__init__()
        self.change, self.calls = change, 0

    def forward(self, image):
        self.calls += 1
        return DepthPrediction(self.change(torch.from_numpy(walk()[self.calls - 1].depth)[None]))


WRONG = {
    "an eighth": (lambda z: z / 9, "the predicted depth is 0.11 times what the anchors show: another unit, or a scene"),
    "inverse depth": (lambda z: 4 / z, "far is near in the depth"),
    "right": (lambda z: 1.2 * z, ""),
    "a third": (lambda z: z / 3, ""),
}


@pytest.mark.parametrize("mistake", WRONG)
def test_a_depth_that_contradicts_its_first_anchors_is_named_once(caplog, mistake):
    change, words = WRONG[mistake]
    model = UncertainDepth(Scaled(change))
    for _ in range(2):
        followed(model)
        model.reset()
        model.networks[0].calls = 0
    found = [text for text in caplog.messages if "anchors show" in text or "far is near" in text]
    assert len(found) == bool(words), caplog.messages
    assert all(words in text for text in found)


def ring(n, around):
    """Cameras on a circle of 20 cm, with angles [deg] between their axes."""
    poses = np.tile(np.eye(4), (n, 1, 1))
    for pose, angle in zip(poses, around, strict=True):
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        pose[:3, :3], pose[:3, 3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]], 0.2 * np.array([s, 0, c])
    return poses


BATCHES = {
    "a clip": (lambda: np.stack([frame.T_world_cam for frame in walk()[:8]]), True),
    "a clip in another order": (lambda: np.stack([walk()[i].T_world_cam for i in (3, 0, 6, 1, 7, 4, 2, 5)]), False),
    "one pose": (lambda: np.tile(np.eye(4), (8, 1, 1)), False),
    "a ring of cameras": (lambda: ring(6, np.arange(6) * 60), False),
    "robots in a row": (lambda: np.stack([np.eye(4) + np.eye(4, k=3) * 2.0 * i for i in range(8)]), False),
}


@pytest.mark.parametrize("batch", BATCHES)
def test_a_clip_that_is_passed_as_a_batch_is_named_once(caplog, batch):
    poses, named = BATCHES[batch]
    poses = poses()
    ufm = UfMStar()
    depth = torch.from_numpy(np.stack([frame.depth for frame in walk()[: len(poses)]]))
    for _ in range(2):
        ufm(depth, poses, walk()[0].intrinsics)
        ufm.reset()
    found = [text for text in caplog.messages if "look like successive frames of one video" in text]
    assert len(found) == 2 * named  # reset() begins anew
    assert all("8 streams of a batch" in text and "their poses form one path" in text for text in found)
