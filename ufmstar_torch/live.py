"""``LiveDepth``: depth with a variance from images and poses that arrive at their own pace, in any thread."""

from __future__ import annotations

import math
import sys
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from threading import Condition, Thread, current_thread
from time import perf_counter
from typing import Self

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.anchors.landmarks import OtherCameraError
from ufmstar_torch.arguments import CameraLike, ImageLike, as_image, as_intrinsics, as_pose
from ufmstar_torch.atomic import write_atomic
from ufmstar_torch.camera import rotation_deviation
from ufmstar_torch.frame import FRAME_FAULTS, pose_fault
from ufmstar_torch.pipeline import UncertainDepth, UncertainPrediction
from ufmstar_torch.stream_warnings import LOGGER
from ufmstar_torch.trajectory import SAME_TIME, Trajectory, interpolate_pose

# Why an image was dropped (another one was more recent) or skipped (it cannot be used).
NEWER, CLOSED = "a newer image was ready", "closed"
BACKWARDS, LATE, GAP = "its stamp is not after the image before", "no pose in time", "poses too far apart around it"
LOST = "a pose around it is not finite"
_WAITING = 16  # images that wait for their poses: half a second at 30 frames/s
_POSES = 4096  # poses kept: 4 s of an inertial filter at 1 kHz


@dataclass(frozen=True, eq=False)
class LiveResult:
    """An image's result; times are ``time.perf_counter``'s [s]."""

    stamp: float  # of the image, as it was pushed [s]
    image: ImageLike  # as it was pushed (a copy)
    T_world_cam: np.ndarray  # [4, 4] float64, interpolated at the stamp [m]
    out: UncertainPrediction  # depth, variance and the rest
    received: float  # when the image was pushed
    started: float  # when its pose was known and the network began
    finished: float  # when the variance was there

    @property
    def latency(self) -> float:
        """[s] From the image to its variance, the wait for its pose included."""
        return self.finished - self.received


@dataclass(frozen=True)
class LiveStatistics:
    """Counts so far. ``images`` = ``results`` + all ``dropped`` + all ``skipped`` + those that still wait."""

    images: int  # pushed
    poses: int  # pushed
    results: int  # delivered
    dropped: Mapping[str, int]  # by reason: images without a fault of their own
    skipped: Mapping[str, int]  # by reason: images that could not be used
    saved: int  # how often the state was
    restarts: int  # how often an image of another size or camera made the anchors' evidence start afresh


@dataclass(frozen=True, eq=False)
class _Waiting:
    """An image that waits for its pose."""

    stamp: float
    image: ImageLike
    intrinsics: Tensor
    received: float


