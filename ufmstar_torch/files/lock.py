"""Locks of files between processes."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from filelock import BaseFileLock

_POLL_SECONDS = 0.02
# Error codes of a file system without locks.
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


def hold(path: Path, *, wait: float = 0.0) -> BaseFileLock | None:
    """Lock a file until the lock is released or the process ends in any way. None if another process, or an earlier
    call, holds it for more than ``wait`` [s]. Raises OSError: the file cannot be opened or locked."""
    from filelock import FileLock, Timeout

    lock = FileLock(path, thread_local=False, fallback_to_soft=False)
    try:
        lock.acquire(timeout=wait, poll_interval=_POLL_SECONDS)
    except Timeout:
        return None
    except (NotImplementedError, OSError) as error:
        code = error.errno if isinstance(error, OSError) else errno.ENOSYS  # filelock's form of it
        if code not in _NO_LOCKS:
            raise
        text = f"the file system does not support locks ({os.strerror(code)}), choose a folder on another one"
        raise OSError(code, text, str(path)) from error
    return lock
