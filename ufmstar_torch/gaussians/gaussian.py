"""Closed forms for Gaussians: singular values, Wasserstein distance and geodesic, overlap.

All functions are batched over leading dimensions, differentiable almost everywhere and free of host synchronisation
(except :func:`barycenter`). Distances, geodesics and barycenters are computed in float64 and returned in the caller's
dtype; the decompositions use the dtype of their input.

Why Jacobi rotations: the trigonometric eigenvalues of a symmetric 3x3 lose half the digits where two of them coincide,
and the batched ``eigh`` is slow on GPUs. A few sweeps of Jacobi rotations are a fixed number of elementwise operations
and reach rounding. The Wasserstein distance uses only the singular values of L_b^T L_a (L the Cholesky factors), never
the square Q, so that thin Gaussians keep their digits: W2^2(A, A) is 0 up to the rounding of tr A.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ufmstar_torch.gaussians.fixed_order import congruence, product

# Cyclic Jacobi on 3x3 converges quadratically: after 4 sweeps float64 rounding is reached on random
# spectra from 1 to 1e-14, repeated ones included (tests/test_gaussian.py); one more for safety.
_SWEEPS = 5
_MOVED = 1e-13  # share of the trace by which a barycenter moves in its last step
_PAIRS = ((0, 1), (0, 2), (1, 2))

# Variance of a point within one pixel [px^2], a uniform density over a width of 1. It is added to every projected
# covariance, because the image resolves nothing finer; this keeps edge-on surfaces regular.
PIXEL_VARIANCE = 1.0 / 12.0


def symmetrize(S: Tensor) -> Tensor:
    """(S + S^T)/2 of [..., n, n]."""
    return 0.5 * (S + S.mT)


def _rotation(alpha: Tensor, beta: Tensor, gamma: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine and sine that annihilate gamma in [[alpha, gamma], [gamma, beta]] (the smaller angle)."""
    zeros = gamma == 0
    zeta = (beta - alpha) / (2 * torch.where(zeros, torch.ones_like(gamma), gamma))
    t = torch.where(zeta < 0, -1.0, 1.0) / (zeta.abs() + torch.sqrt(1 + zeta * zeta))
    t = torch.where(zeros, torch.zeros_like(t), t)
    c = torch.rsqrt(1 + t * t)
    return c, c * t


def right_singular(M: Tensor) -> tuple[Tensor, Tensor]:
    """Singular values and right singular vectors of M = U diag(s) V^T by one-sided Jacobi.

    Args:
        M: [..., 3, 3].

    Returns:
        s [..., 3], not sorted, and V [..., 3, 3]. Small singular values are accurate relative to their columns, which
        M^T M would lose.
    """
    eye = torch.eye(3, dtype=M.dtype, device=M.device).expand_as(M)
    columns = list(torch.cat([M, eye], dim=-2).unbind(-1))
    for _ in range(_SWEEPS):
        for p, q in _PAIRS:
            a, b = columns[p], columns[q]
            top_a, top_b = a[..., :3], b[..., :3]
            c, s = _rotation((top_a * top_a).sum(-1), (top_b * top_b).sum(-1), (top_a * top_b).sum(-1))
            c, s = c[..., None], s[..., None]
            columns[p], columns[q] = c * a - s * b, s * a + c * b
    rotated = torch.stack(columns, dim=-1)
    return torch.linalg.vector_norm(rotated[..., :3, :], dim=-2), rotated[..., 3:, :]


