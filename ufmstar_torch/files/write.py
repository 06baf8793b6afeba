"""Files written atomically, and locks between processes."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO
from uuid import uuid4

if TYPE_CHECKING:
    from filelock import BaseFileLock

_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{12}\.tmp")  # as write_atomic names them
# Error codes of a file system without locks.
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


def write_atomic(path: Path, write: Callable[[BinaryIO], object], *, durable: bool = False) -> None:
    """Write a temporary file in the same folder, then rename it to ``path``.

    A full disk, Ctrl-C or a crash leaves the previous file, or none. If ``path`` is a link, the link stays and its
    target is replaced. Pipes and devices, such as /dev/null, are written directly.

    Args:
        path: the file; its folder must exist.
        write: writes to the open binary file.
        durable: call fsync, so that the file also survives a power cut (milliseconds).

    Raises:
        OSError: the file system reports an error; the temporary file is removed.
    """
    path = Path(os.path.realpath(path))
    special = path.exists() and not path.is_file() and not path.is_dir()
    # A hidden file in the same file system, as os.replace requires. Its name is random, because processes on several
    # nodes may share both a folder and a process id.
    temporary = path if special else path.with_name(f".{path.name}.{uuid4().hex[:12]}.tmp")
    try:
        try:
            with open(temporary, "wb") as file:
                write(file)
                if durable and not special:
                    file.flush()
                    os.fsync(file.fileno())
        except OSError as error:  # when the disk is full, neither Python nor NumPy names the file
            raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from error
        if not special:
            os.replace(temporary, path)
    finally:
        if not special:
            temporary.unlink(missing_ok=True)


def remove_temporaries(paths: Iterable[Path]) -> None:
    """Remove temporary files of ``write_atomic`` that a killed process left behind."""
    for path in list(paths):
        if _TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)


def hold(path: Path) -> BaseFileLock | None:
    """Lock a file until the lock is released or the process ends in any way. None if another process, or an earlier
    call, holds it. Raises OSError: the file cannot be created, opened or locked."""
    from filelock import FileLock, Timeout

    lock = FileLock(path, thread_local=False, fallback_to_soft=False)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        if not path.exists():  # filelock tries again where a file system, such as /proc, creates no files
            raise FileNotFoundError(errno.ENOENT, "no file can be created there", str(path)) from None
        return None
    except (NotImplementedError, OSError) as error:
        code = error.errno if isinstance(error, OSError) else errno.ENOSYS  # filelock's form of it
        if code not in _NO_LOCKS:
            raise
        text = f"the file system does not support locks ({os.strerror(code)}), choose a folder on another one"
        raise OSError(code, text, str(path)) from error
    return lock
