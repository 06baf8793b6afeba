"""The parts of every row on every frame, in turn, so that a busy machine slows all of them alike.

A frame's networks run first, then the multiview steps on their predictions; odd frames in the reverse order
(``TimedCalls``). What uncertainty adds to a network is the difference of two calls on one frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ufmstar_torch import UfMStar, UncertainDepth
from ufmstar_torch.eval.bench.networks import DEPTH, EVERY, ONCE, TimedNetwork
from ufmstar_torch.eval.bench.timing import StagedStep, TimedCalls
from ufmstar_torch.eval.engine.estimators import ufm_star_config
from ufmstar_torch.eval.methods.method import ALONE, UFM
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.ufm import UfM, UfMConfig
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.prediction import DepthPrediction

MULTIVIEW = "multiview"
# ``Setting.anchors`` that are measured: the name of the same anchors in ``UncertainDepth``.
ANCHORS = {"": None, "tracked": "corners", "dense": "dense"}
Part = tuple[str, str]  # the owner of a part, a base or a row by its label, and the part


class StepInput(NamedTuple):
    """One frame for a multiview step.

    Attributes:
        image: [1, 3, H, W] uint8, and its intrinsics [1, 3, 3] [px].
        pose: [1, 4, 4] camera-to-world [m].
        x: the network's input [1, 3, h, w], its intrinsics and the depth map's [1, 3, 3] [px], and its prediction.
    """

    image: tuple[Tensor, Tensor]
    pose: Tensor
    x: tuple[Tensor, Tensor]
    prediction: DepthPrediction


class _Replay(nn.Module):
    """Stands for the network in ``UncertainDepth``: returns a frame's prediction without computing it."""

    current: StepInput

    def prepare(self, image: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
        return self.current.x

    def forward(self, x: Tensor) -> DepthPrediction:
        return self.current.prediction


class MultiviewStep:
    """Runs one row's UfM or UfM* on a device; UfM* includes the row's landmarks and posterior.

    A row whose variance leaves A and E aside gets the depth alone.
    """

    def __init__(self, row: Row, device: torch.device) -> None:
        self._row, self._device, self._network = row, device, _Replay()
        self.ufm: UfM | UfMStar
        self._model: UncertainDepth | None = None
        if row.method.fusion == UFM:
            self.ufm = UfM(UfMConfig(max_points=row.method.max_points, on_bad_frame="skip"), device=device)
        else:
            options: dict[str, Any] = {"preprocess": self._network.prepare, "anchors": ANCHORS[row.setting.anchors]}
            self._model = UncertainDepth(self._network, ufm_star_config(row), **options).to(device)
            self.ufm = self._model.ufm

    def __call__(self, frame: StepInput, *, first: bool = False) -> Any:
        """A frame: its maps to the device, and the step; the ``first`` one begins with an empty state."""
        if first:
            (self._model or self.ufm).reset()
        depth, T, K, a, e = self.arguments(frame)
        if self._model is None:
            return self.ufm(depth, T, K, a, e)
        self._network.current = frame._replace(x=(frame.x[0], K), prediction=DepthPrediction(depth, a, e))
        out = self._model(frame.image[0], T, frame.image[1])
        return out.ufm.posterior() if self._row.setting.posterior else out

    def arguments(self, frame: StepInput) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor | None]:
        """Depth, pose [1, 4, 4], intrinsics [1, 3, 3], A and E as the row uses them, on its device."""
        used = self._row.method.uses_aleatoric
        a, e = frame.prediction.aleatoric_variance, frame.prediction.epistemic_variance
        a, e = (v.to(self._device) if v is not None and used else None for v in (a, e))
        depth, T, K = (v.to(self._device) for v in (frame.prediction.depth, frame.pose, frame.x[1]))
        return depth, T, K, a, e

    def memory(self) -> dict[str, float]:
        """Bytes and number of the points or components, what anchors add included; bytes of the map for smoothing."""
        if isinstance(self.ufm, UfM):
            cloud = self.ufm.clouds()[0]
            points = len(cloud.count)
            return {"bytes_end": points * cloud.bytes_per_point, "count_end": points, "smoothing_bytes": 0}
        count, added = int(self.ufm.mixture.components.sum()), 0
        if self._row.setting.anchors:
            plain = {f"ufm.{name}" for name in UfMStar().state_dict()}
            state = self._model.state_dict() if self._model is not None else {}
            added = sum(v.nbytes for name, v in state.items() if name not in plain and isinstance(v, Tensor))
        kept = count * self.ufm.mixture.bytes_per_component() + added
        return {"bytes_end": kept, "count_end": count, "smoothing_bytes": self.ufm.smoothed.nbytes}


