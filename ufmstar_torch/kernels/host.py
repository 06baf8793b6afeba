"""Runs CPU kernels on the tensors of an accelerator, for work that is a long chain of tiny steps there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor


def moved(value: Any, device: torch.device | str) -> Any:
    """The same value with its tensors on a device: a tensor, a tuple, or a dataclass with tensors in its fields."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, tuple):
        return tuple(moved(part, device) for part in value)
    if not is_dataclass(value) or isinstance(value, type):
        return value
    before = {f.name: getattr(value, f.name) for f in fields(value)}
    after = {name: moved(part, device) for name, part in before.items()}
    changed = any(after[name] is not part for name, part in before.items())
    return replace(value, **after) if changed else value


def on_host(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a CPU kernel for tensors of any device: copy them, synchronise, return results on the first tensor's
    device."""

    def call(*arguments: Any) -> Any:
        return moved(kernel(*moved(arguments, "cpu")), _first(arguments).device)

    return call


def _first(value: Any) -> Any:
    """The first tensor in a value, or None."""
    if isinstance(value, Tensor):
        return value
    parts = value if isinstance(value, tuple) else vars(value).values() if is_dataclass(value) else ()
    return next((tensor for part in parts if (tensor := _first(part)) is not None), None)
