"""Gaussian mixture regression: every backend against oracle and reference, the error bound of the culling, sampling."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from backends import make_backend
from hypothesis import given
from hypothesis import strategies as st
from numba import njit
from random_gaussians import as_lists, mixture
from shared_data import require_shared

import oracle
import scenes
import ufmstar_torch.steps.regress as regress_module
from ufmstar_torch import UfMStar
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.gaussians.camera import relative_pose, unproject
from ufmstar_torch.kernels.cpu import regress as regress_cpu
from ufmstar_torch.kernels.cpu.vectors import vectors
from ufmstar_torch.models.load import load_network
from ufmstar_torch.steps.regress import (
    Regression,
    distribute,
    memory_for,
    regress,
    regress_image,
    set_unmeasured,
    shares,
    smooth,
)
from ufmstar_torch.steps.sample import sample_pixels

pytestmark = pytest.mark.numerics

K = torch.tensor(scenes.intrinsics(40, 56))[None]
EXACT = UfMStarConfig(prior_mean=0.3, prior_weight=2.0)
NEAR = EXACT.replace(regression="neighbourhood")
BOTH = pytest.mark.parametrize("config", [EXACT, NEAR], ids=["exact", "neighbourhood"])


def rendered(seed: int = 0) -> torch.Tensor:
    depth = torch.tensor(scenes.render(scenes.tour(8)[seed % 8], K[0].numpy(), 40, 56))[None]
    depth[0, 3, 4] = torch.nan
    return depth


@BOTH
@given(seed=st.integers(0, 10**6))
def test_agrees_with_the_oracle(backend, config, seed):
    m, camera = mixture(2, 9, seed, features=2), torch.tensor(scenes.intrinsics(3, 5))
    generator = torch.Generator().manual_seed(seed)
    depth = 1 + 4 * torch.rand(2, 3, 5, generator=generator, dtype=torch.float64)
    points = unproject(depth, camera.expand(2, 3, 3)).flatten(1, 2)
    m = m.replace(mean=torch.cat([points[:, :7] + 0.02, m.mean[:, 7:]], 1))
    arguments = (m, depth, camera.expand(2, 3, 3), depth > 0, config)
    result = backend.kernels.regress_image(*arguments)
    sparse = backend.kernels.regress_image(*arguments, torch.tensor([[14, 3], [0, 9]]))
    neighbourhood = (2.0, 0.1, 0.5) if config is NEAR else None
    for b in range(2):
        components = as_lists(m, b)
        table, prior = [[g["m"], *g["features"]] for g in components], np.array([0.3, 0, 0])
        expected = oracle.regress(
            points[b].numpy(), components, table, prior, prior_weight=2.0, neighbourhood=neighbourhood
        )
        values, features = expected[:, 0], expected[:, 1:]
        np.testing.assert_allclose(result.disagreement[b].flatten(), values, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(result.features[b].flatten(0, 1), features, rtol=1e-9, atol=1e-12)
        chosen = [[14, 3], [0, 9]][b]
        np.testing.assert_allclose(sparse.disagreement[b], values[chosen], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(sparse.features[b], features[chosen], rtol=1e-9, atol=1e-12)


@BOTH
def test_shares_make_up_the_regression(config):
    m = mixture(2, 9, 4, features=2)
    m = m.replace(weight=m.weight * (torch.arange(9) != 5))  # an empty slot
    points = torch.randn(2, 20, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    points[:, :9] = m.mean + 0.02
    points[:, -1] = 1e3  # far from everything: nothing but the prior
    share, result = shares(m, points, config), regress(m, points, config)
    assert share.min() >= 0
    assert (share[..., 5] == 0).all()
    assert share[:, -1].max() < 1e-300
    value = (share * m.disagreement[:, None]).sum(-1) + (1 - share.sum(-1)) * config.prior_mean
    torch.testing.assert_close(value, result.disagreement, rtol=1e-11, atol=0)
    torch.testing.assert_close(share @ m.features, result.features, rtol=1e-11, atol=1e-300)
    values = torch.randn(2, 20, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    for points_at in (slice(None), slice(0, 11)):
        summed = distribute(m, points[:, points_at], values[:, points_at], config)
        torch.testing.assert_close(summed, share[:, points_at].mT @ values[:, points_at], rtol=1e-10, atol=1e-12)


def crowded(seed: int, count: int = 300, features: int = 0):
    """Gaussians near the surface of ``rendered(2)`` and behind the camera, many of them thin; and the depth."""
    depth = rendered(2)
    m = mixture(1, count, seed, empty=3, features=features)
    generator = torch.Generator().manual_seed(seed)
    surface = unproject(depth.nan_to_num(1.0), K).flatten(1, 2)
    near = surface[:, torch.randint(surface.shape[1], (count,), generator=generator)]
    sign = 1 - 2 * (torch.arange(count) % 10 == 0).double()[:, None]
    scale = 10 ** (-3 * torch.rand(count, generator=generator, dtype=torch.float64))
    return m.replace(mean=near * sign, covariance=m.covariance * scale[:, None, None]), depth


@BOTH
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 1e-4)])
@pytest.mark.parametrize(("size", "features"), [((40, 56), 2), ((33, 41), 0), ((7, 3), 4)])
def test_agrees_with_the_reference(compiled_backend, config, dtype, tolerance, size, features):
    """Images of different sizes, with holes and an outlier, and subsets of pixels: one, less than a tile, several in a
    block."""
    m, depth = crowded(6, 60 if compiled_backend.slow else 300, features)
    size = tuple(map(min, size, (24, 40) if compiled_backend.slow else size))
    depth = depth[:, : size[0], : size[1]].contiguous()
    valid = torch.rand(depth.shape, generator=torch.Generator().manual_seed(0)) > 0.4
    valid[:, :9, 16:32] = False  # whole tiles
    valid &= depth > 0
    depth[0, 2, 2] = 1e30  # does not affect its neighbours
    exact = regress_image(m, depth, K, valid, config)
    for count in (None, 1, 63, 700):
        pixels, expected = None, (exact.disagreement, exact.features)
        if count is not None:
            pixels = torch.randperm(depth[0].numel(), generator=torch.Generator().manual_seed(count))[None, :count]
            expected = exact.disagreement.flatten(1)[:, pixels[0]], exact.features.flatten(1, 2)[:, pixels[0]]
        found = compiled_backend.kernels.regress_image(m, depth.to(dtype), K, valid, config, pixels)
        assert found.disagreement.dtype == dtype
        for a, b in zip((found.disagreement, found.features), expected, strict=True):
            torch.testing.assert_close(a.double(), b, rtol=0, atol=tolerance, equal_nan=True)


@pytest.mark.parametrize(("dtype", "least", "tolerance"), [(np.float32, -120, 4e-7), (np.float64, -1000, 4e-15)])
def test_powers_of_two_as_vectors(dtype, least, tolerance):
    @vectors
    def write(code, t, out):
        for row in range(0, 1024, code.lanes):
            out.store(t.load(row).exp2(), row)

    @njit
    def powers(t, out):
        write(t, out)

    t = np.concatenate([np.linspace(least, 126, 1020), [-np.inf, np.nan, -1e30, 2.0 * least]]).astype(dtype)
    out = np.empty_like(t)
    powers(t, out)
    exact = np.exp2(t[:1020].astype(np.longdouble))
    assert np.abs(out[:1020] / exact - 1).max() < tolerance
    np.testing.assert_allclose(out[1020:].astype(np.longdouble), np.exp2(np.longdouble(least)), rtol=tolerance)


@pytest.mark.parametrize("prior_mean", [0.0, 0.7])
@pytest.mark.parametrize("weight", [1.0, 1e-3, 1e3])
@pytest.mark.parametrize("epsilon", [0.5, 1e-2, 1e-6])
def test_culling_keeps_its_bound(monkeypatch, epsilon, weight, prior_mean):
    """Relative to M, whose components are from 1e-16 m^2 on."""
    m, depth = crowded(5, features=1)
    m = m.replace(disagreement=m.disagreement * 10.0 ** (-(torch.arange(len(m.weight[0])) % 16)))
    config = UfMStarConfig(prior_mean=prior_mean, prior_weight=weight)
    exact = regress_image(m, depth, K, depth > 0, config)
    monkeypatch.setitem(regress_cpu.ERROR, torch.float64, epsilon)
    found = make_backend("numba").kernels.regress_image(m, depth, K, depth > 0, config)
    bound, valid = epsilon / (1 - epsilon) * 1.000001, depth > 0
    error = (found.disagreement - exact.disagreement).abs()[valid]
    assert (error <= bound * exact.disagreement[valid].clamp_min(1e-12)).all()
    spread = m.features.max().clamp_min(0) - m.features.min().clamp_max(0)
    assert (found.features - exact.features).abs()[valid].max() <= bound * spread
    if epsilon == 0.5 and prior_mean > 0:
        assert error.max() > 1e-9, "some components must be culled"


def recorded(source: str):
    """Depth [1, H, W], pose and intrinsics of frames: of a rendered tour with smooth errors, or of a recording."""
    if source.startswith("tour"):
        sequence, network = open_sequence(source), None
    else:
        sequence = open_sequence(require_shared(f"data/{source}"))
        network = load_network("fastdepth", require_shared("weights/fastdepth_nyu.onnx"), threads=1)
    for n in range(0, 30, 3):
        frame = sequence[n]
        camera = torch.from_numpy(frame.intrinsics)[None]
        if network is None:
            depth = torch.from_numpy(scenes.flicker(frame.depth, 0.05, n)).float()[None]
        else:
            x, camera = network.preprocess(image_tensor(frame), camera)
            depth = network(x).depth
        yield depth, torch.from_numpy(frame.T_world_cam), camera


@pytest.mark.parametrize(
    "source",
    ["tour:3?frames=30&size=112x112", "tour:31?frames=30&size=112x112", "hololens_office", "tartanair_sample/P000",
     "rgbd_dataset_freiburg1_xyz", "rgbd_dataset_freiburg3_teddy"],
)  # fmt: skip
def test_sigma_in_single_precision_is_off_by_less_than_a_hundredth(source):
    """At every seventh pixel of the last frame, against the sum over all components in double precision."""
    config = UfMStarConfig(unmeasured="paper", ema_alpha=1.0)
    ufm = UfMStar(config)
    for depth, T, camera in recorded(source):
        out = ufm(depth, T, camera)
    mixture_cam = ufm.mixture.to(torch.float64).rigid(*relative_pose(ufm.T_world_first, T[None]))
    pixels = out.valid.flatten().nonzero()[::7].T
    exact = regress_image(mixture_cam, depth.double(), camera.double(), out.valid, config, pixels).disagreement
    assert (exact > 1e-6).double().mean() > 0.5
    found = out.disagreement.flatten(1)[:, pixels[0]].double()
    torch.testing.assert_close(found.sqrt(), exact.sqrt(), rtol=1e-2, atol=1e-6)


@BOTH
def test_far_away_and_in_an_empty_mixture_the_prior_rules(backend, config):
    depth, empty = torch.full((1, 40, 56), 50.0, dtype=torch.float64), mixture(1, 3, 1, empty=3, features=1)
    for m, d in ((mixture(1, 8, 1, features=1), depth), (empty, rendered())):
        out = backend.kernels.regress_image(m, d, K, d > 0, config)
        assert out.disagreement[d > 0].numpy() == pytest.approx(0.3, rel=1e-12)
        assert (out.features[d > 0] == 0).all()
        assert backend.kernels.regress_image(m, d, K, d < 0, config).disagreement.isnan().all()


def test_chunks_change_nothing(monkeypatch):
    m = mixture(1, 9, 4)
    points = unproject(rendered(1).nan_to_num(1.0), K).flatten(1, 2)
    whole = regress(m, points, EXACT).disagreement
    monkeypatch.setattr(regress_module, "_CHUNK", 9 * 100)
    torch.testing.assert_close(regress(m, points, EXACT).disagreement, whole, rtol=1e-13, atol=0)
    assert regress(m, points[:, :0], EXACT).disagreement.shape == (1, 0)


def test_smooth_averages_where_both_are_known():
    nan = float("nan")
    before, current = torch.tensor([[[1.0, nan, 2.0, nan]]]), torch.tensor([[[3.0, 4.0, nan, nan]]]).double()
    memory, shown = smooth(before, current, 0.25)
    torch.testing.assert_close(memory, torch.tensor([[[1.5, 4.0, 2.0, nan]]]), equal_nan=True)
    torch.testing.assert_close(shown, torch.tensor([[[1.5, 4.0, nan, nan]]]).double(), equal_nan=True)


def test_an_average_of_images_of_another_size_begins_again():
    memory = torch.rand(2, 3, 4)
    assert memory_for(memory, (3, 4)) is memory
    assert memory_for(memory, (4, 3)).shape == (2, 4, 3)
    assert memory_for(memory, (4, 3)).isnan().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("stated", ["relative", "paper", "nan"])
def test_filling_and_smoothing_at_once_equal_both(stated, dtype, monkeypatch):
    config, generator = UfMStarConfig(unmeasured=stated), torch.Generator().manual_seed(6)
    maps = torch.rand(4, 2, 9, 11, generator=generator).to(dtype)
    maps[3, :, :2, ::2], maps[:3, :, 1:4, :3] = torch.nan, torch.nan  # of the mixture, and of the frame
    disagreement, measured, depth, memory = (*maps[:3], maps[3].float())

    def regressed(*_):
        return disagreement.numpy().copy(), measured[:, None].numpy().copy()

    monkeypatch.setattr(regress_cpu, "regression", regressed)
    filled, _ = set_unmeasured(Regression(disagreement, measured[..., None]), depth, config)
    for alpha in (0.3, 1.0):
        after, shown = smooth(memory, filled.disagreement, alpha)
        changed, previous = config.replace(ema_alpha=alpha), memory.numpy() if alpha < 1 else None
        M, _, mixed, counts = regress_cpu.regress_maps([], depth.numpy(), K.numpy(), changed, smoothed=previous)
        assert counts == (measured < 0.5).sum((1, 2)).tolist()
        for a, b in ((M, shown),) if mixed is None else ((M, shown), (mixed, after)):
            rtol = 4 * torch.finfo(torch.float32).eps
            torch.testing.assert_close(torch.from_numpy(a), b, rtol=rtol, atol=0, equal_nan=True)


def test_sample_is_seeded_uniform_and_valid():
    valid = torch.zeros(2, 10, 10, dtype=torch.bool)
    valid[0, :5] = True
    valid[1, 0, :3] = True
    index, used = sample_pixels(valid, 20, seed=4)
    again, _ = sample_pixels(valid, 20, seed=4)
    other, _ = sample_pixels(valid, 20, seed=5)
    assert torch.equal(index, again)
    assert not torch.equal(index, other)
    assert used.sum(1).tolist() == [20, 3]
    assert valid.flatten(1).gather(1, index)[used].all()
    assert all(len(set(row.tolist())) == 20 for row in index)
    counts = torch.zeros(100)
    for seed in range(400):
        index, _ = sample_pixels(valid[:1], 10, seed)
        counts[index[0]] += 1
    equal, _ = sample_pixels(valid[:1].expand(3, 10, 10), 10, 7)
    assert torch.equal(equal[0], equal[1])
    assert torch.equal(equal[0], sample_pixels(valid, 10, 7)[0][0]), "for any content of the other streams"
    # Binomial(400, 0.2) per valid pixel: mean 80, sigma 8.
    assert (counts[:50] - 80).abs().max() < 5 * 8
    assert counts[50:].sum() == 0
