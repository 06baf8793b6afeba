"""Lazy import of a package's public names at their first use (PEP 562), so that importing the package is fast.

A package lists its names once, as imports for type checkers and editors::

    if TYPE_CHECKING:
        from ufmstar_torch.config import UfMStarConfig as UfMStarConfig
    else:
        __getattr__, __dir__ = lazy_names(__name__)
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

from ufmstar_torch.runtime.optional import naming_extra


def lazy_names(package: str, **completed: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package for the names imported under ``if TYPE_CHECKING:`` in it.

    Args:
        package: the package's ``__name__``. Its source is parsed when the first name is looked up.
        completed: by name, a module with a subclass that replaces the listed class at run time.
    """

    @cache
    def origins() -> dict[str, tuple[str, str]]:
        """By public name: its module, and its name in that module."""
        import ast
        import inspect

        source = inspect.getsource(sys.modules[package])
        blocks = (node.body for node in ast.parse(source).body if isinstance(node, ast.If))
        imports = (node for body in blocks for node in body if isinstance(node, ast.ImportFrom))
        return {alias.asname or alias.name: (str(i.module), alias.name) for i in imports for alias in i.names}

    def getattr_(name: str) -> Any:
        if name.startswith("__") or name not in origins():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, original = origins()[name]
        module = completed.get(name, module)
        try:
            return getattr(import_module(module), original)
        except ModuleNotFoundError as error:
            raise naming_extra(error, f"{package}.{name}") from error

    return getattr_, lambda: sorted(origins())
