"""Saving and restoring the state of landmark sources: arrays and numbers by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.frames.frame import LARGEST


def saved_image(state: Mapping[str, Tensor], name: str) -> NDArray[np.uint8]:
    """Read a grey image [H, W] from a saved state; ValueError: another shape or dtype, or no such image."""
    image = state.get(name, torch.empty(0))
    if image.dtype != torch.uint8 or image.dim() != 2:
        raise ValueError(
            f"state[{name!r}] must have shape (H, W) and dtype uint8, got {tuple(image.shape)} and {image.dtype}"
        )
    return image.numpy()


class SavedState:
    """Attributes that :meth:`state` copies and :meth:`load_state` restores to the last bit.

    Attributes:
        HELD: name in the state by attribute. Each attribute is an array of fixed shape, or a number.
    """

    HELD: ClassVar[Mapping[str, str]]

    def state(self) -> dict[str, Tensor]:
        """Copy the state, for :meth:`load_state`."""
        return {name: torch.from_numpy(np.array(getattr(self, attribute))) for attribute, name in self.HELD.items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of :meth:`state`.

        Raises:
            ValueError: an array has another shape or dtype, or a value is impossible; the state stays unchanged.
        """
        values: dict[str, Any] = {}
        for attribute, name in self.HELD.items():
            value, current = np.array(state[name].numpy()), np.asarray(getattr(self, attribute))
            if value.shape != current.shape or value.dtype != current.dtype:
                text = f"must have shape {current.shape} and dtype {current.dtype}, got {value.shape} and {value.dtype}"
                raise ValueError(f"state[{name!r}] {text}")
            if not (np.abs(value, dtype=np.float64) <= LARGEST).all():  # NaN is not
                text = f"finite and within {LARGEST:g}: the state is damaged, start with reset()"
                raise ValueError(f"state[{name!r}] must be {text}")
            values[attribute] = value if value.ndim else value.item()
        for attribute, value in values.items():
            setattr(self, attribute, value)
