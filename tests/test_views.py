"""Two views from one place are one view, and an image that shows nothing is no view."""

from __future__ import annotations

import logging
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from modules import same

from ufmstar_torch import UfMStar, UfMStarConfig, UncertainDepth
from ufmstar_torch.frames.image_check import ImageCheck, reduced, shows_something
from ufmstar_torch.frames.image_evidence import ImageEvidence
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.models import Preprocess, wrap_network
from ufmstar_torch.steps.fuse import COMPLETE, LEAST, after_view, view_weights

pytestmark = pytest.mark.numerics
CONFIG = UfMStarConfig()
REST = 60  # frames
H, W = 96, 128
K = torch.tensor([[100.0, 0, 63.5], [0, 100, 47.5], [0, 0, 1]])


def room(x: float, flicker: int) -> torch.Tensor:
    """Depth of a rough wall at 2.5 m and a box in front of it, seen ``x`` m to the right, with a flicker of .2 %."""
    u = torch.arange(W)[None] + 0 * torch.arange(H)[:, None]
    box = ((u - 63.5) / 100 * 1.8 + x).abs() < 0.5
    noise = 0.002 * torch.randn(6, 8, generator=torch.Generator().manual_seed(flicker))
    smooth = torch.nn.functional.interpolate(noise[None, None], (H, W), mode="bilinear")[0, 0]
    relief = 1 + 0.03 * torch.sin(u / 5.0 + 20 * x)
    return torch.where(box, 1.8, 2.5) * relief * (1 + smooth)


def pose_at(x: float, tremble: float = 0.0, rng: np.random.Generator | None = None) -> torch.Tensor:
    T = torch.eye(4, dtype=torch.float64)
    T[0, 3] = x
    if rng is not None:
        T[:3, 3] += torch.tensor(tremble * rng.standard_normal(3))
    return T


def at_rest(ufm: UfMStar, *, frames: int = REST, tremble: float = 0.0, members: int = 1, seed: int = 0):
    """The output after ``frames`` flickering views of one scene from one place."""
    rng = np.random.default_rng(seed)
    for i in range(frames):
        depth = room(0, i) * (1 + 0.05 * (i % members))
        out = ufm(depth[None], pose_at(0, tremble, rng)[None], K[None], member=i % members)
    return out


@pytest.mark.parametrize("tremble", [0.0, 0.002])
def test_a_camera_at_rest_measures_nothing(tremble):
    """Sigma stays that of an unmeasured pixel, 20 % of the depth, also if the camera trembles by 2 mm; with the paper's
    rule it falls to a share of that."""
    out = at_rest(UfMStar(CONFIG), tremble=tremble)
    assert float(out.measured.nanmean()) < 0.1
    ratio = (out.std / out.depth)[out.valid]
    torch.testing.assert_close(ratio, torch.full_like(ratio, 0.2), rtol=0.05, atol=0)
    paper = at_rest(UfMStar(CONFIG.replace(view_baseline=None)), tremble=tremble)
    assert float((paper.std / paper.depth)[paper.valid].median()) < 0.05


def test_networks_in_turn_measure_at_rest():
    """That is what alternating is for: two networks that differ by 5 % disagree, from one place as well."""
    out = at_rest(UfMStar(CONFIG), members=2)
    assert float(out.measured.nanmean()) > 0.9
    ratio = (out.std / out.depth)[out.valid]
    assert 0.01 < float(ratio.median()) < 0.1


def test_standing_still_after_a_walk_changes_little():
    ufm, rng = UfMStar(CONFIG), np.random.default_rng(1)
    end = 0.4
    for i, x in enumerate([*np.linspace(0, end, 15), *[end] * 10]):  # the moving average follows
        walked = ufm((room(x, i) * (1 + 0.02 * math.sin(9 * x)))[None], pose_at(x)[None], K[None])
    for i in range(300):
        depth = room(end, 100 + i) * (1 + 0.02 * math.sin(9 * end))
        out = ufm(depth[None], pose_at(end, 0.001, rng)[None], K[None])
    assert float(walked.measured.mean()) > 0.5
    assert float(out.std.mean() / walked.std.mean()) == pytest.approx(1, abs=0.1)
    assert float(out.measured.mean() - walked.measured.mean()) == pytest.approx(0, abs=0.05)


def component(distance: float) -> GaussianMixture:
    """One component at this distance along z, first seen from the origin."""
    fields = {"mean": torch.tensor([[[0.0, 0.0, distance]]]).double(), "weight": torch.ones(1, 1).double()}
    return GaussianMixture.empty(1, 1, dtype=torch.float64, device="cpu").replace(**fields)


