"""Strict JSON, and atomic writing of files (``ufmstar_torch.files.write``)."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ufmstar_torch.files.write import remove_temporaries as remove_temporaries
from ufmstar_torch.files.write import write_atomic as write_atomic


def write_bytes_atomic(path: Path, content: bytes) -> None:
    """Write a file; see ``write_atomic``."""
    write_atomic(path, lambda file: file.write(content))


def write_json_atomic(path: Path, data: Mapping[str, Any]) -> None:
    """Write strict JSON (NaN and infinities become null) atomically and durably. Raises TypeError: a value has no JSON
    form; OSError: see ``write_atomic``."""
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
