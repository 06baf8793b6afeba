"""``ufmstar rank``: statistics of every image's variance and its parts, and pictures of both ends of the ranking."""

from __future__ import annotations

from bisect import insort
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch.eval.engine.judge import UFM
from ufmstar_torch.eval.engine.predictions import FramePredictions
from ufmstar_torch.eval.engine.stream import FrameResult
from ufmstar_torch.eval.run.job import RunJob
from ufmstar_torch.eval.run.panels import FramePanel
from ufmstar_torch.eval.run.pictures import panel_of
from ufmstar_torch.eval.sequences.frame import FrameError
from ufmstar_torch.frames.choose import choose
from ufmstar_torch.steps.sample import sample_statistics

# The quantities for ranking, V, M, A, E and B, and their maps.
PARTS = {
    "total": "variance", "disagreement": "disagreement", "aleatoric": "aleatoric", "epistemic": "epistemic",
    "anchored": "anchored",
}  # fmt: skip
_COMPARED = ("total", "disagreement")  # need other views
_PICTURES = 3  # at each end of the ranking
_LETTERS = 20  # largest number of letters of a sequence's name next to a picture
_UNITS = {"mean": "m2", "variance": "m4", "median": "m2", "maximum": "m2"}


@dataclass(frozen=True, eq=False)
class RankedImage:
    """An image: its line of scores.csv without the rank, its score [m^2] (NaN = none), pose [4, 4] and median depth
    [m]."""

    line: dict[str, Any]
    score: float
    T_world_cam: NDArray[np.float64]
    depth: float


class ImageScores:
    """Scores the ``images`` of sequences, in the order of processing.

    Args:
        by: a name of ``PARTS``, whose mean over the pixels is the score; with ``unmeasured="nan"`` in the config, over
            the measured pixels for V and M.
        measured: smallest share of pixels seen from two places for an image to be ranked by V or M.
    """

    sequence = ""  # name of the current sequence in scores.csv

    def __init__(self, by: str, measured: float) -> None:
        self._by, self._measured = by, measured if by in _COMPARED else 0.0
        self.images: list[RankedImage] = []
        self._shown: list[tuple[float, int, FramePanel]] = []  # score, number of the image, picture

    def add(self, result: FrameResult) -> None:
        """Score an image."""
        row = result.rows.get(UFM)
        if row is None or result.frame is None:
            return
        parts = {}
        for name, of in PARTS.items():
            if (values := row.map(of)) is not None:
                masked = torch.where(row.valid, values, torch.nan).flatten()[None]
                parts[name] = {key: float(value) for key, value in asdict(sample_statistics(masked)).items()}
        measured = row.map("measured")
        assert measured is not None
        share = float((measured >= 0.5)[row.valid].float().mean())
        score = parts[self._by]["mean"] if share >= self._measured else float("nan")
        columns = {f"{n}_{key}_{unit}": one[key] for n, one in parts.items() for key, unit in _UNITS.items()}
        line = {"sequence": self.sequence, "frame": result.name, "measured": share, **columns}
        depth = float(row.depth[row.valid].median()) if bool(row.valid.any()) else float("nan")
        self.images.append(RankedImage(line, score, row.T_world_cam, depth))
        if score == score and result.frame.image is not None:
            name = Path(self.sequence).name
            name = name if len(name) <= _LETTERS else f"…{name[1 - _LETTERS :]}"
            note = f"{name}, {self._by}, {score**0.5:.3g} m"
            insort(self._shown, (score, len(self.images), panel_of(result.name, note, result.frame, row)))
            if len(self._shown) > 2 * _PICTURES:
                del self._shown[_PICTURES]

    def chosen(self, count: int | None, *, diverse: bool) -> list[int]:
        """Indices of the images to label, in the order of labelling (``ufmstar_torch.frames.choose``)."""
        score = torch.tensor([image.score for image in self.images], dtype=torch.float64)
        count = None if count is None else min(count, len(score))
        if not diverse or bool(score.isnan().all()):
            return choose(score, count)
        poses = torch.from_numpy(np.stack([image.T_world_cam for image in self.images]))
        distance = float(np.nanmedian([image.depth for image in self.images]))
        sequences = [image.line["sequence"] for image in self.images]
        return choose(score, count, poses=poses, distance=distance, sequences=sequences)

    def panels(self) -> Sequence[FramePanel]:
        """The least and the most certain images, from the least certain one on."""
        return [panel for _, _, panel in reversed(self._shown)]


def require_part(job: RunJob, by: str) -> None:
    """Raises ValueError: the prediction of the first readable frame has no part to rank ``by``."""
    if by == "anchored" and job.config.anchors is None:
        raise ValueError("--by anchored needs --anchors")
    for index in job.indices if by in ("aleatoric", "epistemic") else ():
        try:
            prediction = FramePredictions(job.sequence[index], torch.device("cpu"), None, "").of(
                job.source, 0, job.every
            )
        except FrameError:
            continue
        if {"aleatoric": prediction.aleatoric_variance, "epistemic": prediction.epistemic_variance}[by] is None:
            source = "the network states" if job.source.networks else "the depth comes with"
            raise ValueError(f"--by {by}: {source} no {by} variance")
        return
