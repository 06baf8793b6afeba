"""Files that are complete or absent."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import BinaryIO
from uuid import uuid4

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
            try:
                with open(temporary.get(path, path), "wb") as file:
                    write(file)
                    if durable and path not in special:
                        file.flush()
                        os.fsync(file.fileno())
            except OSError as error:  # of a full disk neither Python nor NumPy names the file
                raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from error
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
