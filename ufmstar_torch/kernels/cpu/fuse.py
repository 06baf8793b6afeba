"""Fusion on the CPU (numba): the floor of covariances, one pass over the matched pairs, and new components."""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import leaf
from ufmstar_torch.steps.fuse import COMPLETE, LEAST

_SWEEPS = 12  # an upper bound: the loops end when a sweep no longer rotates
_NEGLIGIBLE = 16 * np.finfo(np.float64).eps
WORK = (8, 3, 3)  # shape of the scratch array (float64) of the functions below


@leaf
def cholesky3(S, L):
    """Lower Cholesky factor of positive semidefinite S, written to L (upper part zero)."""
    negligible = _NEGLIGIBLE * max(S[0, 0], S[1, 1], S[2, 2])
    for j in range(3):
        for r in range(3):
            L[r, j] = 0.0
    for j in range(3):
        pivot = S[j, j]
        for i in range(j):
            pivot -= L[j, i] * L[j, i]
        if pivot <= negligible:
            continue
        root = math.sqrt(pivot)
        L[j, j] = root
        for r in range(j + 1, 3):
            value = S[r, j]
            for i in range(j):
                value -= L[r, i] * L[j, i]
            L[r, j] = value / root


@leaf
def _angle(alpha, beta, gamma):
    """Cosine and sine of the smaller rotation that annihilates gamma in [[alpha, gamma], [gamma, beta]]."""
    zeta = (beta - alpha) / (2 * gamma)
    t = (-1.0 if zeta < 0 else 1.0) / (abs(zeta) + math.sqrt(1 + zeta * zeta))
    c = 1 / math.sqrt(1 + t * t)
    return c, c * t


@leaf
def right_singular(M, V, s):
    """Singular values s and right singular vectors V of M by one-sided Jacobi; M is overwritten with U diag(s)."""
    for i in range(3):
        for j in range(3):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(_SWEEPS):
        rotated = False
        for p in range(2):
            for q in range(p + 1, 3):
                alpha = M[0, p] ** 2 + M[1, p] ** 2 + M[2, p] ** 2
                beta = M[0, q] ** 2 + M[1, q] ** 2 + M[2, q] ** 2
                gamma = M[0, p] * M[0, q] + M[1, p] * M[1, q] + M[2, p] * M[2, q]
                if gamma * gamma <= 1e-34 * alpha * beta:
                    continue
                rotated = True
                c, sn = _angle(alpha, beta, gamma)
                for i in range(3):
                    M[i, p], M[i, q] = c * M[i, p] - sn * M[i, q], sn * M[i, p] + c * M[i, q]
                    V[i, p], V[i, q] = c * V[i, p] - sn * V[i, q], sn * V[i, p] + c * V[i, q]
        if not rotated:
            break
    for j in range(3):
        s[j] = math.sqrt(M[0, j] ** 2 + M[1, j] ** 2 + M[2, j] ** 2)


@leaf
def geodesic(mean_a, cov_a, mean_b, cov_b, lam, work):
    """Move (mean_a, cov_a) by ``lam`` towards b in place; return W2^2 between the two as they were.

    ``work`` is scratch.
    """
    L_a, L_b, M, V, half, T, s = work[0], work[1], work[2], work[3], work[4], work[5], work[6, 0]
    cholesky3(cov_a, L_a)
    cholesky3(cov_b, L_b)
    for i in range(3):
        for j in range(3):
            M[i, j] = L_b[0, i] * L_a[0, j] + L_b[1, i] * L_a[1, j] + L_b[2, i] * L_a[2, j]
    right_singular(M, V, s)
    distance, shift = -2 * (s[0] + s[1] + s[2]), 0.0
    for i in range(3):
        distance += cov_a[i, i] + cov_b[i, i]
        shift += (mean_a[i] - mean_b[i]) ** 2
    distance = shift + max(distance, 0.0)
    for j in range(3):  # half = L_a^-T V by back substitution
        for i in range(2, -1, -1):
            value = V[i, j]
            for r in range(i + 1, 3):
                value -= L_a[r, i] * half[r, j]
            half[i, j] = value / L_a[i, i]
    for i in range(3):
        for j in range(3):
            Z = half[i, 0] * s[0] * half[j, 0] + half[i, 1] * s[1] * half[j, 1] + half[i, 2] * s[2] * half[j, 2]
            T[i, j] = lam * Z + ((1 - lam) if i == j else 0.0)
    for i in range(3):  # M = T L_a, so that T Sigma T^T = M M^T is symmetric by construction
        for j in range(3):
            M[i, j] = T[i, 0] * L_a[0, j] + T[i, 1] * L_a[1, j] + T[i, 2] * L_a[2, j]
    for i in range(3):
        mean_a[i] = (1 - lam) * mean_a[i] + lam * mean_b[i]
        for j in range(i + 1):
            value = M[i, 0] * M[j, 0] + M[i, 1] * M[j, 1] + M[i, 2] * M[j, 2]
            cov_a[i, j] = value
            cov_a[j, i] = value
    return distance


