"""Predictions on disk, so that a network sees an image once, however often the rows on it are changed.

One npz for each network, frame and member, ``NETWORK/SEQUENCE/FRAME@MEMBER.npz``, with the maps in float32. A file that
was changed or cut off is not used.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from ufmstar_torch.array_files import read_npz_whole
from ufmstar_torch.eval.engine.predictions import Predicted
from ufmstar_torch.eval.run.files import write_atomic
from ufmstar_torch.prediction import DepthPrediction

# Names of the maps in a file, and in a ``DepthPrediction``.
_MAPS = {
    "depth": "depth",
    "aleatoric": "aleatoric_variance",
    "epistemic": "epistemic_variance",
    "confidence": "confidence",
}


class CacheError(Exception):
    """The folder cannot be used; the message names it and the reason."""


class PredictionCache:
    """A ``PredictionStore`` in files. Several processes may use one folder: a file is whole or absent, and processes
    that write the same file write the same content.

    Args:
        folder: made if it does not exist.

    Raises:
        CacheError: the folder cannot be made or written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        # Tried by writing: permissions say nothing about file systems that are mounted read-only.
        self._write(Path(".writable"), lambda opened: opened.write(b""))

    def load(self, path: Path, content: str, device: torch.device) -> Predicted | None:
        """The prediction, or None where it has to be made: there is no file, it belongs to another image of that name,
        was cut off or changed, or cannot be read."""
        try:
            arrays = read_npz_whole(self.folder / path)
        except (OSError, ValueError):
            return None
        if bytes(arrays.pop("content")).decode() != content:
            return None
        K = torch.from_numpy(arrays.pop("intrinsics"))
        maps = {_MAPS[name]: torch.from_numpy(value)[None].to(device) for name, value in arrays.items()}
        return Predicted(DepthPrediction(**maps), K[None])

    def store(self, path: Path, content: str, predicted: Predicted) -> None:
        """Keep a prediction. Raises CacheError: it cannot be written."""
        named = {name: getattr(predicted.maps, field) for name, field in _MAPS.items()}
        arrays = {name: value[0].cpu().numpy() for name, value in named.items() if value is not None}
        arrays["intrinsics"] = predicted.intrinsics[0].numpy()
        arrays["content"] = np.frombuffer(content.encode(), np.uint8)
        self._write(path, lambda opened: np.savez(opened, allow_pickle=False, **arrays))

    def _write(self, path: Path, write: Callable[[BinaryIO], object]) -> None:
        file = self.folder / path
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(file, write)
        except OSError as error:
            raise CacheError(
                f"the cache of predictions cannot be written to {self.folder} ({error}): choose another folder, or none"
            ) from error
