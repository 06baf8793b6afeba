"""Packages that are not always installed, imported where they are first needed."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def optional(module: str, need: str, install: str) -> Any:
    """The module. Raises ModuleNotFoundError: it is not installed; the message states the ``need`` ("pictures need
    matplotlib") and what pip has to ``install``."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{need}: pip install {install}") from error
