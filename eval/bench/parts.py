"""Times the parts of every row on every frame, alternately, so that other load slows all parts equally.

A frame's networks run first, then the multiview steps on their predictions; odd frames use the reverse order. The cost
of a network's uncertainty is the difference of two calls on one frame.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.anchors.sources import landmark_source
from ufmstar_torch.anchors.streams import StreamLandmarks
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.bench.networks import DEPTH, EVERY, ONCE, TimedNetwork
from ufmstar_torch.eval.bench.timing import Clock, StagedStep
from ufmstar_torch.eval.engine.estimators import Gaussians, Pointwise, make_estimator
from ufmstar_torch.eval.engine.progress import synchronize
from ufmstar_torch.eval.methods.method import ALONE
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.frames.image_check import reduced, shows_something
from ufmstar_torch.frames.prediction import DepthPrediction

MULTIVIEW, SAMPLE = "multiview", "sample"
# ``Setting.anchors`` that are measured: the name of their source of landmarks.
ANCHORS = {"": None, "corners": "corners", "dense": "dense"}
_INFERENCES = 40  # number of inferences that the meter repeats
Part = tuple[str, str]  # the owner of a part, a base or a row by its label, and the part


class MultiviewStep:
    """Runs one row's UfM or UfM* on a device; UfM* includes the row's landmarks and posterior."""

    def __init__(self, row: Row, device: torch.device) -> None:
        self.estimator, self._device = make_estimator(row, device), device
        anchors = ANCHORS[row.setting.anchors]
        self._landmarks = None if anchors is None else StreamLandmarks(landmark_source(anchors))

    def __call__(self, image: Tensor | None, frame: Frame, prediction: DepthPrediction, *, first: bool = False) -> None:
        """Move a frame's maps to the device, track landmarks in its ``image`` [1, 3, H, W], and run the step.
        ``first`` resets the state before."""
        if first:
            self.reset()
        anchors, T = None, torch.from_numpy(frame.T_world_cam)
        if self._landmarks is not None:
            K = torch.from_numpy(frame.intrinsics)
            anchors = self._landmarks.update(image, T, K, UfMStarConfig.rotation_tolerance)
            anchors = anchors.moved(K, prediction.K).to(self._device)
        self.estimator.update(prediction.to(self._device), T, anchors)

    def sample(self, frame: Frame, prediction: DepthPrediction, *, first: bool = False) -> None:
        """Average the uncertainty of a frame's map over 1,000 pixels; ``first`` resets the state before."""
        if first:
            self.reset()
        assert isinstance(self.estimator, Gaussians)
        prediction, T = prediction.to(self._device), torch.from_numpy(frame.T_world_cam)
        used = self.estimator.used(prediction)
        maps = used.arguments(confidence=self.estimator.ufm.uses_confidence)
        self.estimator.ufm.mean_uncertainty(pose=T, intrinsics=prediction.K, **maps)

    def reset(self) -> None:
        """Reset the state."""
        assert isinstance(self.estimator, Pointwise | Gaussians)
        self.estimator.ufm.reset()
        if self._landmarks is not None:
            self._landmarks.reset()

    def memory(self) -> dict[str, float]:
        """Bytes of the state, that of anchors included; number of points or components; bytes of the smoothing map."""
        memory = self.estimator.memory()
        landmarks = {} if self._landmarks is None else self._landmarks.state()
        state_bytes = memory["bytes"] + sum(value.nbytes for value in landmarks.values())
        return {"bytes_end": state_bytes, "count_end": memory["count"], "smoothing_bytes": memory["smoothing_bytes"]}


class TimedParts:
    """The parts that were run on the frames, and their times. On odd frames the parts run in the reverse order, so that
    no part always follows the same one.

    Attributes:
        warm_up: frames at the beginning that are not counted.
        calls: the parts to be repeated, one call per frame, in this order; each returns when its device has finished.
        staged: by row's label, the stages of UfM*.
        memory: by row's label, the memory of the multiview step after the last frame, and "bytes_mean" over all counted
            frames.
        size: of the depth maps, "224 x 224" [px].
    """

    def __init__(self, warm_up: int, clock: Clock) -> None:
        self.warm_up, self.size, self._clock = warm_up, "", clock
        self.calls: dict[Part, list[Callable[[], Any]]] = {}
        self.staged: dict[str, StagedStep] = {}
        self.memory: dict[str, dict[str, float]] = {}
        self._ms: dict[Part, list[float]] = {}

    @property
    def frames(self) -> int:
        """The number of counted frames."""
        return max(0, max(map(len, self._ms.values()), default=0) - self.warm_up)

    def ms(self, owner: str, part: str) -> list[float]:
        """Times of a part [ms], one per frame after the warm-up; empty if it was not run."""
        return self._ms.get((owner, part), [])[self.warm_up :]

    def run(
        self, number: int, calls: Mapping[Part, Callable[[], Any]], device: torch.device, *, keep: bool
    ) -> dict[Part, Any]:
        """Time the parts of frame ``number`` on a device; ``keep`` the calls to repeat them. Returns their results."""
        results = {}
        for part in list(calls)[:: -1 if number % 2 else 1]:
            call = partial(_finish, calls[part], device)
            self.calls.setdefault(part, []).extend([call] if keep else [])
            synchronize(device)
            started = self._clock()
            results[part] = call()
            self._ms.setdefault(part, []).append(1e3 * (self._clock() - started))
        return results