@leaf
def _exceeds(S, floor):
    """True if every eigenvalue of S is certainly above ``floor``: S - floor I has a Cholesky factor.

    The rounding of its pivots, and of the eigenvalues that it saves, is far below 1e-13 tr S.
    """
    least = 1e-13 * (S[0, 0] + S[1, 1] + S[2, 2])
    a = S[0, 0] - floor - least
    if not a > least:
        return False
    l10, l20 = S[1, 0] / a, S[2, 0] / a
    b = S[1, 1] - floor - least - l10 * S[1, 0]
    if not b > least:
        return False
    c = S[2, 1] - l20 * S[1, 0]
    return S[2, 2] - floor - least - l20 * S[2, 0] - c * c / b > least


@leaf
def floor_covariance(S, floor, work):
    """Lift the eigenvalues of a positive semidefinite covariance [3, 3] to ``floor``, in place."""
    if _exceeds(S, floor):
        return
    M, V, s = work[0], work[1], work[2, 0]
    for i in range(3):  # a slice assignment takes seconds to compile, for its error message
        for j in range(3):
            M[i, j] = S[i, j]
    right_singular(M, V, s)  # of a positive semidefinite matrix: its eigenvalues and eigenvectors
    if s[0] >= floor and s[1] >= floor and s[2] >= floor:
        return
    for i in range(3):
        for j in range(i + 1):
            value = 0.0
            for k in range(3):
                value += V[i, k] * max(s[k], floor) * V[j, k]
            S[i, j] = value
            S[j, i] = value


@leaf
def view_weight(mean, reference, view, baseline, near):
    """w of a comparison of a component with a new view (``steps.fuse``); ``baseline`` 0 = the paper's 1."""
    if baseline == 0 or reference[3] != view[3]:
        return 1.0
    moved = reach = 0.0
    for i in range(3):
        moved += (view[i] - reference[i]) ** 2
        reach += (mean[i] - view[i]) ** 2
    change = -math.expm1(-moved / (max(reach, near * near) * (baseline * baseline)))
    increase = change - reference[4]
    return increase if increase >= LEAST else 0.0


@leaf
def fuse_pairs(
    mean, covariance, weight, disagreement, compared, views, references, features,
    mean_c, cov_c, weight_c, features_c, pair_c, pair_k, overlap, view, settings, w, work,
):  # fmt: skip
    """Fuse the pairs [P] of one stream in their order, in place.

    After each pair the values are rounded to the dtype of the state. With ``weighted``, pi_c is multiplied by the
    overlap [P]. ``view`` [4]: see ``ufmstar_torch.steps.fuse.fuse``; ``w`` [K] is written.
    """
    weighted, epsilon, baseline, near = settings
    mean_k, cov_k = work[6, 1], work[7]
    for p in range(pair_k.size):
        w[pair_k[p]] = -1.0
    for p in range(pair_k.size):
        k = pair_k[p]
        if w[k] < 0:
            w[k] = view_weight(mean[k], references[k], view, baseline, near)
            if w[k] > 0:
                views[k] = np.float64(views[k]) + w[k]
                change = np.float64(references[k, 4]) + w[k]
                if change >= COMPLETE:
                    for i in range(4):
                        references[k, i] = view[i]
                    change = 0.0
                references[k, 4] = change
    for p in range(pair_c.size):
        c, k = pair_c[p], pair_k[p]
        if w[k] == 0:
            continue
        pi_k = np.float64(weight[k])
        pi_c = weight_c[c] * (overlap[p] if weighted else 1.0)
        lam = pi_c / (pi_k + pi_c)
        for i in range(3):  # no slice assignments: see floor_covariance
            mean_k[i] = mean[k, i]
            for j in range(3):
                cov_k[i, j] = covariance[k, i, j]
        squared = geodesic(mean_k, cov_k, mean_c[c], cov_c[c], lam, work)
        floor_covariance(cov_k, 8 * epsilon * (cov_k[0, 0] + cov_k[1, 1] + cov_k[2, 2]), work)
        for i in range(3):
            mean[k, i] = mean_k[i]
            for j in range(3):
                covariance[k, i, j] = cov_k[i, j]
        weight[k] = pi_k + pi_c
        added = w[k] * pi_c
        total = np.float64(compared[k]) + added
        rho = added / total
        disagreement[k] = (1 - rho) * np.float64(disagreement[k]) + rho * squared
        compared[k] = total
        for g in range(features.shape[1]):
            features[k, g] = (1 - lam) * np.float64(features[k, g]) + lam * features_c[c, g]


@leaf
def append(
    mean, covariance, weight, disagreement, compared, views, references, features,
    mean_c, cov_c, weight_c, features_c, new, occupied, view, baseline,
):  # fmt: skip
    """Append the components c where ``new`` [C] from slot ``occupied`` on, in place, until the slots are full; return
    the number of slots in use. ``view``, ``baseline``: as :func:`fuse_pairs`."""
    slot = occupied
    for c in range(weight_c.size):
        if not new[c] or slot == weight.size:
            continue
        for i in range(3):
            mean[slot, i] = mean_c[c, i]
            for j in range(3):
                covariance[slot, i, j] = cov_c[c, i, j]
        for g in range(features.shape[1]):
            features[slot, g] = features_c[c, g]
        weight[slot], disagreement[slot], views[slot] = weight_c[c], 0.0, 0.0
        compared[slot] = weight_c[c] if baseline == 0 else 0.0
        for i in range(4):
            references[slot, i] = view[i]
        references[slot, 4] = 0.0
        slot += 1
    return slot
