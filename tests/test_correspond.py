"""Correspondence of every backend: against the oracle, and rule by rule."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from random_gaussians import as_lists, mixture

import oracle
import scenes
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.steps.correspond import correspond

pytestmark = pytest.mark.numerics

SIZE = (48, 64)
K = torch.tensor(scenes.intrinsics(*SIZE))


def blob(*components: tuple[float, float, float, float]) -> GaussianMixture:
    """Round Gaussians: x, y, z, sigma [m]."""
    n = len(components)
    values = torch.tensor(components, dtype=torch.float64)
    return GaussianMixture.empty(1, n, dtype=torch.float64, device="cpu").replace(
        mean=values[None, :, :3],
        covariance=(values[:, 3] ** 2)[None, :, None, None] * torch.eye(3, dtype=torch.float64),
        weight=torch.ones(1, n, dtype=torch.float64),
    )


@pytest.fixture
def pairs(backend):
    """Pairs of two mixtures of one stream; the settings as options."""

    def call(previous, current, **settings):
        return backend.kernels.correspond(previous, current, K[None], SIZE, UfMStarConfig(**settings))

    return call


@given(st.integers(0, 10**6), st.floats(0.05, 0.6), st.floats(0.05, 1.0))
def test_agrees_with_the_oracle(backend, seed, eta, eta_occl):
    previous, current = mixture(2, 14, seed), mixture(2, 7, seed + 50)
    config = UfMStarConfig(eta=eta, eta_occlusion=eta_occl)
    found = backend.kernels.correspond(previous, current, K.expand(2, 3, 3), SIZE, config)
    for b in range(2):
        matches, overlaps = oracle.correspond(
            as_lists(previous, b), as_lists(current, b), K.numpy(), SIZE, eta, eta_occl, config.near_plane
        )
        for c in range(7):
            expected = matches[c] if c < len(matches) else []
            assert found.match[b, c].nonzero().flatten().tolist() == expected
            for k in range(14) if backend.name != "numba" else expected:  # numba returns the pairs only
                assert found.overlap[b, c, k].item() == pytest.approx(overlaps.get((c, k), 0.0), rel=1e-9, abs=1e-300)


def test_any_number_of_pairs(backend):
    """More pairs than the kernels' initial lists and words hold, and many hidden components."""
    count = 34 if backend.slow else 120
    many = mixture(1, count, 3, empty=0)
    many = many.replace(
        mean=many.mean * 0.01 + torch.tensor([0.0, 0.0, 3.0]), covariance=many.covariance[:, :1] + 0 * many.covariance
    )
    for eta, eta_occl in ((0.01, 1.0), (0.3, 0.4)):
        config = UfMStarConfig(eta=eta, eta_occlusion=eta_occl)
        expected = correspond(many, many, K[None], SIZE, config).match
        assert expected.sum() >= count
        assert torch.equal(backend.kernels.correspond(many, many, K[None], SIZE, config).match, expected)


def test_a_nearer_member_hides_a_farther_one_in_any_order(pairs):
    near, far, aside = (0, 0, 2.0, 0.1), (0, 0, 3.0, 0.15), (0.12, 0, 2.5, 0.125)
    for order in ([near, far, aside], [far, aside, near], [aside, near, far]):
        found = pairs(blob(*order), blob((0, 0, 2.5, 0.125)), eta_occlusion=0.95)
        assert {order[k] for k in found.match[0, 0].nonzero().flatten().tolist()} == {near, aside}
    # Alone, the farther component corresponds: its wrong depth is the disagreement to measure.
    assert pairs(blob(far), blob((0, 0, 2.0, 0.1))).match.all()
    assert pairs(blob((0, 0, 2, 0.1), (0, 0, 2, 0.1)), blob((0, 0, 2, 0.1))).match.all(), "equal depths hide nothing"


def test_candidates_end_at_the_near_plane_and_the_image_s_border(pairs):
    for outside in [(0, 0, -2, 0.1), (0, 0, 0.04, 0.1), (3, 0, 2, 0.5), (0, -3, 2, 0.5)]:
        found = pairs(blob(outside), blob((0, 0, 2, 0.3)), eta=1e-9)
        assert not found.match.any()
        assert (found.overlap == 0).all()
    for u, v, inside in [(-0.49, 0, 1), (-0.51, 0, 0), (63.49, 47.49, 1), (63.51, 0, 0), (0, 47.51, 0)]:
        x, y = (u - K[0, 2].item()) / K[0, 0].item() * 2, (v - K[1, 2].item()) / K[1, 1].item() * 2
        assert pairs(blob((x, y, 2.0, 0.2)), blob((x, y, 2.0, 0.2)), eta=0.1).match.item() == inside


def test_edge_on_surface_has_a_finite_overlap(pairs):
    flat = torch.diag(torch.tensor([0.0, 0.01, 0.01], dtype=torch.float64))
    sliver = blob((0, 0, 2, 0.1)).replace(covariance=flat[None, None])
    assert pairs(sliver, sliver).overlap.item() == pytest.approx(1)
