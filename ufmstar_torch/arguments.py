"""Checks of tensors at public entries: dtype, shape and device, each with one wording."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

Shapes = Sequence[tuple[int, ...]]


def require_float(name: str, value: object, shapes: Shapes = (), like: Tensor | None = None) -> Tensor:
    """The argument ``name`` if it is a tensor of a floating-point dtype.

    Args:
        shapes: those allowed; () = any.
        like: on whose device it must lie; None = any.

    Raises:
        TypeError: no tensor or of another dtype.
        ValueError: of another shape or on another device.
    """
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a torch.Tensor, got {type(value).__name__}")
    if not value.is_floating_point():
        raise TypeError(f"{name} must have a floating-point dtype, got {value.dtype}")
    return _fitting(name, value, shapes, like)


def require_mask(name: str, value: object, shapes: Shapes, like: Tensor | None = None) -> Tensor:
    """As :func:`require_float`, for torch.bool."""
    if not isinstance(value, Tensor) or value.dtype != torch.bool:
        kind = value.dtype if isinstance(value, Tensor) else type(value).__name__
        raise TypeError(f"{name} must be a torch.bool tensor (True = use), got {kind}")
    return _fitting(name, value, shapes, like)


def _fitting(name: str, value: Tensor, shapes: Shapes, like: Tensor | None) -> Tensor:
    if shapes and tuple(value.shape) not in shapes:
        expected = " or ".join(str(shape) for shape in dict.fromkeys(shapes))
        raise ValueError(f"{name} must have shape {expected}, got {tuple(value.shape)}")
    if like is not None and value.device != like.device:
        raise ValueError(f"{name} must lie on the depth's device {like.device}, got {value.device}")
    return value
