"""``torchmetrics.Metric`` without the metrics of torchmetrics, whose imports (torchvision, transformers, the compiler
of torch) take some three seconds and 200 MB.

The package's own initialisation runs at the first use of anything else of it, as in any other import.
"""

from __future__ import annotations

import importlib
import logging
import sys
from importlib.util import find_spec, module_from_spec
from threading import RLock
from types import ModuleType
from typing import TYPE_CHECKING, Any

_NAME = "torchmetrics"
_UNUSED = "_ufmstar_torch_unused_spec"  # in the package, until it is initialised
_INITIALISING = RLock()


class _Waiting(ModuleType):
    """A package that is initialised when an attribute is missing, by the first thread that misses one."""

    def __getattr__(self, name: str) -> Any:
        with _INITIALISING:  # other threads wait; the same one may ask again while the package imports its parts
            spec = self.__dict__.pop(_UNUSED, None)
            if spec is not None:
                spec.loader.exec_module(self)
                self.__class__ = ModuleType  # type: ignore[assignment]  # a module's class may change to its base
            return ModuleType.__getattribute__(self, name)


def _prepare() -> None:
    """Make the submodules of torchmetrics importable before the package is initialised."""
    spec = find_spec(_NAME) if _NAME not in sys.modules else None
    if spec is None:  # initialised already, or not installed, which the import below reports
        return
    package = module_from_spec(spec)
    package.__dict__["_logger"] = logging.getLogger(_NAME)  # the only name that these submodules need of the package
    package.__dict__[_UNUSED] = spec
    package.__class__ = _Waiting
    sys.modules[_NAME] = package
    importlib.import_module(f"{_NAME}.utilities")  # imports the metric's module, which cannot be the first


if TYPE_CHECKING:
    from torchmetrics import Metric as Metric
else:
    _prepare()
    Metric = importlib.import_module(f"{_NAME}.metric").Metric
