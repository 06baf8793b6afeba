"""The file of a live model's state."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from ufmstar_torch.files.read import read_tensors
from ufmstar_torch.files.write import hold, remove_temporaries, write_atomic


class StateFile:
    """The file of a model's stream state, which one process at a time writes.

    Args:
        file: if it exists, the model continues from it.
        load: ``load_stream_state`` of the model.

    Raises:
        FileNotFoundError, IsADirectoryError: the folder does not exist, or ``file`` is one.
        ValueError: another process writes the file, or the model cannot continue from it, and is unchanged.
    """

    def __init__(self, file: Path, load: Callable[[dict[str, Any]], object]) -> None:
        if not file.parent.is_dir():
            raise FileNotFoundError(f"state: no such folder: {file.parent}")
        if file.is_dir():
            raise IsADirectoryError(f"state must be a file, got the folder {file}")
        self._file, target = file, Path(os.path.realpath(file))
        lock = hold(target.with_name(f".{target.name}.lock"))
        if lock is None:
            raise ValueError(f"state: another process is writing {file}: each needs a file of its own")
        self._lock = lock
        try:  # temporary files of a killed process go
            remove_temporaries(path for path in target.parent.iterdir() if path.name.startswith(f".{target.name}."))
            if file.exists():
                self._load(load)
        except BaseException:
            lock.release()
            raise

    def _load(self, load: Callable[[dict[str, Any]], object]) -> None:
        try:
            with self._file.open("rb") as opened:
                state = read_tensors(opened, "it")
            load(state)
        except (RuntimeError, TypeError, ValueError, OSError) as error:
            text = f"state {self._file} cannot be continued: {error}. Delete the file, or name another one, to begin"
            raise ValueError(f"{text} anew") from error

    def save(self, state: dict[str, Any]) -> None:
        """Write a state atomically."""
        write_atomic(self._file, lambda file: torch.save(state, file))

    def release(self) -> None:
        """Let other processes write the file."""
        self._lock.release()
