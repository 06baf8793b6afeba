"""Predictions on disk, so that a network sees an image once."""

from __future__ import annotations

from pathlib import Path


class PredictionCache:
    """Files of predictions.

    Args:
        folder: where; None = keep nothing.
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self.hits = self.misses = self.damaged = 0
