"""What the benchmark feeds to UfM*: a rendered room, or the frames of a recorded sequence."""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.eval.sequences import FrameSequence
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.eval.tour import box_room as synthetic
from ufmstar_torch.models import FastDepth, Preprocess

Floats = NDArray[np.float64]
_PITCH = np.array([7.2, 3.0, 7.2])  # from one room of a building to the next [m]
_ENDLESS = 10**12  # frames


class PosedDepth(NamedTuple):
    """One frame of one stream: the arguments of a step.

    Attributes:
        depth: [1, H, W] float32 [m], 0 where there is none.
        T_world_cam: [4, 4] float64 camera-to-world [m].
        intrinsics: [3, 3] float64 of the depth map [px].
    """

    depth: Tensor
    T_world_cam: Tensor
    intrinsics: Tensor


class FrameSource(ABC):
    """Where frames come from."""

    @property
    def available(self) -> int | None:
        """How many frames there are, None = as many as one likes."""
        return None

    @abstractmethod
    def frames(self, size: int, count: int) -> Iterator[PosedDepth]:
        """The first ``count`` frames at size x size pixels, or fewer where there are not so many."""

    @abstractmethod
    def describe(self) -> dict[str, object]:
        """What it is, for the report."""


@dataclass(frozen=True, kw_only=True)
class _Rendered(FrameSource):
    """Frames whose depth flickers as a network's does, without an end.

    Attributes:
        flicker: standard deviation of the smooth relative error of the depth.
        seed: of what is rendered and of the flicker.
        max_depth: what lies farther has no depth [m].
    """

    KIND: ClassVar[str]
    flicker: float = 0.03
    seed: int = 0
    max_depth: float = math.inf

    def frames(self, size: int, count: int) -> Iterator[PosedDepth]:
        K, rng = synthetic.intrinsics(size, size), np.random.default_rng(self.seed)
        for room, T, origin in itertools.islice(self._views(), count):
            depth = synthetic.flicker(synthetic.render(room, T, K, size, size), self.flicker, rng)
            depth = np.where(depth <= self.max_depth, depth, 0.0)
            T[:3, 3] += origin
            yield PosedDepth(torch.from_numpy(depth).float()[None], torch.from_numpy(T), torch.from_numpy(K))

    def describe(self) -> dict[str, object]:
        settings = {name: value for name, value in asdict(self).items() if value != math.inf}
        return {"kind": f"rendered {self.KIND}", **settings}

    @abstractmethod
    def _views(self) -> Iterator[tuple[synthetic.BoxRoom, Floats, Floats]]:
        """What each frame sees, the camera's pose [4, 4] in it, and where its origin lies in the world [3] [m]."""


@dataclass(frozen=True, kw_only=True)
class RenderedRoom(_Rendered):
    """A room with things in it, in which the camera turns.

    Attributes:
        boxes: number of things.
        period: frames per turn of the camera.
    """

    KIND: ClassVar[str] = "room"
    boxes: int = 40
    period: int = 100

    def _views(self) -> Iterator[tuple[synthetic.BoxRoom, Floats, Floats]]:
        room = synthetic.BoxRoom.furnished(self.boxes, self.seed)
        for T in synthetic.walk(_ENDLESS, self.period):
            yield room, T, np.zeros(3)


