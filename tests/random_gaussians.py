"""Random covariances and mixtures with controlled conditioning."""

from __future__ import annotations

import torch
from torch import Tensor

from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.steps.correspond import Correspondence


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
        compared=2000 * draw() * mask,
        views=3 * draw() * mask,
        reference=torch.cat([0.5 * draw(3), (2 * draw(1)).round(), 0.8 * draw(1)], -1) * mask[..., None],
        features=draw(features) * mask[..., None],
    )


def as_lists(m: GaussianMixture, stream: int) -> list[dict]:
    """The components of a stream as the oracle's dicts."""
    n = int(m.components[stream])
    return [
        {
            "mean": m.mean[stream, k].numpy(),
            "cov": m.covariance[stream, k].numpy(),
            "weight": m.weight[stream, k].item(),
            "m": m.disagreement[stream, k].item(),
            "compared": m.compared[stream, k].item(),
            "views": m.views[stream, k].item(),
            "reference": m.reference[stream, k].numpy(),
            "features": m.features[stream, k].numpy(),
        }
        for k in range(n)
    ]


def views(streams: int, seed: int) -> Tensor:
    """[streams, 4] centre of a camera near the origin [m], and the index 0 or 1 of a network."""
    generator = torch.Generator().manual_seed(seed + 3)
    centre = 0.5 * torch.rand(streams, 3, generator=generator, dtype=torch.float64)
    return torch.cat([centre, torch.randint(0, 2, (streams, 1), generator=generator).double()], 1)


def random_pairs(streams: int, previous, current, seed: int, density: float = 0.3) -> Correspondence:
    """Matches of a share ``density`` of all pairs, with overlaps of .5 to 1."""
    generator = torch.Generator().manual_seed(seed)
    shape = (streams, current.capacity, previous.capacity)
    match = torch.rand(shape, generator=generator) < density
    match &= current.valid[:, :, None] & previous.valid[:, None]
    overlap = 0.5 + 0.5 * torch.rand(shape, generator=generator, dtype=torch.float64)
    return Correspondence(match, overlap)
