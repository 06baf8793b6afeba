"""Fusion against the oracle and its conservation laws."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from random_gaussians import as_lists, mixture, random_pairs

import oracle
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.correspond import Correspondence
from ufmstar_torch.fuse import append, fuse

pytestmark = pytest.mark.numerics


@pytest.mark.parametrize("weighted", [False, True])
@given(seed=st.integers(0, 10**6))
@settings(max_examples=12)
def test_agrees_with_the_oracle(weighted, seed):
    previous, current = mixture(2, 6, seed, features=2), mixture(2, 5, seed + 50, empty=1, features=2)
    pairs = random_pairs(2, previous, current, seed)
    config = UfMStarConfig(overlap_weighted=weighted, features=2)
    room = previous.padded(12)
    wide = Correspondence(torch.nn.functional.pad(pairs.match, (0, 6)), torch.nn.functional.pad(pairs.overlap, (0, 6)))
    fused = fuse(room, current, wide, config)
    new = current.valid & ~pairs.match.any(2)
    fused, dropped = append(fused, current, new)
    assert dropped.tolist() == [0, 0]
    for b in range(2):
        matches = [pairs.match[b, c].nonzero().flatten().tolist() for c in range(int(current.components[b]))]
        overlaps = {(c, k): pairs.overlap[b, c, k].item() for c in range(5) for k in range(6)}
        expected = oracle.fuse(
            as_lists(previous, b), as_lists(current, b), matches, overlaps, overlap_weighted=weighted
        )
        ours = as_lists(fused, b)
        assert len(ours) == len(expected)
        for mine, theirs in zip(ours, expected, strict=True):
            assert mine["count"] == theirs["count"]
            for name in ("mean", "cov", "weight", "m", "features"):
                np.testing.assert_allclose(mine[name], theirs[name], rtol=1e-10, atol=1e-11)


@given(st.integers(0, 10**6))
@settings(max_examples=15)
def test_each_fusion_adds_exactly_its_weight(seed):
    previous, current = mixture(1, 8, seed), mixture(1, 6, seed + 50)
    previous = previous.replace(weight=previous.weight.round())
    current = current.replace(weight=current.weight.round())
    pairs = random_pairs(1, previous, current, seed)
    fused = fuse(previous, current, pairs, UfMStarConfig())
    added = torch.einsum("bck,bc->bk", pairs.match.double(), current.weight)
    assert torch.equal(fused.weight, previous.weight + added)
    assert torch.equal(fused.count, previous.count + pairs.match.sum(1))
    untouched = ~pairs.match.any(1)
    for name, value in fused.tensors().items():
        assert torch.equal(value[untouched], getattr(previous, name)[untouched])


def test_order_is_increasing_c():
    previous, current = mixture(1, 1, 3, empty=0), mixture(1, 2, 60, empty=0)
    both = Correspondence(torch.ones(1, 2, 1, dtype=torch.bool), torch.ones(1, 2, 1, dtype=torch.float64))
    config = UfMStarConfig()
    together = fuse(previous, current, both, config)
    step = previous
    for c in range(2):
        one = torch.zeros(1, 2, 1, dtype=torch.bool)
        one[:, c] = True
        step = fuse(step, current, Correspondence(one, both.overlap), config)
    torch.testing.assert_close(together.covariance, step.covariance, rtol=1e-14, atol=1e-15)
    swapped = fuse(previous, current.replace(**{n: v.flip(1) for n, v in current.tensors().items()}), both, config)
    assert (together.disagreement - swapped.disagreement).abs().max() > 1e-6


def test_a_static_number_of_rounds_changes_nothing():
    previous, current = mixture(2, 6, 5), mixture(2, 5, 6)
    pairs = random_pairs(2, previous, current, 8)
    config = UfMStarConfig()
    for name, value in fuse(previous, current, pairs, config, rounds=5).tensors().items():
        torch.testing.assert_close(value, getattr(fuse(previous, current, pairs, config), name), rtol=1e-14, atol=1e-15)


def test_equal_gaussians_disagree_by_nothing_in_float32():
    previous = mixture(1, 6, 5)
    previous = previous.replace(disagreement=torch.zeros_like(previous.disagreement)).to(torch.float32)
    eye = torch.eye(6, dtype=torch.bool)[None] & previous.valid[:, None]
    fused = fuse(previous, previous, Correspondence(eye, eye.double()), UfMStarConfig())
    assert fused.disagreement.max() < 1e-14
    torch.testing.assert_close(fused.covariance, previous.covariance, rtol=1e-6, atol=1e-9)


def test_append_counts_what_has_no_slot():
    previous, current = mixture(2, 6, 5, empty=2), mixture(2, 5, 6, empty=0)
    new = torch.tensor([[True, False, True, False, True], [False, True, False, False, False]])
    filled, dropped = append(previous, current, new)
    assert dropped.tolist() == [1, 0]
    assert torch.equal(filled.mean[0, 4], current.mean[0, 0])
    assert torch.equal(filled.mean[0, 5], current.mean[0, 2])
    assert torch.equal(filled.mean[1, 4], current.mean[1, 1])
    assert filled.disagreement[0, 4:].tolist() == [0, 0]
    assert filled.count[0, 4:].tolist() == [1, 1]
    for name, value in filled.tensors().items():
        assert torch.equal(value[:, :4], getattr(previous, name)[:, :4])
