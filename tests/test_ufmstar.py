"""The whole algorithm against the oracle, and its properties over sequences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from modules import CONFIG, same
from torch.utils._python_dispatch import TorchDispatchMode
from walks import HEIGHT, WIDTH, run, walk, walks

import scenes
from ufmstar_torch import AnchorConfig, SPGFConfig, UfMStar, UfMStarConfig

pytestmark = pytest.mark.numerics

BACKENDS = ("torch", "numba")


VARIANTS = {
    "weighted": {"overlap_weighted": True, "initial_capacity": 2},
    "neighbourhood": {"regression": "neighbourhood", "variances_in_h": True},
    "anchored": {"anchors": AnchorConfig()},
}


class Products(TorchDispatchMode):
    """Records matrix products: BLAS chooses their order of summation by shape and processor."""

    def __init__(self):
        super().__init__()
        self.seen = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.name().removeprefix("aten::").split(".")[0]
        if name.lstrip("_").removeprefix("foreach_") in BLAS or name.startswith(("linalg_", "_linalg_")):
            self.seen.add(name)
        return func(*args, **(kwargs or {}))


class Trace:
    """An observer that records its arguments."""

    def __init__(self):
        self.events = []

    def stage(self, name):
        self.events.append(name)


STAGES = ["check", "segment", "correspond", "fuse", "append", "regress", "average"]


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_observer_follows_the_stages_and_changes_no_bit(backend):
    config = CONFIG.replace(backend=backend, anchors=AnchorConfig())
    watched, plain = UfMStar(config), UfMStar(config)
    watched.observer = Trace()
    for depth, pose, K, anchors in walks(2, 3):
        a, b = (m(depth, pose, K, anchors=anchors) for m in (watched, plain))
        assert same(a.variance, b.variance)
        assert watched.observer.events == STAGES
        watched.observer.events.clear()
    for name, value in plain.state_dict().items():
        assert same(value, watched.state_dict()[name])
    watched.mean_uncertainty(depth, pose, K)
    assert watched.observer.events[-2:] == ["regress", "average"]


BLAS = {"mm", "bmm", "addmm", "baddbmm", "addbmm", "addmv", "addr", "mv", "dot", "vdot", "matmul", "einsum", "int_mm"}
ELEMENTWISE = {"linalg_vector_norm", "linalg_cross"}


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_no_matrix_product_in_a_step(backend, variant):
    config = CONFIG.replace(backend=backend, **VARIANTS[variant])
    with Products() as products:
        _, ufm = walk(config, list(walks(2, 2)))
        ufm.query(torch.ones(2, 5, 3))
    assert products.seen <= ELEMENTWISE


def test_rigid_motion_of_the_world_changes_nothing():
    depths, poses, K = scenes.sequence(10, HEIGHT, WIDTH, 0.04)
    world = scenes.camera_pose((512.0, -64.0, 2048.0), 0.7, -0.4)
    config = CONFIG
    unmoved, original = run(config, depths, poses, K)
    ufm, shifted = run(config, depths, [world @ T for T in poses], K)
    for a, b in zip(original, shifted, strict=True):
        torch.testing.assert_close(a.variance, b.variance, rtol=0, atol=1e-10, equal_nan=True)
    here, there = (torch.tensor((T @ [0.1, 0.2, 2.0, 1.0])[:3]).view(1, 1, 3) for T in (poses[0], world @ poses[0]))
    torch.testing.assert_close(ufm.query(there).disagreement, unmoved.query(here).disagreement, rtol=1e-8, atol=1e-10)


def test_kilometres_from_the_origin_float32_loses_nothing():
    depths, poses, K = scenes.sequence(10, HEIGHT, WIDTH, 0.04)
    far = np.eye(4)
    far[:3, 3] = 4.5e6, -3.2e6, 120.0  # easting and northing of a map projection
    config = CONFIG
    _, near = run(config, depths, poses, K, dtype=torch.float32)
    _, distant = run(config, depths, [far @ T for T in poses], K, dtype=torch.float32)
    for a, b in zip(near, distant, strict=True):
        torch.testing.assert_close(a.std, b.std, rtol=0, atol=1e-4, equal_nan=True)


@pytest.mark.parametrize("backend", BACKENDS)
def test_identical_views_do_not_disagree(backend):
    depths, poses, K = scenes.sequence(1, HEIGHT, WIDTH, 0.0)
    config = CONFIG.replace(backend=backend, view_baseline=None)  # every comparison counts
    ufm, outputs = run(config, depths * 5, poses * 5, K, torch.float32)
    assert outputs[-1].statistics.new.item() == 0
    assert outputs[-1].statistics.matched.item() == outputs[-1].statistics.segments.item()
    # Matched with themselves only; the others also match an overlapping neighbour.
    first = run(config, depths, poses, K, torch.float32)[0].mixture.weight
    same = ufm.mixture.valid & (ufm.mixture.weight == 5 * first)
    assert same.sum() >= 3
    assert ufm.mixture.disagreement[same].max() < 1e-12
    valid = outputs[-1].valid
    assert outputs[-1].disagreement[valid].min() < 1e-12


def test_more_depth_noise_more_disagreement():
    """From a fixed pose, where segments do not slide, M and the mixture's m rise with the noise."""
    K, T = scenes.intrinsics(HEIGHT, WIDTH), scenes.tour(30)[0]
    exact = scenes.render(T, K, HEIGHT, WIDTH)
    dense, stored = [], []
    for amount in (0.0, 0.01, 0.02, 0.04, 0.08):
        depths = [scenes.flicker(exact, amount, i) for i in range(12)]
        ufm, outputs = run(CONFIG.replace(view_baseline=None), depths, [T] * 12, K)
        dense.append(torch.stack([o.disagreement.mean() for o in outputs[6:]]).mean().item())
        stored.append(((ufm.mixture.disagreement * ufm.mixture.weight).sum() / ufm.mixture.weight.sum()).item())
    assert dense == sorted(dense)
    assert stored == sorted(stored)
    assert dense[0] < 1e-12 < 1e-3 < dense[-1]


