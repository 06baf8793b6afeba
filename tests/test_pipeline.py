"""UncertainDepth: alternation, the full modes, preprocessing, state."""

from __future__ import annotations

import threading

import pytest
import torch
from modules import same
from torch import nn
from walks import SPGF

import scenes
from ufmstar_torch import DepthPrediction, UfMStar, UfMStarConfig, UncertainDepth
from ufmstar_torch.eval.engine.networks import NetworkSource
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.frames.prediction import NetworksInTurn, combine
from ufmstar_torch.models import Preprocess

H, W = 30, 40
CONFIG = UfMStarConfig(segment=SPGF, unmeasured="paper")
K = torch.tensor(scenes.intrinsics(H, W))
POSES = [torch.tensor(T) for T in scenes.tour(30)[:9]]


class Scaled(nn.Module):
    """A network: depth = the image times a factor."""

    def __init__(self, factor: float, aleatoric: float | None = None) -> None:
        super().__init__()
        self.factor, self.aleatoric, self.calls = nn.Parameter(torch.tensor(factor)), aleatoric, 0

    def forward(self, image):
        self.calls += 1
        depth = image[:, 0] * self.factor
        return DepthPrediction(depth, None if self.aleatoric is None else torch.full_like(depth, self.aleatoric))


class Noisy(nn.Module):
    """A stochastic network that samples in eval mode."""

    def forward(self, image):
        return DepthPrediction(image[:, 0] * (1 + 0.1 * torch.randn(())))


def image(i: int) -> torch.Tensor:
    depth = torch.tensor(scenes.render(POSES[i].numpy(), K.numpy(), H, W), dtype=torch.float32)
    return depth.expand(1, 3, H, W)


def test_members_take_turns():
    members = [Scaled(1.0), Scaled(1.1), Scaled(0.9)]
    model = UncertainDepth(members, CONFIG, posterior=False)
    used = [model(image(i), POSES[i], K).member for i in range(7)]
    assert used == [0, 1, 2, 0, 1, 2, 0]
    assert [m.calls for m in members] == [3, 2, 2]


def test_one_inference_then_ufmstar():
    model, ufm = UncertainDepth(Scaled(1.2, aleatoric=0.04), CONFIG, posterior=False), UfMStar(CONFIG)
    for i in range(4):
        out = model(image(i), POSES[i], K)
        expected = ufm(image(i)[:, 0] * 1.2, POSES[i], K, aleatoric=torch.full((1, H, W), 0.04))
        torch.testing.assert_close(out.variance, expected.variance, equal_nan=True)
        torch.testing.assert_close(out.std, expected.std, equal_nan=True)
        assert torch.equal(out.depth, out.prediction.depth)
        assert not out.variance.requires_grad


def test_full_ensemble_is_the_predictive_mixture():
    members = [Scaled(1.0, 0.01), Scaled(1.2, 0.03)]
    model = UncertainDepth(members, CONFIG, posterior=False, mode="full")
    out = model(image(0), POSES[0], K)
    d = image(0)[:, 0]
    assert out.member is None
    torch.testing.assert_close(out.depth, 1.1 * d)
    torch.testing.assert_close(out.prediction.aleatoric_variance, torch.full_like(d, 0.02))
    torch.testing.assert_close(out.prediction.epistemic_variance, (0.1 * d) ** 2)
    torch.testing.assert_close(out.variance, out.disagreement + 0.02 + (0.1 * d) ** 2)


def test_full_stochastic_network_samples():
    torch.manual_seed(0)
    out = UncertainDepth(Noisy(), CONFIG, posterior=False, mode="full", samples=200)(image(0), POSES[0], K)
    relative = (out.prediction.epistemic_variance / image(0)[:, 0] ** 2).mean().sqrt().item()
    assert relative == pytest.approx(0.1, rel=0.2)


def test_combine():
    x = torch.ones(1, 2, 2)
    with_e = [DepthPrediction(x, x, 0.5 * x), DepthPrediction(3 * x, x, 1.5 * x)]
    torch.testing.assert_close(combine(with_e).epistemic_variance, 2 * x)
    mixed = combine([DepthPrediction(x, x), DepthPrediction(3 * x)])
    assert mixed.aleatoric_variance is None
    torch.testing.assert_close(mixed.epistemic_variance, x)


