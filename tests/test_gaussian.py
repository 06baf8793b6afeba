"""Closed forms for Gaussians against LAPACK, POT, the NumPy oracle and known identities."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from random_gaussians import covariances, means

import oracle
from ufmstar_torch.gaussians import gaussian
from ufmstar_torch.gaussians.gaussian import pointwise_disagreement

pytestmark = pytest.mark.numerics

seeds = st.integers(0, 2**20)


def test_singular_values_are_lapacks_on_hard_spectra():
    generator = torch.Generator().manual_seed(3)
    n = 20000
    Q = torch.linalg.qr(torch.randn(n, 3, 3, generator=generator, dtype=torch.float64))[0]
    values = 10 ** (-14 * torch.rand(n, 3, generator=generator, dtype=torch.float64))
    values[: n // 4, 1] = values[: n // 4, 0]  # repeated
    values[n // 4 : n // 2] = values[n // 4 : n // 2, :1]  # a multiple of the identity
    S, scale = gaussian.symmetrize((Q * values[:, None]) @ Q.mT), values.amax(1)
    for M in (S, S @ Q):
        singular, V = gaussian.right_singular(M)
        reference = torch.linalg.svdvals(M)
        assert ((singular.sort(-1, descending=True)[0] - reference).abs().amax(1) / scale).max() < 1e-14
        assert ((M @ V).mT @ (M @ V)).tril(-1).abs().amax() < 1e-14
        assert (V.mT @ V - torch.eye(3, dtype=torch.float64)).abs().max() < 1e-14
    singular, V = gaussian.right_singular(S)
    assert (((V * singular[:, None]) @ V.mT - S).abs().amax((1, 2)) / scale).max() < 1e-14
    for part, batch in ((S[0], ()), (S[:6].view(2, 3, 3, 3), (2, 3))):
        assert gaussian.right_singular(part)[1].shape == (*batch, 3, 3)


def test_degenerate_inputs_stay_finite():
    zero = torch.zeros(3, 3, dtype=torch.float64)
    flat = torch.diag(torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64))
    for S in (zero, flat, torch.eye(3, dtype=torch.float64)):
        L = gaussian.cholesky3(S)
        torch.testing.assert_close(L @ L.mT, S, rtol=0, atol=1e-14)
        assert gaussian.right_singular(S)[1].isfinite().all()
    origin = torch.zeros(3, dtype=torch.float64)
    # A flat disc against the same disc of twice the variance: (sqrt 2 - 1)^2 along two axes.
    expected = 2 * (2**0.5 - 1) ** 2
    assert gaussian.wasserstein_squared(origin, flat, origin, 2 * flat).item() == pytest.approx(expected, abs=1e-14)


@given(seeds)
def test_wasserstein_is_a_squared_metric_and_agrees_with_oracle_and_pot(seed):
    cov, mean = covariances(3, seed), means(3, seed)

    def distance(i, j):
        return gaussian.wasserstein_squared(mean[i], cov[i], mean[j], cov[j]).item()

    assert distance(0, 0) < 1e-13  # float64; a squared Q would leave 1e-9 here
    assert distance(0, 1) == pytest.approx(distance(1, 0), rel=1e-13, abs=1e-13)
    assert distance(0, 2) ** 0.5 <= distance(0, 1) ** 0.5 + distance(1, 2) ** 0.5 + 1e-12
    pair = mean[0].numpy(), cov[0].numpy(), mean[1].numpy(), cov[1].numpy()
    assert distance(0, 1) == pytest.approx(oracle.w2_squared(*pair), abs=1e-11)
    import ot  # takes a second

    root = ot.gaussian.bures_wasserstein_distance(pair[0], pair[2], pair[1], pair[3])
    assert distance(0, 1) == pytest.approx(float(root) ** 2, abs=1e-7)


def test_float32_callers_are_served_in_float64():
    cov, mean = covariances(500, 7, decades=5).float(), means(500, 7).float()
    distance = gaussian.wasserstein_squared(mean, cov, mean, cov)
    assert distance.dtype == torch.float32
    assert distance.max() < 1e-13  # in float32 arithmetic: 3e-6
    plate = torch.diag(torch.tensor([1.0, 1.0, 1e-8]))
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, 0, 1e-3], [0, 0, 0], [-1e-3, 0, 0]]))
    zero, half = torch.zeros(3), torch.tensor(0.5)
    moved = gaussian.geodesic(zero, plate, zero, turn @ plate @ turn.T, half)
    assert all(value.isfinite().all() and value.dtype == torch.float32 for value in moved)


@given(seeds, st.floats(0, 1))
def test_geodesic(seed, lam):
    (a, b), (mean_a, mean_b) = covariances(2, seed), means(2, seed)
    mean, cov, squared = gaussian.geodesic(mean_a, a, mean_b, b, torch.tensor(lam, dtype=torch.float64))
    mean_o, cov_o = oracle.geodesic(mean_a.numpy(), a.numpy(), mean_b.numpy(), b.numpy(), lam)
    np.testing.assert_allclose(mean.numpy(), mean_o, rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(cov.numpy(), cov_o, atol=1e-11)
    # Constant speed: W2 from a is lam W2(a, b), and from b the rest.
    from_a = gaussian.wasserstein_squared(mean_a, a, mean, cov).item()
    from_b = gaussian.wasserstein_squared(mean, cov, mean_b, b).item()
    assert from_a == pytest.approx(lam**2 * squared.item(), abs=1e-11)
    assert from_b == pytest.approx((1 - lam) ** 2 * squared.item(), abs=1e-11)
    # The smallest eigenvalue never falls below those of the ends.
    ends = torch.minimum(torch.linalg.eigvalsh(a)[0], torch.linalg.eigvalsh(b)[0])
    assert torch.linalg.eigvalsh(cov)[0] >= ends * (1 - 1e-7)


@given(seeds)
def test_bhattacharyya(seed):
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(2, 2, 2, generator=generator, dtype=torch.float64)
    cov = root @ root.mT + 0.1 * torch.eye(2, dtype=torch.float64)
    mean = torch.randn(2, 2, generator=generator, dtype=torch.float64)
    ours = gaussian.bhattacharyya(mean[0], cov[0], mean[1], cov[1]).item()
    expected = oracle.bhattacharyya(mean[0].numpy(), cov[0].numpy(), mean[1].numpy(), cov[1].numpy())
    assert ours == pytest.approx(expected, rel=1e-11, abs=1e-300)
    assert gaussian.bhattacharyya(mean[0], cov[0], mean[0], cov[0]).item() == pytest.approx(1, abs=1e-14)
    grid = np.stack(np.meshgrid(np.linspace(-15, 15, 301), np.linspace(-15, 15, 301)), -1)

    def pdf(m, S):
        d = grid - m.numpy()
        density = np.exp(-0.5 * np.einsum("...i,ij,...j", d, np.linalg.inv(S.numpy()), d))
        return density / (2 * np.pi * np.sqrt(np.linalg.det(S.numpy())))

    integral = np.sqrt(pdf(mean[0], cov[0]) * pdf(mean[1], cov[1])).sum() * 0.01
    assert ours == pytest.approx(integral, abs=2e-3)


def test_barycenter_agrees_with_oracle_and_pot_and_is_a_minimum():
    cov, mean = covariances(5, 21, decades=2), means(5, 21)
    weight = torch.tensor([1.0, 2.0, 0.5, 3.0, 1.5], dtype=torch.float64)
    centre, S = gaussian.barycenter(mean, cov, weight)
    centre_o, S_o = oracle.barycenter(mean.numpy(), cov.numpy(), weight.numpy())
    np.testing.assert_allclose(centre.numpy(), centre_o, atol=1e-13)
    np.testing.assert_allclose(S.numpy(), S_o, atol=1e-11)
    import ot

    share = (weight / weight.sum()).numpy()
    _, S_pot = ot.gaussian.bures_wasserstein_barycenter(mean.numpy(), cov.numpy(), share, num_iter=1000, eps=1e-12)
    np.testing.assert_allclose(S.numpy(), S_pot, atol=1e-9)
    best = gaussian.wasserstein_variance(mean, cov, weight).item()
    for seed in range(5):
        other = S + 1e-3 * (covariances(1, seed)[0] - covariances(1, seed + 9)[0])
        away = gaussian.wasserstein_squared(centre.expand(5, 3), other.expand(5, 3, 3), mean, cov)
        assert (weight * away).sum().item() / weight.sum().item() > best
    with pytest.raises(RuntimeError, match="after 1 iterations"):
        gaussian.barycenter(mean, cov, weight, iterations=1)


def test_barycenter_of_two_is_the_geodesic_and_batches():
    cov, mean = covariances(6, 2).view(3, 2, 3, 3), means(6, 2).view(3, 2, 3)
    weight = torch.tensor([[1.0, 3.0]] * 3, dtype=torch.float64)
    centre, S = gaussian.barycenter(mean, cov, weight)
    lam = torch.full((3,), 0.75, dtype=torch.float64)
    mean_g, cov_g, squared = gaussian.geodesic(mean[:, 0], cov[:, 0], mean[:, 1], cov[:, 1], lam)
    torch.testing.assert_close(centre, mean_g, rtol=0, atol=1e-13)
    torch.testing.assert_close(S, cov_g, rtol=0, atol=1e-10)
    # Wasserstein variance of two: w (1-w) W2^2, as for points.
    variance = gaussian.wasserstein_variance(mean, cov, weight)
    torch.testing.assert_close(variance, 0.75 * 0.25 * squared, rtol=0, atol=1e-9)


def test_pixel_footprint_is_the_variance_across_one_pixel():
    edge = np.linspace(-0.5, 0.5, 20001) * 2.0 / 200.0
    assert gaussian.pixel_footprint(torch.tensor(2.0), torch.tensor(200.0)).item() == pytest.approx(
        edge.var(), rel=1e-3
    )


def test_pointwise_disagreement_is_the_trace_of_the_sample_covariance():
    points = torch.randn(4, 5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = [np.trace(np.cov(views.numpy().T)) for views in points]
    torch.testing.assert_close(pointwise_disagreement(points), torch.tensor(expected, dtype=torch.float64))
    assert pointwise_disagreement(points.float()).dtype == torch.float32
    assert torch.equal(pointwise_disagreement(points[:, :1].expand(4, 3, 3)), torch.zeros(4, dtype=torch.float64))
    with pytest.raises(ValueError, match="at least two views"):
        pointwise_disagreement(points[:, :1])
