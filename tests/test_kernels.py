"""Three tiers, one answer: the compiled CPU kernels against the torch reference."""

from __future__ import annotations

import sys
import threading
import warnings
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from random_gaussians import covariances, mixture
from test_fuse import random_pairs

import scenes
from ufmstar_torch import UfMStar, UfMStarConfig, gaussian
from ufmstar_torch.correspond import correspond
from ufmstar_torch.fuse import fuse
from ufmstar_torch.kernels import correspond_cpu, fuse_cpu, regress_cpu, select
from ufmstar_torch.step import REFERENCE

pytestmark = pytest.mark.numerics

SIZE = (48, 64)
K = torch.tensor(scenes.intrinsics(*SIZE))


@given(st.integers(0, 10**6), st.floats(0.05, 0.6), st.floats(0.05, 0.9))
@settings(max_examples=30)
def test_correspond(seed, eta, eta_occl):
    previous, current = mixture(2, 14, seed), mixture(2, 8, seed + 50)
    config = UfMStarConfig(eta=eta, eta_occlusion=eta_occl)
    reference = correspond(previous, current, K.expand(2, 3, 3), SIZE, config)
    fast = correspond_cpu.correspond(previous, current, K.expand(2, 3, 3), SIZE, config)
    torch.testing.assert_close(fast.overlap, reference.overlap, rtol=1e-11, atol=1e-100)
    assert torch.equal(fast.match, reference.match)


@pytest.mark.parametrize("weighted", [False, True])
@given(seed=st.integers(0, 10**6))
@settings(max_examples=15)
def test_fuse(weighted, seed):
    previous, current = mixture(2, 6, seed, features=2), mixture(2, 5, seed + 50, features=2)
    pairs = random_pairs(2, previous, current, seed)
    config = UfMStarConfig(overlap_weighted=weighted)
    before = previous.mean.clone()
    reference, fast = fuse(previous, current, pairs, config), fuse_cpu.fuse(previous, current, pairs, config)
    for name, value in reference.tensors().items():
        torch.testing.assert_close(getattr(fast, name), value, rtol=1e-10, atol=1e-12)
    assert torch.equal(previous.mean, before)
    single = fuse_cpu.fuse(previous.to(torch.float32), current, pairs, config)
    for name, value in fuse(previous.to(torch.float32), current, pairs, config).tensors().items():
        torch.testing.assert_close(getattr(single, name), value, rtol=1e-5, atol=1e-7)


def test_floor_covariance():
    cov = covariances(60, 4, decades=6).view(3, 20, 3, 3)
    floor = torch.linspace(1e-8, 1e-2, 20, dtype=torch.float64).expand(3, 20)
    torch.testing.assert_close(
        fuse_cpu.floor_covariance(cov, floor), gaussian.floor_covariance(cov, floor), rtol=0, atol=1e-15
    )
    least = torch.linalg.eigvalsh(cov)[..., 0]
    for share in (0.5, 1 - 1e-6, 1 + 1e-6, 2.0):  # unchanged to the last bit below the least eigenvalue, and only there
        lifted = fuse_cpu.floor_covariance(cov, share * least)
        assert (lifted == cov).all(-1).all(-1).eq(share < 1).all()
    zero = torch.zeros(1, 3, 3, dtype=torch.float64)
    lifted = fuse_cpu.floor_covariance(zero, torch.tensor([1e-6], dtype=torch.float64))
    torch.testing.assert_close(lifted[0], 1e-6 * torch.eye(3, dtype=torch.float64), rtol=1e-12, atol=0)


def test_without_numba_the_reference_serves_and_says_so_once(monkeypatch):
    for name in [
        n for n in sys.modules if (n.startswith("ufmstar_torch.kernels.") and n.endswith("_cpu")) or n == "numba"
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr("ufmstar_torch.kernels.regress_cpu")
    select._numba.cache_clear()
    for name in ("correspond_cpu", "fuse_cpu", "segment_cpu", "segment_image_cpu"):
        monkeypatch.delattr(f"ufmstar_torch.kernels.{name}", raising=False)
    monkeypatch.setitem(sys.modules, "numba", None)
    select._numba_or_none.cache_clear()
    try:
        with pytest.warns(UserWarning, match="numba cannot be imported .* torch reference serves") as caught:
            chosen = [select.select_kernels("auto", "cpu") for _ in range(2)]
        assert len(caught) == 1
        assert chosen == [REFERENCE] * 2
        with pytest.raises(ImportError):
            select.select_kernels("numba", "cpu")
    finally:
        select._numba_or_none.cache_clear()


def test_seam():
    compiled = select.select_kernels("numba", "cpu")
    assert select.select_kernels("auto", "cpu") is compiled is not REFERENCE
    assert select.select_kernels("torch", "cpu") is select.select_kernels("torch", "cuda") is REFERENCE
    mixed = select.select_kernels("auto", "cuda")
    assert mixed.spgf is not REFERENCE.spgf, "on the host"
    assert replace(mixed, spgf=REFERENCE.spgf) == REFERENCE
    with pytest.raises(ValueError, match="needs CPU tensors"):
        select.select_kernels("numba", "cuda")


def test_whole_sequence_fast_and_slow():
    depths, poses, K = scenes.sequence(6, 48, 64, 0.05)
    config = UfMStarConfig(regression="exact")
    fast = UfMStar(config.replace(backend="numba"), dtype=torch.float64)
    slow = UfMStar(config.replace(backend="torch"), dtype=torch.float64)
    for depth, T in zip(depths, poses, strict=True):
        arguments = torch.tensor(depth)[None], torch.tensor(T), torch.tensor(K)
        a, b = fast(*arguments), slow(*arguments)
        assert torch.equal(a.labels, b.labels)
        torch.testing.assert_close(a.variance, b.variance, rtol=1e-9, atol=1e-12, equal_nan=True)
        assert torch.equal(a.statistics.components, b.statistics.components)
        assert torch.equal(a.statistics.pairs, b.statistics.pairs)


def test_several_threads_at_once():
    """Two streams in two Python threads give what they give alone."""
    depths, poses, K = scenes.sequence(4, 48, 64, 0.05)
    frames = [
        (torch.tensor(d)[None].float(), torch.tensor(T), torch.tensor(K)) for d, T in zip(depths, poses, strict=True)
    ]

    def run(out: list) -> None:
        ufm = UfMStar()
        out.extend(ufm(*frame).variance for frame in frames)

    alone: list = []
    run(alone)
    results: list[list] = [[] for _ in range(3)]
    threads = [threading.Thread(target=run, args=(out,)) for out in results]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    for out in results:
        for mine, theirs in zip(out, alone, strict=True):
            assert torch.equal(mine.nan_to_num(-1), theirs.nan_to_num(-1))


def test_importing_the_package_leaves_the_warnings_alone():
    before = list(warnings.filters)
    __import__("ufmstar_torch.kernels.regress_cpu")
    assert list(warnings.filters) == before


@pytest.mark.parametrize("config", [UfMStarConfig(), UfMStarConfig(regression="neighbourhood")])
def test_threads_share_the_image_and_leave_torchs_number_alone(config):
    m = mixture(2, 20, 3, features=1)
    K = torch.tensor(scenes.intrinsics(200, 300)).expand(2, 3, 3)
    depth = torch.tensor(scenes.render(scenes.tour(8)[1], K[0].numpy(), 200, 300)).expand(2, 200, 300)
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(regress_cpu.regress_image(m, depth, K, depth > 0, config))
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert torch.equal(other.disagreement, results[0].disagreement)
        assert torch.equal(other.features, results[0].features)
