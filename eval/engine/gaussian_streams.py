"""UfM* of several sequences at the same time: each sequence is a stream of one module."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import torch
from torch import Tensor

from ufmstar_torch.anchors.given import Anchors
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.ufmstar import UfMStar, UfMStarOutput

_Batch = TypeVar("_Batch")


@dataclass(frozen=True, eq=False)
class StreamInput:
    """What ``UfMStar.forward`` takes of one stream, without the leading dimension."""

    depth: Tensor  # [H, W] [m]
    pose: Tensor  # [4, 4] float64 camera-to-world [m]
    intrinsics: Tensor  # [3, 3] float64 [px]
    # aleatoric, epistemic: [H, W] [m^2], or None.
    aleatoric: Tensor | None = None
    epistemic: Tensor | None = None
    features: Tensor | None = None  # [F, H, W], or None
    anchors: Anchors | None = None  # [1, N], or None


class UfMStarStreams:
    """The streams of a module, and which of them a sequence uses.

    A batch must have one size, so maps of another size get a module of their own with as many streams. A stream without
    a frame gets a pose of NaN, which UfM* with ``on_bad_frame = "skip"`` leaves out: its state stays as it is, but for
    the count of skipped frames, from which :meth:`state` takes these frames off again. Streams do not depend on each
    other: each has the values, to the last bit, that it has alone.

    Args:
        make: a module without a state.
        count: number of streams. One alone takes maps of any size.
    """

    def __init__(self, make: Callable[[], UfMStar], count: int = 1) -> None:
        self._make, self._count = make, count
        self._modules: dict[tuple[int, int] | None, UfMStar] = {None: make()}
        self._of: list[UfMStar | None] = [None] * count
        self._absent = [0] * count

    def module(self, stream: int) -> UfMStar:
        """The module of a stream; before its first frame one without a state."""
        return self._of[stream] or self._modules[None]

    def restart(self, stream: int) -> None:
        """Forget a stream: another sequence is to use it."""
        module, self._of[stream] = self.module(stream), None
        if len(module.mean):
            module.reset([stream])

    def choose(self, stream: int, size: tuple[int, int]) -> UfMStar:
        """The module of a stream, which the size (h, w) of its first map decides."""
        chosen = self._of[stream]
        if chosen is not None or self._count == 1:
            return chosen or self._modules[None]
        chosen = self._modules.setdefault(size, self._make())
        if len(chosen.mean):
            chosen.reset([stream])  # also the frames that it counted as skipped
        self._of[stream], self._absent[stream] = chosen, 0
        return chosen

    def __call__(self, given: Mapping[int, StreamInput]) -> dict[int, UfMStarOutput]:
        """The outputs, each as of a batch of one, of streams of one module for their next frame; their maps are of one
        size and kind. Errors as ``UfMStar.forward``; all streams are as they were then."""
        rows = [given.get(stream) for stream in range(self._count)]
        first = next(row for row in rows if row is not None)
        (module,) = {self.choose(stream, (one.depth.shape[0], one.depth.shape[1])) for stream, one in given.items()}
        nowhere = torch.full_like(first.pose, torch.nan)
        maps = {
            name: _stack([None if row is None else getattr(row, name) for row in rows])
            for name in ("depth", "aleatoric", "epistemic", "features")
        }
        out = module(
            pose=torch.stack([nowhere if row is None else row.pose for row in rows]),
            intrinsics=torch.stack([first.intrinsics if row is None else row.intrinsics for row in rows]),
            anchors=_padded([None if row is None else row.anchors for row in rows]),
            **maps,
        )
        for stream, row in enumerate(rows):
            self._absent[stream] += row is None and self._of[stream] is module
        return {stream: stream_of(out, stream) for stream in given}

    def mixture(self, stream: int) -> GaussianMixture:
        """[1, K] in the frame of the stream's first camera."""
        return stream_of(self.module(stream).mixture, stream)

    def tensor(self, stream: int, name: str) -> Tensor:
        """[1, ...] a tensor of the stream's state (``UfMStarState``)."""
        value: Tensor = getattr(self.module(stream), name)[stream : stream + 1]
        return value

    def state(self, stream: int) -> dict[str, Tensor]:
        """``UfMStar.state_dict`` as of the stream alone, which has room for as many components as all have."""
        state = dict(self.module(stream).state_dict())
        if self._count == 1:
            return state
        own = {name: value if name == "_extra_state" else value[stream : stream + 1] for name, value in state.items()}
        return own | {"skipped": own["skipped"] - self._absent[stream]}


def stream_of(batch: _Batch, stream: int) -> _Batch:
    """One stream of a dataclass of tensors, and of functions that return one, as a batch of one."""

    def one(value: Any) -> Any:
        if isinstance(value, Tensor):
            return value[stream : stream + 1]
        if callable(value):
            return lambda: one(value())
        return None if value is None else stream_of(value, stream)

    kind: Any = type(batch)
    return kind(**{f.name: one(getattr(batch, f.name)) for f in fields(kind)})


def _stack(values: Sequence[Tensor | None]) -> Tensor | None:
    """[B, ...] with zeros where there is none; None without any."""
    given = [value for value in values if value is not None]
    if not given:
        return None
    return torch.stack([torch.zeros_like(given[0]) if value is None else value for value in values])


def _padded(each: Sequence[Anchors | None]) -> Anchors | None:
    """[B, N] with as many as the longest row has, of which those that are none are masked; None without any."""
    given = [anchors for anchors in each if anchors is not None]
    if not given:
        return None
    room = max(anchors.depth.shape[1] for anchors in given)

    def part(name: str, anchors: Anchors | None) -> Tensor:
        like = getattr(given[0], name)
        value = None if anchors is None else getattr(anchors, name)
        if name == "valid":
            like = torch.ones_like(given[0].depth, dtype=torch.bool)
            value = torch.ones_like(anchors.depth, dtype=torch.bool) if value is None and anchors is not None else value
        out = like.new_zeros(1, room, *like.shape[2:])
        if value is not None:
            out[:, : value.shape[1]] = value
        return out

    names = ("pixel", "depth", "variance", "valid")
    return Anchors(**{name: torch.cat([part(name, anchors) for anchors in each]) for name in names})
