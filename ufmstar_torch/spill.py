"""Components that the present frame cannot reach, in files instead of memory (``config.spill``), an extension.

After a frame with more than ``config.max_components`` components, those that it could not reach are written out, the
farthest first, in pages of neighbours, until three quarters of the limit are left. Before a frame, every page that it
may reach is read back. A component is within reach of a frame where

- its mean may project into the image, at any depth beyond the near plane: then it can match (``correspond``); or
- its density may exceed 1e-9 of the prior's weight at a point of the depth map: then the regression reads it.

Both are decided by axis-aligned boxes against the planes of the viewing pyramid, which can only say "reached" too
often. So matching and fusion are those of a mixture that was never written out, to the last bit, and the map differs by
rounding; components stand in another order. What lies within reach of one frame is kept even beyond the limit.

Pages never change: a file is named by its content. Which pages are out is written beside them whenever it changes,
under the number of frames, so that a saved state finds its own pages as long as the folder is kept. A folder belongs to
one run.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
from collections.abc import Iterator, MutableMapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.state import UfMStarState

MEMORY = "memory"
_COLUMNS = ("mean", "covariance", "weight", "disagreement", "count", "features", "evidence")
_PAGE = 4.0  # [m] edge of the cubes whose components share a page
_KEPT = 0.75  # share of the limit that is left after writing out
_NEGLIGIBLE = 1e-9  # density at a point, in units of the prior's weight

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class Page:
    """Components that were written out together.

    Attributes:
        name: of the file.
        count: of its components.
        means: box around their means, lower and upper corner in the frame of the first camera [m].
        reach: box outside of which none of them counts [m].
    """

    name: str
    count: int
    means: Box
    reach: Box


class Folder(MutableMapping[str, bytes]):
    """Files of a folder by name; each is either the old one or the whole new one."""

    def __init__(self, path: str) -> None:
        self._path = Path(path)
        self._path.mkdir(parents=True, exist_ok=True)

    def __getitem__(self, name: str) -> bytes:
        return (self._path / name).read_bytes()

    def __setitem__(self, name: str, value: bytes) -> None:
        partial = self._path / f"{name}.partial"
        partial.write_bytes(value)
        os.replace(partial, self._path / name)

    def __delitem__(self, name: str) -> None:
        (self._path / name).unlink()

    def __contains__(self, name: object) -> bool:
        return (self._path / str(name)).exists()

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(p.name for p in self._path.iterdir() if p.suffix in (".npy", ".json")))

    def __len__(self) -> int:
        return len(list(iter(self)))


class Spill:
    """The pages of one stream of frames.

    Args:
        config: with ``spill`` and ``max_components``.

    Attributes:
        config: of the steps, whose mixture may grow.
        pages: that are out.
    """

    def __init__(self, config: UfMStarConfig) -> None:
        assert config.spill is not None
        assert config.max_components is not None
        self.config = config.replace(max_components=None, spill=None)
        self.pages: tuple[Page, ...] = ()
        self._limit = config.max_components
        self._store: MutableMapping[str, bytes] = {} if config.spill == MEMORY else Folder(config.spill)
        self._left: tuple[Page, ...] = ()  # those that the present frame has not read back
        self._frames = -1

    def read_back(self, state: UfMStarState, frame: FrameInput) -> UfMStarState:
        """The state with all components within reach of a frame. The pages stay listed until :meth:`write_out`.

        Raises:
            ValueError: several streams.
            OSError: a page cannot be read.
        """
        if state.weight.shape[0] != 1:
            raise ValueError(f"spill needs one stream, got {state.weight.shape[0]}")
        self._follow(int(state.frames[0]))
        self._left = self.pages
        if not self.pages or bool(frame.fault[0] != 0):
            return state
        boxes = (np.array([page.means for page in self.pages]), np.array([page.reach for page in self.pages]))
        reached = _reached(*boxes, state, frame, self.config)
        if not reached.any():
            return state
        self._left = tuple(page for page, hit in zip(self.pages, reached, strict=True) if not hit)
        rows = [self._read(page) for page, hit in zip(self.pages, reached, strict=True) if hit]
        return _with_rows(state, np.concatenate([_rows(state), *rows]))

    def write_out(self, state: UfMStarState, frame: FrameInput) -> UfMStarState:
        """The state without what is beyond the limit, as far as the frame cannot reach it.

        Raises:
            OSError: a page cannot be written; the list of pages is as before the frame.
        """
        pages = list(self._left)
        if int(state.mixture.components[0]) > self._limit and bool(frame.fault[0] == 0):
            rows = _rows(state)
            means, reach = _boxes(rows, self.config)
            free = np.flatnonzero(~_reached(means, reach, state, frame, self.config))
            camera = torch.linalg.inv(state.T_world_first[0]) @ frame.T_world_cam[0].to(state.T_world_first)
            cubes, member = np.unique(np.floor(rows[free, :3] / _PAGE), axis=0, return_inverse=True)
            distance = np.linalg.norm((cubes + 0.5) * _PAGE - camera[:3, 3].cpu().numpy(), axis=1)
            stays = np.ones(len(rows), np.bool_)
            for cube in np.argsort(-distance, kind="stable"):
                if stays.sum() <= _KEPT * self._limit:
                    break
                out = free[member.ravel() == cube]
                stays[out] = False
                pages.append(self._write(rows[out], means[out], reach[out]))
            state = _with_rows(state, rows[stays], max(self._limit, int(stays.sum())))
        frames = int(state.frames[0])
        if tuple(pages) != self.pages:
            self._list(tuple(pages), frames)
        self.pages, self._frames = tuple(pages), frames
        return state

    def everything(self, state: UfMStarState) -> UfMStarState:
        """The state with all components, as if none had been written out."""
        self._follow(int(state.frames[0]))
        return _with_rows(state, np.concatenate([_rows(state), *map(self._read, self.pages)]))

    def _read(self, page: Page) -> NDArray:
        rows: NDArray = np.load(io.BytesIO(self._store[page.name]))
        return rows

    def _write(self, rows: NDArray, means: NDArray, reach: NDArray) -> Page:
        buffer = io.BytesIO()
        np.save(buffer, rows)
        name = f"{hashlib.sha256(buffer.getvalue()).hexdigest()[:24]}.npy"
        if name not in self._store:
            self._store[name] = buffer.getvalue()
        return Page(name, len(rows), _around(means), _around(reach))

    def _list(self, pages: tuple[Page, ...], frames: int) -> None:
        """Write the list of pages that holds after so many frames."""
        self._forget(_index(frames))  # a run that went on from here before wrote others
        self._store[_index(frames)] = json.dumps([asdict(page) for page in pages]).encode()

    def _forget(self, first: str) -> None:
        for name in [n for n in self._store if n.endswith(".json") and n >= first]:
            del self._store[name]

    def _follow(self, frames: int) -> None:
        """Make the list of pages that of a state after so many frames: another one was loaded, or it was reset."""
        if frames == self._frames:
            return
        if frames == 0:
            self._forget("")
        known = [name for name in self._store if name.endswith(".json") and name <= _index(frames)]
        listed = json.loads(self._store[max(known)]) if known else []
        self.pages = tuple(Page(p["name"], p["count"], _tuples(p["means"]), _tuples(p["reach"])) for p in listed)
        self._frames = frames


def _index(frames: int) -> str:
    return f"pages-{frames:012d}.json"


def _tuples(box: list[list[float]]) -> Box:
    (a, b, c), (d, e, f) = box
    return (a, b, c), (d, e, f)


def _around(boxes: NDArray) -> Box:
    return _tuples([boxes[:, 0].min(0).tolist(), boxes[:, 1].max(0).tolist()])


def _rows(state: UfMStarState) -> NDArray:
    """[n, C] float64, the components in use; every number of a state is exact in it."""
    n = int(state.mixture.components[0])
    columns = [value for name in _COLUMNS if len(value := getattr(state, name)[0])]
    return np.concatenate([v[:n].cpu().double().reshape(n, math.prod(v.shape[1:])).numpy() for v in columns], 1)


def _with_rows(state: UfMStarState, rows: NDArray, capacity: int | None = None) -> UfMStarState:
    """The state with other components, in as many slots as before or more, or in ``capacity``."""
    slots = max(state.weight.shape[1], len(rows)) if capacity is None else capacity
    table, at, changed = torch.from_numpy(rows), 0, {}
    for name in _COLUMNS:
        old: Tensor = getattr(state, name)
        if not old.shape[1]:
            continue  # no evidence without anchors
        width = math.prod(old.shape[2:])
        new = old.new_zeros(1, slots, *old.shape[2:])
        new[0, : len(rows)] = table[:, at : at + width].reshape(len(rows), *old.shape[2:]).to(new)
        changed[name], at = new, at + width
    return replace(state, **changed)


def _boxes(rows: NDArray, config: UfMStarConfig) -> tuple[NDArray, NDArray]:
    """[n, 2, 3] the means as boxes, and the boxes outside of which a component's density is negligible [m]."""
    mean, covariance, weight = rows[:, :3], rows[:, 3:12].reshape(-1, 3, 3), rows[:, 12]
    log_peak = np.log(weight) - 1.5 * math.log(2 * math.pi) - 0.5 * np.linalg.slogdet(covariance)[1]
    square = np.maximum(2 * (log_peak - math.log(_NEGLIGIBLE * config.prior_weight)), 0.0)
    half = np.sqrt(square[:, None] * np.einsum("kii->ki", covariance)) * (1 + 1e-6)
    return np.stack([mean, mean], 1), np.stack([mean - half, mean + half], 1)


