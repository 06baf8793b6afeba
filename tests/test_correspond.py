"""Correspondence against the oracle, and its rules one by one."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from random_gaussians import as_lists, mixture

import oracle
import scenes
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.correspond import correspond
from ufmstar_torch.mixture import GaussianMixture

pytestmark = pytest.mark.numerics

SIZE = (48, 64)
K = torch.tensor(scenes.intrinsics(*SIZE))


def blob(*components: tuple[float, float, float, float]) -> GaussianMixture:
    """Round Gaussians: x, y, z, sigma [m]."""
    n = len(components)
    values = torch.tensor(components, dtype=torch.float64)
    return GaussianMixture(
        values[None, :, :3],
        (values[:, 3] ** 2)[None, :, None, None] * torch.eye(3, dtype=torch.float64),
        torch.ones(1, n, dtype=torch.float64),
        torch.zeros(1, n, dtype=torch.float64),
        torch.ones(1, n, dtype=torch.int64),
        torch.zeros(1, n, 0, dtype=torch.float64),
    )


@given(st.integers(0, 10**6), st.floats(0.05, 0.6), st.floats(0.05, 0.9))
@settings(max_examples=25)
def test_agrees_with_the_oracle(seed, eta, eta_occl):
    previous, current = mixture(2, 12, seed), mixture(2, 7, seed + 50)
    config = UfMStarConfig(eta=eta, eta_occlusion=eta_occl)
    pairs = correspond(previous, current, K.expand(2, 3, 3), SIZE, config)
    for b in range(2):
        matches, overlaps = oracle.correspond(
            as_lists(previous, b), as_lists(current, b), K.numpy(), SIZE, eta, eta_occl, config.near_plane
        )
        for c in range(7):
            expected = matches[c] if c < len(matches) else []
            assert pairs.match[b, c].nonzero().flatten().tolist() == expected
            for k in range(12):
                assert pairs.overlap[b, c, k].item() == pytest.approx(overlaps.get((c, k), 0.0), rel=1e-9, abs=1e-300)


def test_a_nearer_member_hides_a_farther_one_in_any_order():
    near, far, aside = (0, 0, 2.0, 0.1), (0, 0, 3.0, 0.15), (0.12, 0, 2.5, 0.125)
    for order in ([near, far, aside], [far, aside, near], [aside, near, far]):
        previous = blob(*order)
        pairs = correspond(previous, blob((0, 0, 2.5, 0.125)), K[None], SIZE, UfMStarConfig(eta_occlusion=0.95))
        kept = {order[k] for k in pairs.match[0, 0].nonzero().flatten().tolist()}
        assert kept == {near, aside}
    # Alone, the farther one corresponds: its depth is wrong, which is what is to be measured.
    assert correspond(blob(far), blob((0, 0, 2.0, 0.1)), K[None], SIZE, UfMStarConfig()).match.all()


def test_equal_depths_hide_nothing():
    previous = blob((0, 0, 2, 0.1), (0, 0, 2, 0.1))
    assert correspond(previous, blob((0, 0, 2, 0.1)), K[None], SIZE, UfMStarConfig()).match.all()


def test_one_current_component_may_match_many_and_the_reverse():
    pieces = blob((-0.05, 0, 2, 0.1), (0.05, 0, 2, 0.1))
    whole = blob((0, 0, 2, 0.12))
    assert correspond(pieces, whole, K[None], SIZE, UfMStarConfig()).match.sum() == 2
    assert correspond(whole, pieces, K[None], SIZE, UfMStarConfig()).match.sum() == 2


@pytest.mark.parametrize("outside", [(0, 0, -2, 0.1), (0, 0, 0.04, 0.1), (3, 0, 2, 0.5), (0, -3, 2, 0.5)])
def test_no_candidates_behind_or_outside(outside):
    pairs = correspond(blob(outside), blob((0, 0, 2, 0.3)), K[None], SIZE, UfMStarConfig(eta=1e-9))
    assert not pairs.match.any()
    assert (pairs.overlap == 0).all()


def test_the_border_pixel_still_counts():
    def at(u, v):
        return ((u - K[0, 2].item()) / K[0, 0].item() * 2, (v - K[1, 2].item()) / K[1, 1].item() * 2, 2.0, 0.2)

    config = UfMStarConfig(eta=0.1)
    for u, v, inside in [
        (-0.49, 0, True),
        (-0.51, 0, False),
        (63.49, 47.49, True),
        (63.51, 0, False),
        (0, 47.51, False),
    ]:
        pairs = correspond(blob(at(u, v)), blob(at(u, v)), K[None], SIZE, config)
        assert pairs.match.item() == inside


def test_edge_on_surface_has_a_finite_overlap():
    sliver = blob((0, 0, 2, 0.1))
    flat = torch.diag(torch.tensor([0.0, 0.01, 0.01], dtype=torch.float64))
    sliver = sliver.replace(covariance=flat[None, None])
    pairs = correspond(sliver, sliver, K[None], SIZE, UfMStarConfig())
    assert pairs.overlap.item() == pytest.approx(1)
