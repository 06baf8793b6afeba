"""What anchors cost: following corners and triangulating them, and a step that takes them, on one thread."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch import AnchorConfig, PosteriorConfig, UfMStar, UfMStarConfig
from ufmstar_torch.anchors.given import Anchors
from ufmstar_torch.anchors.tracker import Landmarks, LandmarkTracker, TrackerConfig
from ufmstar_torch.eval.bench.frames import FrameSource, PosedDepth
from ufmstar_torch.eval.bench.memory import state_memory, tensor_bytes
from ufmstar_torch.eval.bench.settings import BenchSettings
from ufmstar_torch.eval.bench.step import build_up
from ufmstar_torch.eval.bench.timing import TimedCalls, pinned_threads, spread_of_counts
from ufmstar_torch.eval.engine.clock import CallTimes
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.tour import tour_sequence
from ufmstar_torch.posterior.running import SIZE as POSTERIOR_SIZE

# Every moment in the tracker's update belongs to one of these; "rest" is the gray image and the window's upkeep.
PARTS = ("following", "searching", "triangulating", "rest")
_TRACKER_WARM_UP = 12  # frames: the window is full then
_STEP_WARM_UP = 3
# New corners are searched for when a fifth of the slots is free: with a quarter more slots than corners asked for, as
# many as asked for are followed on average.
_SLOTS_PER_POINT = 1.25
# The network of the anchored step is short by a tenth of the depth; its anchors have a standard deviation of 2 %.
_SHORT_BY, _ANCHOR_SIGMA = 0.1, 0.02


@dataclass(frozen=True)
class TrackedTour:
    """A rendered hall with enough corners in its textures, and a camera that walks and turns.

    Attributes:
        size: (H, W) of the images [px].
        seed: of the hall.
        path_frames: frames of the whole path, of which the first ones are taken: more are a slower walk.
    """

    size: tuple[int, int] = (480, 640)
    seed: int = 1
    path_frames: int = 900

    def frames(self, count: int) -> list[Frame]:
        """The first ``count`` frames, with images.

        Raises:
            ValueError: more than the path has.
        """
        if count > self.path_frames:
            raise ValueError(f"{count} frames were asked for, the path has {self.path_frames}")
        sequence = tour_sequence(self.seed, frames=self.path_frames, size=self.size, style="hall")
        return [sequence[index] for index in range(count)]


def measure_anchors(options: BenchSettings, source: FrameSource, config: UfMStarConfig, size: int) -> dict[str, Any]:
    """Time the tracker and the anchored step with ``options.anchors`` corners; torch, numba and OpenCV on one thread.

    Args:
        options: of the benchmark.
        source, config, size: of the step and its depth maps [px].

    Returns:
        "tracker" (see :func:`measure_tracker`), "step" (see :func:`measure_anchored_step`) and the settings.

    Raises:
        ValueError: too few frames.
        ModuleNotFoundError: OpenCV is not installed.
    """
    assert options.anchors is not None
    tour, points, frames = TrackedTour(), options.anchors, options.frames
    with pinned_threads(1, opencv=True):
        tracker = measure_tracker(tour.frames(_TRACKER_WARM_UP + frames), points)
        built, depths, _ = build_up(
            source, config.replace(anchors=AnchorConfig()), size=size, in_view=options.in_view, history=options.history,
            rounds=_STEP_WARM_UP + frames,
        )  # fmt: skip
        step = measure_anchored_step(built, depths, points)
    return {"points": points, "frames": frames, "threads": 1, "tour": asdict(tour), "tracker": tracker, "step": step}


def measure_tracker(frames: Sequence[Frame], points: int) -> dict[str, Any]:
    """Two trackers follow the same images in turn: one is timed as a whole, the other part by part; the first 12 frames
    are not counted.

    Returns:
        "update" and "parts": times [ms]; "refills": the share of frames in which new corners were taken;
        "followed" and "landmarks" per frame; "state_bytes".
    """
    config = TrackerConfig(max_points=round(_SLOTS_PER_POINT * points))
    whole, parts, timed = LandmarkTracker(config), _TimedTracker(config), TimedCalls()
    results: list[Landmarks] = []
    for frame in timed.frames(frames, warm_up=_TRACKER_WARM_UP):
        calls = {"whole": whole.update, "parts": parts.update}
        results.append(timed.call(calls, frame.image, frame.T_world_cam, frame.intrinsics)["whole"])
    parts.times.drop(_TRACKER_WARM_UP)
    counted = results[_TRACKER_WARM_UP:]
    return {
        "slots": config.max_points,
        "update": _spread(timed.times, "whole"),
        "parts": {name: _spread(parts.times, name) for name in PARTS},
        "refills": float(np.mean(parts.refilled[_TRACKER_WARM_UP:])),
        "followed": spread_of_counts([landmarks.tracked for landmarks in counted]),
        "landmarks": spread_of_counts([len(landmarks.depth) for landmarks in counted]),
        "state_bytes": tensor_bytes(whole.state().values()),
    }


def measure_anchored_step(built: UfMStar, frames: Sequence[PosedDepth], points: int) -> dict[str, Any]:
    """Steps without anchors, with them and with the posterior, from one state, in turn.

    Args:
        built: with ``config.anchors``; not modified.
        frames: the first 3 are not counted.
        points: anchors of a frame, at random pixels.

    Returns:
        "plain", "anchored" and "posterior": times [ms]; "ratio" of the first two; "used": anchors that were not
        rejected; "extra_bytes": what the state keeps of anchors, in all and per slot of the mixture.
    """
    plain, anchored, posterior = (copy.deepcopy(built) for _ in range(3))
    plain.config = built.config.replace(anchors=None)
    posterior.config = built.config.replace(posterior=PosteriorConfig())
    posterior.posterior = torch.zeros(len(built.mean), POSTERIOR_SIZE, dtype=torch.float64)
    calls: dict[str, Callable[[PosedDepth, Anchors], Any]] = {
        "plain": lambda frame, _: plain(*frame),
        "anchored": lambda frame, anchors: anchored(*frame, anchors=anchors),
        "posterior": lambda frame, anchors: posterior(*frame, anchors=anchors),
    }
    timed, used, rng = TimedCalls(), [], np.random.default_rng(0)
    for frame in timed.frames(frames, warm_up=_STEP_WARM_UP):
        results = timed.call(calls, frame, _anchors(frame, points, rng))
        used.append(int(results["anchored"].statistics.anchors_used))
    return {
        "size": frames[0].depth.shape[-1],
        "anchors": points,
        "used": spread_of_counts(used[_STEP_WARM_UP:]),
        "components": state_memory(anchored)["components"],
        **{name: _spread(timed.times, name) for name in calls},
        "ratio": timed.times.ratio("anchored", "plain"),
        "extra_bytes": {
            "total": anchored.evidence.nbytes + anchored.overall_evidence.nbytes,
            "per_slot": anchored.evidence[0, 0].nbytes,
        },
    }


class _TimedTracker(LandmarkTracker):
    """A tracker with times of its parts, each at most once a frame; "rest" is what the others leave of the update."""

    def __init__(self, config: TrackerConfig) -> None:
        super().__init__(config)
        self.times = CallTimes()
        self.refilled: list[bool] = []

    def update(
        self, image: NDArray[np.uint8] | None, T_world_cam: NDArray[np.float64], K: NDArray[np.float64]
    ) -> Landmarks:
        landmarks: Landmarks = self.times.time("rest", super().update, image, T_world_cam, K)
        for clock in (self.times.wall, self.times.cpu):
            for name in PARTS[:-1]:
                times = clock.setdefault(name, [])
                times.extend([0.0] * (len(clock["rest"]) - len(times)))  # a part that this frame did not need
                clock["rest"][-1] -= times[-1]
        return landmarks

    def _followed(self, *args: Any) -> tuple[NDArray, NDArray]:
        return self.times.time("following", super()._followed, *args)

    def _fill(self, gray: NDArray[np.uint8]) -> None:
        before = self._seen[:, self._view].sum()
        self.times.time("searching", super()._fill, gray)
        self.refilled.append(bool(before != self._seen[:, self._view].sum()))

    def _landmarks(self, tracked: int) -> Landmarks:
        return self.times.time("triangulating", super()._landmarks, tracked)


def _anchors(frame: PosedDepth, count: int, rng: np.random.Generator) -> Anchors:
    """At random pixels, with the depth that the network is short of and noise."""
    depth = frame.depth[0].double()
    height, width = depth.shape
    u, v = rng.integers(0, width, count), rng.integers(0, height, count)
    truth = depth[torch.from_numpy(v), torch.from_numpy(u)] / (1 - _SHORT_BY)
    noise = torch.from_numpy(1 + _ANCHOR_SIGMA * rng.standard_normal(count))
    pixel = torch.from_numpy(np.stack([u, v], axis=-1).astype(np.float64))
    return Anchors(pixel[None], (truth * noise)[None], (_ANCHOR_SIGMA * truth).square()[None])


def _spread(times: CallTimes, name: str) -> dict[str, float | int]:
    """Median, 90th percentile, mean and minimum of wall-clock and processor times [ms], and their count."""
    figures: dict[str, float | int] = {"count": len(times.wall[name])}
    for prefix, values in (("", times.wall[name]), ("cpu_", times.cpu[name])):
        least, median, p90 = np.percentile(values, (0, 50, 90)).tolist()
        of = {"median": median, "p90": p90, "mean": float(np.mean(values)), "min": least}
        figures |= {f"{prefix}{key}_ms": value for key, value in of.items()}
    return figures
