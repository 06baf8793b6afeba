"""Files that are complete or absent: atomic writes and strict JSON."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO
from uuid import uuid4

import numpy as np
import torch

_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{12}\.tmp")  # as write_together names them


def write_atomic(path: Path, write: Callable[[BinaryIO], object], *, durable: bool = False) -> None:
    """Write a file through a temporary one in the same folder, which then takes its place.

    A full disk, Ctrl-C or a crash in the middle leaves the earlier file, or none.

    Args:
        path: the file; its folder must exist.
        write: gets the open binary file.
        durable: wait until the disk has it, so that it survives a power cut as well (milliseconds).

    Raises:
        OSError: whatever the file system reports, the temporary file being removed.
    """
    write_together({path: write}, durable=durable)


def write_together(files: Mapping[Path, Callable[[BinaryIO], object]], *, durable: bool = False) -> None:
    """``write_atomic`` for files that belong together: none takes its place before all are written.

    They do so in the order given: where the last one exists, all do. A link stays, the file it leads to is replaced. A
    pipe or device, such as /dev/null, is written to.
    """
    targets = {Path(os.path.realpath(path)): write for path, write in files.items()}
    special = {path for path in targets if path.exists() and not path.is_file() and not path.is_dir()}
    # Hidden, and in the same file system, as os.replace needs.
    # Named at random: processes on several nodes may share both a folder and an id.
    temporary = {p: p.with_name(f".{p.name}.{uuid4().hex[:12]}.tmp") for p in targets if p not in special}
    try:
        for path, write in targets.items():
            with open(temporary.get(path, path), "wb") as file:
                write(file)
                if durable and path not in special:
                    file.flush()
                    os.fsync(file.fileno())
        for path, written in temporary.items():
            os.replace(written, path)
    finally:
        for left in temporary.values():
            left.unlink(missing_ok=True)


def remove_temporaries(paths: Iterable[Path]) -> None:
    """Remove those of the files that ``write_together`` began and a killed process left."""
    for path in list(paths):
        if _TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)


def write_json_atomic(path: Path, data: Mapping[str, Any]) -> None:
    """Write strict JSON (NaN and infinities become null) atomically and durably: mappings, sequences, dataclasses,
    NumPy arrays, tensors, paths, and plain values.

    Raises:
        TypeError: a value has no JSON form; the message names its place.
        OSError: see ``write_atomic``.
    """
    text = json.dumps(to_json(data), indent=2, allow_nan=False) + "\n"
    write_atomic(path, lambda file: file.write(text.encode()), durable=True)


def to_json(value: Any, where: str = "data") -> Any:
    """The value as dict, list, str, int, float, bool or None, with None for NaN and infinities. Raises TypeError: the
    value, or one inside it, has no JSON form."""
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_json(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item, f"{where}[{i}]") for i, item in enumerate(value)]
    raise TypeError(f"{where} must have a JSON form (number, text, list, mapping, ...), got {type(value).__name__}")
