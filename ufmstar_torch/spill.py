"""Components that the present frame cannot reach, in files instead of memory (``config.spill``), an extension.

After a frame with more than ``config.max_components`` components, those that it could not reach are written out, the
farthest first, until three quarters of the limit are left; neighbours of about the same size share a page. Before a
frame, every page that it may reach is read back. A component is within reach of a frame where

- its mean may project into the image, at any depth beyond the near plane: then it can match (``correspond``); or
- its density may exceed 1e-9 of the prior's weight at a point of the depth map: then the regression reads it.

Both are decided by axis-aligned boxes against the planes of the viewing pyramid, which can only say "reached" too
often. So matching and fusion are those of a mixture that was never written out, to the last bit, and the map differs by
rounding; components stand in another order. What lies within reach of one frame is kept even beyond the limit.

The work of a frame depends on what is in memory and what it reads back: pages are looked up in a tree of boxes
(``spill_index``), and a journal keeps what changed (``spill_store``). Streams are independent; each has its own limit
and pages. A folder belongs to one run.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.spill_index import Page, PageIndex, View
from ufmstar_torch.spill_store import Change, Folder, Memory
from ufmstar_torch.state import UfMStarState

MEMORY = "memory"
_COLUMNS = ("mean", "covariance", "weight", "disagreement", "count", "features", "evidence")
_PAGE = 16  # most components of a page: the more there are, the more frames reach one of them and read them all
_KEPT = 0.75  # share of the limit that is left after writing out
_NEGLIGIBLE = 1e-9  # density at a point, in units of the prior's weight


@dataclass(frozen=True)
class Spilled:
    """What is out of memory, over all streams.

    Attributes:
        pages: that are out.
        components: in them.
        read: how many pages were read back so far.
    """

    pages: int
    components: int
    read: int


class Spill:
    """The pages of every stream.

    Args:
        config: with ``spill`` and ``max_components``.

    Attributes:
        config: of the steps, whose mixture may grow.
    """

    def __init__(self, config: UfMStarConfig) -> None:
        assert config.spill is not None
        assert config.max_components is not None
        self.config = config.replace(max_components=None, spill=None)
        self._limit, self._place = config.max_components, config.spill
        self._streams: list[_StreamPages] = []

    def read_back(self, state: UfMStarState, frame: FrameInput) -> UfMStarState:
        """The state with all components within reach of a frame. The pages stay listed until :meth:`write_out`.

        Raises:
            OSError: a page cannot be read.
        """
        streams = self._at(state)
        for b, pages in enumerate(streams):
            usable = len(pages.index) > 0 and bool(frame.fault[b] == 0)
            pages.back = pages.index.reached(_view(state, frame, b, self.config)) if usable else []
        if not any(pages.back for pages in streams):
            return state
        return _with_more(state, [pages.content(pages.back) for pages in streams])

    def write_out(self, state: UfMStarState, frame: FrameInput) -> UfMStarState:
        """The state without what is beyond the limit, as far as the frame cannot reach it.

        Raises:
            OSError: a page cannot be written; the pages are those before the frame.
        """
        beyond = (state.mixture.components > self._limit) & (frame.fault == 0)
        rows, out = [], []
        for b, pages in enumerate(self._streams):
            pages.changing()
            own = _rows(state, b) if bool(beyond.any()) else np.empty((0, 0))
            stays, left = _parted(own, state, frame, b, self.config, self._limit) if bool(beyond[b]) else (own, [])
            rows.append(stays)
            out.append([pages.write(*part) for part in left])
        for pages, new, frames in zip(self._streams, out, state.frames.tolist(), strict=True):
            pages.settle(frames, new)
        for pages, frames in zip(self._streams, state.frames.tolist(), strict=True):
            pages.frames = frames
        return _with_rows(state, rows, self._limit) if bool(beyond.any()) else state

    def everything(self, state: UfMStarState) -> UfMStarState:
        """The state with all components, as if none had been written out."""
        return _with_more(state, [pages.content(pages.index) for pages in self._at(state)])

    def spilled(self, state: UfMStarState) -> Spilled:
        """What is out of memory beside a state."""
        streams = self._at(state)
        each = [(len(pages.index), pages.index.components, pages.read) for pages in streams]
        return Spilled(*(sum(numbers) for numbers in zip((0, 0, 0), *each, strict=True)))

    def _at(self, state: UfMStarState) -> list[_StreamPages]:
        """The pages of the streams as they were at a state."""
        frames = state.frames.tolist()
        if len(self._streams) != len(frames):
            alone = len(frames) == 1
            self._streams = [_StreamPages(self._place, "" if alone else f"stream-{b}") for b in range(len(frames))]
        for pages, number in zip(self._streams, frames, strict=True):
            pages.follow(number)
        return self._streams


class _StreamPages:
    """The pages of one stream.

    Args:
        place: a folder, or ``MEMORY``.
        name: of the stream's own folder in it.

    Attributes:
        index: of the pages that are out.
        back: numbers of those that the present frame reads back.
        read: how many were read back so far.
        frames: after which these are out; -1 = to be looked up.
    """

    def __init__(self, place: str, name: str) -> None:
        self.index, self.back, self.read, self.frames = PageIndex(), list[int](), 0, -1
        self._store = Memory() if place == MEMORY else Folder(os.path.join(place, name))
        self._journal: tuple[Change, ...] | None = None  # to be written where that of the store is of another run
        self._next = 0

    def follow(self, frames: int) -> None:
        """Make the pages those of a state after so many frames: another one was loaded, or it was reset."""
        if frames == self.frames:
            return
        journal = self._store.changes()
        own = tuple(change for change in journal if 0 < change.frames <= frames)
        self._journal = None if own == journal else own
        self.index, self.frames, self._next = PageIndex(), frames, 0
        for change in own:
            self._take(change)

    def content(self, numbers: Sequence[int] | PageIndex) -> NDArray:
        """The rows [n, C] of pages, one page behind the other; [0, 0] of none."""
        pages = [self.index[number] for number in numbers]
        content = b"".join([self._store.read(page.name) for page in pages])
        return np.frombuffer(content).reshape(sum(page.count for page in pages), -1) if pages else np.empty((0, 0))

    def write(self, rows: NDArray, boxes: NDArray) -> Page:
        """A page of rows [n, C] with their boxes [n, 2, 2, 3], which is not listed yet."""
        content = rows.tobytes()
        name = f"{hashlib.sha256(content).hexdigest()[:24]}.f64"
        self._store.write(name, content)
        return Page(name, len(rows), np.stack([boxes[:, :, 0].min(0), boxes[:, :, 1].max(0)], 1))

    def changing(self) -> None:
        """From here on the pages are between two states: an error sends the next frame to the journal."""
        self.frames = -1

    def settle(self, frames: int, out: Sequence[Page]) -> None:
        """List the pages of a frame that has been taken in."""
        change = Change(frames, tuple(out), tuple(self.back))
        changes = (change,) if out or self.back else ()
        if self._journal is not None:
            self._store.rewrite((*self._journal, *changes))
            self._journal = None
        elif changes:
            self._store.append(change)
        self._take(change)
        self.read += len(self.back)
        self.back = []

    def _take(self, change: Change) -> None:
        for number in change.back:
            self.index.remove(number)
        for page in change.out:
            self.index.add(self._next, page)
            self._next += 1


def _parted(
    rows: NDArray, state: UfMStarState, frame: FrameInput, b: int, config: UfMStarConfig, limit: int
) -> tuple[NDArray, list[tuple[NDArray, NDArray]]]:
    """The rows that stay, and those of every page that goes, with their boxes."""
    boxes = _boxes(rows, config)
    free = np.flatnonzero(~_view(state, frame, b, config).reaches(boxes))
    camera = torch.linalg.inv(state.T_world_first[b]) @ frame.T_world_cam[b].to(state.T_world_first)
    distance = np.linalg.norm(rows[free, :3] - camera[:3, 3].cpu().numpy(), axis=1)
    goes = free[np.argsort(-distance, kind="stable")[: len(rows) - math.ceil(_KEPT * limit)]]
    stays = np.ones(len(rows), np.bool_)
    stays[goes] = False
    corners = boxes[:, 1].reshape(-1, 6)
    return rows[stays], [(rows[part], boxes[part]) for part in _divided(goes, corners)]


def _divided(members: NDArray[np.int64], corners: NDArray) -> list[NDArray[np.int64]]:
    """Members in halves of halves, each along the coordinate [n, 6] of the largest range, until they fit."""
    if len(members) <= _PAGE:
        return [members] if len(members) else []
    own = corners[members]
    order = members[np.argsort(own[:, np.ptp(own, axis=0).argmax()], kind="stable")]
    half = len(order) // 2
    return [*_divided(order[:half], corners), *_divided(order[half:], corners)]


def _rows(state: UfMStarState, b: int) -> NDArray:
    """[n, C] float64, the components of a stream; every number of a state is exact in it."""
    n = int(state.mixture.components[b])
    columns = [value[b] for value in _columns(state).values()]
    return np.concatenate([v[:n].cpu().double().reshape(n, math.prod(v.shape[1:])).numpy() for v in columns], 1)


def _with_rows(state: UfMStarState, rows: Sequence[NDArray], capacity: int) -> UfMStarState:
    """The state with other components [n, C] in every stream, in ``capacity`` slots or more."""
    slots = max(capacity, *map(len, rows))
    empty = {name: v.new_zeros(len(rows), slots, *v.shape[2:]) for name, v in _columns(state).items()}
    return _with_more(replace(state, **empty), rows)


def _with_more(state: UfMStarState, rows: Sequence[NDArray]) -> UfMStarState:
    """The state with more components [n, C] in every stream, in as many slots as before or more."""
    first = state.mixture.components.tolist()
    slots = max(state.weight.shape[1], *(n + len(table) for n, table in zip(first, rows, strict=True)))
    at, changed = 0, {}
    for name, old in _columns(state).items():
        width = math.prod(old.shape[2:])
        new = torch.cat([old, old.new_zeros(len(old), slots - old.shape[1], *old.shape[2:])], 1)
        for b, table in enumerate(rows):
            if len(table):
                values = torch.from_numpy(table[:, at : at + width].copy()).to(new)
                new[b, first[b] : first[b] + len(table)] = values.reshape(len(table), *old.shape[2:])
        changed[name], at = new, at + width
    return replace(state, **changed)


def _columns(state: UfMStarState) -> dict[str, Tensor]:
    """The tensors of the components; no evidence without anchors."""
    return {name: value for name in _COLUMNS if (value := getattr(state, name)).shape[1]}


def _boxes(rows: NDArray, config: UfMStarConfig) -> NDArray:
    """[n, 2, 2, 3] the means as boxes, and the boxes outside of which a component's density is negligible [m]."""
    mean, covariance, weight = rows[:, :3], rows[:, 3:12].reshape(-1, 3, 3), rows[:, 12]
    log_peak = np.log(weight) - 1.5 * math.log(2 * math.pi) - 0.5 * np.linalg.slogdet(covariance)[1]
    square = np.maximum(2 * (log_peak - math.log(_NEGLIGIBLE * config.prior_weight)), 0.0)
    half = np.sqrt(square[:, None] * np.einsum("kii->ki", covariance)) * (1 + 1e-6)
    return np.stack([mean, mean, mean - half, mean + half], 1).reshape(-1, 2, 2, 3)


def _view(state: UfMStarState, frame: FrameInput, b: int, config: UfMStarConfig) -> View:
    """What the frame of one stream may reach, in the frame of its first camera."""
    first = state.T_world_first[b] if bool(state.started[b]) else frame.T_world_cam[b]
    move = (torch.linalg.inv(frame.T_world_cam[b]) @ first).cpu().double().numpy()
    K, (height, width) = frame.intrinsics[b].cpu().double(), frame.size
    fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    # Inside: n . x + d >= 0 for every plane, in camera coordinates; a hair wider than the image.
    left, right, top, bottom = cx + 0.501, width - 0.499 - cx, cy + 0.501, height - 0.499 - cy
    sides = [[fx, 0, left, 0], [-fx, 0, right, 0], [0, fy, top, 0], [0, -fy, bottom, 0]]
    depth = torch.where(frame.valid[b], frame.depth[b], 0.0).max()
    near, far = [0, 0, 1, -config.near_plane * (1 - 1e-6)], [0, 0, -1, float(depth) * (1 + 1e-6)]
    planes = [np.array([*sides, *rest], dtype=np.float64) @ move for rest in ([near], [[0, 0, 1, 0], far])]
    return View(*planes)
