"""What the metrics share: sum states in float64 or int64, saved with the state_dict, merged with care."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor
from torchmetrics import Metric

from ufmstar_torch.eval.metrics.pixels import Pixels, require_variance, select_pixels


class SumMetric(Metric):
    """A metric whose states are sums of fixed size, over the pixels with ground truth and a usable prediction.

    ``compute()`` returns the figures of all updates so far as a dict of float64 tensors by name: scalars, and curves
    [B] where the metric has one. States reduce by addition: across processes (torchmetrics synchronises at
    ``compute``; pass ``sync_on_compute=False`` where every process holds another sequence) and through
    ``merge_state``. Counts are int64 and exact; float64 sums depend on the order of the updates in the last bits only.
    Float64 rules out MPS: keep the metric on the CPU there.

    Attributes:
        OF_VARIANCE: the name, in messages, of a metric that needs a variance; "" for one of the depth alone.
    """

    OF_VARIANCE: ClassVar[str] = ""
    is_differentiable = False
    full_state_update = False

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Tensor:
            """The states are the only attributes that are not in ``__dict__``."""

    def __init__(self, settings: dict[str, Any] | None = None, **kwargs: Any) -> None:
        # torchmetrics keeps a computed value across merge_state and load_state_dict, where it is stale.
        kwargs.setdefault("compute_with_cache", False)
        super().__init__(**kwargs)
        self.settings = dict(settings or {})

    @property
    def update_called(self) -> bool:
        """True: sums that were loaded or merged are as good as updated ones, and no frame gives NaN."""
        return True

    @property
    def states(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(self._defaults)

    def add_counts(self, *names: str, shape: tuple[int, ...] = ()) -> None:
        """Add int64 states of zeros."""
        for name in names:
            self.add_state(name, torch.zeros(shape, dtype=torch.int64), dist_reduce_fx="sum", persistent=True)

    def add_sums(self, *names: str, shape: tuple[int, ...] = ()) -> None:
        """Add float64 states of zeros."""
        for name in names:
            self.add_state(name, torch.zeros(shape, dtype=torch.float64), dist_reduce_fx="sum", persistent=True)

    def update(self, depth: Tensor, variance: Tensor | None, target: Tensor, valid: Tensor | None = None) -> None:
        """Add frames: maps of one shape [...] in m and m^2, ``valid`` True = use. Raises ValueError: shapes or types
        disagree, or a needed variance is missing."""
        needed = require_variance(variance, self.OF_VARIANCE) if self.OF_VARIANCE else None
        self.add(**self.sums_of(select_pixels(depth, needed, target, valid)))

    @abstractmethod
    def sums_of(self, p: Pixels) -> Mapping[str, Tensor | float]:
        """What pixels add to the states, by name."""

    def add(self, **sums: Tensor | float) -> None:
        """Add to the states by name; the states are exchanged, never changed in place."""
        for name, value in sums.items():
            state: Tensor = getattr(self, name)
            setattr(self, name, state + (value.to(state.device) if isinstance(value, Tensor) else value))

    def merge_state(self, incoming_state: dict[str, Any] | Metric) -> None:
        """Add another metric's sums to this one's. Raises ValueError: the other one was made with other settings, so
        that its sums mean something else."""
        if isinstance(incoming_state, SumMetric) and incoming_state.settings != self.settings:
            raise ValueError(
                f"incoming_state must come from a metric with the settings {self.settings}, "
                f"got {incoming_state.settings}"
            )
        super().merge_state(incoming_state)
        if isinstance(incoming_state, Metric):
            self._update_count += incoming_state._update_count


def share(part: Tensor, whole: Tensor) -> Tensor:
    """part / whole in float64, NaN where whole is 0."""
    return part.double() / whole.double()
