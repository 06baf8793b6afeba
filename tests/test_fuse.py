"""Fusion of every backend: against the oracle, conservation laws, and the covariance floor."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from random_gaussians import as_lists, covariances, mixture, random_pairs, views

import oracle
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.steps.correspond import Correspondence
from ufmstar_torch.steps.fuse import append, fuse, view_weights

pytestmark = pytest.mark.numerics


@pytest.mark.parametrize(("weighted", "baseline"), [(False, 0.07), (True, 0.5), (False, None)])
@given(seed=st.integers(0, 10**6))
def test_agrees_with_the_oracle(backend, weighted, baseline, seed):
    """Several c that match one k are fused in increasing c. ``weighted``: by overlap."""
    previous, current = mixture(2, 6, seed, features=2), mixture(2, 5, seed + 50, empty=1, features=2)
    pairs = random_pairs(2, previous, current, seed)
    config = UfMStarConfig(overlap_weighted=weighted, view_baseline=baseline)
    view = views(2, seed)
    fused = backend.kernels.fuse(previous.padded(12), current, pairs.padded(12), view, config)
    fused, dropped = append(fused, current, current.valid & ~pairs.match.any(2), view, config)
    assert dropped.tolist() == [0, 0]
    for b in range(2):
        matches = [pairs.match[b, c].nonzero().flatten().tolist() for c in range(int(current.components[b]))]
        overlaps = {(c, k): pairs.overlap[b, c, k].item() for c in range(5) for k in range(6)}
        expected = oracle.fuse(
            as_lists(previous, b), as_lists(current, b), matches, overlaps, view[b].numpy(), baseline=baseline,
            overlap_weighted=weighted,
        )  # fmt: skip
        ours = as_lists(fused, b)
        assert len(ours) == len(expected)
        for mine, theirs in zip(ours, expected, strict=True):
            for name in ("mean", "cov", "weight", "m", "compared", "views", "reference", "features"):
                np.testing.assert_allclose(mine[name], theirs[name], rtol=1e-10, atol=1e-11)
    single = backend.kernels.fuse(previous.to(torch.float32), current, pairs, view, config)
    for name, value in fuse(previous.to(torch.float32), current, pairs, view, config).tensors().items():
        torch.testing.assert_close(getattr(single, name), value, rtol=1e-5, atol=1e-7)


@given(st.integers(0, 10**6))
def test_each_fusion_adds_exactly_its_weight(backend, seed):
    previous, current = mixture(1, 8, seed), mixture(1, 6, seed + 50)
    previous = previous.replace(weight=previous.weight.round())
    current = current.replace(weight=current.weight.round())
    pairs = random_pairs(1, previous, current, seed)
    config, view = UfMStarConfig(), views(1, seed)
    fused = backend.kernels.fuse(previous, current, pairs, view, config)
    match = pairs.match & (view_weights(previous, view, config) > 0)[:, None]
    added = torch.einsum("bck,bc->bk", match.double(), current.weight)
    assert torch.equal(fused.weight, previous.weight + added)
    untouched = ~match.any(1)
    for name, value in fused.tensors().items():
        assert torch.equal(value[untouched], getattr(previous, name)[untouched])


def test_a_static_number_of_rounds_changes_nothing():
    previous, current = mixture(2, 6, 5), mixture(2, 5, 6)
    pairs = random_pairs(2, previous, current, 8)
    config = UfMStarConfig()
    for name, value in fuse(previous, current, pairs, views(2, 5), config, rounds=5).tensors().items():
        free = fuse(previous, current, pairs, views(2, 5), config)
        torch.testing.assert_close(value, getattr(free, name), rtol=1e-14, atol=1e-15)


def test_equal_gaussians_disagree_by_nothing_in_float32(backend):
    previous = mixture(1, 6, 5)
    previous = previous.replace(disagreement=torch.zeros_like(previous.disagreement)).to(torch.float32)
    eye = torch.eye(6, dtype=torch.bool)[None] & previous.valid[:, None]
    fused = backend.kernels.fuse(
        previous, previous.to(torch.float64), Correspondence(eye, eye.double()), views(1, 5), UfMStarConfig()
    )
    assert fused.disagreement.max() < 1e-14
    torch.testing.assert_close(fused.covariance, previous.covariance, rtol=1e-6, atol=1e-9)


def test_the_floor_lifts_eigenvalues_below_it_and_nothing_else(backend):
    floored = backend.kernels.floor_covariance
    cov = covariances(60, 4, decades=6).view(3, 20, 3, 3)
    floor = torch.linspace(1e-8, 1e-2, 20, dtype=torch.float64).expand(3, 20)
    before, after = (torch.linalg.eigvalsh(value) for value in (cov, floored(cov, floor)))
    torch.testing.assert_close(after, before.maximum(floor[..., None]), rtol=0, atol=1e-15)
    for share in (0.5, 1 - 1e-6, 1 + 1e-6, 2.0):  # smaller floors leave the covariance unchanged bit for bit
        lifted = floored(cov, share * before[..., 0])
        assert (lifted == cov).all(-1).all(-1).eq(share < 1).all()
    lifted = floored(torch.zeros(1, 3, 3, dtype=torch.float64), torch.tensor([1e-6], dtype=torch.float64))
    torch.testing.assert_close(lifted[0], 1e-6 * torch.eye(3, dtype=torch.float64), rtol=1e-12, atol=0)


def test_thin_wide_plates_survive_many_fusions_in_float32(backend):
    """A tilted plate, 3000 times wider than thick, keeps a thickness above float32's rounding of its trace."""
    one = torch.ones(1, 1, dtype=torch.float64)
    tilt = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.5, 0.3], [0.5, 0.0, -0.8], [-0.3, 0.8, 0.0]]).double())
    cov = tilt @ torch.diag(torch.tensor([1.0, 1.0, 1e-7], dtype=torch.float64)) @ tilt.T
    plate = GaussianMixture.empty(1, 1, dtype=torch.float64, device="cpu").replace(
        covariance=cov[None, None], weight=one
    )
    m, pairs = plate.to(torch.float32), Correspondence(one.bool()[None], one[None])
    for _ in range(20 if backend.slow else 200):
        m = backend.kernels.fuse(m, plate, pairs, torch.zeros(1, 4).double(), UfMStarConfig.paper(), rounds=1)
        assert torch.linalg.eigvalsh(m.covariance.double())[0, 0, 0] > 4 * torch.finfo(torch.float32).eps * 2
    assert m.disagreement.isfinite().all()


def test_append_counts_what_has_no_slot():
    previous, current = mixture(2, 6, 5, empty=2), mixture(2, 5, 6, empty=0)
    new = torch.tensor([[True, False, True, False, True], [False, True, False, False, False]])
    view = views(2, 5)
    filled, dropped = append(previous, current, new, view, UfMStarConfig())
    assert dropped.tolist() == [1, 0]
    assert torch.equal(filled.mean[0, 4], current.mean[0, 0])
    assert torch.equal(filled.mean[0, 5], current.mean[0, 2])
    assert torch.equal(filled.mean[1, 4], current.mean[1, 1])
    assert filled.disagreement[0, 4:].tolist() == [0, 0]
    assert filled.views[0, 4:].tolist() == filled.compared[0, 4:].tolist() == [0, 0]
    assert torch.equal(filled.reference[0, 4:, :4], view[0].expand(2, 4))
    papers = append(previous, current, new, view, UfMStarConfig.paper())[0]
    assert torch.equal(papers.compared[0, 4:], papers.weight[0, 4:])
    for name, value in filled.tensors().items():
        assert torch.equal(value[:, :4], getattr(previous, name)[:, :4])