class LiveDepth:
    """Runs a model in a thread of its own on the newest image whose pose is known.

    ``push_image`` and ``push_pose`` may be called from any thread and return at once. Poses may be late: an image waits
    for the first pose after it, at most ``max_wait``, and gets the pose interpolated at its stamp. Nothing queues:
    when the model is free, the newest image with a pose is taken and all older ones are dropped. ``statistics`` counts
    drops and skips by reason. Stamps of images and poses are of one clock, in seconds.

    Args:
        model: an :class:`UncertainDepth` on one stream; only this object calls it from now on. Call
            ``model.ufm.warm_up((224, 224))`` before, or the first image waits for the compiler.
        on_result: called with each :class:`LiveResult` in the worker thread; the next image waits for it.
        intrinsics: of the images [px], [3, 3] or fx, fy, cx, cy; None: every ``push_image`` has its own.
        max_wait: for poses after an image [s].
        max_gap: between the poses around an image, beyond which it is skipped [s].
        state: file in which ``model.state_dict()`` is saved, whole or not at all, every ``save_every`` seconds [s] and
            at the end; None = never. ``model.load_state_dict(torch.load(FILE))`` goes on from it.
        save_every: see ``state``.

    Raises:
        TypeError, ValueError: an argument is impossible.
        FileNotFoundError: the folder of ``state`` does not exist.

    Images of another size or camera than those before start the evidence of ``model``'s anchors afresh. An error of the
    model, of ``on_result`` or of saving ends the worker; every later ``push_*``, ``reset``, ``wait_idle`` and ``close``
    raises it.
    """

    def __init__(
        self,
        model: UncertainDepth,
        on_result: Callable[[LiveResult], object],
        intrinsics: CameraLike | None = None,
        *,
        max_wait: float = 0.2,
        max_gap: float = 0.1,
        state: str | Path | None = None,
        save_every: float = 10.0,
    ) -> None:
        for name, value in (("max_wait", max_wait), ("max_gap", max_gap), ("save_every", save_every)):
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} must be a number of seconds of at least 0, got {value}")
        if not hasattr(model, "ufm"):
            raise TypeError(f"model must be an UncertainDepth, got {type(model).__name__}: UncertainDepth(network)")
        if not callable(on_result):
            raise TypeError(f"on_result must be callable, got {type(on_result).__name__}")
        self._state = None if state is None else Path(state)
        if self._state is not None and not self._state.parent.is_dir():
            raise FileNotFoundError(f"state: no such folder: {self._state.parent}")
        if self._state is not None and self._state.is_dir():
            raise IsADirectoryError(f"state must be a file, got the folder {self._state}")
        self.model, self._on_result = model, on_result
        self._intrinsics = None if intrinsics is None else as_intrinsics(intrinsics)
        self._max_wait, self._max_gap, self._save_every = max_wait, max_gap, save_every
        self._changed = Condition()  # guards everything below
        self._waiting: list[_Waiting] = []  # images, the oldest first
        self._times: list[float] = []  # of the poses, increasing
        self._poses: list[np.ndarray] = []
        self._last_image = -math.inf
        self._busy = self._ending = self._ended = self._resetting = False
        self._counts, self._dropped, self._skipped = Counter[str](), Counter[str](), Counter[str]()
        self._error: BaseException | None = None
        self._worker = Thread(target=self._run, name="ufmstar live", daemon=True)
        self._worker.start()

    def push_image(self, stamp: float, rgb: ImageLike, intrinsics: CameraLike | None = None) -> None:
        """Offer an image.

        Args:
            stamp: moment of its exposure [s], after the image before; an earlier one is skipped and counted.
            rgb: [H, W, 3] NumPy array or Pillow image, or [3, H, W] tensor, as the model takes it; copied.
            intrinsics: of this image [px], [3, 3] or fx, fy, cx, cy; None: those of the constructor.

        Raises:
            TypeError, ValueError: an argument is impossible, or there are no intrinsics.
            BaseException: the model or ``on_result`` failed before.
        """
        self._raise()
        received, stamp = perf_counter(), _seconds(stamp)
        if len(as_image(rgb)) != 1:
            raise ValueError("rgb must be one image: every camera has a LiveDepth of its own")
        K = self._intrinsics if intrinsics is None else as_intrinsics(intrinsics)
        if K is None:
            raise ValueError("intrinsics of the image are needed: give them here, or once to LiveDepth")
        image = rgb.clone() if isinstance(rgb, Tensor) else rgb.copy()
        with self._changed:
            self._counts["images"] += 1
            if self._ending:
                self._dropped[CLOSED] += 1
            elif stamp <= self._last_image:
                self._skip(BACKWARDS, stamp)
            else:
                self._last_image = stamp
                if len(self._waiting) == _WAITING:  # the oldest will have its pose first: it stays
                    self._waiting.pop()
                    self._dropped[NEWER] += 1
                self._waiting.append(_Waiting(stamp, image, K, received))
                self._changed.notify_all()

    def push_pose(self, stamp: float, T: CameraLike) -> None:
        """Give the camera's pose at a moment; also late ones, in any order. One with the stamp of an earlier one
        replaces it.

        Args:
            stamp: [s].
            T: [4, 4] or [3, 4] camera-to-world [m]. With NaN: the position is lost, and images around it are skipped.

        Raises:
            TypeError, ValueError: an argument is impossible, or the pose is finite but not rigid.
            BaseException: the model or ``on_result`` failed before.
        """
        self._raise()
        stamp, pose = _seconds(stamp), _pose(T, self.model.ufm.config.rotation_tolerance)
        with self._changed:
            self._counts["poses"] += 1
            index = bisect_left(self._times, stamp)
            if index < len(self._times) and self._times[index] == stamp:
                self._poses[index] = pose
            else:
                self._times.insert(index, stamp)
                self._poses.insert(index, pose)
            del self._times[:-_POSES], self._poses[:-_POSES]
            self._changed.notify_all()

    @property
    def statistics(self) -> LiveStatistics:
        """Counts up to now."""
        with self._changed:
            counts = {name: self._counts[name] for name in ("images", "poses", "results", "saved", "restarts")}
            return LiveStatistics(**counts, dropped=dict(self._dropped), skipped=dict(self._skipped))

    def reset(self) -> None:
        """Forget views, poses and waiting images: after a loop closure that moved old poses, or a jump of the clock.
        The model is reset before its next image."""
        self._raise()
        with self._changed:
            self._drop_waiting(len(self._waiting), NEWER)
            self._times, self._poses, self._last_image, self._resetting = [], [], -math.inf, True

    def wait_idle(self, timeout: float | None = None) -> bool:
        """Wait until no image waits and none is computed, at most ``timeout`` [s] (not in ``on_result``); whether that
        came true. Raises BaseException: the model or ``on_result`` failed."""
        with self._changed:
            idle = self._changed.wait_for(lambda: not (self._waiting or self._busy) or self._ended, timeout)
        self._raise()
        return idle

    def close(self) -> None:
        """End after the current image, drop those that wait, save the state. May be called again, and in
        ``on_result``, which it ends without waiting. Raises BaseException: the model or ``on_result`` failed."""
        self._end()
        self._raise()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self._end()
        if kind is None:
            self._raise()

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error

    def _end(self) -> None:
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        if current_thread() is not self._worker:
            self._worker.join()

    def _run(self) -> None:
        with ExitStack() as stack:
            stack.push(self._keep_error)
            self._work()
        with self._changed:
            self._busy, self._ended = False, True
            self._changed.notify_all()

    def _keep_error(self, _: object, error: BaseException | None, __: object) -> bool:
        self._error = error
        return True

    def _work(self) -> None:
        saved, unsaved = perf_counter(), False
        while (chosen := self._next()) is not None:
            unsaved |= self._process(*chosen)
            if unsaved and perf_counter() - saved >= self._save_every:
                self._save()
                saved, unsaved = perf_counter(), False
        if unsaved:
            self._save()

    def _next(self) -> tuple[_Waiting, np.ndarray, bool] | None:
        """The next image, its pose, and whether to reset the model before, as soon as there is one; None = the end."""
        with self._changed:
            self._busy = False
            while not self._ending:
                if (chosen := self._choose(perf_counter())) is not None:
                    self._busy, resetting, self._resetting = True, self._resetting, False
                    return *chosen, resetting
                self._changed.notify_all()
                oldest = self._waiting[0].received if self._waiting else math.inf
                wait = oldest + self._max_wait - perf_counter()
                self._changed.wait(None if wait == math.inf else max(wait, 0))
            self._drop_waiting(len(self._waiting), CLOSED)
            return None

    def _choose(self, now: float) -> tuple[_Waiting, np.ndarray] | None:
        """The newest image that need not wait any longer and its pose; older ones are dropped."""
        latest = self._times[-1] if self._times else -math.inf
        for n in reversed(range(len(self._waiting))):
            frame = self._waiting[n]
            late = latest < frame.stamp - SAME_TIME
            if late and now - frame.received < self._max_wait:
                continue
            del self._waiting[n]
            T = self._pose_at(frame.stamp)
            if T is not None and np.isfinite(T).all():
                self._drop_waiting(n, NEWER)
                return frame, T
            self._skip(LOST if T is not None else LATE if late else GAP, frame.stamp)
        return None

    def _pose_at(self, stamp: float) -> np.ndarray | None:
        """The pose [4, 4] at a moment [s]; NaN or None as ``interpolate_pose``."""
        index = bisect_left(self._times, stamp)
        around = slice(max(index - 1, 0), index + 1)
        if not self._times[around]:
            return None
        trajectory = Trajectory(np.array(self._times[around]), np.stack(self._poses[around]))
        return interpolate_pose(trajectory, stamp, self._max_gap)

    def _process(self, frame: _Waiting, T: np.ndarray, resetting: bool) -> bool:
        """Predict and deliver an image; whether the state has changed."""
        if resetting:
            self.model.reset()
        started = perf_counter()
        try:
            out = self.model(frame.image, T, frame.intrinsics)
        except OtherCameraError:
            assert self.model.landmarks is not None
            self.model.landmarks.reset()
            with self._changed:
                self._counts["restarts"] += 1
            out = self.model(frame.image, T, frame.intrinsics)
        finished = perf_counter()
        if fault := int(out.ufm.statistics.fault[0]):
            with self._changed:
                self._skip(FRAME_FAULTS[fault], frame.stamp)
            return False
        with self._changed:
            self._counts["results"] += 1
        self._on_result(LiveResult(frame.stamp, frame.image, T, out, frame.received, started, finished))
        return True

    def _save(self) -> None:
        if self._state is not None:
            values = self.model.state_dict()
            write_atomic(self._state, lambda file: torch.save(values, file))
            with self._changed:
                self._counts["saved"] += 1

    def _skip(self, reason: str, stamp: float) -> None:
        """Count an image that cannot be used; the first one for each reason is logged with the times of the poses."""
        self._skipped[reason] += 1
        if self._skipped[reason] == 1:
            span = f"{self._times[0]:.3f} to {self._times[-1]:.3f} s" if self._times else "none"
            LOGGER.warning("image at %.3f s skipped: %s (poses: %s; said once)", stamp, reason, span)

    def _drop_waiting(self, count: int, reason: str) -> None:
        """Drop the ``count`` oldest images that wait."""
        del self._waiting[:count]
        if count:
            self._dropped[reason] += count


