"""Files that are complete or absent."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO
from uuid import uuid4

_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{12}\.tmp")  # as write_atomic names them


def write_atomic(path: Path, write: Callable[[BinaryIO], object], *, durable: bool = False) -> None:
    """Write a file through a temporary one in the same folder, which then takes its place.

    A full disk, Ctrl-C or a crash in the middle leaves the earlier file, or none. A link stays, the file it leads to is
    replaced. A pipe or device, such as /dev/null, is written to.

    Args:
        path: the file; its folder must exist.
        write: gets the open binary file.
        durable: wait until the disk has it, so that it survives a power cut as well (milliseconds).

    Raises:
        OSError: whatever the file system reports, the temporary file being removed.
    """
    path = Path(os.path.realpath(path))
    special = path.exists() and not path.is_file() and not path.is_dir()
    # Hidden, and in the same file system, as os.replace needs.
    # Named at random: processes on several nodes may share both a folder and an id.
    temporary = path if special else path.with_name(f".{path.name}.{uuid4().hex[:12]}.tmp")
    try:
        try:
            with open(temporary, "wb") as file:
                write(file)
                if durable and not special:
                    file.flush()
                    os.fsync(file.fileno())
        except OSError as error:  # of a full disk neither Python nor NumPy names the file
            raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from error
        if not special:
            os.replace(temporary, path)
    finally:
        if not special:
            temporary.unlink(missing_ok=True)


def remove_temporaries(paths: Iterable[Path]) -> None:
    """Remove those of the files that ``write_atomic`` began and a killed process left."""
    for path in list(paths):
        if _TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)
