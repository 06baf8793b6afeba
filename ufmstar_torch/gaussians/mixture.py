"""The Gaussian mixture over geometry X and disagreement H (section "Gaussian mixture model for geometry
and uncertainty"): B independent streams of K slots, padded and masked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.gaussians.fixed_order import apply, congruence
from ufmstar_torch.runtime.kinds import check_kinds


@dataclass(frozen=True)
class GaussianMixture:
    """B unnormalised mixtures of at most K components. A slot of weight 0 is empty and holds zeros.

    Attributes:
        mean: [B, K, 3] mu_X [m], in the frame that the variable's name states (``mixture_cam``: the camera's).
        covariance: [B, K, 3, 3] Sigma_XX [m^2], symmetric.
        weight: [B, K] pi, the number of pixels observed so far [px]; 0 = empty slot.
        disagreement: [B, K] m, the mean squared 2-Wasserstein distance of the comparisons that counted [m^2].
        compared: [B, K] weight of m, the sum of w pi_c over these comparisons (``steps.fuse``) [px].
        views: [B, K] n, the sum of w over the views that were compared; 0 = seen in a single view.
        reference: [B, K, 5] the reference view (``steps.fuse``): the camera's centre in the first camera's frame [m],
            the index of the network, and the largest change q of the view since.
        features: [B, K, F] further entries of H, running averages.
    """

    mean: Tensor
    covariance: Tensor
    weight: Tensor
    disagreement: Tensor
    compared: Tensor
    views: Tensor
    reference: Tensor
    features: Tensor

    @classmethod
    @check_kinds
    def empty(
        cls, streams: int, capacity: int, *, features: int = 0, dtype: torch.dtype, device: torch.device | str
    ) -> GaussianMixture:
        """A mixture of empty slots."""

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(streams, capacity, *shape, dtype=dtype, device=device)

        return cls(zeros(3), zeros(3, 3), zeros(), zeros(), zeros(), zeros(), zeros(5), zeros(features))

    @property
    def streams(self) -> int:
        """B."""
        return self.mean.shape[0]

    @property
    def capacity(self) -> int:
        """K, the number of slots."""
        return self.mean.shape[1]

    @property
    def valid(self) -> Tensor:
        """[B, K] True where a slot is occupied."""
        return self.weight > 0

    @property
    def components(self) -> Tensor:
        """[B] number of occupied slots, int64."""
        return self.valid.sum(-1)

    def bytes_per_component(self) -> int:
        """Memory of one slot [bytes]."""
        return sum(v[:1, :1].nelement() * v.element_size() for v in self.tensors().values())

    def tensors(self) -> dict[str, Tensor]:
        """The fields by name, without copying."""
        return dict(vars(self))

    def replace(self, **changes: Tensor) -> GaussianMixture:
        """A copy with some fields replaced."""
        return GaussianMixture(**{**self.tensors(), **changes})

    def to(self, *args: Any, **kwargs: Any) -> GaussianMixture:
        """``Tensor.to`` on every field."""
        return GaussianMixture(**{name: value.to(*args, **kwargs) for name, value in self.tensors().items()})

    @check_kinds
    def rigid(self, R: Tensor, t: Tensor) -> GaussianMixture:
        """The mixture in another frame (section "Projection to the Image Plane", step 1).

        mu <- R mu + t, Sigma <- R Sigma R^T; empty slots stay zero. ``reference`` stays in the frame of the
        mixture's first camera.

        Args:
            R: [B, 3, 3] rotation from the current frame into the new one.
            t: [B, 3] translation [m].
        """
        mean = apply(R[:, None], self.mean) + t[:, None]
        covariance = congruence(R[:, None], self.covariance)
        return self.replace(
            mean=torch.where(self.valid[..., None], mean, torch.zeros_like(mean)), covariance=covariance
        )

    def grown(self, needed: int, limit: int | None) -> GaussianMixture:
        """The same mixture with its capacity doubled until ``needed`` slots fit, or to the ``limit``."""
        capacity = self.capacity
        while capacity < needed:
            capacity *= 2
        return self.padded(capacity if limit is None else min(capacity, limit))

    def padded(self, capacity: int) -> GaussianMixture:
        """The same mixture with at least ``capacity`` slots, new ones empty."""
        missing = capacity - self.capacity
        if missing <= 0:
            return self

        def pad(value: Tensor) -> Tensor:
            return torch.cat([value, value.new_zeros(value.shape[0], missing, *value.shape[2:])], dim=1)

        return GaussianMixture(**{name: pad(value) for name, value in self.tensors().items()})
