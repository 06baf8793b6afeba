"""Saving and restoring the state of landmark sources: arrays and numbers by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.frames.frame import LARGEST

POSITIVE = (1e-12, LARGEST)  # range of lengths and variances that divide others


def _array(state: Mapping[str, Tensor], name: str) -> NDArray[Any]:
    """A tensor of a saved state as an array; ValueError: there is none on the CPU."""
    value: object = state.get(name)
    if not isinstance(value, Tensor) or not value.is_cpu or value.requires_grad:
        kind = f"a tensor on {value.device}" if isinstance(value, Tensor) else type(value).__name__
        raise ValueError(f"state[{name!r}] must be a tensor on the CPU without a gradient, got {kind}")
    return value.numpy()


class SavedState:
    """Attributes that :meth:`state` copies and :meth:`load_state` restores to the last bit, with those of attributes
    that are of this class themselves.

    Attributes:
        HELD: name in the state by attribute. Each attribute is an array of fixed shape, a number, or a gray image
            [..., H, W] of bytes and any size; ``_K`` are intrinsics.
        PREFIXES: prefix of an attribute's names in the state.
        RANGES: least and largest value by attribute; within +-``LARGEST`` where none is stated.
    """

    HELD: ClassVar[Mapping[str, str]]
    PREFIXES: ClassVar[Mapping[str, str]] = {}
    RANGES: ClassVar[Mapping[str, tuple[float, float]]] = {}

    def state(self) -> dict[str, Tensor]:
        """Copy the state, for :meth:`load_state`."""
        held = {name: torch.from_numpy(np.array(getattr(self, attribute))) for attribute, name in self.HELD.items()}
        return held | {prefix + name: value for part, prefix in self._parts() for name, value in part.state().items()}

    def _parts(self) -> list[tuple[SavedState, str]]:
        parts = [(name, value) for name, value in vars(self).items() if isinstance(value, SavedState)]
        return [(part, self.PREFIXES.get(name, "")) for name, part in parts]

    def snapshot(self) -> dict[str, Any]:
        """A copy of the attributes, for :meth:`restore`. Images are shared, as no method writes to them."""
        return _copied(vars(self))

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Return to a result of :meth:`snapshot`."""
        for name, value in _copied(snapshot).items():
            part = getattr(self, name)
            if isinstance(part, SavedState):
                part.restore(value)
            else:
                setattr(self, name, value)

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Restore a result of :meth:`state`.

        Raises:
            ValueError: an array has another shape or dtype, or a value is impossible; the state stays unchanged.
        """
        values: dict[str, Any] = {}
        for attribute, name in self.HELD.items():
            value, current = np.array(_array(state, name)), np.asarray(getattr(self, attribute))
            fixed = slice(current.ndim if current.dtype != np.uint8 else current.ndim - 2)
            same = value.ndim == current.ndim and value.shape[fixed] == current.shape[fixed]
            if not same or value.dtype != current.dtype:
                text = f"must have shape {current.shape} and dtype {current.dtype}, got {value.shape} and {value.dtype}"
                raise ValueError(f"state[{name!r}] {text}")
            low, high = self.RANGES.get(attribute, (-LARGEST, LARGEST))
            if not ((value >= low) & (value <= high)).all():  # NaN is not
                text = f"finite and within {low:g} and {high:g}: the state is damaged, start with reset()"
                raise ValueError(f"state[{name!r}] must be {text}")
            if attribute == "_K" and not min(value[0, 0], value[1, 1]) > 0:
                raise ValueError(f"state[{name!r}] must be intrinsics with fx, fy > 0: start with reset()")
            values[attribute] = value if value.ndim else value.item()
        for attribute, value in values.items():
            setattr(self, attribute, value)
        for part, prefix in self._parts():
            part.load_state({name.removeprefix(prefix): v for name, v in state.items() if name.startswith(prefix)})


def _copied(values: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of what methods modify in place: arrays, lists and dictionaries, also those of parts."""
    result = dict(values)
    for name, value in values.items():
        kind = type(value)
        if (kind is np.ndarray and value.dtype != np.uint8) or kind is list:
            result[name] = value.copy()
        elif kind is dict:
            result[name] = _copied(value)
        elif isinstance(value, SavedState):
            result[name] = _copied(vars(value))
    return result