def counted(mixture: GaussianMixture, positions: np.ndarray) -> float:
    """n after comparisons from these positions of the camera [N, 3]."""
    total = 0.0
    for position in positions:
        view = torch.tensor([[*position, 0.0]]).double()
        weight = view_weights(mixture, view, UfMStarConfig())
        mixture = mixture.replace(reference=after_view(mixture, view, weight))
        total += float(weight)
    return total


@given(steps=st.integers(1, 60), share=st.floats(0.05, 0.99), distance=st.floats(0.5, 20))
def test_a_slow_camera_counts_as_much_as_a_fast_one(steps, share, distance):
    """On a path to the side that ends before the reference changes, n = 1 - exp(-(b/b_0)^2), however many views there
    are, and back at the start it is the same."""
    b_0 = UfMStarConfig().view_baseline
    longest = b_0 * math.sqrt(-math.log(1 - COMPLETE))
    b = share * longest
    x = b * distance / math.sqrt(1 - b * b)  # b = x / sqrt(x^2 + distance^2)
    path = np.zeros((steps, 3))
    path[:, 0] = np.linspace(x / steps, x, steps)
    expected = 1 - math.exp(-((b / b_0) ** 2))
    there_and_back = np.concatenate([path, path[::-1]])
    for positions in (path, there_and_back, np.repeat(path, 3, 0)):
        assert counted(component(distance), positions) == pytest.approx(expected, abs=LEAST)


@given(seed=st.integers(0, 10**6), frames=st.integers(1, 200))
def test_trembling_counts_no_more_than_its_largest_step(seed, frames):
    positions = 0.004 * np.random.default_rng(seed).uniform(-1, 1, (frames, 3))
    largest = np.linalg.norm(positions, axis=1).max() / (2 - 0.004)
    limit = 1 - math.exp(-((largest / UfMStarConfig().view_baseline) ** 2))
    assert counted(component(2.0), positions) <= limit


def test_a_path_of_any_length_counts_by_its_baselines():
    """Ten steps up and down, each as long as to the next reference, are ten views."""
    step = CONFIG.view_baseline * math.sqrt(-math.log(1 - COMPLETE)) * 50
    path = np.zeros((10, 3))
    path[::2, 1] = 1.05 * step
    assert 10 * COMPLETE < counted(component(50.0), path) <= 10


