"""Kinds of arguments, checked by the annotations of a public function and of a dataclass's fields.

A number may be Python's or NumPy's, a sequence a list, tuple, array or tensor. Shapes, ranges and names are checked
where they are used.
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np

Function = TypeVar("Function", bound=Callable[..., Any])
_NAMES: dict[Any, tuple[tuple[type, ...], str]] = {
    int: ((int, np.integer), "a whole number"),
    float: ((int, float, np.integer, np.floating), "a number"),
    bool: ((bool, np.bool_), "True or False"),
    str: ((str,), "text"),
    Path: ((Path,), "a pathlib.Path"),
    np.ndarray: ((np.ndarray,), "a NumPy array"),
    NoneType: ((NoneType,), "None"),
}
_UNIONS, _SEQUENCES, _OTHERS = (Union, UnionType), (tuple, list, Sequence), (Iterable, Collection, Mapping, dict)


def check_kinds(function: Function) -> Function:
    """A function whose arguments raise TypeError, which names them, if they have not the kinds of its annotations."""
    signature, hints_of = inspect.signature(function), functools.cache(get_type_hints)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            bound = signature.bind(*args, **kwargs).arguments
        except TypeError:  # the function's own error names it
            bound = {}
        hints = hints_of(function)
        for name, value in bound.items():
            require(name, value, hints.get(name, Any))
        return function(*args, **kwargs)

    return cast("Function", call)


def check_fields(instance: Any) -> None:
    """Raises ValueError: a field of a dataclass has not the kind of its annotation."""
    hints = get_type_hints(type(instance))
    for field in fields(instance):
        try:
            require(f"{type(instance).__name__}.{field.name}", getattr(instance, field.name), hints[field.name])
        except TypeError as error:
            raise ValueError(error) from error


def require(name: str, value: Any, hint: Any) -> Any:
    """The argument ``name``. Raises TypeError: it has not the kind of a type hint."""
    if not _fits(value, hint):
        inside = f" of {type(value[0]).__name__}" if isinstance(value, list | tuple) and value else ""
        raise TypeError(f"{name} must be {_described(hint)}, got {type(value).__name__}{inside}")
    return value


def _fits(value: Any, hint: Any) -> bool:
    hint = hint.__bound__ or Any if isinstance(hint, TypeVar) else hint
    origin, args = get_origin(hint), get_args(hint)
    if origin in _UNIONS:
        return any(_fits(value, arg) for arg in args)
    if origin is Literal:
        return isinstance(value, tuple({type(arg) for arg in args}))
    if origin in _SEQUENCES:
        return _is_several(value, (Sequence, np.ndarray, *_tensor())) and _items_fit(value, args)
    if origin in _OTHERS:
        return _is_several(value, origin)
    if origin is Callable:
        return callable(value)
    kind = NoneType if hint is None else origin or hint
    if kind in _tensor():
        return isinstance(value, kind) and str(getattr(value, "layout", "")) == "torch.strided"
    if kind in _NAMES:
        return isinstance(value, _NAMES[kind][0]) and (kind is bool or not isinstance(value, bool | np.bool_))
    unchecked = kind is Any or not isinstance(kind, type) or getattr(kind, "_is_protocol", False)
    return unchecked or isinstance(value, kind)


def _tensor() -> tuple[Any, ...]:
    """The class of tensors where torch is imported; without it no value is one, and ``--help`` does not wait for it."""
    return (sys.modules["torch"].Tensor,) if "torch" in sys.modules else ()


def _is_several(value: object, kinds: Any) -> bool:
    """True for a collection of these kinds that is no text and no scalar array."""
    return isinstance(value, kinds) and not isinstance(value, str | bytes) and getattr(value, "ndim", 1) > 0


def _items_fit(values: Any, args: tuple[Any, ...]) -> bool:
    if hasattr(values, "ndim"):  # an array or a tensor
        if values.ndim != 1 or (isinstance(values, np.ndarray) and values.dtype.kind not in "iuf"):
            return False
        values = values.tolist()
    if len(args) > 1 and args[1] is not ...:
        return len(values) == len(args) and all(map(_fits, values, args))
    return all(_fits(value, args[0]) for value in values) if args else True


def _described(hint: Any) -> str:
    origin, args = get_origin(hint), get_args(hint)
    if origin in _UNIONS:
        return " or ".join(map(_described, args))
    if origin is Literal:
        return f"one of {args}"
    if origin in _SEQUENCES:
        several = len(args) > 1 and args[1] is not ...
        return f"({', '.join(map(_described, args))})" if several else f"a sequence with {_described(args[0])} each"
    if origin is Callable:
        return "a function"
    if origin is type:
        return f"a class derived from {args[0].__name__}"
    kind = NoneType if hint is None else origin or hint
    if kind in _tensor():
        return "a dense torch.Tensor"
    return _NAMES[kind][1] if kind in _NAMES else f"{'an' if kind.__name__[0] in 'AEIO' else 'a'} {kind.__name__}"
