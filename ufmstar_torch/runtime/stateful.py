"""The base of modules with a state: buffers that move, save and load together, used by one thread at a time."""

from __future__ import annotations

import inspect
import json
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from functools import lru_cache, wraps
from typing import TYPE_CHECKING, Any, Self, TypeVar

import torch
from torch import Tensor, nn

from ufmstar_torch.runtime.checked import Checked, flat

Class = TypeVar("Class")


class OneCaller:
    """The thread that is inside a method of its object, if any. Copies and pickles begin unused."""

    def __init__(self) -> None:
        self._lock, self._owner, self._depth, self._method = threading.Lock(), 0, 0, ""

    def __reduce__(self) -> tuple[type[OneCaller], tuple[()]]:
        return OneCaller, ()

    def enter(self, method: str) -> None:
        """Begin a call; the same thread may nest calls. Raises RuntimeError: another thread is inside."""
        me = threading.get_ident()
        if self._owner != me:
            if not self._lock.acquire(blocking=False):
                raise RuntimeError(
                    f"{method} was called by {_thread(me)} while {_thread(self._owner)} is in {self._method}: the "
                    "state takes one thread at a time; create a module for each thread, or hold a lock around the calls"
                )
            self._owner, self._method = me, method
        self._depth += 1

    def leave(self) -> None:
        """End a call."""
        self._depth -= 1
        if self._depth == 0:
            self._owner = 0
            self._lock.release()


def one_caller(*names: str) -> Callable[[type[Class]], type[Class]]:
    """Decorate a class, whose instances have an attribute ``_caller``, a :class:`OneCaller`: its methods and properties
    ``names`` refuse a second thread."""

    def decorate(owner: type[Class]) -> type[Class]:
        for name in names:
            member = inspect.getattr_static(owner, name)
            is_property = isinstance(member, property)
            guarded = _guarded(member.fget if is_property else member)
            setattr(owner, name, property(guarded) if is_property else guarded)
        return owner

    return decorate


def _guarded(method: Callable[..., Any]) -> Callable[..., Any]:
    name = method.__qualname__

    @wraps(method)
    def called(self: Any, *args: Any, **kwargs: Any) -> Any:
        self._caller.enter(name)
        try:
            return method(self, *args, **kwargs)
        finally:
            self._caller.leave()

    guarded: Any = called
    # torch.compile does not compile this method. torch.compiler.disable does the same, but imports the compiler (6 s).
    frames = torch._C._dynamo.eval_frame
    skip = frames._FrameAction.SKIP
    function: Any = guarded
    frames.set_code_exec_strategy(function.__code__, frames._FrameExecStrategy(skip, skip))
    function._torchdynamo_disable = True
    return guarded


def _thread(ident: int) -> str:
    names = [thread.name for thread in threading.enumerate() if thread.ident == ident]
    return f"thread {names[0]!r}" if names else "another thread"


