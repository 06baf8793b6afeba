"""Reading untrusted files of ``torch.save``: tensors and plain values only, so that they cannot run code."""

from __future__ import annotations

import pickle
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO
from zipfile import ZIP_STORED, BadZipFile, ZipFile, is_zipfile

import torch
from torch import Tensor

from ufmstar_torch.files.limits import require_bytes

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
        _require_plain_archive(file)
        content = torch.load(file, map_location="cpu", weights_only=True)
        _require_stored(content)
        return content
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"{name} is damaged or holds pickled Python objects (a whole module?), which are never loaded because "
            "they can run code; save the module's state_dict() with the program that made it, and load that"
        ) from error
    except (*DAMAGE, BadZipFile, struct.error) as error:
        raise CheckpointError(f"{name} is damaged or not a file of torch.save: {error}") from error


def _require_plain_archive(file: BinaryIO) -> None:
    """Raises ValueError: an archive has compressed files, which may expand without limit; ``torch.save`` writes none.
    The file's position does not change."""
    if is_zipfile(file):
        with ZipFile(file) as archive:
            if any(entry.compress_type != ZIP_STORED for entry in archive.infolist()):
                raise ValueError("it has compressed files, which torch.save does not write")
    file.seek(0)


def _require_stored(content: Any) -> None:
    """Raises ValueError: a tensor, in nested plain values, repeats its stored values up to more than the limit."""
    if isinstance(content, Tensor):
        stated = content.numel() * content.element_size()
        if content.layout == torch.strided and stated > content.untyped_storage().nbytes():
            require_bytes(f"a tensor {list(content.shape)} that repeats its stored values", stated)
    elif isinstance(content, Mapping):
        for value in content.values():
            _require_stored(value)
    elif isinstance(content, list | tuple):
        for value in content:
            _require_stored(value)
