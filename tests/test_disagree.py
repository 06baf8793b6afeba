"""The overlap disagreement: against the oracle, on planes cut in different ways, and over sequences in all tiers."""

from __future__ import annotations

import numpy as np
import pytest
import random_gaussians
import torch
from hypothesis import given
from hypothesis import strategies as st

import oracle
from ufmstar_torch.gaussians.gaussian import wasserstein_squared
from ufmstar_torch.steps.disagree import overlap_disagreement

pytestmark = pytest.mark.numerics


def piece(centre, spans, thickness=0.0):
    """A flat Gaussian: mean, and the covariance of the two spanning vectors and an isotropic thickness [m]."""
    spans = torch.tensor(spans, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)
    return torch.tensor(centre, dtype=torch.float64), spans.mT @ spans + thickness**2 * eye


def on_plane(normal, offset, position, spans):
    """A piece of the plane normal.x = offset, with its centre at ``position`` (x/z, y/z) and the extent ``spans``."""
    ray = np.array([*position, 1.0])
    centre = ray * offset / (normal @ ray)
    flat = [np.array(s) - normal * (normal @ np.array(s)) / (normal @ normal) for s in spans]
    return piece(centre, np.stack(flat))


@given(st.integers(0, 10**6))
def test_agrees_with_the_oracle(seed):
    mean_a, mean_b = (random_gaussians.means(1, seed + n)[0] + torch.tensor([0, 0, 2.0]) for n in (0, 1000))
    mean_a[2], mean_b[2] = mean_a[2].abs() + 0.3, mean_b[2].abs() + 0.3
    cov_a, cov_b = (random_gaussians.covariances(1, seed + n)[0] for n in (0, 1000))
    ours = overlap_disagreement(mean_a, cov_a, mean_b, cov_b)
    expected = oracle.overlap_squared(*(x.numpy() for x in (mean_a, cov_a, mean_b, cov_b)))
    np.testing.assert_allclose(ours.numpy(), expected, rtol=1e-9, atol=1e-12)
    back = overlap_disagreement(mean_b, cov_b, mean_a, cov_a)
    torch.testing.assert_close(ours, back, rtol=1e-12, atol=1e-15)


coordinate = st.floats(-0.25, 0.25)
extent = st.tuples(*[st.floats(-0.4, 0.4)] * 3)


@given(
    normal=st.tuples(st.floats(-0.8, 0.8), st.floats(-0.8, 0.8)),
    first=st.tuples(coordinate, coordinate),
    second=st.tuples(coordinate, coordinate),
    spans=st.tuples(extent, extent, extent, extent),
)
def test_two_cuts_of_one_tilted_plane_agree(normal, first, second, spans):
    n = np.array([*normal, 1.0])
    a = on_plane(n, 2.0, first, spans[:2])
    b = on_plane(n, 2.0, second, spans[2:])
    areas = [float(torch.linalg.svdvals(cov)[1]) for _, cov in (a, b)]
    if min(areas) < 1e-3:  # a line is no plane
        return
    assert float(overlap_disagreement(*a, *b)) < 1e-12
    # W2^2 is not 0 for two different cuts of a plane; it is 0 for the same cut.
    shift = float(((a[0] - b[0]) ** 2).sum())
    assert float(wasserstein_squared(*a, *b)) >= shift - 1e-9


@given(offset=st.floats(-0.5, 0.5), first=st.tuples(coordinate, coordinate), second=st.tuples(coordinate, coordinate))
def test_frontal_planes_disagree_by_their_squared_distance(offset, first, second):
    n = np.array([0.0, 0.0, 1.0])
    a = on_plane(n, 2.0, first, ((0.3, 0, 0), (0, 0.2, 0)))
    b = on_plane(n, 2.0 + offset, second, ((0.1, 0.1, 0), (0, 0.4, 0)))
    np.testing.assert_allclose(float(overlap_disagreement(*a, *b)), offset**2, rtol=1e-9, atol=1e-13)


def test_slope_and_thickness_count_where_both_are_seen():
    flat = piece((0.0, 0.0, 2.0), ((0.4, 0, 0), (0, 0.4, 0)))
    tilted = piece((0.0, 0.0, 2.0), ((0.4, 0, 0.2), (0, 0.4, 0)))
    # S_uu = .04 both; shared .02; the slope dz/du is .2/.4 * 2 = 1: .02 [m^2].
    np.testing.assert_allclose(float(overlap_disagreement(*flat, *tilted)), 0.02, rtol=1e-9)
    thick = piece((0.0, 0.0, 2.0), ((0.4, 0, 0), (0, 0.4, 0), (0, 0, 0.1)))
    np.testing.assert_allclose(float(overlap_disagreement(*flat, *thick)), 0.01, rtol=1e-9)


def test_a_surface_seen_edge_on_stays_finite():
    edge = piece((0.1, 0.0, 2.0), ((0.001, 0, 1.0), (0, 0.4, 0)))
    flat = piece((0.3, 0.0, 2.0), ((0.4, 0, 0), (0, 0.4, 0)))
    squared = float(overlap_disagreement(*edge, *flat))
    assert 0 <= squared < 20**2
    np.testing.assert_allclose(squared, oracle.overlap_squared(*(x.numpy() for x in (*edge, *flat))), rtol=1e-9)
