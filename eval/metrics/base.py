"""What the metrics share: sum states in float64 or int64, saved with the state_dict, merged with care."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric


class SumMetric(Metric):
    """A metric whose states are sums of fixed size.

    ``update(depth, variance, target, valid=None)`` adds frames: maps of one shape [...] in m and m^2, ``valid`` True =
    use; metrics of the depth alone ignore the variance. ``compute()`` returns the figures of all updates so far as a
    dict of float64 tensors by name: scalars, and curves [B] where the metric has one. States reduce by addition: across
    processes (torchmetrics synchronises at ``compute``; pass ``sync_on_compute=False`` where every process holds
    another sequence) and through ``merge_state``. Counts are int64 and exact; float64 sums depend on the order of the
    updates in the last bits only. Float64 rules out MPS: keep the metric on the CPU there.
    """

    is_differentiable = False
    full_state_update = False

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

    def add_count(self, name: str, *shape: int) -> None:
        """Add an int64 state of zeros."""
        self.add_state(name, torch.zeros(shape, dtype=torch.int64), dist_reduce_fx="sum", persistent=True)

    def add_sum(self, name: str, *shape: int) -> None:
        """Add a float64 state of zeros."""
        self.add_state(name, torch.zeros(shape, dtype=torch.float64), dist_reduce_fx="sum", persistent=True)

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
