"""Imports at the first use: a package's public names (PEP 562), and optional packages.

Importing a package of ours is fast, because it lists its names once, as imports for type checkers and editors::

    if TYPE_CHECKING:
        from ufmstar_torch.config import UfMStarConfig as UfMStarConfig
    else:
        __getattr__, __dir__ = lazy_names(__name__)

An optional package that is missing is named with the extra that installs it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

# By import name: the extra of ``ufmstar-torch`` that installs the package.
EXTRAS = {
    **dict.fromkeys(("torchvision", "onnx", "onnxruntime", "safetensors", "transformers"), "models"),
    **dict.fromkeys(("filelock", "torchmetrics", "scipy", "cv2", "imageio", "imageio_ffmpeg", "kornia_rs"), "eval"),
    **dict.fromkeys(("PIL", "tqdm", "tyro", "h5py", "jinja2", "pandas", "OpenEXR", "yaml"), "eval"),
    "matplotlib": "viz",
    "lightning": "train",
    "kornia": "train",
    "tensorboard": "train",
    "zeus": "energy",
}


def optional(module: str, need: str, install: str) -> Any:
    """Import a module. Raises ModuleNotFoundError: it is not installed; the message states the ``need`` ("pictures need
    matplotlib") and the package to ``install``."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{need}: pip install {install}") from error


def naming_extra(error: BaseException, who: str) -> BaseException:
    """The error; if a package is missing, one that names the extra that ``who`` needs."""
    package = (getattr(error, "name", None) or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) or package not in EXTRAS:
        return error
    text = f"{who} needs the package {package}: pip install 'ufmstar-torch[{EXTRAS[package]}]'"
    return ModuleNotFoundError(text, name=error.name)


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
            value = getattr(import_module(module), original)
        except ModuleNotFoundError as error:
            raise naming_extra(error, f"{package}.{name}") from error
        setattr(sys.modules[package], name, value)  # the next look-up does not come here
        return value

    return getattr_, lambda: sorted(origins())