def _reached(means: NDArray, reach: NDArray, state: UfMStarState, frame: FrameInput, config: UfMStarConfig) -> NDArray:
    """[n] bool, whether a frame may reach what lies in boxes [n, 2, 3] in the frame of the first camera."""
    first = state.T_world_first[0] if bool(state.started[0]) else frame.T_world_cam[0]
    T = torch.linalg.inv(frame.T_world_cam[0]) @ first
    K, (height, width) = frame.intrinsics[0].cpu().double(), frame.size
    fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    # Inside: n . x + d >= 0 for every plane, in camera coordinates; a hair wider than the image.
    left, right, top, bottom = cx + 0.501, width - 0.499 - cx, cy + 0.501, height - 0.499 - cy
    sides = [[fx, 0, left, 0], [-fx, 0, right, 0], [0, fy, top, 0], [0, -fy, bottom, 0]]
    depth = torch.where(frame.valid, frame.depth, 0.0).max()
    near, far = [0, 0, 1, -config.near_plane * (1 - 1e-6)], [0, 0, -1, float(depth) * (1 + 1e-6)]
    move = T.cpu().double().numpy()
    matching = _meets(means, np.array([*sides, near], dtype=np.float64) @ move)
    return matching | _meets(reach, np.array([*sides, [0, 0, 1, 0], far], dtype=np.float64) @ move)


def _meets(boxes: NDArray, planes: NDArray) -> NDArray:
    """[n] False where a box [n, 2, 3] lies outside of one of the planes [P, 4]."""
    normal, offset = planes[:, :3], planes[:, 3]
    corner = np.where(normal >= 0, boxes[:, None, 1], boxes[:, None, 0])  # [n, P, 3] farthest along the normal
    slack = 1e-9 * (np.abs(corner) * np.abs(normal)).sum(-1)
    inside: NDArray = ((corner * normal).sum(-1) + offset >= -slack).all(1)
    return inside
