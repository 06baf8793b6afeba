"""The clocks: every part of every row on every frame, in turns, so that a busy machine slows all of them down.

A frame's networks run first, then what judges its views; odd frames in the reverse order, so that nothing always
follows the same neighbour. What uncertainty adds to a network is the difference of two calls on one frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.eval.bench.contender import Contender
from ufmstar_torch.eval.bench.multiview import Inputs, Multiview, StagedUfMStar, synchronize, waited
from ufmstar_torch.eval.engine.clock import CallTimes
from ufmstar_torch.eval.methods.method import ALONE, UFM_STAR
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.sequences.images import image_tensor

DEPTH, ONCE, EVERY, MULTIVIEW = "depth", "once", "every", "multiview"
# Clocks: what passes, and what this process computes (over all its threads), which other work does not stretch.
WALL, PROCESSOR = "wall", "processor"


@dataclass(frozen=True)
class Prepared:
    """A frame as a network takes it.

    Attributes:
        x: [1, 3, H, W] its input, on its device.
        T_world_cam: [1, 4, 4] float64 [m]; ``intrinsics``: [1, 3, 3] float64 of the input [px].
        intrinsics: see ``T_world_cam``.
    """

    x: Tensor
    T_world_cam: Tensor
    intrinsics: Tensor


@dataclass
class Race:
    """What was run and how long it took.

    Attributes:
        watch: times by (base or row, part), of the frames after the warm-up.
        prepared: by base, every frame.
        inputs: by base and part ("once" or "every"), what the multiview methods were given.
        multiview: by row's label, the state after the last frame.
        staged: likewise, the stages of UfM*.
    """

    watch: CallTimes = field(default_factory=CallTimes)
    prepared: dict[str, list[Prepared]] = field(default_factory=dict)
    inputs: dict[tuple[str, str], list[Inputs]] = field(default_factory=dict)
    multiview: dict[str, Multiview] = field(default_factory=dict)
    staged: dict[str, StagedUfMStar] = field(default_factory=dict)

    def ms(self, owner: str, part: str, clock: str = WALL) -> list[float]:
        """Times of a part by a clock [ms], one per frame; none if it was not run."""
        times = self.watch.wall if clock == WALL else self.watch.cpu
        return times.get(f"{owner}/{part}", [])

    def added_ms(self, base: str, part: str, clock: str = WALL) -> list[float]:
        """What a network's inference takes beyond that of depth alone [ms], frame by frame."""
        return [a - b for a, b in zip(self.ms(base, part, clock), self.ms(base, DEPTH, clock), strict=True)]


def parts_of(base: str, rows: Iterable[Row]) -> tuple[str, ...]:
    """What has to be run of a base's networks for the rows on it; depth alone always."""
    needed = {inference_of(row) for row in rows if row.method.base == base}
    return (DEPTH, *(part for part in (ONCE, EVERY) if part in needed))


def inference_of(row: Row) -> str:
    """The form of inference that a row gets its prediction from."""
    return EVERY if row.method.every_member else ONCE


def run_race(
    rows: Sequence[Row],
    contenders: Mapping[str, Contender],
    frames: Sequence[Frame],
    *,
    warm_up: int,
    device: torch.device,
    multiview_device: torch.device,
) -> Race:
    """Run every part of every row on every frame.

    Args:
        rows: different ones.
        contenders: by base.
        frames: with images; the first ``warm_up`` are run, but not counted.
        warm_up: see ``frames``.
        device: of the networks.
        multiview_device: of UfM and UfM*.

    Raises:
        FrameError: a frame has no image.
    """
    race = Race()
    bases = [base for base in contenders if any(row.method.base == base for row in rows)]
    judged = [row for row in rows if row.method.fusion != ALONE]
    gaussians = [row for row in judged if row.method.fusion == UFM_STAR]
    race.multiview = {row.label: Multiview(row, multiview_device) for row in judged}
    race.staged = {row.label: StagedUfMStar(row, multiview_device) for row in gaussians}
    for number, frame in enumerate(frames):
        for base in _turned(bases, number):
            _run_networks(race, contenders[base], parts_of(base, rows), frame, number, device)
        for row in _turned(judged, number):
            given = race.inputs[row.method.base, inference_of(row)][-1]
            one = race.multiview[row.label]
            race.watch.time(f"{row.label}/{MULTIVIEW}", waited(one, multiview_device), given)
            one.note()
            if row.label in race.staged:
                race.staged[row.label](given)
    race.watch.drop(warm_up)
    for staged in race.staged.values():
        staged.clock.drop(warm_up)
    return race


def prepare(contender: Contender, frame: Frame, device: torch.device) -> Prepared:
    """A frame's image as a network's input.

    Raises:
        FrameError: it has none.
    """
    image = image_tensor(frame).to(device)
    x, K = contender.preprocess(image, torch.from_numpy(frame.intrinsics)[None].to(device))
    return Prepared(x, torch.from_numpy(frame.T_world_cam)[None], K)


def _run_networks(
    race: Race, contender: Contender, parts: Sequence[str], frame: Frame, number: int, device: torch.device
) -> None:
    base = contender.base
    prepared = prepare(contender, frame, device)
    race.prepared.setdefault(base, []).append(prepared)
    calls: dict[str, Any] = {
        DEPTH: contender.alone,
        ONCE: lambda x, K: contender.once(x, number, K),
        EVERY: contender.every,
    }
    for part in _turned(parts, number):
        synchronize(device)
        result = race.watch.time(f"{base}/{part}", waited(calls[part], device), prepared.x, prepared.intrinsics)
        if part != DEPTH:
            inputs = Inputs(result, prepared.T_world_cam, prepared.intrinsics)
            race.inputs.setdefault((base, part), []).append(inputs)


def _turned(items: Sequence[Any], number: int) -> Sequence[Any]:
    """In order for even numbers, in reverse for odd ones."""
    return items if number % 2 == 0 else items[::-1]
