"""A Gaussian field on a grid's nodes, conditioned on observations at some: mean and variance at every node.

    y = x . b + f + noise,      b ~ N(b_0, P),      f ~ N(0, Q^-1)

with the features x and the field f of precision Q: f^T Q f = kappa |f|^2 + sum over links (f_i - f_j)^2 / variance of
the link. An observation of variance 1/w at node i adds w to Q_ii. A Schur complement integrates b out. The only large
system is that of the nodes; its bandwidth is the number of nodes in a row.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Solved:
    """The system A x = y on n nodes.

    Attributes:
        columns: [B, n, q] A^-1 Y.
        variance: [B, n] diagonal of A^-1.
    """

    columns: Tensor
    variance: Tensor


def solve(diagonal: Tensor, right: Tensor, down: Tensor, columns: Tensor, cols: int) -> Solved:
    """Solve A X = Y and compute the diagonal of A^-1, for A from a diagonal and the links of a grid; dense.

    Args:
        diagonal: [B, n] diagonal of A without the links, positive.
        right, down: [B, n] precision of the link to the next node in the row, in the column; 0 where there is none.
        columns: [B, n, q] Y.
        cols: nodes in a row.
    """
    n = diagonal.shape[1]
    A = torch.diag_embed(diagonal)
    for step, link in ((1, right[:, : n - 1]), (cols, down[:, : n - cols])):
        ends = torch.nn.functional.pad(link, (0, step)) + torch.nn.functional.pad(link, (step, 0))
        off_diagonal = torch.diag_embed(link, step) + torch.diag_embed(link, -step)
        A = A + torch.diag_embed(ends) - off_diagonal
    L = torch.linalg.cholesky(A)
    return Solved(torch.cholesky_solve(columns, L), torch.cholesky_inverse(L).diagonal(dim1=1, dim2=2))


@dataclass(frozen=True)
class Prior:
    """Prior of b and f.

    Attributes:
        diagonal: [B, n] kappa.
        right, down: [B, n] precisions of the links.
        mean: [B, F] b_0.
        precision: [B, F, F] P^-1.
        cols: nodes in a row.
    """

    diagonal: Tensor
    right: Tensor
    down: Tensor
    mean: Tensor
    precision: Tensor
    cols: int


@dataclass(frozen=True)
class Observed:
    """N observations. Some may have the weight 0.

    Attributes:
        node: [B, N] int64.
        features: [B, N, F] x.
        value: [B, N] y.
    """

    node: Tensor
    features: Tensor
    value: Tensor


@dataclass(frozen=True)
class Field:
    """b and f, conditioned on the observations.

    Attributes:
        coefficients: [B, F] mean of b.
        covariance: [B, F, F] of b.
        offset: [B, n] mean of f.
        response: [B, n, F] decrease of f's mean per unit of b.
        variance: [B, n] variance of f for fixed b.
    """

    coefficients: Tensor
    covariance: Tensor
    offset: Tensor
    response: Tensor
    variance: Tensor

    @classmethod
    def conditioned(cls, prior: Prior, observed: Observed, weight: Tensor) -> Field:
        """Condition the prior on observations of precision ``weight`` [B, N]."""
        weighted = weight[..., None] * observed.features
        residual = observed.value - (observed.features * prior.mean[:, None]).sum(-1)
        rows = torch.cat([weighted, (weight * residual)[..., None], weight[..., None]], -1)
        nodes = torch.zeros(*prior.diagonal.shape, rows.shape[-1], dtype=rows.dtype, device=rows.device)
        nodes = nodes.scatter_add(1, observed.node[..., None].expand_as(rows), rows)
        solved = solve(prior.diagonal + nodes[..., -1], prior.right, prior.down, nodes[..., :-1], prior.cols)
        response, offset = solved.columns[..., :-1], solved.columns[..., -1]
        cross = nodes[..., :-2].mT
        precision = prior.precision + weighted.mT @ observed.features - cross @ response
        covariance = torch.linalg.inv_ex(precision).inverse
        right_side = (weighted * residual[..., None]).sum(1) - (cross @ offset[..., None])[..., 0]
        b = (covariance @ right_side[..., None])[..., 0]
        field = offset - (response @ b[..., None])[..., 0]
        return cls(prior.mean + b, covariance, field, response, solved.variance)

    def at(self, node: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance [B, N] of x . b + f at nodes [B, N] with features [B, N, F]."""
        x = features - torch.gather(self.response, 1, node[..., None].expand_as(features))
        variance = torch.gather(self.variance, 1, node) + ((x @ self.covariance) * x).sum(-1)
        return (features * self.coefficients[:, None]).sum(-1) + torch.gather(self.offset, 1, node), variance