def _seconds(stamp: float) -> float:
    """A finite stamp. Raises TypeError, ValueError: it is none."""
    if isinstance(stamp, bool) or not isinstance(stamp, float | int | np.floating | np.integer):
        raise TypeError(f"stamp must be a number of seconds, got {type(stamp).__name__}")
    exact = stamp.item() if isinstance(stamp, np.generic) else stamp
    if not abs(exact) < sys.float_info.max:
        raise ValueError(f"stamp must be finite [s], got {stamp}")
    step = float(np.spacing(abs(stamp))) if isinstance(stamp, np.floating) else math.ulp(exact)
    if step > SAME_TIME:
        raise ValueError(f"stamp must be in seconds and exact to 1 ms, got {stamp}, which is exact to {step:g} s")
    return float(stamp)


def _pose(T: CameraLike, tolerance: float) -> np.ndarray:
    """[4, 4] float64; all NaN where an entry is not finite. Raises TypeError, ValueError: no pose, or not rigid."""
    pose = as_pose(T).detach().cpu().double()
    if pose.dim() != 2:
        raise ValueError(f"T must be one pose, [4, 4] or [3, 4], got {tuple(pose.shape)}")
    if not bool(pose.isfinite().all()):
        return np.full((4, 4), np.nan)
    fault = int(pose_fault(pose[None], rotation_deviation(pose[None, :3, :3]), tolerance)[0])
    if fault:
        raise ValueError(f"T: {FRAME_FAULTS[fault]}")
    rigid: np.ndarray = pose.numpy().copy()
    return rigid
