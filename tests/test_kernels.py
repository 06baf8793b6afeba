"""Three tiers, one answer: the compiled CPU kernels against the torch reference."""

from __future__ import annotations

import functools
import sys
import threading
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from modules import same
from parts import compiled
from random_gaussians import covariances, mixture, random_pairs

import scenes
from ufmstar_torch import UfMStar, UfMStarConfig, frame, gaussian
from ufmstar_torch.correspond import Correspondence, correspond
from ufmstar_torch.fuse import fuse
from ufmstar_torch.kernels import (
    check_cpu,
    correspond_cpu,
    fuse_cpu,
    posterior_cpu,
    regress_cpu,
    rigid_cpu,
    select,
    step_cpu,
)
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.posterior.update import update as update_posterior
from ufmstar_torch.step import step
from ufmstar_torch.step_parts import REFERENCE

pytestmark = pytest.mark.numerics

SIZE = (48, 64)
K = torch.tensor(scenes.intrinsics(*SIZE))


def pairs_of(previous, current, config, stream: int):
    """The compiled list of one stream's pairs: c, k and beta."""
    fields = [value for m in (previous, current) for value in (by_field(m, stream), m.capacity)]
    thresholds = (config.eta, config.eta_occlusion, config.near_plane, gaussian.PIXEL_VARIANCE)
    return map(torch.from_numpy, compiled(correspond_cpu.matches)(*fields, K.numpy(), *SIZE, thresholds))


def by_field(m: GaussianMixture, stream: int):
    """All slots of a stream by field (``rigid_cpu``)."""
    fields = np.empty((rigid_cpu.FIELDS, rigid_cpu.padded(m.capacity)))
    moments = (v[stream].numpy() for v in (m.mean, m.covariance, m.weight))
    rigid_cpu.gather(np.arange(m.capacity), 0, m.capacity, *moments, fields)
    return fields


@given(st.integers(0, 10**6), st.floats(0.05, 1.0), st.floats(0.05, 1.0))
@settings(max_examples=30)
def test_correspond_agrees_with_the_reference(seed, eta, eta_occl):
    previous, current = mixture(2, 14, seed), mixture(2, 8, seed + 50)
    config = UfMStarConfig(eta=eta, eta_occlusion=eta_occl)
    reference = correspond(previous, current, K.expand(2, 3, 3), SIZE, config)
    for b in range(2):
        c, k, overlap = pairs_of(previous, current, config, b)
        assert torch.equal(torch.stack([c, k], 1), reference.match[b].nonzero()), "in increasing c and then k"
        torch.testing.assert_close(overlap, reference.overlap[b, c, k], rtol=1e-11, atol=0)


def test_correspond_lists_any_number_of_pairs():
    many = mixture(1, 120, 3, empty=0)
    many = many.replace(
        mean=many.mean * 0.01 + torch.tensor([0.0, 0.0, 3.0]), covariance=many.covariance[:, :1] + 0 * many.covariance
    )
    config = UfMStarConfig(eta=0.01, eta_occlusion=1.0)
    c, k, _ = pairs_of(many, many, config, 0)
    match = correspond(many, many, K[None], SIZE, config).match[0]
    assert len(c) > 64
    assert torch.equal(torch.stack([c, k], 1), match.nonzero())


def fused(previous, current, pairs, config):
    """The compiled fusion of a mixture, stream by stream."""
    out = GaussianMixture(*(value.clone() for value in previous.tensors().values()))
    epsilon = torch.finfo(previous.covariance.dtype).eps
    for b in range(previous.streams):
        c, k = pairs.match[b].nonzero(as_tuple=True)
        distance = torch.empty(0).double() if pairs.distance is None else pairs.distance[b, c, k]
        new = (v[b].numpy() for v in (current.mean, current.covariance, current.weight, current.features))
        compiled(fuse_cpu.fuse_pairs)(
            *(value[b].numpy() for value in out.tensors().values()), *new,
            c.numpy(), k.numpy(), np.arange(previous.capacity), pairs.overlap[b, c, k].numpy(), distance.numpy(),
            config.overlap_weighted, epsilon, np.empty(fuse_cpu.WORK),
        )  # fmt: skip
    return out


@pytest.mark.parametrize("weighted", [False, True])
@given(seed=st.integers(0, 10**6))
@settings(max_examples=15)
def test_fuse_agrees_with_the_reference(weighted, seed):
    previous, current = mixture(2, 6, seed, features=2), mixture(2, 5, seed + 50, features=2)
    pairs = random_pairs(2, previous, current, seed)
    config = UfMStarConfig(overlap_weighted=weighted)
    reference, fast = fuse(previous, current, pairs, config), fused(previous, current, pairs, config)
    for name, value in reference.tensors().items():
        torch.testing.assert_close(getattr(fast, name), value, rtol=1e-10, atol=1e-12)
    single = fused(previous.to(torch.float32), current, pairs, config)
    for name, value in fuse(previous.to(torch.float32), current, pairs, config).tensors().items():
        torch.testing.assert_close(getattr(single, name), value, rtol=1e-5, atol=1e-7)


def floored(cov, floor):
    out, mean = torch.zeros_like(cov), torch.zeros(*cov.shape[:-2], 3, dtype=cov.dtype)
    mean[..., 2] = floor.sqrt()  # a camera whose pixel is 1 wide at depth 1
    given = mean.view(-1, 3).numpy(), cov.reshape(-1, 3, 3).numpy()
    work = np.empty(fuse_cpu.WORK)
    compiled(fuse_cpu.floored)(len(given[0]), *given, 0.0, 1.0, 1.0, 0.0, out.view(-1, 3, 3).numpy(), work)
    return out