def cholesky3(S: Tensor) -> Tensor:
    """Lower Cholesky factor of positive semidefinite S [..., 3, 3], without a check that synchronises with the device.

    A pivot at or below rounding (16 eps of the largest diagonal entry) ends its column with zeros: the
    factor of a singular S then still satisfies L L^T = S up to 4 sqrt(eps) of that entry.
    """
    scale = torch.diagonal(S, dim1=-2, dim2=-1).amax(-1)
    negligible = 16 * torch.finfo(S.dtype).eps * scale

    def column(pivot: Tensor, *below: Tensor) -> list[Tensor]:
        used = pivot > negligible
        root = torch.where(used, pivot, torch.ones_like(pivot)).sqrt()
        return [torch.where(used, v / root, torch.zeros_like(v)) for v in (pivot, *below)]

    l00, l10, l20 = column(S[..., 0, 0], S[..., 1, 0], S[..., 2, 0])
    l11, l21 = column(S[..., 1, 1] - l10 * l10, S[..., 2, 1] - l20 * l10)
    (l22,) = column(S[..., 2, 2] - l20 * l20 - l21 * l21)
    zero = torch.zeros_like(l00)
    return torch.stack([l00, zero, zero, l10, l11, zero, l20, l21, l22], dim=-1).unflatten(-1, (3, 3))


def inverse_lower3(L: Tensor) -> Tensor:
    """Inverse of lower triangular L [..., 3, 3] with a nonzero diagonal, by back substitution."""
    i00, i11, i22 = (1 / L[..., i, i] for i in range(3))
    i10 = -L[..., 1, 0] * i00 * i11
    i21 = -L[..., 2, 1] * i11 * i22
    i20 = -(L[..., 2, 0] * i00 + L[..., 2, 1] * i10) * i22
    zero = torch.zeros_like(i00)
    return torch.stack([i00, zero, zero, i10, i11, zero, i20, i21, i22], dim=-1).unflatten(-1, (3, 3))


def _trace(S: Tensor) -> Tensor:
    return torch.diagonal(S, dim1=-2, dim2=-1).sum(-1)


def wasserstein_squared(mean_a: Tensor, cov_a: Tensor, mean_b: Tensor, cov_b: Tensor) -> Tensor:
    """Squared 2-Wasserstein distance of Gaussians (section "Multiview Fusion").

    W2^2 = |mu_a - mu_b|^2 + tr(Sigma_a + Sigma_b - 2 Q^(1/2)), Q = Sigma_a^(1/2) Sigma_b Sigma_a^(1/2).
    tr Q^(1/2) is the sum of the singular values of L_b^T L_a. Never negative; [...] in m^2 for inputs
    mean [..., 3] in m and covariance [..., 3, 3] in m^2. Semidefinite covariances are allowed.
    """
    dtype = mean_a.dtype
    mean_a, cov_a, mean_b, cov_b = _double(mean_a, cov_a, mean_b, cov_b)
    singular, _ = right_singular(product(cholesky3(cov_b).mT, cholesky3(cov_a)))
    shape = _trace(cov_a) + _trace(cov_b) - 2 * singular.sum(-1)
    return (((mean_a - mean_b) ** 2).sum(-1) + shape.clamp_min(0)).to(dtype)


def _double(*values: Tensor) -> tuple[Tensor, ...]:
    return tuple(value.to(torch.float64) for value in values)


def transport_map(cov_a: Tensor, cov_b: Tensor) -> Tensor:
    """Z [..., 3, 3], the symmetric positive definite map with Z Sigma_a Z = Sigma_b.

    Equals the paper's Sigma_a^(-1/2) Q^(1/2) Sigma_a^(-1/2), since Z is unique. Computed as
    L^-T (L^T Sigma_b L)^(1/2) L^-1 with Sigma_a = L L^T. Sigma_a must be positive definite.
    """
    return _transport(*_double(cov_a, cov_b))[0].to(cov_a.dtype)


def _transport(cov_a: Tensor, cov_b: Tensor) -> tuple[Tensor, Tensor]:
    """Z and tr Q^(1/2)."""
    L = cholesky3(cov_a)
    singular, V = right_singular(product(cholesky3(cov_b).mT, L))
    L_inv = inverse_lower3(L)
    half = product(L_inv.mT, V)
    return symmetrize(product(half * singular[..., None, :], half.mT)), singular.sum(-1)


