"""The clocks: every part of every row on every frame, in turn, so that a busy machine slows all of them down.

A frame's networks run first, then the multiview steps on their predictions; odd frames in the reverse order
(``TimedCalls``). What uncertainty adds to a network is the difference of two calls on one frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
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
# Clocks: what passes, and what this process computes (over all its threads), which other work does not stretch.
WALL, PROCESSOR = "wall", "processor"
# The owner of a part, a base or a row by its label, and the part.
Part = tuple[str, str]


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
        timed: the clocks, after the warm-up.
        calls: the parts that were run, one call per frame, which can be repeated in this order.
        steps, staged: by row's label, the state after the last frame, and the stages of UfM*.
    """

    warm_up: int
    timed: TimedCalls = field(default_factory=TimedCalls)
    calls: dict[Part, list[Callable[[], Any]]] = field(default_factory=dict)
    steps: dict[str, MultiviewStep] = field(default_factory=dict)
    staged: dict[str, StagedStep] = field(default_factory=dict)

    def ms(self, owner: str, part: str, clock: str = WALL) -> list[float]:
        """Times of a part by a clock [ms], one per frame; none if it was not run."""
        times = self.timed.times.wall if clock == WALL else self.timed.times.cpu
        return times.get((owner, part), [])

    def added_ms(self, base: str, part: str, clock: str = WALL) -> list[float]:
        """What a network's inference takes beyond that of depth alone [ms], frame by frame."""
        return [a - b for a, b in zip(self.ms(base, part, clock), self.ms(base, DEPTH, clock), strict=True)]

    def run(self, calls: Mapping[Part, Callable[[], Any]], device: torch.device) -> dict[Part, Any]:
        """Time the parts of a frame on a device; what they return."""
        for part, call in calls.items():
            self.calls.setdefault(part, []).append(call)
        return self.timed.call(calls, device=device)


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
    race = Race(warm_up)
    parts = {base: parts_of(base, rows) for base in networks if any(row.method.base == base for row in rows)}
    for row in rows:
        if row.method.fusion != ALONE:
            race.steps[row.label], twin = (MultiviewStep(row, multiview_device) for _ in range(2))
            if isinstance(twin.module, UfMStar):
                race.staged[row.label] = StagedStep(twin.module, multiview_device)
    for turn, frame in enumerate(race.timed.frames(frames, warm_up=warm_up)):
        given = {base: networks[base].prepare(frame, device) for base in parts}
        inferences: dict[Part, Callable[[], DepthPrediction]] = {
            (base, part): partial(networks[base].predict, part, *given[base], turn=turn)
            for base, needed in parts.items()
            for part in needed
        }
        predicted, T = race.run(inferences, device), torch.from_numpy(frame.T_world_cam)[None]
        inputs = {}
        for label, step in race.steps.items():
            base = step.row.method.base
            inputs[label] = predicted[base, inference_of(step.row)], T, given[base][1]
        steps = {(label, MULTIVIEW): partial(race.steps[label], *inputs[label], first=turn == 0) for label in inputs}
        race.run(steps, multiview_device)
        for label, step in race.steps.items():
            step.note()
            if label in race.staged:
                race.staged[label](*step.arguments(*inputs[label]))
    return race
