"""Reading untrusted .npy and .npz files: errors name the damaged file, and allocations are bounded."""

from __future__ import annotations

import lzma
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from math import prod
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

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