def scene(seed: int = 0, height: int = 120, width: int = 160) -> np.ndarray:
    """A textured image of bytes."""
    coarse = np.random.default_rng(seed).integers(0, 256, (height // 8, width // 8, 3), dtype=np.uint8)
    return np.kron(coarse, np.ones((8, 8, 1), np.uint8))


def nothing(kind: str) -> np.ndarray:
    image, rng = scene().astype(float), np.random.default_rng(3)
    if kind == "covered":  # black with the noise of a sensor
        return np.clip(rng.normal(4, 3, image.shape), 0, 255).astype(np.uint8)
    if kind == "blurred":
        flat = torch.tensor(image).permute(2, 0, 1)[None]
        small = torch.nn.functional.adaptive_avg_pool2d(flat, 2)
        return (
            torch.nn.functional.interpolate(small, image.shape[:2], mode="bicubic")[0].permute(1, 2, 0).byte().numpy()
        )
    return np.full_like(image, {"black": 0, "saturated": 255}[kind]).astype(np.uint8)


@pytest.mark.parametrize("kind", ["black", "saturated", "covered", "blurred"])
def test_images_that_show_nothing_are_found(kind):
    def shows(image):
        return bool(shows_something(reduced(torch.from_numpy(image).permute(2, 0, 1)[None])))

    assert not shows(nothing(kind))
    assert shows(scene())
    noisy = np.clip(scene() + np.random.default_rng(0).normal(0, 20, scene().shape), 0, 255).astype(np.uint8)
    assert shows(noisy)
    floats = torch.from_numpy(nothing(kind)).permute(2, 0, 1)[None] / 255
    assert not bool(ImageCheck().informative(floats, torch.eye(4)))


def test_images_on_an_accelerator_are_judged_alike(monkeypatch):
    """Their values stay tensors, which nothing reads on the host."""
    images = [np.roll(scene(), -3 * i, 1) for i in range(3)] + [nothing("black")] * 2 + [scene()] * 3
    images = [torch.from_numpy(image).permute(2, 0, 1)[None] for image in images]
    on_host, elsewhere = ImageCheck(), ImageCheck()
    for i, image in enumerate(images):
        pose = torch.eye(4)
        pose[0, 3] = 0.1 * i
        expected = on_host.informative(image, pose)
        with monkeypatch.context() as patch:
            patch.setattr(torch.Tensor, "is_cpu", False)
            patch.setattr(torch.Tensor, "numpy", None)
            found = elsewhere.informative(image, pose)
        assert torch.equal(found, expected)
        assert bool(expected) == (i in (0, 1, 2, 5))
        if i == 2:
            for check in (on_host, elsewhere):
                check.undo([0])
    assert int(on_host._seen.frozen[0]) == int(elsewhere._seen.frozen[0]) == 2


@pytest.mark.parametrize("shape", [(2, 3, 36, 40), (1, 3, 7, 20), (1, 3, 60, 401)])
def test_bytes_and_floats_of_an_image_have_the_same_cells(shape):
    image = torch.from_numpy(np.random.default_rng(0).integers(0, 256, shape, np.uint8))
    torch.testing.assert_close(reduced(image), reduced(image.double() / 255).float(), rtol=1e-6, atol=1e-4)


class Guess(torch.nn.Module):
    """Predicts almost the same depth for every image."""

    def forward(self, x):
        return 2.6 + 0.3 * (torch.nn.functional.avg_pool2d(x.mean(1, keepdim=True), 21, 1, 10) - 0.5)


def walk_of(images, *, moving: bool = True):
    """The output after the images of a camera that moves to the right, plain UfM*, and the messages logged."""
    model = UncertainDepth(wrap_network(Guess(), preprocess=Preprocess()))
    camera = np.array([[150.0, 0, 79.5], [0, 150, 59.5], [0, 0, 1]])
    for i, image in enumerate(images):
        pose = np.eye(4)
        pose[0, 3] = 0.1 * i * moving
        out = model(image, pose, camera)
    return out


def test_a_covered_lens_is_named_and_measures_nothing(caplog):
    rng = np.random.default_rng(0)
    images = [np.roll(scene(), -7 * i, 1) for i in range(12)]
    seen = walk_of(images)
    assert float(seen.measured.nanmean()) > 0.5
    assert not [text for text in caplog.messages if "show nothing" in text]
    covered = [np.clip(rng.normal(4, 3, scene().shape), 0, 255).astype(np.uint8) for _ in range(12)]
    with caplog.at_level(logging.WARNING, "ufmstar_torch"):
        out = walk_of(images + covered)
    assert float(out.measured.nanmean()) == 0
    assert len([text for text in caplog.messages if "images in a row show nothing" in text]) == 1
    assert int(out.statistics.segments) == 0
    assert torch.equal(out.statistics.components, seen.statistics.components)  # the map is as before
    ratio = (out.ufm_variance.sqrt() / out.network_depth)[out.valid]
    torch.testing.assert_close(ratio, torch.full_like(ratio, 0.2), rtol=0.1, atol=0)


def test_a_frozen_image_of_a_moving_camera_measures_nothing(caplog):
    with caplog.at_level(logging.WARNING, "ufmstar_torch"):
        out = walk_of([scene()] * 14)
    assert float(out.measured.nanmean()) == 0
    assert [text for text in caplog.messages if "the image was the same in 9 frames of a moving camera" in text]


def test_an_image_that_is_refused_is_forgotten_by_all_that_read_it():
    """The same image at another pose is then no repeated one, and corners continue from the image before."""
    evidence = ImageEvidence("corners", by_default=True, check_poses=0, rotation_tolerance=0.01)
    image, source = torch.from_numpy(scene()).permute(2, 0, 1)[None], evidence.landmarks
    how = {"K": K, "anchors": None, "device": torch.device("cpu"), "search": True, "skip": False}
    with evidence.next_image(image.roll(9, 3), pose_at(0.0), **how) as (_, informative):
        assert informative.all()
    before = source.state()
    with pytest.raises(OverflowError), evidence.next_image(image, pose_at(0.1), **how):
        raise OverflowError
    assert all(same(value, before[name]) for name, value in source.state().items())
    with evidence.next_image(image, pose_at(0.2), **how) as (_, informative):
        assert informative.all()
    assert not all(same(value, before[name]) for name, value in source.state().items())


def test_equal_poses_of_moving_images_are_named(caplog):
    with caplog.at_level(logging.WARNING, "ufmstar_torch"):
        out = walk_of([scene(seed) for seed in range(10)], moving=False)
    assert [text for text in caplog.messages if "the pose was the same in 9 images, which show different" in text]
    assert float(out.measured.nanmean()) < 0.1
    caplog.clear()
    rng = np.random.default_rng(0)
    still = [np.clip(scene() + rng.normal(0, 8, scene().shape), 0, 255).astype(np.uint8) for _ in range(20)]
    with caplog.at_level(logging.WARNING, "ufmstar_torch"):
        walk_of(still, moving=False)
    assert not caplog.messages


def test_the_arguments_of_a_view_are_checked():
    ufm, depth = UfMStar(CONFIG), torch.full((1, H, W), 2.0)
    with pytest.raises(ValueError, match=r"informative must be a bool tensor \[1\]"):
        ufm(depth, torch.eye(4), K, informative=torch.ones(1))
