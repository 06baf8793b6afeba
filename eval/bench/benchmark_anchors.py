"""What anchors cost: following corners and triangulating them, and a step that takes them, on one thread."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import cycle
from time import perf_counter, process_time
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.anchors.given import Anchors
from ufmstar_torch.anchors.tracker import Landmarks, LandmarkTracker, TrackerConfig
from ufmstar_torch.eval.bench.benchmark_frames import FrameSource, PosedDepth
from ufmstar_torch.eval.bench.benchmark_step import build_up, memory
from ufmstar_torch.eval.bench.benchmark_timing import pinned_threads
from ufmstar_torch.eval.engine.clock import CallTimes
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.tour import tour_sequence

# Every moment in the tracker's update belongs to one of these; "rest" is the gray image and the window's upkeep.
PARTS = ("following", "searching", "triangulating", "rest")
_WARM_UP = 12  # frames: the window is full then
# New corners are searched for when a fifth of the slots is free: with a quarter more slots than corners asked for, as
# many as asked for are followed on average.
_SLOTS_PER_POINT = 1.25
# The network of the anchored step is short by a tenth of the depth; its anchors have a standard deviation of 2 %.
_SHORT_BY, _ANCHOR_SIGMA = 0.1, 0.02


@dataclass(frozen=True)
class TrackedTour:
    """A rendered hall whose textures have corners enough, seen by a camera that walks and turns.

    Attributes:
        size: (H, W) of the images [px].
        seed: of the hall.
        path_frames: frames of the whole way, of which the first ones are taken: more are a slower walk.
    """

    size: tuple[int, int] = (480, 640)
    seed: int = 1
    path_frames: int = 900

    def frames(self, count: int) -> list[Frame]:
        """The first ``count`` frames, with images.

        Raises:
            ValueError: more than the way has.
        """
        if count > self.path_frames:
            raise ValueError(f"{count} frames were asked for, the way has {self.path_frames}")
        sequence = tour_sequence(self.seed, frames=self.path_frames, size=self.size, style="hall")
        return [sequence[index] for index in range(count)]


def measure_anchors(
    source: FrameSource,
    config: UfMStarConfig,
    *,
    points: int,
    frames: int,
    history: int,
    in_view: int,
    step_size: int,
    tour: TrackedTour | None = None,
) -> dict[str, Any]:
    """Time the tracker and the anchored step with ``points`` corners, on one thread of torch, numba and OpenCV.

    Args:
        source: of the step's depth maps.
        config: of the step.
        points: corners to follow on average, and anchors of a step.
        frames: timed.
        history, in_view: as :func:`~ufmstar_torch.eval.bench.benchmark_step.build_up` takes them.
        step_size: of the step's depth maps [px].
        tour: what the tracker sees; None = the standard one.

    Returns:
        "tracker" (see :func:`measure_tracker`), "step" (see :func:`measure_step`) and the settings.

    Raises:
        ValueError: ``points`` is not positive, or too few frames.
        ModuleNotFoundError: OpenCV is not installed.
    """
    if points < 1:
        raise ValueError(f"points must be at least 1, got {points}")
    tour = TrackedTour() if tour is None else tour
    with one_thread():
        tracker = measure_tracker(tour.frames(_WARM_UP + frames), points)
        built, depths, _ = build_up(
            source, config.replace(anchored=True), size=step_size, in_view=in_view, history=history, rounds=3 + frames
        )
        step = measure_step(built, depths, points, warm_up=3)
    return {"points": points, "frames": frames, "threads": 1, "tour": asdict(tour), "tracker": tracker, "step": step}


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch, numba and OpenCV use one thread each; afterwards what they used before.

    Raises:
        ModuleNotFoundError: OpenCV is not installed.
    """
    import cv2

    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        with pinned_threads(1):
            yield
    finally:
        cv2.setNumThreads(before)


def measure_tracker(frames: Sequence[Frame], points: int) -> dict[str, Any]:
    """Two trackers follow the same images in turns: one is timed as a whole, the other part by part.

    Returns:
        "update" and "parts": times [ms]; "refills": the share of frames in which new corners were taken;
        "followed" and "landmarks" per frame; "state_bytes".
    """
    config = TrackerConfig(max_points=round(_SLOTS_PER_POINT * points))
    whole, parts, watch = LandmarkTracker(config), _Parts(config), CallTimes()
    results: list[Landmarks] = []
    for frame in frames:
        arguments = (_image(frame), frame.T_world_cam, frame.intrinsics)
        results.append(watch.time("whole", whole.update, *arguments))
        parts.update(*arguments)
    watch.drop(_WARM_UP)
    parts.drop(_WARM_UP)
    timed = results[_WARM_UP:]
    return {
        "slots": config.max_points,
        "update": _times(watch.wall["whole"], watch.cpu["whole"]),
        "parts": {name: _times(parts.wall[name], parts.cpu[name]) for name in PARTS},
        "refills": float(np.mean(parts.refilled)),
        "followed": _counts([found.tracked for found in timed]),
        "landmarks": _counts([len(found.depth) for found in timed]),
        "state_bytes": sum(value.nelement() * value.element_size() for value in whole.state().values()),
    }


