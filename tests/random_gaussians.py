"""Random covariances and mixtures with controlled conditioning."""

from __future__ import annotations

import torch
from torch import Tensor

from ufmstar_torch.mixture import GaussianMixture


def covariances(count: int, seed: int, decades: float = 4.0, largest: float = 0.1) -> Tensor:
    """[count, 3, 3] float64, eigenvalues between ``largest`` and ``largest`` 10^-decades [m^2]."""
    generator = torch.Generator().manual_seed(seed)
    Q = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))[0]
    values = largest * 10 ** (-decades * torch.rand(count, 3, generator=generator, dtype=torch.float64))
    return 0.5 * ((Q * values[:, None]) @ Q.mT + ((Q * values[:, None]) @ Q.mT).mT)


def means(count: int, seed: int) -> Tensor:
    """[count, 3] float64 in front of a camera [m]."""
    generator = torch.Generator().manual_seed(seed + 1)
    spread = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return spread * torch.tensor([0.8, 0.6, 0.7]) + torch.tensor([0.0, 0.0, 3.0])


def mixture(streams: int, capacity: int, seed: int, *, empty: int = 2, features: int = 0) -> GaussianMixture:
    """A mixture with ``empty`` empty slots at the end of every stream."""
    generator = torch.Generator().manual_seed(seed + 2)
    n = streams * capacity
    valid = (torch.arange(capacity) < capacity - empty).expand(streams, capacity)
    mask = valid.double()

    def draw(*shape: int) -> Tensor:
        return torch.rand(streams, capacity, *shape, generator=generator, dtype=torch.float64)

    return GaussianMixture(
        mean=means(n, seed).view(streams, capacity, 3) * mask[..., None],
        covariance=covariances(n, seed).view(streams, capacity, 3, 3) * mask[..., None, None],
        weight=(100 + 2000 * draw()) * mask,
        disagreement=draw() * mask,
        count=valid.long(),
        features=draw(features) * mask[..., None],
    )
