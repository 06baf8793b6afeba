"""What the modules with a state of their own share: buffers that move, save and load as wholes."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

import torch
from torch import Tensor, nn


class Config(Protocol):
    """A frozen config with a form as plain values."""

    def to_dict(self) -> dict[str, Any]:
        """Nested plain values."""
        ...


class StatefulModule(nn.Module):
    """A module whose state is a fixed set of buffers.

    Buffers are float32 or float64 whatever ``.half()`` is asked for. A saved state brings its own shapes (streams,
    components, image size) and says with which config it was made.

    Attributes:
        STATE: the buffers' names.
        ALWAYS_FLOAT64: those of them that keep float64 under ``.float()``: a world coordinate of kilometres needs it.
        config: of the module.
    """

    STATE: ClassVar[tuple[str, ...]]
    ALWAYS_FLOAT64: ClassVar[tuple[str, ...]] = ("T_world_first",)
    config: Config

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Tensor:
            """The buffers are the only attributes that are not in ``__dict__``."""

    def _store(self, state: Mapping[str, Tensor]) -> None:
        """Exchange all buffers."""
        self._buffers.update({name: state[name] for name in self.STATE})

    def _chosen(self, streams: Sequence[int] | Tensor, count: int) -> Tensor:
        """Bool mask [count] of streams given as indices or as a mask, on the state's device.

        Raises:
            IndexError: an index is out of range.
            ValueError: a mask of the wrong length.
        """
        device = getattr(self, self.STATE[0]).device
        given = torch.as_tensor(streams, device=device)
        if given.dtype == torch.bool and given.shape != (count,):
            raise ValueError(f"streams as a mask must have shape ({count},), got {tuple(given.shape)}")
        chosen = torch.zeros(count, dtype=torch.bool, device=device)
        chosen[given if given.numel() else given.long()] = True
        return chosen

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """``.to()`` and friends, with the exceptions that the class states."""
        before = {name: getattr(self, name) for name in self.STATE}
        super()._apply(fn, recurse)
        for name, old in before.items():
            moved = getattr(self, name)
            narrowed = moved.is_floating_point() and moved.dtype not in (torch.float32, torch.float64)
            if (narrowed or name in self.ALWAYS_FLOAT64) and moved.dtype != old.dtype:
                setattr(self, name, old.to(moved.device))
        return self

    def get_extra_state(self) -> Tensor:
        """The config as bytes, so that a checkpoint (safetensors too) says what it was made with."""
        return torch.tensor(list(json.dumps(self.config.to_dict()).encode()), dtype=torch.uint8)

    def set_extra_state(self, state: Tensor) -> None:
        """Warn where the config of a loaded state differs from this module's."""
        saved = json.loads(bytes(state.tolist()).decode())
        ours = self.config.to_dict()
        changed = sorted(k for k in saved.keys() | ours.keys() if saved.get(k) != ours.get(k))
        if changed:
            warnings.warn(f"the loaded state was made with another config: {', '.join(changed)} differ", stacklevel=2)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Take the shapes of a saved state before its values are copied."""
        for name in self.STATE:
            saved, own = state_dict.get(prefix + name), getattr(self, name)
            if isinstance(saved, Tensor) and saved.shape != own.shape:
                setattr(self, name, torch.empty(saved.shape, dtype=own.dtype, device=own.device))
        super()._load_from_state_dict(state_dict, prefix, *args)


def full_precision(device: torch.device) -> AbstractContextManager[object]:
    """Autocast off, where the device has it: it would turn products into half precision."""
    if device.type == "meta" or not torch.amp.is_autocast_available(device.type):
        return nullcontext()
    return torch.autocast(device.type, enabled=False)