@dataclass(frozen=True, kw_only=True)
class RenderedBuilding(_Rendered):
    """Furnished rooms, four on a floor, in each of which the camera turns once; after the last one, again from the
    first.

    Attributes:
        floors: of four rooms each.
        boxes: number of things in a room.
        period: frames per turn of the camera.
    """

    KIND: ClassVar[str] = "building"
    floors: int = 5
    boxes: int = 40
    period: int = 50

    def _views(self) -> Iterator[tuple[synthetic.BoxRoom, Floats, Floats]]:
        rooms = [synthetic.BoxRoom.furnished(self.boxes, self.seed + number) for number in range(4 * self.floors)]
        for frame, T in enumerate(synthetic.walk(_ENDLESS, self.period)):
            number = frame // self.period % len(rooms)
            yield rooms[number], T, _PITCH * [number % 2, -(number // 4), number // 2 % 2]


@dataclass(frozen=True, kw_only=True)
class RenderedStreet(_Rendered):
    """A drive straight along a street of 20 m between houses, with things on both sides.

    Attributes:
        step: way between two frames [m].
        gap: mean way between two things of one side [m].
    """

    KIND: ClassVar[str] = "street"
    step: float = 2.0
    gap: float = 6.0
    max_depth: float = 60.0

    def _views(self) -> Iterator[tuple[synthetic.BoxRoom, Floats, Floats]]:
        for number in itertools.count():
            z = self.step * number
            T = synthetic.look((np.sin(0.05 * number), 0.0, z), 0.1 * np.sin(0.11 * number), 0.05)
            yield self._around(z), T, np.zeros(3)

    def _around(self, z: float) -> synthetic.BoxRoom:
        """What a camera at z can see of the street."""
        places = range(int((z - 2 * self.gap) / self.gap), int((z + 1.2 * self.max_depth) / self.gap) + 1)
        boxes = np.array([self._thing(place, side) for place in places for side in (-1.0, 1.0)])
        return synthetic.BoxRoom(np.array([[-10.0, -12.0, z - 60.0], [10.0, 1.5, z + 10 * self.max_depth]]), boxes)

    def _thing(self, place: int, side: float) -> Floats:
        """[2, 3] the corners of the thing at a place of one side."""
        rng = np.random.default_rng([self.seed, place + 2**31, int(side > 0)])
        size = rng.uniform((0.6, 0.8, 0.8), (1.8, 4.0, 4.5))
        x, z = side * rng.uniform(4.5, 8.5), self.gap * (place + rng.uniform(0, 1))
        return np.array([[x - size[0] / 2, 1.5 - size[1], z], [x + size[0] / 2, 1.5, z + size[2]]])


@dataclass(frozen=True)
class RecordedSequence(FrameSource):
    """Frames on disk with their own depth, or with FastDepth's prediction from their images.

    Attributes:
        path: the sequence, any layout that ``open_sequence`` knows.
        network: predicts the depth at its own resolution; None = the sequence's depth maps.
    """

    path: Path
    network: FastDepth | None = None

    @property
    def available(self) -> int:
        return len(self._open())

    def frames(self, size: int, count: int) -> Iterator[PosedDepth]:
        """The first ``count`` frames, cropped to the centre and resized to size x size pixels.

        Raises:
            ValueError: they have no depth maps and no network predicts any.
        """
        sequence = self._open()
        if self.network is None and sequence.without_depth:
            raise ValueError(
                f"{self.path} has frames without a depth map: give weights to predict depth from the images"
            )
        for index in range(min(count, len(sequence))):
            frame = sequence[index]
            T = torch.from_numpy(frame.T_world_cam)
            if self.network is None:
                assert frame.depth is not None  # checked above
                own = frame.intrinsics if frame.depth_intrinsics is None else frame.depth_intrinsics
                depth, K = torch.from_numpy(frame.depth)[None], torch.from_numpy(own)
                square = Preprocess(resize_height=size, crop=(size, size))
                yield PosedDepth(square.apply_depth(depth), T, square.apply_intrinsics(K, *depth.shape[-2:]))
            else:
                yield _predicted(self.network, image_tensor(frame), T, torch.from_numpy(frame.intrinsics), size)

    def describe(self) -> dict[str, object]:
        """What was read, for the report; the folder's name only, not where it lies on this machine."""
        depth = "of the sequence" if self.network is None else "predicted by FastDepth"
        return {"kind": "recorded sequence", "name": self.path.name, "depth": depth}

    def _open(self) -> FrameSequence:
        from ufmstar_torch.eval.sequences import open_sequence

        return open_sequence(self.path)


def _predicted(network: FastDepth, image: Tensor, T_world_cam: Tensor, K: Tensor, size: int) -> PosedDepth:
    """FastDepth at the resolution it was trained for, enlarged linearly."""
    x, K = network.preprocess(image, K)
    with torch.inference_mode():
        depth = network(x).depth
    enlarged = Preprocess(size=(size, size), antialias=False)
    resized = torch.nn.functional.interpolate(depth[None], (size, size), mode="bilinear")[0]
    return PosedDepth(resized.clone(), T_world_cam, enlarged.apply_intrinsics(K, *depth.shape[-2:]))
