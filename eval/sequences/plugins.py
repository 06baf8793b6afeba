"""The user's readers, methods and metrics: from installed packages (entry points) or a file (``--plugin FILE.py``).

A file has one or more of these dicts by name; a package has entry points of the same kinds, as ``ufmstar.readers``:

- ``READERS``: with ``detect(path)``, ``read(path, options)`` and ``LOOKED_FOR``, like the modules of this package;
- ``METHODS``: callables of a row and a device that return an ``Estimator``; in suites "NAME-Ensemble", ...;
- ``METRICS``: classes of ``SumMetric``, whose scalars become columns.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import entry_points
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

_NEEDED = {"readers": ("detect", "read", "LOOKED_FOR"), "methods": ("__call__",), "metrics": ("add", "compute")}


@dataclass(frozen=True)
class Plugins:
    """Plugged-in readers, methods and metrics, by name."""

    readers: Mapping[str, Any] = field(default_factory=dict)
    methods: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, Any] = field(default_factory=dict)


def load_plugins(files: Sequence[str] = ()) -> Plugins:
    """The plug-ins of installed packages and of files, which are executed once per process.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a file has no plug-in, a name occurs twice, or an object lacks an attribute of its kind.
    """
    return _load(tuple(str(Path(file).resolve()) for file in files))


@cache
def _load(files: tuple[str, ...]) -> Plugins:
    loaded: dict[str, dict[str, Any]] = {kind: {} for kind in _NEEDED}
    for kind in _NEEDED:
        for point in entry_points(group=f"ufmstar.{kind}"):
            _add(loaded[kind], kind, point.name, point.load(), f"the entry point {point.value}")
    for file in files:
        module, count = _module(Path(file)), sum(map(len, loaded.values()))
        for kind in _NEEDED:
            named = getattr(module, kind.upper(), {})
            if not isinstance(named, Mapping) or not all(isinstance(name, str) for name in named):
                raise ValueError(f"{file}: {kind.upper()} must be a dict by name, got {named!r:.80}")
            for name, value in named.items():
                _add(loaded[kind], kind, name, value, file)
        if sum(map(len, loaded.values())) == count:
            raise ValueError(f"--plugin {file} has none of {', '.join(kind.upper() for kind in _NEEDED)}")
    return Plugins(**loaded)


def _add(by_name: dict[str, Any], kind: str, name: str, value: Any, source: str) -> None:
    missing = [attribute for attribute in _NEEDED[kind] if not hasattr(value, attribute)]
    if missing or name in by_name or not name.isidentifier() or not name.islower():
        why = (
            f"lacks {missing[0]}" if missing else "has that name already" if name in by_name else "needs small letters"
        )
        raise ValueError(f"{source}: {kind}: {name!r} {why}")
    by_name[name] = value


def _module(file: Path) -> ModuleType:
    if not file.is_file():
        raise FileNotFoundError(f"--plugin: no such file: {file}")
    name = f"ufmstar_plugin_{file.stem}"
    spec = spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ValueError(f"--plugin {file}: expected a Python file (*.py)")
    module = module_from_spec(spec)
    sys.modules[name] = module  # needed by dataclasses
    spec.loader.exec_module(module)
    return module
