"""Refuses a second thread that calls a stateful object while another one is inside."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import torch

Class = TypeVar("Class")


class OneCaller:
    """The thread that is inside a method of its object, if any. Copies and pickles begin unused."""

    def __init__(self) -> None:
        self._lock, self._owner, self._depth, self._inside = threading.Lock(), 0, 0, ""

    def __reduce__(self) -> tuple[type[OneCaller], tuple[()]]:
        return OneCaller, ()

    def enter(self, method: str) -> None:
        """Begin a call; the same thread may nest calls. Raises RuntimeError: another thread is inside."""
        me = threading.get_ident()
        if self._owner != me:
            if not self._lock.acquire(blocking=False):
                raise RuntimeError(
                    f"{method} was called by {_this_thread()} while {self._inside}: the state takes one thread at a "
                    "time; create a module for each thread, or hold a lock around the calls"
                )
            self._owner, self._inside = me, f"{_this_thread()} is in {method}"
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
            member = vars(owner)[name]
            is_property = isinstance(member, property)
            guarded = _guarded(member.fget if is_property else member)
            setattr(owner, name, property(guarded) if is_property else guarded)
        return owner

    return decorate


def _guarded(method: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(method)
    def called(self: Any, *args: Any, **kwargs: Any) -> Any:
        self._caller.enter(f"{type(self).__name__}.{method.__name__}")
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


def _this_thread() -> str:
    return f"thread {threading.current_thread().name!r}"
