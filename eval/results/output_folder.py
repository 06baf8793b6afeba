"""What every program that fills an output folder needs: whose it is, who writes there now, what differs."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

_SHOWN = 5  # values that are named in a message
_POLL_SECONDS = 0.02


class FolderError(ValueError):
    """The output folder cannot be used as asked; the message says what to do."""


def hold(path: Path, *, wait: float = 0.0) -> BinaryIO | None:
    """Hold a lock file; the hold goes with the process, however it ends.

    On a network file system the lock holds between computers if it passes on ``flock``, as NFS does. Where the system
    has no such locks (not POSIX), nothing is held back.

    Args:
        path: created if missing, its content is kept; its folder must exist.
        wait: longest time [s] to wait for another holder.

    Returns:
        The open file, which closing releases; None where another process (or an earlier call) holds it.

    Raises:
        OSError: the file cannot be opened, or the file system has no locks.
    """
    file = path.open("a+b")
    try:
        import fcntl
    except ImportError:  # not a POSIX system: no lock
        return file
    end = time.monotonic() + wait
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= end:
                file.close()
                return None
            time.sleep(_POLL_SECONDS)
        except OSError as error:
            file.close()
            told = f"the file system knows no locks (flock: {error.strerror}), choose a folder on another one"
            raise OSError(error.errno, told, str(path)) from error
        else:
            return file


def differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """What differs between two nested mappings of plain values, by dotted names; "" if nothing does."""
    before, after = flatten(then), flatten(now)
    changed = [key for key in sorted(before.keys() | after.keys()) if before.get(key) != after.get(key)]
    told = "; ".join(f"{key} was {_shown(before.get(key))}, now {_shown(after.get(key))}" for key in changed[:_SHOWN])
    return told + (f" and {len(changed) - _SHOWN} more" if len(changed) > _SHOWN else "")


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings and lists of them as one level, with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, list) and value and isinstance(value[0], Mapping):
            value = {str(i): item for i, item in enumerate(value)}
        flat |= flatten(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:16] + '..."'