class ByFocal(nn.Module):
    """Depth = the image times fx / 16, fx [px] of the network's input."""

    takes_intrinsics = True

    def forward(self, image, K):
        assert K.shape == (len(image), 3, 3)
        assert K.dtype == image.dtype == torch.float32
        return DepthPrediction(image[:, 0] * K[:, 0, 0, None, None] / 16)


@pytest.mark.parametrize("mode", ["alternate", "full"])
def test_the_preprocessed_intrinsics_reach_the_networks_that_take_them(mode):
    """Half the size, half the focal length. A member without ``takes_intrinsics`` gets the image only."""
    half = Preprocess(size=(H // 2, W // 2))
    x = torch.rand(2, 3, H, W, generator=torch.Generator().manual_seed(0))
    model = UncertainDepth([ByFocal(), Scaled(1.0)], CONFIG, posterior=False, mode=mode, preprocess=half)
    expected = half.apply_image(x)[:, 0] * K[0, 0].float() / 2 / 16
    if mode == "full":
        expected = (expected + half.apply_image(x)[:, 0]) / 2
    torch.testing.assert_close(model(x, POSES[0], K).depth, expected)
    source = NetworkSource(NetworksInTurn(ByFocal(), preprocess=half), torch.device("cpu"), {})
    picture = (x[0] * 255).byte()
    frame = Frame(0, "0", picture.permute(1, 2, 0).numpy(), None, POSES[0].numpy(), K.numpy())
    depth = source.one(frame, 0).depth
    torch.testing.assert_close(depth.reshape(H // 2, W // 2), ByFocal()(*half(picture[None], K[None].float())).depth[0])


def test_the_mean_uncertainty_of_images():
    """Equal to UfM*'s, with alternating members. A failed call does not advance the member index."""
    model, ufm = UncertainDepth([Scaled(1.0, 0.01), Scaled(1.2, 0.03)], CONFIG, posterior=False), UfMStar(CONFIG)
    for i in range(4):
        factor, a = ((1.0, 0.01), (1.2, 0.03))[i % 2]
        with pytest.raises(ValueError, match="pixels or fraction"):
            model.mean_uncertainty(image(i), POSES[i], K, pixels=5, fraction=0.5)
        got = model.mean_uncertainty(image(i), POSES[i], K, pixels=200, seed=i)
        want = ufm.mean_uncertainty(
            image(i)[:, 0] * factor, POSES[i], K, torch.full((1, H, W), a), member=i % 2, pixels=200, seed=i
        )
        assert torch.equal(got.mean, want.mean)
        assert int(got.pixels) == 200
    assert model(image(4), POSES[4], K).member == 0


@pytest.mark.parametrize("beside", [True, False])
def test_a_stream_may_reuse_the_arrays_of_its_frames(beside, monkeypatch):
    """Networks run ahead in a thread of their own, or, as on an accelerator, in the caller's."""
    monkeypatch.setattr(UncertainDepth, "_networks_on_cpu", lambda self: beside)

    def video():
        picture, pose, intrinsics = image(0)[0].clone(), POSES[0].numpy().copy(), K.numpy().copy()
        for i in range(4):
            picture[:], pose[:], intrinsics[:] = image(i)[0], POSES[i].numpy(), K.numpy()
            intrinsics[0, 0] *= 1 + i / 20
            yield picture, pose, intrinsics

    model, one_by_one = (UncertainDepth(Scaled(1.0), CONFIG, posterior=False) for _ in range(2))
    for out, frame in zip(model.stream(video()), video(), strict=True):
        assert torch.equal(out.variance, one_by_one(*frame).variance)


def test_networks_stay_in_eval_mode():
    model = UncertainDepth(nn.Sequential(Scaled(1.0)), CONFIG, posterior=False)
    model.train()
    assert not model.networks.training
    assert not any(m.training for m in model.networks.modules())


def test_state_continues_and_resets():
    def fresh():
        return UncertainDepth([Scaled(1.0), Scaled(1.1)], CONFIG, posterior=False)

    whole, first, second = fresh(), fresh(), fresh()
    expected = [whole(image(i), POSES[i], K).variance for i in range(5)]
    for i in range(3):
        first(image(i), POSES[i], K)
    second.load_stream_state(first.stream_state())
    assert torch.equal(second(image(3), POSES[3], K).variance, expected[3])
    whole.reset()
    assert whole(image(0), POSES[0], K).member == 0


def test_a_state_that_is_refused_leaves_the_last_image_known():
    """The camera moves, and its image is repeated: that is noticed although a load failed in between."""
    picture = torch.randint(100, 255, (1, 3, H, W), dtype=torch.uint8)

    class Wall(nn.Module):
        def forward(self, x):
            return DepthPrediction(torch.full_like(x[:, 0], 2.0))

    models = [UncertainDepth(Wall(), CONFIG, posterior=False) for _ in range(3)]
    for model in models:
        model(picture, POSES[0], K)
    with pytest.raises(ValueError, match="the state must hold"):
        models[0].load_stream_state({})
    models[1].load_stream_state(models[1].stream_state())  # forgets the image
    refused, loaded, undisturbed = (model(picture, POSES[1], K).variance.nan_to_num() for model in models)
    assert torch.equal(refused, undisturbed)
    assert not torch.equal(loaded, undisturbed)


def test_a_state_holds_no_weights():
    first = UncertainDepth([Scaled(1.0), Scaled(1.1)], CONFIG, posterior=False)
    for i in range(3):
        first(image(i), POSES[i], K)
    state = first.stream_state()
    others = UncertainDepth([Scaled(1.0), Scaled(1.2)], CONFIG, posterior=False)
    others.load_stream_state(state)
    assert int(others.ufm.frames) == 3
    with pytest.raises(ValueError, match="image_index must be a whole number of at least 0"):
        others.load_stream_state({**state, "image_index": torch.tensor(-1)})
    assert [network.factor.item() for network in others.networks] == [1.0, pytest.approx(1.2)]


class Meeting:
    """Lets a network wait from the second image on until UfM* has begun the image before, and UfM* until the network
    has begun."""

    def __init__(self) -> None:
        self.network, self.ufm = threading.Event(), threading.Event()

    def stage(self, name):
        self.ufm.set()
        assert self.network.wait(60)


class Waiting(Scaled):
    def __init__(self, meeting: Meeting) -> None:
        super().__init__(1.0)
        self.meeting = meeting

    def forward(self, image):
        if self.calls:
            self.meeting.network.set()
            assert self.meeting.ufm.wait(60)
        return super().forward(image)


def test_stream_runs_a_network_on_the_cpu_beside_ufm_star():
    meeting = Meeting()
    model = UncertainDepth(Waiting(meeting), CONFIG, posterior=False)
    model.ufm.observer = meeting
    assert len(list(model.stream((image(i), POSES[i], K) for i in range(3)))) == 3


@pytest.mark.parametrize("beside", [True, False], ids=["in a thread", "in the caller's thread, as on a GPU"])
def test_an_error_of_the_network_in_a_stream_comes_after_the_result_before_it(beside):
    class Failing(Scaled):
        def forward(self, image):
            if self.calls == 2:
                raise ArithmeticError("the third image")
            return super().forward(image)

    model = UncertainDepth(Failing(1.0), CONFIG, posterior=False)
    model._networks_on_cpu = lambda: beside
    results = model.stream((image(i), POSES[i], K) for i in range(4))
    assert [next(results).member for _ in range(2)] == [0, 0]
    with pytest.raises(ArithmeticError, match="the third image"):
        next(results)
    assert model.image_index == 2


def test_stream_and_a_device_for_the_multiview_part_change_no_bit():
    members = [Scaled(1.0), Scaled(1.1), Scaled(0.9)]
    plain = UncertainDepth(members, CONFIG, posterior=False)
    ahead = UncertainDepth(members, CONFIG, posterior=False, multiview_device="cpu").to(torch.device("cpu"))
    frames = [(image(i), POSES[i], K) for i in range(5)]
    requested = []

    def video():
        for i, frame in enumerate(frames):
            requested.append(i)
            yield frame

    for i, out in enumerate(ahead.stream(video())):
        expected = plain(*frames[i])
        assert out.member == expected.member == i % 3
        assert same(out.variance, expected.variance)
        assert requested[-1] == min(i + 1, 4), "one image ahead"
    assert int(ahead.image_index) == 5
    assert list(ahead.stream([])) == []
    assert ahead.ufm.mean.device.type == "cpu"