@dataclass
class TimedParts:
    """A measured row and its times.

    Attributes:
        warm_up: frames at the beginning that are not counted.
        timed: the clocks, after the warm-up.
        calls: the parts that were run, one call per frame, which can be repeated in this order.
        staged: by row's label, the stages of UfM*.
        memory: by row's label, what the multiview step keeps after the last frame.
        size: of the depth maps, "224 x 224" [px].
    """

    warm_up: int
    timed: TimedCalls = field(default_factory=TimedCalls)
    calls: dict[Part, list[Callable[[], Any]]] = field(default_factory=dict)
    staged: dict[str, StagedStep] = field(default_factory=dict)
    memory: dict[str, dict[str, float]] = field(default_factory=dict)
    size: str = ""

    def ms(self, owner: str, part: str) -> list[float]:
        """Times of a part [ms], one per frame; none if it was not run."""
        return self.timed.times.wall.get((owner, part), [])

    def run(self, calls: Mapping[Part, Callable[[], Any]], device: torch.device) -> dict[Part, Any]:
        """Time the parts of a frame on a device; what they return."""
        for part, call in calls.items():
            self.calls.setdefault(part, []).append(call)
        return self.timed.call(calls, device)


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
    """Run every part of every row on every frame; the first ``warm_up`` are not counted. Other arguments: see
    ``measure.measure``. Raises FrameError: a frame has no image."""
    parts, steps = TimedParts(warm_up), {}
    forms = {row.method.base: {DEPTH} for row in rows}
    for row in rows:
        forms[row.method.base].add(inference_of(row))
        if row.method.fusion != ALONE:
            steps[row.label], twin = (MultiviewStep(row, multiview_device) for _ in range(2))
            if isinstance(twin.ufm, UfMStar) and not row.setting.anchors:
                parts.staged[row.label] = StagedStep(twin.ufm, multiview_device)
    for turn, frame in enumerate(parts.timed.frames(frames, warm_up=warm_up)):
        prepared = {base: networks[base].prepare(frame, device) for base in forms}
        inferences: dict[Part, Callable[[], DepthPrediction]] = {
            (base, form): partial(networks[base].predict, form, *prepared[base], turn=turn)
            for base, needed in forms.items()
            for form in (DEPTH, ONCE, EVERY)
            if form in needed
        }
        predicted, T = parts.run(inferences, device), torch.from_numpy(frame.T_world_cam)[None]
        image = image_tensor(frame).to(multiview_device), torch.from_numpy(frame.intrinsics)[None]
        inputs = {
            row.label: StepInput(
                image, T, prepared[row.method.base], predicted[row.method.base, inference_of(row)]
            )
            for row in rows
        }  # fmt: skip
        parts.run(
            {(n, MULTIVIEW): partial(step, inputs[n], first=turn == 0) for n, step in steps.items()}, multiview_device
        )
        for label, staged in parts.staged.items():
            staged(*steps[label].arguments(inputs[label]))
        parts.size = " x ".join(str(side) for side in next(iter(predicted.values())).depth.shape[-2:])
    parts.memory = {label: step.memory() for label, step in steps.items()}
    return parts
