"""Gaussian mixture regression: oracle, kernels, the bound of the culling, sampling, the moving average."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from modules import same
from numba import njit
from random_gaussians import as_lists, mixture

import oracle
import scenes
import ufmstar_torch.regress as regress_module
from ufmstar_torch.camera import unproject
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.kernels import regress_cpu
from ufmstar_torch.kernels.vectors_cpu import vectors
from ufmstar_torch.regress import distribute, regress, regress_image, sample_pixels, shares, smooth

pytestmark = pytest.mark.numerics

K = torch.tensor(scenes.intrinsics(40, 56))[None]
EXACT = UfMStarConfig(prior_mean=0.3, prior_weight=2.0)
NEAR = EXACT.replace(regression="neighbourhood")


def rendered(seed: int = 0) -> torch.Tensor:
    depth = torch.tensor(scenes.render(scenes.tour(8)[seed % 8], K[0].numpy(), 40, 56))[None]
    depth[0, 3, 4] = torch.nan
    return depth


@pytest.mark.parametrize("config", [EXACT, NEAR], ids=["exact", "neighbourhood"])
@given(seed=st.integers(0, 10**6))
@settings(max_examples=10)
def test_agrees_with_the_oracle(config, seed):
    m = mixture(2, 9, seed, features=2)
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(2, 20, 3, generator=generator, dtype=torch.float64) + torch.tensor([0.0, 0.0, 3.0])
    points[:, :7] = m.mean[:, :7] + 0.02
    result = regress(m, points, config)
    neighbourhood = (2.0, 0.1, 0.5) if config is NEAR else None
    for b in range(2):
        for p in range(20):
            components, prior = oracle.prepared(as_lists(m, b)), {"prior_weight": 2.0, "prior_mean": 0.3}
            value, features = oracle.regress_point(
                points[b, p].numpy(), components, **prior, neighbourhood=neighbourhood
            )
            assert result.disagreement[b, p].item() == pytest.approx(value, rel=1e-9)
            np.testing.assert_allclose(result.features[b, p].numpy(), features, rtol=1e-9, atol=1e-300)


@pytest.mark.parametrize("config", [EXACT, NEAR], ids=["exact", "neighbourhood"])
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
    torch.testing.assert_close(distribute(m, points, values, config), share.mT @ values, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("config", [EXACT, NEAR], ids=["exact", "neighbourhood"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-11), (torch.float32, 5e-5)])
def test_the_kernel_agrees_with_the_reference(config, dtype, tolerance):
    m = mixture(2, 40, 3, features=2)
    depth = torch.cat([rendered(0), rendered(3)])
    reference = regress_image(m, depth, K.expand(2, 3, 3), depth > 0, config)
    fast = regress_cpu.regress_image(m, depth.to(dtype), K.expand(2, 3, 3), depth > 0, config)
    assert fast.disagreement.dtype == dtype
    assert fast.disagreement.isnan().sum() == 2
    # float32: what the exponent's argument, up to some 100, loses to rounding.
    for a, b in ((fast.disagreement, reference.disagreement), (fast.features, reference.features)):
        torch.testing.assert_close(a.double(), b, rtol=0, atol=tolerance, equal_nan=True)


def crowded(seed: int):
    """300 Gaussians about the surface of ``rendered(2)`` and behind the camera, many of them thin, and its depth."""
    depth = rendered(2)
    m = mixture(1, 300, seed, empty=3)
    generator = torch.Generator().manual_seed(seed)
    surface = unproject(depth.nan_to_num(1.0), K).flatten(1, 2)
    near = surface[:, torch.randint(surface.shape[1], (300,), generator=generator)]
    sign = 1 - 2 * (torch.arange(300) % 10 == 0).double()[:, None]
    scale = 10 ** (-3 * torch.rand(300, generator=generator, dtype=torch.float64))
    return m.replace(mean=near * sign, covariance=m.covariance * scale[:, None, None]), depth


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


@pytest.mark.parametrize("weight", [1.0, 1e-3, 1e3])
@pytest.mark.parametrize("epsilon", [0.5, 1e-2, 1e-6])
def test_culling_keeps_its_bound(monkeypatch, epsilon, weight):
    m, depth = crowded(5)
    config = UfMStarConfig(prior_mean=0.7, prior_weight=weight)
    exact = regress_image(m, depth, K, depth > 0, config).disagreement
    monkeypatch.setitem(regress_cpu.EPSILON, torch.float64, epsilon)
    error = (regress_cpu.regress_image(m, depth, K, depth > 0, config).disagreement - exact).abs().nan_to_num()
    greatest = max(m.disagreement.max().item(), 0.7)
    assert error.max() <= epsilon * greatest
    points = unproject(depth, K).flatten(1, 2).nan_to_num(1.0)
    share = shares(m, points, config)
    unexplained = (share.amax(-1) <= 1e-3 * (1 - share.sum(-1))).view(depth.shape)
    assert error[unexplained].max() <= 1e-3 * epsilon * greatest
    if epsilon == 0.5 and weight == 1e3:
        assert error.max() > 1e-9, "or nothing was left out, and the test tests nothing"


@pytest.mark.parametrize("size", [(40, 56), (33, 41), (7, 3)])
def test_the_kernel_agrees_on_images_of_any_size_and_with_holes(size):
    m, depth = crowded(6)
    depth = depth[:, : size[0], : size[1]].contiguous()
    valid = torch.rand(depth.shape, generator=torch.Generator().manual_seed(0)) > 0.4
    valid[:, :9, 16:32] = False  # whole tiles
    valid &= depth > 0
    depth[0, 2, 2] = 1e30  # spoils no neighbour
    reference = regress_image(m, depth, K, valid, EXACT).disagreement
    fast = regress_cpu.regress_image(m, depth, K, valid, EXACT).disagreement
    torch.testing.assert_close(fast, reference, rtol=0, atol=1e-10, equal_nan=True)
    single = regress_cpu.regress_image(m, depth.float(), K, valid, EXACT).disagreement
    torch.testing.assert_close(single.double(), reference, rtol=0, atol=1e-4, equal_nan=True)


@pytest.mark.parametrize("config", [EXACT, NEAR], ids=["exact", "neighbourhood"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 5e-5)])
def test_the_kernel_at_points_agrees_with_the_reference(config, dtype, tolerance):
    m = mixture(2, 30, 3, features=2)
    points = unproject(torch.cat([rendered(0), rendered(3)]), K.expand(2, 3, 3)).flatten(1, 2)
    points[1, 5, 0] = torch.inf
    reference, fast = regress(m, points, config), regress_cpu.regress(m, points.to(dtype), config)
    finite = points.isfinite().all(-1)
    assert fast.disagreement.dtype == dtype
    for a, b in ((fast.disagreement, reference.disagreement), (fast.features, reference.features)):
        torch.testing.assert_close(a[finite].double(), b[finite], rtol=0, atol=tolerance)
    if config is EXACT:
        assert fast.disagreement[~finite].isnan().all()


def test_sorting_points_into_leaves_changes_nothing():
    """Many small components, so that every leaf has a selection of its own, against one point at a time and the sum."""
    m = mixture(1, 400, 5)
    m = m.replace(mean=m.mean * 6, covariance=m.covariance * 0.05)
    generator = torch.Generator().manual_seed(0)
    at_components = m.mean[:, torch.randint(400, (500,), generator=generator)]
    points = at_components + 0.01 * torch.randn(1, 500, 3, generator=generator, dtype=torch.float64)
    points[0, 17, 1], points[0, 18, 2] = torch.nan, torch.inf
    together = regress_cpu.regress(m, points, EXACT).disagreement[0]
    alone = [regress_cpu.regress(m, points[:, i : i + 1], EXACT).disagreement[0, 0] for i in range(500)]
    assert same(together, torch.stack(alone))
    assert together[[17, 18]].isnan().all()
    finite = points[0].isfinite().all(-1)
    exact = regress(m, points, EXACT).disagreement[0]
    torch.testing.assert_close(together[finite], exact[finite], rtol=0, atol=1e-12)
    assert (exact[finite] - EXACT.prior_mean).abs().mean() > 0.02, "or the test tests nothing"


def test_far_away_and_in_an_empty_mixture_the_prior_rules():
    depth, empty = torch.full((1, 40, 56), 50.0, dtype=torch.float64), mixture(1, 3, 1, empty=3)
    for function in (regress_image, regress_cpu.regress_image):
        for m, d in ((mixture(1, 8, 1), depth), (empty, rendered())):
            for config in (EXACT, NEAR):
                out = function(m, d, K, d > 0, config).disagreement
                assert out[~out.isnan()].numpy() == pytest.approx(0.3, rel=1e-12)


def test_chunks_change_nothing(monkeypatch):
    m = mixture(1, 9, 4)
    points = unproject(rendered(1).nan_to_num(1.0), K).flatten(1, 2)
    whole = regress(m, points, EXACT).disagreement
    monkeypatch.setattr(regress_module, "_CHUNK", 9 * 100)
    torch.testing.assert_close(regress(m, points, EXACT).disagreement, whole, rtol=1e-13, atol=0)
    assert regress(m, points[:, :0], EXACT).disagreement.shape == (1, 0)


def test_on_cuda_free_memory_decides_how_much_is_regressed_at_a_time(monkeypatch):
    def pairs(free: int, kept: int = 0, device: str = "cuda") -> int:
        monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (free, 80 << 30))
        monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: kept)
        monkeypatch.setattr(torch.cuda, "memory_allocated", lambda device: 0)
        return regress_module._pairs_at_a_time(torch.device(device), 4)

    assert pairs(64 << 30) == pairs(32 << 30, 32 << 30) == 2**28
    assert pairs(64 << 30) // (256 * 1024) == 1024, "points at a time, with 256 streams of 1024 components"
    assert pairs(1 << 20) == pairs(64 << 30, device="cpu") == 2**22


@pytest.mark.parametrize("function", [smooth, regress_cpu.smooth], ids=["torch", "numba"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_smooth_averages_where_both_are_known(function, dtype):
    nan = float("nan")
    before, now = torch.tensor([[[1.0, nan, 2.0, nan]]]), torch.tensor([[[3.0, 4.0, nan, nan]]], dtype=dtype)
    memory, shown = function(before, now, 0.25)
    torch.testing.assert_close(memory, torch.tensor([[[1.5, 4.0, 2.0, nan]]]), equal_nan=True)
    torch.testing.assert_close(shown, torch.tensor([[[1.5, 4.0, nan, nan]]], dtype=dtype), equal_nan=True)


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
    assert torch.equal(equal[0], sample_pixels(valid, 10, 7)[0][0]), "whatever is in the other streams"
    # Binomial(400, 0.2) per valid pixel: mean 80, sigma 8.
    assert (counts[:50] - 80).abs().max() < 5 * 8
    assert counts[50:].sum() == 0


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-11), (torch.float32, 5e-5)])
def test_some_pixels_read_what_the_dense_map_reads(dtype, tolerance):
    m, depth = crowded(7)
    depth, valid = depth.to(dtype), depth > 0
    valid[0, 20:24] = False
    everywhere = regress_cpu.regress_image(m, depth, K, valid, EXACT)
    for count in (1, 63, 700):  # a pixel, less than a tile, several in each of the image's blocks
        order = torch.randperm(depth[0].numel(), generator=torch.Generator().manual_seed(count))[None, :count]
        some = regress_cpu.regress_image(m, depth, K, valid, EXACT, order)
        dense = everywhere.disagreement.flatten(1).gather(1, order)
        torch.testing.assert_close(some.disagreement, dense, rtol=0, atol=tolerance, equal_nan=True)
        features = everywhere.features.flatten(1, 2)[:, order[0]]
        torch.testing.assert_close(some.features, features, rtol=0, atol=tolerance, equal_nan=True)
    assert dense.isnan().any()
