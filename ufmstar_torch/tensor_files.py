"""Reading untrusted files of ``torch.save``: tensors and plain values only, so that they cannot run code."""

from __future__ import annotations

import pickle
import struct
from pathlib import Path
from typing import Any, BinaryIO

import torch

# Files of torch.save begin with these bytes: a zip archive, or (before torch 1.6) a pickled magic number.
_BEGINNINGS = (b"PK\x03\x04", b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.")
# Exceptions, not documented, of the restricted unpickler on damaged bytes.
DAMAGE = (EOFError, LookupError, OSError, RuntimeError, TypeError, ValueError, AttributeError, AssertionError)


class CheckpointError(ValueError):
    """A file of weights is damaged, has other content, or does not fit the network; the message names the file."""


def read_tensors(file: BinaryIO, name: str | Path) -> Any:
    """The content of an open file of ``torch.save``, without running code from it. Raises CheckpointError: it is
    damaged, or holds more than tensors and plain values; the message contains ``name``."""
    beginning = file.read(max(map(len, _BEGINNINGS)))
    if not beginning.startswith(_BEGINNINGS):
        raise CheckpointError(f"{name} is damaged or not a file of torch.save: it begins with {beginning[:8]!r}")
    file.seek(0)
    try:
        return torch.load(file, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"{name} is damaged or holds pickled Python objects (a whole module?), which are never loaded because "
            "they can run code; save the module's state_dict() with the program that made it, and load that"
        ) from error
    except (*DAMAGE, struct.error) as error:
        raise CheckpointError(f"{name} is damaged or not a file of torch.save: {error}") from error