def test_a_place_never_seen_starts_afresh():
    depths, poses, K = scenes.sequence(4, HEIGHT, WIDTH, 0.04)
    elsewhere = [poses[0], poses[1], scenes.camera_pose((500.0, 0, 300.0), 2.0), poses[3]]
    _, outputs = run(CONFIG.replace(ema_alpha=1.0), depths, elsewhere, K)
    jump = outputs[2]
    assert jump.statistics.matched.item() == 0
    assert (jump.disagreement[jump.valid] == 0).all()
    assert outputs[3].statistics.matched.item() > 0


@pytest.mark.parametrize("which", ["none", "a", "e", "both"])
def test_total_variance(which):
    depths, poses, K = scenes.sequence(2, HEIGHT, WIDTH, 0.06)
    a, e = torch.full((1, HEIGHT, WIDTH), 0.25).double(), torch.full((1, HEIGHT, WIDTH), 0.5).double()
    ufm = UfMStar(CONFIG.replace(view_baseline=None), dtype=torch.float64)
    network_variances = {
        "aleatoric": a if which in ("a", "both") else None,
        "epistemic": e if which in ("e", "both") else None,
    }
    for depth, T in zip(depths, poses, strict=True):
        out = ufm(torch.tensor(depth)[None], torch.tensor(T), torch.tensor(K), **network_variances)
    added = {"none": 0.0, "a": 0.25, "e": 0.5, "both": 0.75}[which]
    torch.testing.assert_close(out.variance, out.disagreement + added, equal_nan=True)
    torch.testing.assert_close(out.std, out.variance.sqrt(), equal_nan=True)
    assert (out.disagreement[out.valid] > 0).any()


def test_variance_floor_is_off_by_default_and_leaves_nan():
    depths, poses, K = scenes.sequence(1, HEIGHT, WIDTH, 0.04)
    _, (plain,) = run(CONFIG, depths, poses, K)
    _, (floored,) = run(CONFIG.replace(variance_floor=0.01), depths, poses, K)
    assert plain.variance[plain.valid].min() == 0
    assert (floored.variance[floored.valid] == 0.01).all()
    assert torch.equal(floored.variance.isnan(), ~floored.valid)
    assert (floored.disagreement[floored.valid] == 0).all()


def test_identical_near_and_fine_views_do_not_disagree():
    """A checkerboard of small near tiles: segments a few centimetres wide match themselves only."""
    v, u = torch.meshgrid(torch.arange(240), torch.arange(320), indexing="ij")
    depth = torch.where((v // 24 + u // 32) % 2 == 0, 0.45, 0.65)[None]
    ufm = UfMStar(UfMStarConfig(segment=SPGFConfig.preset("tum"), unmeasured="paper"))
    for _ in range(4):
        out = ufm(depth, torch.eye(4), torch.tensor(scenes.intrinsics(240, 320)))
    assert out.statistics.segments.item() > 50
    assert out.statistics.pairs.item() == out.statistics.segments.item()
    assert out.std.max() < 1e-5


def test_a_lens_cap_fills_no_memory():
    ufm = UfMStar(CONFIG)
    for _ in range(5):
        out = ufm(torch.full((1, HEIGHT, WIDTH), 0.04), torch.eye(4), torch.tensor(scenes.intrinsics(HEIGHT, WIDTH)))
    assert out.statistics.segments.item() == out.statistics.dropped.item() > 0
    assert out.statistics.components.item() == 0
