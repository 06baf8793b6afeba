"""The state of UfM* between images: defines all of its tensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.anchors import confidence
from ufmstar_torch.anchors.evidence import SUMS
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.frame import LARGEST, FrameInput
from ufmstar_torch.gaussians.camera import rotation_deviation
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.posterior import running


@dataclass(frozen=True)
class UfMStarState:
    """The state of B streams. The tensors' names are the keys of a saved state (``UfMStar.state_dict``).

    Attributes:
        mean, covariance, weight, disagreement, compared, views, reference, features: M_i (:class:`GaussianMixture`) in
            the frame of each stream's first camera.
        T_world_first: [B, 4, 4] float64 pose of that camera; identity before the first frame.
        started: [B] bool, True after the first frame of a stream.
        frames: [B] int64 number of frames used.
        skipped: [B] int64 number of frames skipped because of a fault.
        smoothed: [B, H, W] moving average of the dense disagreement [m^2] in the mixture's dtype, NaN without a
            value; of size 0 x 0 before the first average.
        by_component: tensors of the anchors [B, K, C] by name, sums over the observations of each component.
        by_stream: tensors [B, C] by name of each stream as a whole, learnt from anchors (:meth:`initial`).
    """

    mean: Tensor
    covariance: Tensor
    weight: Tensor
    disagreement: Tensor
    compared: Tensor
    views: Tensor
    reference: Tensor
    features: Tensor
    T_world_first: Tensor
    started: Tensor
    frames: Tensor
    skipped: Tensor
    smoothed: Tensor
    by_component: Mapping[str, Tensor] = field(default_factory=dict)
    by_stream: Mapping[str, Tensor] = field(default_factory=dict)

    @classmethod
    def initial(
        cls, streams: int, config: UfMStarConfig, dtype: torch.dtype, device: torch.device | str
    ) -> UfMStarState:
        """The empty state of ``streams`` independent streams.

        With ``config.anchors``: ``evidence`` [B, K, 3] and ``overall_evidence`` [B, 3], sums over anchors by component
        and of the stream. With ``config.confidence``: ``confidence`` [B, S]. With ``config.posterior``: ``posterior``
        [B, S] float64, the memory of a stream (``running``).
        """
        capacity = min(config.initial_capacity, config.max_components or config.initial_capacity)
        mixture = GaussianMixture.empty(streams, capacity, features=config.entries, dtype=dtype, device=device)
        counter = torch.zeros(streams, dtype=torch.int64, device=device)
        components: dict[str, Any] = mixture.tensors()
        by_component, by_stream = dict[str, Tensor](), dict[str, Tensor]()
        if config.anchors is not None:
            by_component["evidence"] = torch.zeros(streams, capacity, SUMS, dtype=dtype, device=device)
            by_stream["overall_evidence"] = torch.zeros(streams, SUMS, dtype=dtype, device=device)
        if config.confidence:
            by_stream["confidence"] = torch.zeros(streams, confidence.SIZE, dtype=dtype, device=device)
        if config.posterior is not None:
            by_stream["posterior"] = torch.zeros(streams, running.SIZE, dtype=torch.float64, device=device)
        return cls(
            **components,
            T_world_first=torch.eye(4, dtype=torch.float64, device=device).repeat(streams, 1, 1),
            started=counter.bool(),
            frames=counter,
            skipped=counter.clone(),
            smoothed=torch.zeros(streams, 0, 0, dtype=dtype, device=device),
            by_component=by_component,
            by_stream=by_stream,
        )

    def for_frame(self, frame: FrameInput, config: UfMStarConfig) -> UfMStarState:
        """The state for a frame: the empty one of its streams before the first frame.

        Raises:
            ValueError: the frame has another number of streams, or lies on another device.
        """
        depth, streams, before = frame.depth, frame.depth.shape[0], self.mean.shape[0]
        if before == 0:
            return UfMStarState.initial(streams, config, self.mean.dtype, depth.device)
        if before != streams:
            raise ValueError(f"depth has {streams} streams but the state holds {before}: call reset() first")
        if not (self.mean.is_cpu and depth.is_cpu) and self.mean.device != depth.device:
            raise ValueError(f"depth lies on {depth.device} but the state on {self.mean.device}: move one with .to()")
        return self

    @property
    def mixture(self) -> GaussianMixture:
        """M_i, [B, K]."""
        return GaussianMixture(**{f.name: getattr(self, f.name) for f in fields(GaussianMixture)})

    def require(self, config: UfMStarConfig, like: UfMStarState) -> None:
        """Check tensors from outside, for example a checkpoint, before they are used.

        Args:
            config: of UfM*.
            like: a state with the tensors of the anchors, with any number of streams and components.

        Raises:
            ValueError: shapes that do not fit each other or the config; values that are not finite or out of range;
                covariances that are not positive definite; more slots than ``config.max_components``.
        """
        if self.weight.dim() != 2:
            raise ValueError(f"weight must be [B, K], got {tuple(self.weight.shape)}")
        b, k = self.weight.shape
        image = tuple(self.smoothed.shape[1:]) if self.smoothed.dim() == 3 else ("H", "W")
        shapes = {
            "mean": (b, k, 3), "covariance": (b, k, 3, 3), "disagreement": (b, k), "compared": (b, k),
            "views": (b, k), "reference": (b, k, 5),
            "features": (b, k, config.entries), "T_world_first": (b, 4, 4), "started": (b,), "frames": (b,),
            "skipped": (b,), "smoothed": (b, *image),
            **{name: (b, k, *value.shape[2:]) for name, value in like.by_component.items()},
            **{name: (b, *value.shape[1:]) for name, value in like.by_stream.items()},
        }  # fmt: skip
        tensors = self.tensors()
        for name, shape in shapes.items():
            if (actual := tuple(tensors[name].shape)) != shape:
                raise ValueError(f"{name} must have shape {shape} to match weight {(b, k)}, got {actual}")
        if config.max_components is not None and k > max(config.max_components, 1):
            raise ValueError(f"{k} slots exceed max_components = {config.max_components}")
        if self.weight.device.type == "meta":
            return
        for name, value in self.tensors().items():
            if not bool((value.isfinite() | value.isnan() if name == "smoothed" else value.isfinite()).all()):
                raise ValueError(f"{name} holds NaN or infinity")
        for name in ("weight", "disagreement", "compared", "views", "frames", "skipped", "smoothed"):
            if bool((getattr(self, name) < 0).any()):
                raise ValueError(f"{name} holds negative values")
        occupied = self.weight > 0
        if bool((occupied[:, 1:] & ~occupied[:, :-1]).any()):
            raise ValueError("weight has an empty slot before an occupied one")
        covariance = self.covariance[occupied].double()
        # A rotation rounds an entry and its transpose differently.
        lopsided = (covariance - covariance.mT).abs() > 1e-4 * covariance.abs().amax((-2, -1), keepdim=True)
        if bool(lopsided.any()) or bool(torch.linalg.cholesky_ex(covariance).info.any()):
            raise ValueError("covariance holds matrices that are not symmetric and positive definite")
        R = self.T_world_first[:, :3, :3]
        if b and float(rotation_deviation(R).max()) > 1e-6:
            raise ValueError("T_world_first holds matrices that are not rigid")
        self._require_evidence(config)

    def _require_evidence(self, config: UfMStarConfig) -> None:
        """Raise a ValueError unless a run could have led to the tensors of anchors, whose values are finite."""
        tensors = self.tensors()
        for name in ("evidence", "overall_evidence") if config.anchors is not None else ():
            if bool((tensors[name][..., 0] < 0).any()) or bool((tensors[name].abs() > LARGEST).any()):
                raise ValueError(f"{name} holds negative weights or values beyond {LARGEST:g}")
        if config.confidence:
            confidence.require(tensors["confidence"])
        if config.posterior is not None:
            running.require(tensors["posterior"])

    def tensors(self) -> dict[str, Tensor]:
        """The tensors by name, without copying."""
        tensors = {**vars(self), **self.by_component, **self.by_stream}
        del tensors["by_component"], tensors["by_stream"]
        return tensors

    def with_tensors(self, changed: Mapping[str, Tensor]) -> UfMStarState:
        """A copy with some tensors replaced, by name."""
        named = {**vars(self), **changed}
        for group in ("by_component", "by_stream"):
            if values := named[group]:
                named[group] = {name: named.pop(name, value) for name, value in values.items()}
        return UfMStarState(**named)

    def restarted(self, again: Tensor) -> UfMStarState:
        """A copy with the streams of the mask ``again`` [B] set to the state before their first frame."""
        start = {"T_world_first": torch.eye(4, dtype=torch.float64, device=again.device), "smoothed": torch.nan}

        def value(name: str, old: Tensor) -> Tensor:
            mask = again.view(-1, *[1] * (old.dim() - 1))
            return torch.where(mask, torch.as_tensor(start.get(name, 0), dtype=old.dtype, device=old.device), old)

        return self.with_tensors({name: value(name, old) for name, old in self.tensors().items()})


# Names of the tensors without anchors, in order.
NAMES = tuple(f.name for f in fields(UfMStarState) if f.name not in ("by_component", "by_stream"))
# Names of the tensors that stay float64 when the module is converted.
ALWAYS_FLOAT64 = ("T_world_first", "posterior")
