"""The loop over frames: read, predict, update every row.

``ufmstar run`` writes the results of one row, ``ufmstar eval`` judges those of a suite's rows, ``ufmstar rank`` scores
those of one row on many sequences.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch.anchors.names import CORNERS, DENSE
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.engine.predictions import FramePredictions, PredictionCache, sequence_digest
from ufmstar_torch.eval.engine.progress import Progress, timed
from ufmstar_torch.eval.engine.rows import RowResult, RowRunner
from ufmstar_torch.eval.engine.threads import read_ahead
from ufmstar_torch.eval.sequences.frame import Frame, FrameError, FrameSequence, Size
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.frames.frame import FRAME_FAULTS
from ufmstar_torch.frames.prediction import DepthPrediction

_CPU = torch.device("cpu")


class Stopped(Exception):
    """The caller asked to stop, between two frames."""


@dataclass(frozen=True, eq=False)
class FrameResult:
    """The result of one frame."""

    number: int  # of the frame in the stream, from 0
    index: int  # of the frame in its sequence
    name: str  # of the frame
    frame: Frame | None = None  # None if no row selects it, or it cannot be used
    rows: Mapping[str, RowResult] = field(default_factory=dict)  # by key, of the rows that used the frame
    skipped: Mapping[str, str] = field(default_factory=dict)  # by key of a row that selects it, why it cannot be used
    # [ms]: "read" (the wait for the thread that reads ahead), "predict", "truth", "cycle" (since the previous result).
    ms: Mapping[str, float] = field(default_factory=dict)


def frame_results(
    sequence: FrameSequence,
    indices: Sequence[int],
    rows: Sequence[RowRunner],
    *,
    cache: PredictionCache | None = None,
    device: torch.device = _CPU,
    stop: Callable[[], bool] = lambda: False,
) -> Generator[FrameResult]:
    """Yield the result of every frame, in order. A frame that no row selects is not decoded. If a frame cannot be read
    or predicted from, lacks what a row needs, or has an unusable pose or unusable intrinsics, all rows skip it, so that
    their figures can be compared. Close the generator to end the thread that reads ahead.

    Args:
        sequence: posed frames.
        indices: of the frames, in order.
        rows: with different keys, in their initial state.
        cache: of predictions; None = compute all.
        device: of the rows' estimators and their maps.
        stop: called before every frame.

    Raises:
        Stopped: ``stop`` returned True.
    """
    names, digest = sequence.names, "" if cache is None else sequence_digest(sequence)

    def read(index: int) -> FramePredictions:
        predictions = FramePredictions(sequence[index], device, cache, digest)
        if torch.get_num_threads() == 1:  # a second team of OpenMP threads makes networks three times slower
            for row in rows:
                predictions.prepare(row.source)
        return predictions

    selected = [index for n, index in enumerate(indices) if any(row.selects(n) for row in rows)]
    last = perf_counter()
    with closing(read_ahead(read, selected)) as reading:
        for number, index in enumerate(indices):
            if stop():
                raise Stopped
            active, ms = [row for row in rows if row.selects(number)], dict[str, float]()
            results, skipped, frame = dict[str, RowResult](), dict[str, str](), None
            try:
                if active:
                    with timed(ms, "read", device):
                        predictions = next(reading).result()
                    _require_inputs(predictions.frame, rows)
                    predicted, truths = _predicted(predictions, active, ms, device)
                    frame = predictions.frame
                    results = {row.key: row.update(frame, predicted[row.key], truths[row.key]) for row in active}
            except FrameError as error:
                skipped = {row.key: error.reason for row in active}
            now = perf_counter()
            ms["cycle"], last = 1000 * (now - last), now
            yield FrameResult(number, index, names[index], frame, results, skipped, ms)


def _require_inputs(frame: Frame, rows: Sequence[RowRunner]) -> None:
    """Raises FrameError: the frame lacks the image or the depth that a row needs, or its camera is unusable."""
    tracked = any(row.setting.anchors in (CORNERS, DENSE) for row in rows)
    if frame.image is None and (tracked or any(row.source.needs_image for row in rows)):
        raise FrameError(frame.name, "no image")
    if frame.depth is None and any(row.source.is_truth for row in rows):
        raise FrameError(frame.name, "no depth map")
    if frame.image is not None:
        require_camera(frame, frame.intrinsics, (frame.image.shape[0], frame.image.shape[1]))


def _predicted(
    predictions: FramePredictions, rows: Sequence[RowRunner], ms: dict[str, float], device: torch.device
) -> tuple[dict[str, DepthPrediction], dict[str, NDArray[np.float32] | None]]:
    """The rows' predictions, and the ground truth at their pixels, by key; adds their times to ``ms``. Raises
    FrameError: there is nothing to predict from, or a camera is missing or unusable."""
    with timed(ms, "predict", device):
        predicted = {row.key: predictions.of(row.source, row.images, row.every) for row in rows}
    with timed(ms, "truth", device):
        return predicted, _truths(predictions.frame, predicted)


def _truths(frame: Frame, predictions: Mapping[str, DepthPrediction]) -> dict[str, NDArray[np.float32] | None]:
    """Ground truth at the pixels of every row's maps, computed once per camera. Raises FrameError: a camera is
    unusable."""
    computed: dict[tuple[object, ...], NDArray[np.float32] | None] = {}
    truths = {}
    for key, prediction in predictions.items():
        K = prediction.K[0].numpy()
        camera = (prediction.size, K.tobytes())
        if camera not in computed:
            require_camera(frame, K, prediction.size)
            computed[camera] = truth_at(frame, K, prediction.size)
        truths[key] = computed[camera]
    return truths


def require_camera(frame: Frame, K: NDArray[np.float64], size: Size) -> None:
    """Raises FrameError: UfM* cannot use the frame's pose, or intrinsics K [3, 3] [px] of images of ``size`` (h, w)."""
    from ufmstar_torch.kernels.cpu.check import camera_faults  # kernels compile when they are first needed

    [fault] = camera_faults(frame.T_world_cam[None], K[None], size, UfMStarConfig.rotation_tolerance)
    if fault:
        raise FrameError(frame.name, FRAME_FAULTS[fault])


def frame_progress(show: Callable[[Progress], object], total: int) -> Callable[[FrameResult], None]:
    """Show the progress over ``total`` frames: at the start, and by the returned function after every frame."""
    skipped = 0

    def shown(result: FrameResult) -> None:
        nonlocal skipped
        skipped += bool(result.skipped)
        each = (int(row.out.statistics.components[0]) for row in result.rows.values())
        components = next((count for count in each if count), None)
        show(Progress("frames", result.number + 1, total, components, skipped))

    show(Progress("frames", 0, total))
    return shown
