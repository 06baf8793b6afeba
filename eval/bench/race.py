"""The clocks: every part of every row on every frame, in turn, so that a busy machine slows all of them down.

A frame's networks run first, then the multiview steps on their predictions; odd frames in the reverse order
(``TimedCalls``). What uncertainty adds to a network is the difference of two calls on one frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch import UfMStar
from ufmstar_torch.eval.bench.networks import DEPTH, EVERY, ONCE, TimedNetwork
from ufmstar_torch.eval.bench.timing import StagedStep, TimedCalls
from ufmstar_torch.eval.engine.clock import CallTimes
from ufmstar_torch.eval.engine.estimators import Gaussians, Pointwise, make_estimator
from ufmstar_torch.eval.methods.method import ALONE, UFM_STAR
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.prediction import DepthPrediction

MULTIVIEW = "multiview"
# Clocks: what passes, and what this process computes (over all its threads), which other work does not stretch.
WALL, PROCESSOR = "wall", "processor"


@dataclass(frozen=True)
class NetworkInput:
    """A frame as a network takes it.

    Attributes:
        x: [1, 3, H, W] its input, on its device.
        T_world_cam: [1, 4, 4] float64 camera-to-world [m].
        intrinsics: [1, 3, 3] float64 of the input [px].
    """

    x: Tensor
    T_world_cam: Tensor
    intrinsics: Tensor

    @classmethod
    def of(cls, frame: Frame, network: TimedNetwork, device: torch.device) -> NetworkInput:
        """Raises FrameError where the frame has no image."""
        K = torch.from_numpy(frame.intrinsics)[None].to(device)
        x, K = network.preprocess(image_tensor(frame).to(device), K)
        return cls(x, torch.from_numpy(frame.T_world_cam)[None], K)


class MultiviewStep:
    """UfM or UfM* of a row on a device, as the evaluation builds it, with a state of its own.

    ``kept`` is what the estimator holds after every noted frame (``Estimator.memory``).
    """

    def __init__(self, row: Row, device: torch.device) -> None:
        estimator = make_estimator(row, device)
        assert isinstance(estimator, Pointwise | Gaussians), f"{row.label} has no multiview part"
        self.row, self.device, self.module = row, device, estimator.ufm
        self.kept: list[dict[str, float]] = []
        self._estimator = estimator

    def __call__(self, prediction: DepthPrediction, given: NetworkInput) -> Any:
        """The next frame: its maps to the device, and the step."""
        return self.module(*self.arguments(prediction, given))

    def arguments(self, prediction: DepthPrediction, given: NetworkInput) -> tuple[Tensor | None, ...]:
        """Depth, pose, intrinsics, A and E as the row uses them, on its device."""
        own = (prediction.aleatoric_variance, prediction.epistemic_variance)
        maps = (prediction.depth, given.T_world_cam, given.intrinsics)
        used = (*maps, *own) if self.row.method.uses_aleatoric else (*maps, None, None)
        return tuple(None if value is None else value.to(self.device) for value in used)

    def note(self) -> None:
        """Record what is kept now."""
        self.kept.append(self._estimator.memory())

    def memory(self) -> dict[str, float]:
        """Bytes and points or components after the noted frames: at the end, on average, at most; and of the
        map that is kept for smoothing [bytes]."""
        figures = {"smoothing_bytes": self.kept[-1]["smoothing_bytes"]}
        for name in ("bytes", "count"):
            values = [kept[name] for kept in self.kept]
            mean = sum(values) / len(values)
            figures |= {f"{name}_end": values[-1], f"{name}_mean": mean, f"{name}_max": max(values)}
        return figures


@dataclass
class Race:
    """What was run and its times.

    Attributes:
        warm_up: frames at the beginning that are not counted.
        times: by "base/part" or "row/multiview", of the frames after the warm-up.
        given: by base, the networks' input of every frame.
        predictions: by base and part ("once" or "every"), the multiview steps' input of every frame.
        steps, staged: by row's label, the state after the last frame, and the stages of UfM*.
    """

    warm_up: int
    times: CallTimes = field(default_factory=CallTimes)
    given: dict[str, list[NetworkInput]] = field(default_factory=dict)
    predictions: dict[tuple[str, str], list[DepthPrediction]] = field(default_factory=dict)
    steps: dict[str, MultiviewStep] = field(default_factory=dict)
    staged: dict[str, StagedStep] = field(default_factory=dict)

    def ms(self, owner: str, part: str, clock: str = WALL) -> list[float]:
        """Times of a part by a clock [ms], one per frame; none if it was not run."""
        times = self.times.wall if clock == WALL else self.times.cpu
        return times.get(f"{owner}/{part}", [])

    def added_ms(self, base: str, part: str, clock: str = WALL) -> list[float]:
        """What a network's inference takes beyond that of depth alone [ms], frame by frame."""
        return [a - b for a, b in zip(self.ms(base, part, clock), self.ms(base, DEPTH, clock), strict=True)]

    def step_inputs(self, row: Row) -> list[tuple[DepthPrediction, NetworkInput]]:
        """Of a row's multiview step, frame by frame."""
        base = row.method.base
        return list(zip(self.predictions[base, inference_of(row)], self.given[base], strict=True))


