"""Files of strangers, read without running code; errors name the damaged file, and allocations are bounded."""

from __future__ import annotations

import lzma
import pickle
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Any, BinaryIO, cast
from zipfile import ZIP_STORED, BadZipFile, ZipFile, is_zipfile

import numpy as np
import torch
from numpy.lib import format as npy
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.files.limits import require_bytes

# The errors that NumPy, zipfile and its decompressors raise for damaged files (found by changing every byte).
_DAMAGED = (
    *(OSError, EOFError, ValueError, TypeError, LookupError, ArithmeticError, RuntimeError, SyntaxError, MemoryError),
    *(struct.error, tokenize.TokenError, zlib.error, lzma.LZMAError, zipfile.BadZipFile),
)


def read_npy(path: str | Path, *, mapped: bool = False) -> NDArray[Any]:
    """Read a .npy file without unpickling.

    Args:
        path: the file.
        mapped: map the file into memory, read-only and of any size, instead of reading it.

    Raises:
        OSError: the file cannot be opened.
        ValueError: the file is damaged, or its header states more data than the file holds or than ``MOST_BYTES``;
            the message names the file.
    """
    with Path(path).open("rb") as file:
        try:
            if mapped:
                return np.load(path, mmap_mode="r", allow_pickle=False)
            return _array(file, Path(path).stat().st_size)
        except _DAMAGED as error:
            raise ValueError(f"{path} is no readable .npy file: {error}") from error


def read_npz(path: str | Path, names: Sequence[str], *, or_single: bool = False) -> list[NDArray[Any]]:
    """Read the arrays ``names`` of a .npz file; with ``or_single``, a file's only array may have any name. Errors as
    :func:`read_npy`; also ValueError: an array is not in the file."""
    with Path(path).open("rb") as file:
        return list(_arrays(file, path, names, or_single=or_single).values())


def read_npz_whole(path: str | Path) -> dict[str, NDArray[Any]]:
    """Read all arrays of a .npz file by name, together at most ``MOST_BYTES``. Errors as :func:`read_npy`."""
    with Path(path).open("rb") as file:
        return _arrays(file, path)


def _arrays(
    file: BinaryIO, path: str | Path, names: Sequence[str] | None = None, *, or_single: bool = False
) -> dict[str, NDArray[Any]]:
    try:
        with zipfile.ZipFile(file) as archive:
            members = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            if names is None or (or_single and len(members) == 1):
                names = list(members)
            if missing := [name for name in names if name not in members]:
                raise ValueError(f"expected the arrays {', '.join(missing)}, got {', '.join(sorted(members))}")
            require_bytes("its arrays", sum(members[name].file_size for name in names))
            arrays = {}
            for name in names:
                with archive.open(members[name]) as member:  # reads at most file_size decompressed bytes
                    arrays[name] = _array(cast(BinaryIO, member), members[name].file_size)
            return arrays
    except _DAMAGED as error:
        raise ValueError(f"{path} is no readable .npz file: {error}") from error


def _array(file: BinaryIO, size: int) -> NDArray[Any]:
    """Read an open .npy file of ``size`` bytes after checking the size that its header states."""
    version = npy.read_magic(file)
    header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = header(file)
    stated = prod(shape) * dtype.itemsize
    require_bytes(f"an array {list(shape)} of {dtype}", stated)
    if min(shape, default=0) < 0 or not 0 <= stated <= size - file.tell():
        raise ValueError(f"its header states {list(shape)} values of {dtype}; it holds {size:,} bytes")
    file.seek(0)
    array: NDArray[Any] = npy.read_array(file, allow_pickle=False)
    return array


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