@one_caller("_save_to_state_dict", "_load_from_state_dict", "_apply")
class StatefulModule(nn.Module):
    """A module whose state is a fixed set of buffers.

    Buffers stay float32 or float64, even after ``.half()``. Loading a saved state changes the buffers' shapes (streams,
    components, image size). A saved state contains the module's config. A second thread that calls a method while
    another one is inside gets a RuntimeError.

    Attributes:
        STATE: the buffers' names.
        ALWAYS_FLOAT64: names of the buffers that stay float64 under ``.float()``, as world coordinates of kilometres
            require.
        config: of the module.
    """

    STATE: tuple[str, ...]
    ALWAYS_FLOAT64: tuple[str, ...] = ()
    config: Checked

    def __init__(self) -> None:
        super().__init__()
        self._caller = OneCaller()

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Tensor:
            """Attributes that are not in ``__dict__`` are buffers."""

    def _store(self, state: Mapping[str, Tensor]) -> None:
        """Replace all buffers."""
        for name in self.STATE:
            self._buffers[name] = state[name]

    def _chosen(self, streams: Sequence[int] | Tensor, count: int) -> Tensor:
        """Convert stream indices or a mask to a bool mask [count] on the state's device. Raises IndexError: an index is
        out of range; ValueError: a mask of the wrong length."""
        device = getattr(self, self.STATE[0]).device
        try:
            indices = torch.as_tensor(streams, device=device)
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise TypeError(f"streams must be indices or a bool mask [B], got {streams!r:.60}") from error
        if indices.dtype not in (torch.bool, torch.int64, torch.int32) and indices.numel():
            raise TypeError(f"streams must be indices or a bool mask [B], got {indices.dtype}")
        if indices.dtype == torch.bool and indices.shape != (count,):
            raise ValueError(f"streams as a mask must have shape ({count},), got {tuple(indices.shape)}")
        chosen = torch.zeros(count, dtype=torch.bool, device=device)
        if indices.dtype != torch.bool and bool(((indices < -count) | (indices >= count)).any()):
            raise IndexError(f"streams must be indices below {count}, got {indices.tolist()}")
        chosen[indices if indices.numel() else indices.long()] = True
        return chosen

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Applies ``.to()`` and similar conversions, with the exceptions in the class's docstring."""
        before = {name: getattr(self, name) for name in self.STATE}
        super()._apply(fn, recurse)
        for name, old in before.items():
            moved = getattr(self, name)
            narrowed = moved.is_floating_point() and moved.dtype not in (torch.float32, torch.float64)
            if (narrowed or name in self.ALWAYS_FLOAT64) and moved.dtype != old.dtype:
                setattr(self, name, old.to(moved.device))
        return self

    def get_extra_state(self) -> Tensor:
        """The config as a tensor of bytes, which safetensors can store, too."""
        return _bytes_of(self.config).clone()

    def set_extra_state(self, state: Tensor) -> None:
        """Does nothing: the module's config stays; :meth:`_load_from_state_dict` warns if the saved one differs."""

    def _warn_of_config(self, state: object) -> None:
        """Warn if the config of a saved state differs from this module's."""
        saved, ours = flat(_config_of(state)), flat(plain(self.config))
        changed = sorted(k for k in saved.keys() | ours.keys() if saved.get(k) != ours.get(k))
        if changed:
            each = ", ".join(f"{key} was {saved.get(key)!r}, is {ours.get(key)!r}" for key in changed)
            warnings.warn(f"the loaded state was made with another config: {each}", stacklevel=4)

    def _require_state(self, state: Mapping[str, Tensor]) -> None:
        """Check a state before it is loaded, in the buffers' dtypes; errors as :meth:`accepted`."""

    def accepted(self, state_dict: Mapping[str, Any], prefix: str = "") -> dict[str, Tensor]:
        """Check a saved state without loading it. Returns its tensors in the buffers' dtypes.

        Raises:
            ValueError: tensors that do not match each other, or invalid values.
        """
        try:
            saved = {
                n: _fitting(n, state_dict[prefix + n], getattr(self, n)) for n in self.STATE if prefix + n in state_dict
            }
            if prefix + "_extra_state" in state_dict:
                _config_of(state_dict[prefix + "_extra_state"])
            self._require_state({name: getattr(self, name) for name in self.STATE} | saved)
        except ValueError as error:
            raise ValueError(f"{type(self).__name__} keeps its state: {error}") from error
        return saved

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, metadata: Any, strict: bool,
        missing: list[str], unexpected: list[str], errors: list[str],
    ) -> None:  # fmt: skip
        """Check a saved state completely before adopting its shapes and copying its values."""
        expected = [prefix + name for name in (*self.STATE, "_extra_state")]
        absent = [key for key in expected if key not in state_dict]
        foreign = [key for key in state_dict if key.startswith(prefix) and key not in expected]
        if strict and (absent or foreign):
            missing.extend(absent)
            unexpected.extend(foreign)
            return
        try:
            saved = self.accepted(state_dict, prefix)
        except ValueError as error:
            errors.append(str(error))
            return
        if prefix + "_extra_state" in state_dict:
            self._warn_of_config(state_dict[prefix + "_extra_state"])  # before any change: it may be raised as an error
        for name, value in saved.items():
            if value.shape != (buffer := getattr(self, name)).shape:
                setattr(self, name, torch.empty(value.shape, dtype=buffer.dtype, device=buffer.device))
        super()._load_from_state_dict(state_dict, prefix, metadata, strict, missing, unexpected, errors)


def _fitting(name: str, saved: object, buffer: Tensor) -> Tensor:
    """A saved tensor in its buffer's dtype. Raises ValueError: no tensor, or another kind of dtype."""
    kind = saved.dtype if isinstance(saved, Tensor) else type(saved).__name__
    both_floats = isinstance(saved, Tensor) and saved.is_floating_point() and buffer.is_floating_point()
    if not isinstance(saved, Tensor) or not (both_floats or saved.dtype == buffer.dtype):
        raise ValueError(f"{name} must be a tensor that fits {buffer.dtype}, got {kind}")
    if saved.is_meta and not buffer.is_meta:
        raise ValueError(f"{name} must hold values, got a tensor on the device meta")
    return saved.detach().to(buffer.dtype)


@lru_cache(maxsize=16)
def _bytes_of(config: Checked) -> Tensor:
    """The config's plain values as bytes of JSON."""
    return torch.tensor(list(json.dumps(config.to_dict()).encode()), dtype=torch.uint8)


def _config_of(state: object) -> dict[str, Any]:
    """The config in a saved ``_extra_state``. Raises ValueError: no tensor of bytes with a JSON object."""
    if not isinstance(state, Tensor) or state.is_meta or state.dtype != torch.uint8 or state.dim() != 1:
        raise ValueError("_extra_state must be a tensor of bytes [n], the config as JSON")
    try:
        config = json.loads(bytes(state.tolist()).decode())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"_extra_state is not the config as JSON: {error}") from error
    if not isinstance(config, dict):
        raise ValueError(f"_extra_state must hold a JSON object, got {type(config).__name__}")
    return config


def plain(config: Checked) -> dict[str, Any]:
    """The config's values after a round trip through JSON."""
    return _config_of(_bytes_of(config))


def undisturbed(like: Tensor) -> AbstractContextManager[object]:
    """Disable gradients, the caller's inference mode, since tensors of the state must outlive it, and autocast, which
    would compute products in half precision, for work on a tensor's device."""
    kind, inferring = "cpu" if like.is_cpu else like.device.type, torch.is_inference_mode_enabled()
    may_cast = kind == "cpu" or (kind != "meta" and torch.amp.is_autocast_available(kind))
    casting = may_cast and torch.is_autocast_enabled(kind)
    if not (inferring or casting):
        return torch.set_grad_enabled(False)
    contexts = ExitStack()
    if inferring:
        contexts.enter_context(torch.inference_mode(False))
    contexts.enter_context(torch.no_grad())
    if casting:
        contexts.enter_context(torch.autocast(kind, enabled=False))
    return contexts
