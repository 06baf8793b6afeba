"""All that UfM* remembers between images: the one place where the tensors of the state are named."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from ufmstar_torch.anchors.hook import EVIDENCE_SUMS
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.mixture import GaussianMixture


@dataclass(frozen=True)
class UfMStarState:
    """The state of B streams. The fields' names are the keys of a saved state (``UfMStar.state_dict``).

    Attributes:
        mean, covariance, weight, disagreement, count, features: M_i (:class:`GaussianMixture`) in the frame of each
            stream's first camera.
        T_world_first: [B, 4, 4] float64 pose of that camera; identity before the first frame.
        started: [B] bool, True once a stream has seen a frame.
        frames: [B] int64 number of frames used.
        skipped: [B] int64 number of frames skipped for a fault.
        smoothed: [B, H, W] moving average of the dense disagreement [m^2] in the mixture's dtype, NaN without a
            value; of size 0 x 0 before the first average.
        evidence: [B, K, 3] sums over anchors, row k of slot k; K = 0 without ``config.anchored``.
        overall_evidence: [B, 3] sums over anchors of the stream.
    """

    mean: Tensor
    covariance: Tensor
    weight: Tensor
    disagreement: Tensor
    count: Tensor
    features: Tensor
    T_world_first: Tensor
    started: Tensor
    frames: Tensor
    skipped: Tensor
    smoothed: Tensor
    evidence: Tensor
    overall_evidence: Tensor

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """The tensors' names."""
        return tuple(f.name for f in fields(cls))

    @classmethod
    def initial(
        cls, streams: int, config: UfMStarConfig, dtype: torch.dtype, device: torch.device | str
    ) -> UfMStarState:
        """The empty state of ``streams`` independent streams."""
        capacity = min(config.initial_capacity, config.max_components or config.initial_capacity)
        mixture = GaussianMixture.empty(streams, capacity, features=config.features, dtype=dtype, device=device)
        counter = torch.zeros(streams, dtype=torch.int64, device=device)
        rows = capacity if config.anchored else 0
        return cls(
            **mixture.tensors(),
            T_world_first=torch.eye(4, dtype=torch.float64, device=device).repeat(streams, 1, 1),
            started=counter.bool(),
            frames=counter,
            skipped=counter.clone(),
            smoothed=torch.zeros(streams, 0, 0, dtype=dtype, device=device),
            evidence=torch.zeros(streams, rows, EVIDENCE_SUMS, dtype=dtype, device=device),
            overall_evidence=torch.zeros(streams, EVIDENCE_SUMS, dtype=dtype, device=device),
        )

    @property
    def mixture(self) -> GaussianMixture:
        """M_i, [B, K]."""
        return GaussianMixture(self.mean, self.covariance, self.weight, self.disagreement, self.count, self.features)

    def tensors(self) -> dict[str, Tensor]:
        """The tensors by name, without copying."""
        return dict(vars(self))

    def restarted(self, again: Tensor) -> UfMStarState:
        """The state with the streams of the mask ``again`` [B] as they were before their first frame."""
        start = {"T_world_first": torch.eye(4, dtype=torch.float64, device=again.device), "smoothed": torch.nan}

        def value(name: str, old: Tensor) -> Tensor:
            mask = again.view(-1, *[1] * (old.dim() - 1))
            return torch.where(mask, torch.as_tensor(start.get(name, 0), dtype=old.dtype, device=old.device), old)

        return UfMStarState(**{name: value(name, old) for name, old in self.tensors().items()})