def geodesic(
    mean_a: Tensor, cov_a: Tensor, mean_b: Tensor, cov_b: Tensor, lam: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The point at ``lam`` on the optimal-transport geodesic from a to b, and W2^2(a, b).

    mu = (1-l) mu_a + l mu_b, Sigma = ((1-l) I + l Z) Sigma_a ((1-l) I + l Z)^T (section "Multiview Fusion").

    Args:
        mean_a, mean_b: [..., 3] [m].
        cov_a, cov_b: [..., 3, 3] [m^2], cov_a positive definite.
        lam: [...] in [0, 1].

    Returns:
        mean [..., 3], covariance [..., 3, 3], W2^2 [...] [m^2].
    """
    dtype = mean_a.dtype
    mean_a, cov_a, mean_b, cov_b, lam = _double(mean_a, cov_a, mean_b, cov_b, lam)
    Z, trace_root = _transport(cov_a, cov_b)
    shape = _trace(cov_a) + _trace(cov_b) - 2 * trace_root
    distance = ((mean_a - mean_b) ** 2).sum(-1) + shape.clamp_min(0)
    eye = torch.eye(3, dtype=Z.dtype, device=Z.device)
    l = lam[..., None]
    T = (1 - l[..., None]) * eye + l[..., None] * Z
    moved = (1 - l) * mean_a + l * mean_b, symmetrize(congruence(T, cov_a)), distance
    return moved[0].to(dtype), moved[1].to(dtype), moved[2].to(dtype)


def bhattacharyya(mean_a: Tensor, cov_a: Tensor, mean_b: Tensor, cov_b: Tensor) -> Tensor:
    """Bhattacharyya coefficient beta in [0, 1] of image-plane Gaussians (section "Gaussian matching").

    Args:
        mean_a, mean_b: [..., 2] [px], broadcast against each other.
        cov_a, cov_b: [..., 2, 2] [px^2], positive definite.
    """
    det_a, det_b = _det2(cov_a), _det2(cov_b)
    S = 0.5 * (cov_a + cov_b)
    det = _det2(S)
    dx, dy = (mean_a - mean_b).unbind(-1)
    squared = (S[..., 1, 1] * dx * dx - 2 * S[..., 0, 1] * dx * dy + S[..., 0, 0] * dy * dy) / det
    return torch.exp(-squared / 8) * torch.sqrt(torch.sqrt(det_a * det_b) / det).clamp_max(1)


def _det2(S: Tensor) -> Tensor:
    return S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] * S[..., 1, 0]


def barycenter(mean: Tensor, covariance: Tensor, weight: Tensor, *, iterations: int = 200) -> tuple[Tensor, Tensor]:
    """Wasserstein-Bures barycenter of J Gaussians (Eq. barycenter; Agueh and Carlier 2011).

    Fixed point (Alvarez-Esteban et al. 2016): S <- S^(-1/2) (sum_j w_j (S^(1/2) Sigma_j S^(1/2))^(1/2))^2 S^(-1/2),
    which equals S <- T S T with T = sum_j w_j Z_j, Z_j the transport map from S to Sigma_j.

    Args:
        mean: [..., J, 3] [m].
        covariance: [..., J, 3, 3] [m^2], positive definite.
        weight: [..., J], not negative, not all zero; normalised here.
        iterations: upper bound on the fixed-point steps; they stop when no entry of S moves by more than 1e-13 tr S
            (checked on the host).

    Returns:
        mean [..., 3] and covariance [..., 3, 3].

    Raises:
        ValueError: a weight is negative or all are zero.
        RuntimeError: no convergence within ``iterations``.
    """
    if bool((weight < 0).any()) or bool((weight.sum(-1) <= 0).any()):
        raise ValueError("weight must be non-negative with a positive sum for every barycenter")
    dtype = mean.dtype
    mean, covariance, weight = _double(mean, covariance, weight)
    w = (weight / weight.sum(-1, keepdim=True))[..., None]
    centre = (w * mean).sum(-2)
    S = (w[..., None] * covariance).sum(-3)
    for _ in range(iterations):
        T = (w[..., None] * transport_map(S[..., None, :, :].expand_as(covariance), covariance)).sum(-3)
        updated = symmetrize(congruence(T, S))
        moved = ((updated - S).abs().amax((-2, -1)) / _trace(updated)).max()
        S = updated
        if float(moved) <= _MOVED:
            return centre.to(dtype), S.to(dtype)
    raise RuntimeError(f"the barycenter moved by {float(moved):.1e} of its trace after {iterations} iterations")


def wasserstein_variance(mean: Tensor, covariance: Tensor, weight: Tensor) -> Tensor:
    """m_g [...] [m^2], the weighted mean of W2^2 from each of J Gaussians to their barycenter (Eq. gmv_exact).

    The definition that the running update of the fusion step approximates; shapes as :func:`barycenter`.
    """
    dtype = mean.dtype
    mean, covariance, weight = _double(mean, covariance, weight)
    centre, S = barycenter(mean, covariance, weight)
    distances = wasserstein_squared(
        centre[..., None, :].expand_as(mean), S[..., None, :, :].expand_as(covariance), mean, covariance
    )
    return ((weight * distances).sum(-1) / weight.sum(-1)).to(dtype)


def pointwise_disagreement(points: Tensor) -> Tensor:
    """m_p = tr Sigma, the spread of the views' estimates of one 3D point (section "Pointwise multiview disagreement").

    Sigma is the sample covariance, 1/(J - 1) sum_j (X_j - mu) (X_j - mu)^T. UfM measures this; UfM* measures
    :func:`wasserstein_variance` of regions.

    Args:
        points: [..., J, 3] estimates of the point from J views, in one frame [m].

    Returns:
        [...] in m^2.

    Raises:
        ValueError: fewer than two views.
    """
    if points.shape[-2] < 2:
        raise ValueError(f"points must hold at least two views, [..., J, 3], got {tuple(points.shape)}")
    return points.to(torch.float64).var(-2).sum(-1).to(points.dtype)


def floor_covariance(covariance: Tensor, floor: Tensor) -> Tensor:
    """Covariances whose eigenvalues are at least ``floor``.

    Args:
        covariance: [..., 3, 3] [m^2], positive semidefinite.
        floor: [...] [m^2].

    Returns:
        [..., 3, 3]; covariances that already satisfy the floor are unchanged to the last bit.
    """
    values, V = right_singular(covariance)  # for a positive semidefinite matrix, its eigenvalues and eigenvectors
    low = values.amin(-1) < floor
    lifted = symmetrize(product(V * torch.maximum(values, floor[..., None])[..., None, :], V.mT))
    return torch.where(low[..., None, None], lifted, covariance)


def storage_floor(covariance: Tensor, dtype: torch.dtype) -> Tensor:
    """[...] the least eigenvalue [m^2] that survives rounding covariances [..., 3, 3] to ``dtype``.

    Rounding moves an eigenvalue by at most 3 eps/2 of the greatest entry, which tr Sigma bounds; 8 eps tr Sigma
    keeps a plate hundreds of times wider than thick positive definite through any number of fusions.
    """
    return 8 * torch.finfo(dtype).eps * _trace(covariance)


def pixel_footprint(z: Tensor, focal: Tensor) -> Tensor:
    """(z/f)^2/12 [m^2]: the variance across one pixel at depth z, the floor of a segment's covariance.

    Without it, a segment thinner than the image resolves (a rendered wall is exactly flat) would have an infinite
    density. Raw SPGF moments have no floor.
    """
    return (z / focal) ** 2 * PIXEL_VARIANCE