def parts_of(base: str, rows: Iterable[Row]) -> tuple[str, ...]:
    """What has to be run of a base's networks for the rows on it; depth alone always."""
    needed = {inference_of(row) for row in rows if row.method.base == base}
    return (DEPTH, *(part for part in (ONCE, EVERY) if part in needed))


def inference_of(row: Row) -> str:
    """The form of inference that a row gets its prediction from."""
    return EVERY if row.method.every_member else ONCE


def run_race(
    rows: Sequence[Row],
    networks: Mapping[str, TimedNetwork],
    frames: Sequence[Frame],
    *,
    warm_up: int,
    device: torch.device,
    multiview_device: torch.device,
) -> Race:
    """Run every part of every row on every frame.

    Args:
        rows, networks, device, multiview_device: as ``eval.bench.measure.measure`` takes them.
        frames: with images; the first ``warm_up`` are run, but not counted.
        warm_up: see ``frames``.

    Raises:
        FrameError: a frame has no image.
    """
    timed, race = TimedCalls(), Race(warm_up)
    race.times = timed.times
    parts = {base: parts_of(base, rows) for base in networks if any(row.method.base == base for row in rows)}
    race.steps = {row.label: MultiviewStep(row, multiview_device) for row in rows if row.method.fusion != ALONE}
    staged = {row.label: MultiviewStep(row, multiview_device) for row in rows if row.method.fusion == UFM_STAR}
    for label, step in staged.items():
        assert isinstance(step.module, UfMStar)
        race.staged[label] = StagedStep(step.module, multiview_device)
    for turn, frame in enumerate(timed.frames(frames, warm_up=warm_up)):
        calls: dict[str, Any] = {}
        for base, needed in parts.items():
            given = NetworkInput.of(frame, networks[base], device)
            race.given.setdefault(base, []).append(given)
            one = partial(networks[base].predict, x=given.x, intrinsics=given.intrinsics, turn=turn)
            calls |= {f"{base}/{part}": partial(one, part) for part in needed}
        predicted = timed.call(calls, device=device)
        for base, needed in parts.items():
            for part in needed[1:]:
                race.predictions.setdefault((base, part), []).append(predicted[f"{base}/{part}"])
        inputs = {label: race.step_inputs(step.row)[-1] for label, step in race.steps.items()}
        steps = {f"{label}/{MULTIVIEW}": partial(step, *inputs[label]) for label, step in race.steps.items()}
        timed.call(steps, device=multiview_device)
        for step in race.steps.values():
            step.note()
        for label, step in staged.items():
            race.staged[label](*step.arguments(*inputs[label]))
    return race
