"""The base of all metrics: states are float64 or int64 sums, which the state_dict saves and which can be merged."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torchmetrics import Metric

Array = NDArray[np.float64]
COUNT, SUM = torch.int64, torch.float64  # kinds of states


@dataclass(frozen=True, eq=False)
class Pixels:
    """The pixels of one or more frames, flat on the CPU. Ground truth is valid if positive and finite, a depth if
    finite, a variance if finite and not negative."""

    depth: Array  # [P] d [m]
    variance: Array  # [P] v [m^2]; [0] without one
    target: Array  # [P] g [m]
    use: NDArray[np.bool_]  # [P] True = use
    inlier: Array  # [P] variance of a mixture's inliers [m^2]; [0] without a mixture
    outlier: Array  # [P] probability of an outlier; [0] without a mixture
    level: Array  # [P] of the smallest central interval with the ground truth in it, NaN = none; [0] without intervals

    @cached_property
    def with_truth(self) -> NDArray[np.bool_]:
        """[P] True where there is ground truth."""
        return self.use & (self.target > 0) & (self.target < np.inf)

    @cached_property
    def predicted(self) -> NDArray[np.bool_]:
        """[P] True where there are depth and variance."""
        return self.use & np.isfinite(self.depth) & (self.variance >= 0) & (self.variance < np.inf)

    @cached_property
    def depths(self) -> tuple[Array, Array]:
        """d and g where both are valid."""
        both = self.with_truth & np.isfinite(self.depth)
        return self.depth[both], self.target[both]

    @cached_property
    def judged(self) -> tuple[Array, Array, Array]:
        """d, v and g where all are valid."""
        every = self.with_truth & self.predicted
        return self.depth[every], self.variance[every], self.target[every]


class SumMetric(Metric):
    """A metric whose states are sums of fixed size, over the pixels with ground truth and a valid prediction.

    ``compute()`` returns the figures of all updates as float64 tensors by name: scalars and curves [B]. States reduce
    by addition: across processes (torchmetrics synchronises at ``compute``; pass ``sync_on_compute=False`` if every
    process has another sequence) and through ``merge_state``. Counts are int64 and exact; float64 sums depend on the
    order of the updates in the last bits only. MPS has no float64: keep the metric on the CPU there.

    Attributes:
        OF_VARIANCE: the name, in messages, of a metric that needs a variance; "" if it needs depth alone.
        STATES: name, ``COUNT`` or ``SUM``, and sizes of the dimensions of each state; initially zeros.
        settings: of the instance; sums with other settings cannot be merged.
    """

    OF_VARIANCE: ClassVar[str] = ""
    STATES: tuple[tuple[Any, ...], ...] = ()
    settings: Mapping[str, Any] = MappingProxyType({})
    is_differentiable = False
    full_state_update = False

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Tensor:
            """The type of the states, which are not in ``__dict__``."""

    def __init__(self, **kwargs: Any) -> None:
        # torchmetrics keeps a computed value across merge_state and load_state_dict, where it is stale.
        kwargs.setdefault("compute_with_cache", False)
        super().__init__(**kwargs)
        for name, kind, *shape in self.STATES:
            self.add_state(name, torch.zeros(shape, dtype=kind), dist_reduce_fx="sum", persistent=True)

    @property
    def update_called(self) -> bool:
        """True, because loaded or merged sums are valid too, and figures without a frame are NaN."""
        return True

    def update(self, depth: Tensor, variance: Tensor | None, target: Tensor, valid: Tensor | None = None) -> None:
        """Add frames: maps of one shape [...] in m and m^2, ``valid`` True = use. Raises ValueError: shapes or types
        disagree, or a needed variance is missing."""
        self.add(flat_pixels(depth, variance, target, valid))

    def add(self, pixels: Pixels) -> None:
        """Add pixels. States are replaced instead of changed in place, because others may hold references to them.
        Raises ValueError: a needed variance is missing."""
        if self.OF_VARIANCE and len(pixels.variance) != len(pixels.depth):
            judged = f"{self.OF_VARIANCE} judges the predicted distribution N(depth, variance)"
            raise ValueError(f"variance must be given: {judged}")
        for name, added in self.sums(pixels).items():
            state = getattr(self, name)
            setattr(self, name, state + torch.as_tensor(added, dtype=state.dtype, device=state.device))

    @abstractmethod
    def sums(self, pixels: Pixels) -> Mapping[str, Any]:
        """The pixels' contribution to each state, by name; a missing state stays unchanged."""

    def merge_state(self, incoming_state: dict[str, Any] | Metric) -> None:
        """Add another metric's sums to this one's. Raises ValueError: the other metric has other settings."""
        if isinstance(incoming_state, SumMetric) and incoming_state.settings != self.settings:
            raise ValueError(
                f"incoming_state must come from a metric with the settings {self.settings}, "
                f"got {incoming_state.settings}"
            )
        super().merge_state(incoming_state)
        if isinstance(incoming_state, Metric):
            self._update_count += incoming_state._update_count


def flat_pixels(
    depth: Tensor, variance: Tensor | None, target: Tensor, valid: Tensor | None = None,
    mixture: tuple[Tensor, Tensor] | None = None, level: Tensor | None = None,
) -> Pixels:  # fmt: skip
    """All pixels of maps of one shape [...], in float64.

    Args:
        depth: predicted depth d [m]; not finite = no prediction.
        variance: predicted variance v [m^2], or None; not finite or < 0 = no prediction.
        target: ground truth [m]; NaN, infinite or <= 0 means there is none.
        valid: bool, True = use; None = everywhere.
        mixture: variance of the inliers [m^2] and probability of an outlier; None = no mixture.
        level: of the smallest central interval with the ground truth in it; None = no intervals.

    Raises:
        ValueError: an argument has another shape than ``depth`` or the wrong type.
    """
    inlier, outlier = mixture or (None, None)
    maps = {"depth": depth, "variance": variance, "target": target, "valid": valid}
    for name, value in (maps | {"inlier": inlier, "outlier": outlier, "level": level}).items():
        if value is None:
            continue
        if value.shape != depth.shape:
            raise ValueError(f"{name} must have the depth's shape {tuple(depth.shape)}, got {tuple(value.shape)}")
        if name == "valid" and value.dtype != torch.bool:
            raise ValueError(f"valid must be a bool mask (True = use), got {value.dtype}")
        if name != "valid" and not torch.is_floating_point(value):
            raise ValueError(f"{name} must be floating point, got {value.dtype}")

    def flat(value: Tensor | None) -> NDArray[Any]:
        return np.zeros(0) if value is None else value.detach().to("cpu", torch.float64).flatten().numpy()

    use = np.ones(depth.numel(), np.bool_) if valid is None else valid.cpu().flatten().numpy()
    return Pixels(flat(depth), flat(variance), flat(target), use, flat(inlier), flat(outlier), flat(level))


def share(part: Tensor, whole: Tensor) -> Tensor:
    """part / whole in float64, NaN where whole is 0."""
    return part.double() / whole.double()
