"""Output folders: the program that owns a folder, its settings, and the lock of the process that writes there.

A folder belongs to a program once it contains the manifest of that program's :class:`FolderKind`. Files of other
programs are never touched, and nothing is written or removed through a symbolic link.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.engine.files import remove_temporaries, to_json, write_json_atomic
from ufmstar_torch.files.limits import read_json
from ufmstar_torch.files.write import hold as hold
from ufmstar_torch.runtime.checked import flat

_SHOWN = 5  # number of differences in a message
_UNFINISHED = "not finished"

Manifest = Mapping[str, Any]


class FolderError(ValueError):
    """The output folder cannot be used; the message names the option that helps."""


@dataclass(frozen=True)
class FolderKind:
    """The output folder of one program."""

    program: str  # as "ufmstar run"; the manifest contains it
    noun: str  # for messages: "run", "evaluation", "training", "demo"
    manifest: str  # path of the manifest below the folder
    files: tuple[str, ...]  # glob patterns of the files of earlier work, without the manifest
    # By pattern, a function that recognises the program's files by their content where a user may have others.
    recognise: Mapping[str, Callable[[Path], bool]] = field(default_factory=dict)
    # Format of the manifest and the other files; None = work cannot be continued, and a summary replaces the manifest
    # at the end.
    format: int | None = None
    lock: str | None = None  # path of the lock file below the folder; None = no lock
    allowed: tuple[str, ...] = ()  # entries that may exist in a folder before its manifest does
    # Glob patterns below the folder of temporary files of a killed process.
    temporary: tuple[str, ...] = (".*.tmp",)
    # (manifest, other manifest) -> the values of the first that must not change.
    identity: Callable[[Manifest, Manifest], Manifest] = lambda manifest, _: manifest["identity"]
    # (manifest in the folder, new manifest) -> the manifest to write.
    merge: Callable[[Manifest, Manifest], Manifest] = lambda earlier, _: earlier

    def read_manifest(self, out: Path) -> dict[str, Any]:
        """The manifest of a folder. Raises FolderError: it is damaged, or of another program or format."""
        path = out / self.manifest
        try:
            manifest = read_json(path)
            if manifest["program"] != self.program or manifest["format"] != self.format:
                raise ValueError(f"made by {manifest['program']}, format {manifest['format']}")
            return dict(manifest)
        except (ValueError, KeyError, TypeError) as error:
            article = "an" if self.noun[0] in "aeiou" else "a"
            raise FolderError(f"{path} is not {article} {self.noun}'s ({error}); --overwrite starts again") from error

    def earlier(self, out: Path, *, overwrite: bool) -> bool:
        """True if the folder contains earlier work of the program. Raises FolderError: ``out`` is a file, or contains
        files of other programs, or finished work that cannot be continued and shall not be replaced."""
        if out.exists() and not out.is_dir():
            raise FolderError(f"--out {out} is a file, expected a folder")
        ours, state = (out / self.manifest).is_file(), ""
        if ours and self.format is None:
            try:
                content = read_json(out / self.manifest)
            except (OSError, ValueError):
                content = None
            ours = isinstance(content, dict) and content.get("program") == self.program
            state = content.get("state", "") if ours else ""
        if not ours:
            if out.is_dir() and any(self._foreign(out)):
                raise FolderError(f"--out {out} holds files of someone else: choose an empty or a new folder")
            return False
        if self.format is None and not overwrite and state != _UNFINISHED:
            raise FolderError(f"--out {out} holds an earlier {self.noun}: --overwrite replaces it")
        return True

    def clear(self, out: Path) -> None:
        """Remove the files of earlier work, and the folders that are empty then."""
        folders = set[Path]()
        for pattern in self.files:
            ours = self.recognise.get(pattern, lambda _: True)
            for path in [path for path in out.glob(pattern) if path.is_file() and ours(path)]:
                path.unlink()
                folders |= set(path.parents[: len(path.relative_to(out).parents) - 1])
        for folder in sorted(folders, key=lambda path: -len(path.parts)):
            with suppress(OSError):  # files of others remain in it
                folder.rmdir()

    def require_no_links(self, out: Path) -> None:
        """Raises FolderError: a file or folder below ``out`` to which the program writes is a symbolic link."""
        for name in (self.manifest, *filter(None, [self.lock]), *self.files):
            parts = Path(name).parts
            for pattern in (str(Path(*parts[:length])) for length in range(1, len(parts) + 1)):
                # glob omits links to nothing where a pattern has no wildcard
                for path in (out / pattern, *out.glob(pattern)):
                    if path.is_symlink():
                        text = (
                            "is a symbolic link, through which nothing is written: remove it or choose another folder"
                        )
                        raise FolderError(f"--out {out}: {path.relative_to(out)} {text}")

    def _foreign(self, out: Path) -> list[Path]:
        """Entries other than those of a process that was killed before it wrote the manifest."""
        manifest = out / self.manifest
        expected = {manifest, manifest.parent, *(out / name for name in self.allowed)}
        expected |= set() if self.lock is None else {out / self.lock}
        entries = [path for folder in {out, manifest.parent} if folder.is_dir() for path in folder.iterdir()]
        return [path for path in entries if path not in expected and not path.name.startswith(f".{manifest.name}.")]


@contextmanager
def output_folder(out: Path, kind: FolderKind, content: Manifest, *, overwrite: bool = False) -> Iterator[None]:
    """Prepare a folder for new work, and hold its lock. Earlier work with the same values continues: its files stay.
    ``overwrite`` removes them.

    Args:
        out: created if missing.
        kind: of the folder.
        content: of the manifest, without program and format.

    Raises:
        FolderError: as :meth:`FolderKind.earlier`; or the earlier work has other values (the message names them), or
            another process holds the folder's lock, or a link is in the way.
        OSError: the folder cannot be made or locked.
    """
    kind.earlier(out, overwrite=overwrite)
    kind.require_no_links(out)
    (out / kind.manifest).parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as locks:
        if kind.lock is not None:
            lock = hold(out / kind.lock)
            if lock is None:
                raise FolderError(f"--out {out}: another {kind.noun} is writing there now")
            locks.callback(lock.release)
        # Check again, because another process may have created the folder while this one waited.
        continued = kind.earlier(out, overwrite=overwrite) and not overwrite and kind.format is not None
        for pattern in kind.temporary:
            remove_temporaries(out.glob(pattern))
        started = {"state": _UNFINISHED} if kind.format is None else {"format": kind.format}
        manifest: dict[str, Any] = to_json({"program": kind.program, **started, **content})
        if continued:
            earlier = kind.read_manifest(out)
            try:
                changed = differences(kind.identity(earlier, manifest), kind.identity(manifest, earlier))
            except (LookupError, TypeError, AttributeError) as error:
                raise FolderError(f"{out / kind.manifest} is damaged ({error!r}); --overwrite starts again") from error
            if changed:
                text = f"the {kind.noun} in {out} was started with other input: {changed}"
                raise FolderError(f"{text}; --overwrite replaces it")
            manifest = dict(kind.merge(earlier, manifest))
        if not continued:
            kind.clear(out)
        if not continued or manifest != earlier:
            write_json_atomic(out / kind.manifest, manifest)
        yield


def differences(old: Manifest, new: Manifest) -> str:
    """The differences between two nested mappings of plain values, by dotted names; "" if they are equal."""
    before, after = flat(old), flat(new)
    changed = [key for key in sorted(before.keys() | after.keys()) if before.get(key) != after.get(key)]
    text = "; ".join(f"{key} was {_short(before.get(key))}, now {_short(after.get(key))}" for key in changed[:_SHOWN])
    return text + (f" and {len(changed) - _SHOWN} more" if len(changed) > _SHOWN else "")


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:16] + '..."'
