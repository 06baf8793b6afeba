"""Claims: which process works on a part of an output folder now.

A claim is a file that its process creates exclusively (``O_EXCL``), so that it needs no locks, which NFS mounted with
``nolock`` grants to every computer at once. The file names the process and is touched while the process lives. Claims
of one place are numbered, and the highest number counts: whoever takes over from a dead process creates the next
number, which only one process can do. A released claim stays until the next one replaces it.
"""

from __future__ import annotations

import json
import os
import socket
import tempfile
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

PATTERN = ".claim*"
# How often a living process touches its claim, and the age at which the claim of a process on another computer counts
# as abandoned. NFS may report attributes that are 60 s old.
_BEAT_SECONDS, ABANDONED_SECONDS = 20.0, 180.0
_RELEASED = {"released": True}


class Claim:
    """A place that this process works on, until :meth:`release` or the end of a ``with`` block.

    Attributes:
        path: the file.
        died: whether a process of the same launch held the place before and ended without a release.
    """

    def __init__(self, path: Path, *, died: bool) -> None:
        self.path, self.died = path, died
        self._over = threading.Event()
        threading.Thread(target=self._beat, daemon=True).start()

    def release(self) -> None:
        """End the claim in good order."""
        self._over.set()
        self.path.write_text(json.dumps(_RELEASED))

    def __enter__(self) -> Claim:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def _beat(self) -> None:
        while not self._over.wait(_BEAT_SECONDS):
            try:
                os.utime(self.path)
            except OSError:  # the folder was removed, or cannot be reached now
                continue


def claim(place: Path, launch: str) -> Claim | None:
    """Claim a place, an existing folder; None while another process, or an earlier call, has it. ``launch`` is the same
    for all processes that were started together. Raises OSError: the folder cannot be written."""
    last, died = _last(place), False
    if last is not None:
        holder = _read(last)
        if holder != _RELEASED:
            if _holds(last, holder):
                return None
            died = holder is not None and holder.get("launch") == launch
    own = place / f".claim-{_number(last) + 1:06}"
    try:
        file = os.open(own, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
    except FileExistsError:
        return None
    with open(file, "w", encoding="utf-8") as text:
        json.dump({**_this_process(), "launch": launch}, text)
    # A listing of a network file system may be older than a claim that was made and replaced meanwhile.
    if _last(place) != own:
        own.unlink(missing_ok=True)
        return None
    for path in list(place.glob(PATTERN)):
        if path != own:
            path.unlink(missing_ok=True)
    return Claim(own, died=died)


def _last(place: Path) -> Path | None:
    """The claim that counts."""
    return max(place.glob(".claim-*"), key=_number, default=None)


def _number(path: Path | None) -> int:
    digits = "" if path is None else path.name.removeprefix(".claim-")
    return int(digits) if digits.isdecimal() else 0


def _read(path: Path) -> dict[str, Any] | None:
    """The content of a claim; None if it is not written yet, or replaced meanwhile."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def _holds(path: Path, holder: dict[str, Any] | None) -> bool:
    """Whether the process behind a claim may still be alive."""
    this = _this_process()
    if os.name == "posix" and holder is not None and holder.get("host") == this["host"]:
        try:
            with suppress(PermissionError):  # a process of another user
                os.kill(int(holder["pid"]), 0)
        except ProcessLookupError:
            return False
        now, then = _started(int(holder["pid"])), holder.get("started")
        return now is None or then is None or now == then
    try:
        with tempfile.TemporaryFile(dir=path.parent) as new:  # the clock of the file system, not of this computer
            return os.fstat(new.fileno()).st_mtime - path.stat().st_mtime < ABANDONED_SECONDS
    except FileNotFoundError:
        return True  # replaced meanwhile


def _this_process() -> dict[str, Any]:
    """Computer, process and the time at which it started: together they name a process once."""
    # Containers share a computer but not its process numbers; computers may share a name but not a boot.
    boot, namespace = Path("/proc/sys/kernel/random/boot_id"), Path("/proc/self/ns/pid")
    parts = [socket.gethostname()]
    with suppress(OSError):  # only Linux has them
        parts += [boot.read_text().strip(), os.readlink(namespace)]
    return {"host": " ".join(parts), "pid": os.getpid(), "started": _started(os.getpid())}


def _started(pid: int) -> str | None:
    """When a process started [clock ticks since boot], "ended" for one that has ended; None where Linux is not."""
    try:
        # The name, in parentheses, may contain anything.
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return "ended" if fields[0] in ("Z", "X") else fields[19]
