"""The file of a live model's state."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from ufmstar_torch.files.read import read_tensors
from ufmstar_torch.files.write import hold, remove_temporaries, write_atomic
from ufmstar_torch.uncertain_depth import UncertainDepth


class StateFile:
    """The file of a model's stream state, which one process at a time writes. The model continues from it if it exists.

    Raises:
        FileNotFoundError, IsADirectoryError: the folder does not exist, or ``file`` is one.
        ValueError: another process writes the file, or the model cannot continue from it, and is unchanged.
    """

    def __init__(self, file: Path, model: UncertainDepth) -> None:
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
                self._load(model)
        except BaseException:
            lock.release()
            raise

    def _load(self, model: UncertainDepth) -> None:
        try:
            with self._file.open("rb") as opened:
                state = read_tensors(opened, "it")
            model.load_stream_state(state)
        except (RuntimeError, TypeError, ValueError, OSError) as error:
            text = f"state {self._file} cannot be continued: {error}. Delete the file, or name another one, to begin"
            raise ValueError(f"{text} anew") from error

    def save(self, model: UncertainDepth) -> None:
        """Write the model's state atomically."""
        values = model.stream_state()
        write_atomic(self._file, lambda file: torch.save(values, file))

    def release(self) -> None:
        """Let other processes write the file."""
        self._lock.release()