def measure_step(built: UfMStar, frames: Sequence[PosedDepth], points: int, *, warm_up: int) -> dict[str, Any]:
    """Steps with and without anchors from one state, in turns; which is first alternates.

    Args:
        built: with ``config.anchored``; not modified.
        frames: the first ``warm_up`` are not counted.
        points: anchors of a frame, at random pixels.

    Returns:
        "plain" and "anchored": times [ms]; "ratio" of the two; "used": anchors that were believed; "extra_bytes":
        what the state holds besides, in all and per slot of the mixture.
    """
    plain, anchored = copy.deepcopy(built), copy.deepcopy(built)
    plain.config = built.config.replace(anchored=False)
    watch, used, rng = CallTimes(), [], np.random.default_rng(0)
    calls: dict[str, Callable[[PosedDepth, Anchors], Any]] = {
        "plain": lambda f, _: plain(f.depth, f.T_world_cam, f.intrinsics),
        "anchored": lambda f, a: anchored(f.depth, f.T_world_cam, f.intrinsics, anchors=a),
    }
    orders = cycle([list(calls), list(calls)[::-1]])
    for frame, order in zip(frames, orders, strict=False):
        anchors = _anchors(frame, points, rng)
        found = {name: watch.time(name, calls[name], frame, anchors) for name in order}
        used.append(int(found["anchored"].statistics.anchors_used))
    watch.drop(warm_up)
    extra = anchored.evidence.nbytes + anchored.overall_evidence.nbytes
    return {
        "size": frames[0].depth.shape[-1],
        "anchors": points,
        "used": _counts(used[warm_up:]),
        "components": memory(anchored)["components"],
        **{name: _times(watch.wall[name], watch.cpu[name]) for name in calls},
        "ratio": watch.ratio("anchored", "plain"),
        "extra_bytes": {"total": extra, "per_slot": anchored.evidence[0, 0].nbytes},
    }


class _Parts(LandmarkTracker):
    """A tracker that notes how long each of its parts takes, wall-clock and processor time [ms]."""

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__(config)
        self.wall: dict[str, list[float]] = {name: [] for name in PARTS}
        self.cpu: dict[str, list[float]] = {name: [] for name in PARTS}
        self.refilled: list[bool] = []
        self._spent: dict[str, tuple[float, float]] = {}

    def update(self, image: NDArray[np.uint8], T_world_cam: NDArray[np.float64], K: NDArray[np.float64]) -> Landmarks:
        self._spent = dict.fromkeys(PARTS, (0.0, 0.0))
        found: Landmarks = self._timed("rest", super().update, image, T_world_cam, K)
        wall, cpu = (sum(self._spent[name][i] for name in PARTS[:-1]) for i in range(2))
        self._spent["rest"] = self._spent["rest"][0] - wall, self._spent["rest"][1] - cpu
        for name, (wall, cpu) in self._spent.items():
            self.wall[name].append(wall)
            self.cpu[name].append(cpu)
        return found

    def drop(self, count: int) -> None:
        """Forget the first ``count`` frames: the warm-up."""
        for times in (*self.wall.values(), *self.cpu.values()):
            del times[:count]
        del self.refilled[:count]

    def _followed(self, gray: NDArray[np.uint8]) -> tuple[NDArray, NDArray]:
        return self._timed("following", super()._followed, gray)

    def _fill(self, gray: NDArray[np.uint8]) -> None:
        free = int((~self._seen[:, self._view]).sum())
        self._timed("searching", super()._fill, gray)
        self.refilled.append(free != int((~self._seen[:, self._view]).sum()))

    def _landmarks(self, tracked: int) -> Landmarks:
        return self._timed("triangulating", super()._landmarks, tracked)

    def _timed(self, name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        cpu, wall = process_time(), perf_counter()
        result = function(*arguments)
        wall, cpu = perf_counter() - wall, process_time() - cpu
        self._spent[name] = 1e3 * wall, 1e3 * cpu
        return result


def _image(frame: Frame) -> NDArray[np.uint8]:
    assert frame.image is not None  # a tour's always has
    return frame.image


def _anchors(frame: PosedDepth, count: int, rng: np.random.Generator) -> Anchors:
    """At random pixels, with the depth that the network is short of and noise."""
    depth = frame.depth[0].double()
    height, width = depth.shape
    u, v = rng.integers(0, width, count), rng.integers(0, height, count)
    truth = depth[torch.from_numpy(v), torch.from_numpy(u)] / (1 - _SHORT_BY)
    noise = torch.from_numpy(1 + _ANCHOR_SIGMA * rng.standard_normal(count))
    pixel = torch.from_numpy(np.stack([u, v], axis=-1).astype(np.float64))
    return Anchors(pixel[None], (truth * noise)[None], (_ANCHOR_SIGMA * truth).square()[None])


def _times(wall: Sequence[float], cpu: Sequence[float]) -> dict[str, float | int]:
    """Median, 90th percentile, mean and minimum of wall-clock and processor times [ms], and their count."""
    told: dict[str, float | int] = {"count": len(wall)}
    for prefix, values in (("", wall), ("cpu_", cpu)):
        median, p90 = (float(q) for q in np.percentile(np.asarray(values, np.float64), (50, 90)))
        told |= {f"{prefix}median_ms": median, f"{prefix}p90_ms": p90}
        told |= {f"{prefix}mean_ms": float(np.mean(values)), f"{prefix}min_ms": float(min(values))}
    return told


def _counts(values: Sequence[int]) -> dict[str, float]:
    return {
        "median": float(np.median(values)),
        "mean": float(np.mean(values)),
        "min": float(min(values)),
        "max": float(max(values)),
    }