def _finish(call: Callable[[], Any], device: torch.device) -> Any:
    """Return the result of a call, once the device has finished."""
    result = call()
    synchronize(device)
    return result


def _staged(rows: Iterable[Row], device: torch.device, clock: Clock) -> dict[str, StagedStep]:
    """Steps of UfM* without anchors whose stages are timed, by the row's label."""
    twins = {row.label: MultiviewStep(row, device) for row in rows if not row.setting.anchors}
    return {
        label: StagedStep(twin.estimator.ufm, twin, device, clock)
        for label, twin in twins.items()
        if isinstance(twin.estimator, Gaussians)
    }


def _inferences(
    networks: Mapping[str, TimedNetwork],
    forms: Mapping[str, Collection[str]],
    prepared: Mapping[str, tuple[Tensor, Tensor]],
    turn: int,
) -> dict[Part, Callable[[], DepthPrediction]]:
    """The forms of inference of every base on its prepared input."""
    return {
        (base, form): partial(networks[base].predict, form, *prepared[base], turn=turn)
        for base, needed in forms.items()
        for form in (DEPTH, ONCE, EVERY)
        if form in needed
    }


def _inputs(
    rows: Iterable[Row], frame: Frame, maps: Mapping[Part, DepthPrediction], cameras: Mapping[str, torch.Tensor],
    device: torch.device,
) -> dict[str, tuple[torch.Tensor | None, Frame, DepthPrediction]]:  # fmt: skip
    """Image (with anchors alone), frame without image, and prediction of a row's step, by the row's label.
    ``cameras``: K [1, 3, 3] of the maps, by the network."""
    image, bare = image_tensor(frame).to(device), replace(frame, image=None, depth=None, moving=None)
    informative = shows_something(reduced(image))
    inputs = {}
    for row in rows:
        stated = maps[row.method.base, inference_of(row)]
        prediction = replace(stated, intrinsics=cameras[row.method.base], informative=informative)
        inputs[row.label] = image if row.setting.anchors else None, bare, prediction
    return inputs


def inference_of(row: Row) -> str:
    """The form of inference of a row's prediction."""
    return EVERY if row.method.every_member else ONCE


def time_parts(
    rows: Sequence[Row],
    networks: Mapping[str, TimedNetwork],
    frames: Iterable[Frame],
    *,
    warm_up: int,
    device: torch.device,
    multiview_device: torch.device,
    restart: bool = False,
    metered: Collection[str] = (DEPTH, ONCE, EVERY, MULTIVIEW, SAMPLE),
    samples: bool = False,
    clock: Clock = time.perf_counter,
) -> TimedParts:
    """Run every part of every row on every frame.

    Args:
        rows, networks, device, multiview_device: as for ``measure.measure``.
        frames: are read once.
        warm_up: number of frames at the beginning that are not counted.
        restart: True if the sequence begins again after them; the rows then forget them.
        metered: parts whose calls are kept for the meter: of multiview steps those on every frame, of networks, whose
            cost does not depend on the image, those on the first ``_INFERENCES`` frames.
        samples: True to run the part ``SAMPLE`` of UfM* without anchors, too.
        clock: returns seconds.

    Raises:
        FrameError: a frame has no image.
    """
    parts, fused = TimedParts(warm_up, clock), [row for row in rows if row.method.fusion != ALONE]
    steps = {row.label: MultiviewStep(row, multiview_device) for row in fused}
    parts.staged |= _staged(fused, multiview_device, clock)
    sampled = {
        row.label: MultiviewStep(row, multiview_device) for row in fused if samples and row.label in parts.staged
    }
    forms = {row.method.base: {DEPTH} for row in rows}
    for row in rows:
        forms[row.method.base].add(inference_of(row))
    sizes: dict[str, list[float]] = {label: [] for label in steps}
    for number, frame in enumerate(frames):
        turn = number - warm_up if restart and number >= warm_up else number
        repeated, first = not restart or number >= warm_up, turn == 0
        prepared = {base: networks[base].prepare(frame, device) for base in forms}
        inferences = _inferences(networks, forms, prepared, turn)
        keep = repeated and turn < _INFERENCES and bool({DEPTH, ONCE, EVERY} & set(metered))
        maps = parts.run(number, inferences, device, keep=keep)
        cameras = {base: K.cpu().double() for base, (_, K) in prepared.items()}
        inputs = _inputs(rows, frame, maps, cameras, multiview_device)
        multiview: dict[Part, Callable[[], Any]]
        multiview = {(label, MULTIVIEW): partial(step, *inputs[label], first=first) for label, step in steps.items()}
        for label, step in sampled.items():
            multiview[label, SAMPLE] = partial(step.sample, *inputs[label][1:], first=first)
        parts.run(number, multiview, multiview_device, keep=repeated and MULTIVIEW in metered)
        for label, staged in parts.staged.items():
            staged(*inputs[label], first=first)
        if number >= warm_up:
            for label, step in steps.items():
                sizes[label].append(step.memory()["bytes_end"])
        parts.size = " x ".join(str(side) for side in next(iter(maps.values())).depth.shape[-2:])
    parts.memory = {
        label: step.memory() | {"bytes_mean": sum(sizes[label]) / max(1, len(sizes[label]))}
        for label, step in steps.items()
    }
    return parts
