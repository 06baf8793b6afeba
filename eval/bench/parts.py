"""The parts of every row of table 2 on every frame, in turn, so that a busy machine slows all of them alike.

A frame's networks run first, then the multiview steps on their predictions; odd frames in the reverse order
(``TimedCalls``). What uncertainty adds to a network is the difference of two calls on one frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch import UfMStar
from ufmstar_torch.eval.bench.networks import DEPTH, EVERY, ONCE, TimedNetwork
from ufmstar_torch.eval.bench.timing import StagedStep, TimedCalls
from ufmstar_torch.eval.engine.estimators import Gaussians, Pointwise, make_estimator
from ufmstar_torch.eval.methods.method import ALONE
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.prediction import DepthPrediction

MULTIVIEW = "multiview"
Part = tuple[str, str]  # the owner of a part, a base or a row by its label, and the part


class MultiviewStep:
    """UfM or UfM* of a row on a device, as the evaluation builds it, with a state of its own."""

    def __init__(self, row: Row, device: torch.device) -> None:
        estimator = make_estimator(row, device)
        assert isinstance(estimator, Pointwise | Gaussians), f"{row.label} has no multiview part"
        self.row, self.device, self.module = row, device, estimator.ufm
        self.memory = estimator.memory

    def __call__(self, prediction: DepthPrediction, T_world_cam: Tensor, K: Tensor, *, first: bool = False) -> Any:
        """A frame: its maps to the device, and the step; the ``first`` one begins with an empty state."""
        if first:
            self.module.reset()
        return self.module(*self.arguments(prediction, T_world_cam, K))

    def arguments(self, prediction: DepthPrediction, T_world_cam: Tensor, K: Tensor) -> list[Tensor | None]:
        """Depth, pose [1, 4, 4], intrinsics [1, 3, 3], A and E as the row uses them, on its device."""
        own = (prediction.aleatoric_variance, prediction.epistemic_variance)
        used = (prediction.depth, T_world_cam, K, *(own if self.row.method.uses_aleatoric else (None, None)))
        return [None if value is None else value.to(self.device) for value in used]


@dataclass
class TimedParts:
    """What was run and its times.

    Attributes:
        warm_up: frames at the beginning that are not counted.
        timed: the clocks, after the warm-up.
        calls: the parts that were run, one call per frame, which can be repeated in this order.
        steps, staged: by row's label, the state after the last frame, and the stages of UfM*.
        memory: by row's label, what the multiview step keeps after the last frame (``Estimator.memory``).
    """

    warm_up: int
    timed: TimedCalls = field(default_factory=TimedCalls)
    calls: dict[Part, list[Callable[[], Any]]] = field(default_factory=dict)
    steps: dict[str, MultiviewStep] = field(default_factory=dict)
    staged: dict[str, StagedStep] = field(default_factory=dict)
    memory: dict[str, dict[str, float]] = field(default_factory=dict)

    def ms(self, owner: str, part: str, clock: str = "wall") -> list[float]:
        """Times of a part by a clock, "wall" or "cpu" [ms], one per frame; none if it was not run."""
        times: list[float] = getattr(self.timed.times, clock).get((owner, part), [])
        return times

    def run(self, calls: Mapping[Part, Callable[[], Any]], device: torch.device) -> dict[Part, Any]:
        """Time the parts of a frame on a device; what they return."""
        for part, call in calls.items():
            self.calls.setdefault(part, []).append(call)
        return self.timed.call(calls, device=device)


def inference_of(row: Row) -> str:
    """The form of inference that a row gets its prediction from."""
    return EVERY if row.method.every_member else ONCE


def time_parts(
    rows: Sequence[Row],
    networks: Mapping[str, TimedNetwork],
    frames: Sequence[Frame],
    *,
    warm_up: int,
    device: torch.device,
    multiview_device: torch.device,
) -> TimedParts:
    """Run every part of every row on every frame.

    Args:
        rows, networks, device, multiview_device: as ``eval.bench.measure.measure`` takes them.
        frames: with images; the first ``warm_up`` are run, but not counted.
        warm_up: see ``frames``.

    Raises:
        FrameError: a frame has no image.
    """
    parts = TimedParts(warm_up)
    forms = {row.method.base: {DEPTH} for row in rows}
    for row in rows:
        forms[row.method.base].add(inference_of(row))
        if row.method.fusion != ALONE:
            parts.steps[row.label], twin = (MultiviewStep(row, multiview_device) for _ in range(2))
            if isinstance(twin.module, UfMStar):
                parts.staged[row.label] = StagedStep(twin.module, multiview_device)
    for turn, frame in enumerate(parts.timed.frames(frames, warm_up=warm_up)):
        prepared = {base: networks[base].prepare(frame, device) for base in forms}
        inferences: dict[Part, Callable[[], DepthPrediction]] = {
            (base, form): partial(networks[base].predict, form, *prepared[base], turn=turn)
            for base, needed in forms.items()
            for form in (DEPTH, ONCE, EVERY)
            if form in needed
        }
        predicted, T = parts.run(inferences, device), torch.from_numpy(frame.T_world_cam)[None]
        inputs = {
            label: (predicted[step.row.method.base, inference_of(step.row)], T, prepared[step.row.method.base][1])
            for label, step in parts.steps.items()
        }
        steps = {(label, MULTIVIEW): partial(parts.steps[label], *inputs[label], first=turn == 0) for label in inputs}
        parts.run(steps, multiview_device)
        for label, staged in parts.staged.items():
            staged(*parts.steps[label].arguments(*inputs[label]))
    parts.memory = {label: step.memory() for label, step in parts.steps.items()}
    return parts
