"""States of what sources of landmarks remember: arrays and numbers, by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor


class SavedState:
    """Attributes that :meth:`state` copies and :meth:`load_state` restores to the last bit.

    Attributes:
        HELD: name in the state by attribute; each is an array of fixed shape, or a number.
    """

    HELD: ClassVar[Mapping[str, str]]

    def state(self) -> dict[str, Tensor]:
        """A copy of all that is remembered, for :meth:`load_state`."""
        return {name: torch.from_numpy(np.array(getattr(self, attribute))) for attribute, name in self.HELD.items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue where :meth:`state` was taken.

        Raises:
            ValueError: an array of another shape, or a value that is not finite; nothing has changed then.
        """
        values: dict[str, Any] = {}
        for attribute, name in self.HELD.items():
            value, expected = np.array(state[name].numpy()), np.shape(getattr(self, attribute))
            if value.shape != expected:
                raise ValueError(f"state[{name!r}] must have shape {expected}, got {value.shape}")
            if not np.isfinite(value).all():
                raise ValueError(f"state[{name!r}] must be finite: the state is damaged, start with reset()")
            values[attribute] = value if value.ndim else value.item()
        for attribute, value in values.items():
            setattr(self, attribute, value)
