"""One frame after the other through all rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.engine.anchor_source import anchor_sources
from ufmstar_torch.eval.engine.confident import confident_pixels, references
from ufmstar_torch.eval.engine.estimator import Estimate
from ufmstar_torch.eval.engine.networks import BaseNetwork
from ufmstar_torch.eval.engine.predicted import Predicted, together
from ufmstar_torch.eval.engine.row_run import RowRun
from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import TRACKED
from ufmstar_torch.eval.results.cache import PredictionCache, PredictionKey, frame_digest, sequence_digest
from ufmstar_torch.eval.results.examples import FinishedFrame
from ufmstar_torch.eval.sequences.frame import Frame, FrameError, FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.frame import FRAME_FAULTS, check_frame

ALL = "all"  # members, where a prediction is kept
_TOLERANCE = UfMStarConfig().rotation_tolerance


class FramePass:
    """The rows on their way through a sequence.

    Args:
        sequence: posed frames.
        rows: different ones.
        networks: by base; those of the rows are used.
        cache: of predictions.
        device: of the estimators.
        confident: see ``confident_pixels``.

    Attributes:
        runs: one for each row, in their order.

    Raises:
        ValueError: see ``make_estimator``.
    """

    def __init__(
        self,
        sequence: FrameSequence,
        rows: Sequence[Row],
        networks: Mapping[str, BaseNetwork],
        cache: PredictionCache,
        device: torch.device,
        confident: float,
    ) -> None:
        self._sequence, self._cache, self._device, self._confident = sequence, cache, device, confident
        self._networks = {row.method.base: networks[row.method.base] for row in rows}
        self._references = {row: references(row, rows) for row in rows}
        self._digest = sequence_digest(sequence)
        self._tracked = any(row.setting.anchors == TRACKED for row in rows)
        anchors = anchor_sources(rows)
        named = {row: [other.method.name for other in found] for row, found in self._references.items()}
        self.runs = [RowRun(row, device, named[row], anchors.get(row)) for row in rows]

    def take(self, number: int, index: int) -> FinishedFrame | None:
        """Take in a frame of the sequence.

        Args:
            number: which of the frames to be judged it is; a setting's skip counts these.
            index: of the frame in the sequence.

        Returns:
            What came of it; None if no row wants it or none can have it, which they count.
        """
        active = [run for run in self.runs if run.selects(number)]
        if not active:
            return None
        try:
            frame = self._read(index)
            asked = FramePredictions(frame, self._networks, self._cache, self._digest, self._device)
            predicted = {run.row: asked.of(run.row.method, run.done) for run in active}
            truths = self._truths(frame, predicted)
        except FrameError as error:
            for run in active:
                run.skip(error.reason)
            return None
        estimates = {run.row: run.estimate(frame, predicted[run.row], truths[run.row]) for run in active}
        if frame.depth is not None:
            self._judge(active, estimates, truths)
        cameras = {row: one.intrinsics.numpy() for row, one in predicted.items()}
        return FinishedFrame(frame, estimates, truths, cameras)

    def _read(self, index: int) -> Frame:
        """The frame, if all networks and UfM* can use it.

        Raises:
            FrameError: they cannot.
        """
        frame = self._sequence[index]
        wanted = self._tracked or any(network.needs_image for network in self._networks.values())
        if frame.image is None and wanted:
            raise FrameError(frame.name, "no image")
        if frame.depth is None and not all(network.needs_image for network in self._networks.values()):
            raise FrameError(frame.name, "no depth map")
        fault = frame_fault(frame)
        if fault is not None:
            raise FrameError(frame.name, fault)
        return frame

    def _truths(self, frame: Frame, predicted: Mapping[Row, Predicted]) -> dict[Row, NDArray[np.float32]]:
        """Ground truth at the pixels of every row's maps, [h, w] [m], 0 = none; once for every camera.

        Raises:
            FrameError: the depth map has no camera.
        """
        known: dict[tuple[object, ...], NDArray[np.float32]] = {}
        found = {}
        for row, one in predicted.items():
            camera = (one.size, one.intrinsics.numpy().tobytes())
            if camera not in known:
                truth = truth_at(frame, one.intrinsics.numpy(), one.size)
                known[camera] = np.zeros(one.size, np.float32) if truth is None else truth
            found[row] = known[camera]
        return found

    def _judge(
        self, active: list[RowRun], estimates: Mapping[Row, Estimate], truths: Mapping[Row, NDArray[np.float32]]
    ) -> None:
        """Add the frame to the metrics of the rows."""
        targets = {row: torch.from_numpy(truth) for row, truth in truths.items()}
        wanted = {other for run in active for other in self._references[run.row]}
        masks = {other: confident_pixels(estimates[other], targets[other], self._confident) for other in wanted}
        for run in active:
            confident = {other.method.name: masks[other] for other in self._references[run.row]}
            run.judge(estimates[run.row], targets[run.row], confident)


class FramePredictions:
    """What the networks say of one frame; each inference is made once, or read from the cache.

    Args:
        frame: which.
        networks: by base.
        cache: of predictions.
        digest: of the sequence.
        device: where the maps are wanted.
    """

    def __init__(
        self,
        frame: Frame,
        networks: Mapping[str, BaseNetwork],
        cache: PredictionCache,
        digest: str,
        device: torch.device,
    ) -> None:
        self._frame, self._networks, self._cache, self._device = frame, networks, cache, device
        self._sequence = digest
        self._content = frame_digest(frame) if cache.folder is not None else ""
        self._known: dict[tuple[str, str], Predicted] = {}

    def of(self, method: Method, position: int) -> Predicted:
        """What a method gets that has used ``position`` images before.

        Raises:
            FrameError: the frame has nothing to predict from.
        """
        network = self._networks[method.base]
        every = method.every_member and network.passes > 1
        return self._get(network, None if every else network.turn(position))

    def _get(self, network: BaseNetwork, n: int | None) -> Predicted:
        """Of member n, or of all for None."""
        member = ALL if n is None else str(n)
        known = (network.digest, member)
        if known not in self._known:
            key = PredictionKey(network.digest, self._sequence, self._frame.name, member, self._content)
            stored = self._cache.load(key, self._device) if network.cacheable else None
            self._known[known] = stored or self._made(network, n, key)
        return self._known[known]

    def _made(self, network: BaseNetwork, n: int | None, key: PredictionKey) -> Predicted:
        if n is None:
            # Members that have been or will be asked for alone are not run again; but only those are kept on disk.
            made = together([self._member(network, i) for i in range(network.passes)])
        else:
            made = self._member(network, n)
        if network.cacheable:
            self._cache.store(key, made)
        return made

    def _member(self, network: BaseNetwork, n: int) -> Predicted:
        """One inference, remembered for the length of the frame."""
        known = (network.digest, f"run {n}")
        if known not in self._known:
            self._known[known] = network.one(self._frame, n).to(self._device)
        return self._known[known]


def frame_fault(frame: Frame) -> str | None:
    """What is wrong with a frame's pose or intrinsics for UfM*, None if nothing is."""
    pose, K = torch.from_numpy(frame.T_world_cam), torch.from_numpy(frame.intrinsics)
    one = torch.ones(1, 1, 1)
    checked = check_frame(one, pose, K, None, None, None, None, feature_count=0, rotation_tolerance=_TOLERANCE)
    code = int(checked.fault[0])
    return FRAME_FAULTS[code] if code else None