def test_floor_covariance():
    cov = covariances(60, 4, decades=6).view(3, 20, 3, 3)
    floor = torch.linspace(1e-8, 1e-2, 20, dtype=torch.float64).expand(3, 20)
    torch.testing.assert_close(floored(cov, floor), gaussian.floor_covariance(cov, floor), rtol=1e-13, atol=1e-15)
    least = torch.linalg.eigvalsh(cov)[..., 0]
    for share in (0.5, 1 - 1e-6, 1 + 1e-6, 2.0):  # unchanged to the last bit below the least eigenvalue, and only there
        lifted = floored(cov, share * least)
        assert (lifted == cov).all(-1).all(-1).eq(share < 1).all()
    lifted = floored(torch.zeros(1, 3, 3, dtype=torch.float64), torch.tensor([1e-6], dtype=torch.float64))
    torch.testing.assert_close(lifted[0], 1e-6 * torch.eye(3, dtype=torch.float64), rtol=1e-12, atol=0)


def test_thin_wide_plates_survive_a_thousand_fusions_in_float32():
    """A plate 2000 times wider than thick: rounding to float32 alone would make it indefinite."""
    generator = torch.Generator().manual_seed(0)

    def plate():
        tilt = torch.linalg.matrix_exp(0.3 * torch.randn(1, generator=generator) * torch.tensor(
            [[0.0, -0.5, 0.3], [0.5, 0.0, -0.8], [-0.3, 0.8, 0.0]]
        )).double()  # fmt: skip
        cov = tilt @ torch.diag(torch.tensor([1.0, 1.0, 0.25e-6], dtype=torch.float64)) @ tilt.T
        one = torch.ones(1, 1, dtype=torch.float64)
        return GaussianMixture(
            torch.zeros(1, 1, 3).double(), cov[None, None], one, 0 * one, one.long(), one[..., None][..., :0]
        )

    def run(step, rounds: int):
        m = plate().to(torch.float32)
        pairs = Correspondence(torch.ones(1, 1, 1, dtype=torch.bool), torch.ones(1, 1, 1, dtype=torch.float64))
        for _ in range(rounds):
            m = step(m, plate(), pairs, UfMStarConfig())
            assert torch.linalg.eigvalsh(m.covariance.double())[0, 0, 0] > 0
        assert m.disagreement.isfinite().all()

    run(fused, 1000)
    run(functools.partial(fuse, rounds=1), 200)


def test_without_numba_the_reference_runs_and_warns_once(monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)
    select.has_numba.cache_clear()
    try:
        with pytest.warns(UserWarning, match="numba cannot be imported .* torch reference serves") as caught:
            chosen = [select.select_step("auto", "cpu") for _ in range(2)]
        assert select.select_check("auto", "cpu") is frame.check_values
        assert len(caught) == 1
        assert all(one.func is step and one.keywords == {"kernels": REFERENCE} for one in chosen)
        with pytest.raises(ImportError):
            select.select_step("numba", "cpu")
    finally:
        select.has_numba.cache_clear()


def test_seam():
    compiled = select.select_step("numba", "cpu")
    assert select.select_step("auto", "cpu") is compiled is step_cpu.step
    assert select.select_check("auto", "cpu") is check_cpu.check_values
    assert select.select_posterior("auto", "cpu") is posterior_cpu.update
    assert select.select_posterior("torch", "cpu") is select.select_posterior("auto", "cuda") is update_posterior
    for device in ("cpu", "cuda"):
        assert select.select_kernels("torch", device) is select.select_step("torch", device).keywords["kernels"]
        assert select.select_kernels("torch", device) is REFERENCE
        assert select.select_check("torch", device) is frame.check_values
    mixed = select.select_kernels("auto", "mps")
    assert mixed.spgf is not REFERENCE.spgf, "on the host"
    assert replace(mixed, spgf=REFERENCE.spgf) == REFERENCE
    with pytest.raises(ValueError, match="needs CPU tensors"):
        select.select_step("numba", "cuda")


def test_seam_of_the_gpu_kernels(monkeypatch):
    pytest.importorskip("triton", reason="needs triton, which torch brings along on Linux")
    compiled = select.select_kernels("triton", "cuda")
    assert select.select_kernels("auto", "cuda") is select.select_kernels("auto", "xpu") is compiled is not REFERENCE
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    with pytest.raises(ValueError, match="'triton' needs tensors of a GPU, got device type 'cpu'"):
        select.select_step("triton", "cpu")
    monkeypatch.setitem(sys.modules, "triton", None)
    select._has_triton.cache_clear()
    try:
        with pytest.warns(UserWarning, match="triton cannot be imported .* torch reference serves") as caught:
            chosen = [select.select_kernels("auto", "cuda") for _ in range(2)]
        assert len(caught) == 1
        assert all(kernels.fuse is REFERENCE.fuse for kernels in chosen)
        monkeypatch.undo()
        monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (7, 5))
        select._has_triton.cache_clear()
        with pytest.warns(UserWarning, match=r"triton needs compute capability 8.0"):
            assert select.select_kernels("auto", "cuda").fuse is REFERENCE.fuse
    finally:
        select._has_triton.cache_clear()


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
            assert same(mine, theirs)


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
