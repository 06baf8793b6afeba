"""``LiveDepth``: depth and variance from images and poses that arrive asynchronously, from any thread."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from threading import Condition, Thread, current_thread
from time import perf_counter
from typing import Self

import numpy as np
from torch import Tensor

from ufmstar_torch.files.state_file import StateFile
from ufmstar_torch.frames.arguments import (
    CameraLike,
    ImageLike,
    as_image,
    as_intrinsics,
    as_path,
    as_pose,
    require_number,
)
from ufmstar_torch.frames.clock import require_stamp
from ufmstar_torch.frames.frame import FRAME_FAULTS, NOT_FINITE
from ufmstar_torch.frames.image_queue import CLOSED, ImageQueue, QueuedImage
from ufmstar_torch.frames.output import UncertaintyOutput
from ufmstar_torch.uncertain_depth import UncertainDepth


@dataclass(frozen=True, eq=False)
class LiveResult:
    """An image's result; times are ``time.perf_counter``'s [s]."""

    stamp: float  # of the image, as it was pushed [s]
    image: ImageLike  # as it was pushed (a copy)
    T_world_cam: np.ndarray  # [4, 4] float64, interpolated at the stamp [m]
    out: UncertaintyOutput  # depth, variance and the rest
    received: float  # when the image was pushed
    started: float  # when its pose was available and the network began
    finished: float  # when the variance was computed

    @property
    def latency(self) -> float:
        """[s] From the image to its variance, the wait for its pose included."""
        return self.finished - self.received


@dataclass(frozen=True)
class LiveStatistics:
    """Counts so far. ``images`` = ``results`` + all ``dropped`` + all ``skipped`` + waiting images."""

    images: int  # pushed
    poses: int  # pushed
    dropped_poses: int  # those with a stamp far from the ones before
    results: int  # delivered
    dropped: Mapping[str, int]  # by reason: usable images
    skipped: Mapping[str, int]  # by reason: unusable images
    saved: int  # how often the state was saved
    restarts: int  # how often an image of another size or camera restarted the anchors' evidence


class LiveDepth:
    """Runs a model in a worker thread on the newest image with a pose.

    ``push_image`` and ``push_pose`` may be called from any thread and return at once. Poses may be late: an image waits
    for the first pose after it, at most ``max_wait``, and gets the pose interpolated at its stamp. There is no queue:
    when the model is free, it processes the newest image with a pose, and all older images are dropped. ``statistics``
    counts drops and skips by reason. Stamps of images and poses must come from one clock, in seconds. A single stamp
    that is over two seconds away from those before it is dropped and counted; the third in sequence is a jump of the
    clock, which is logged and followed.

    Args:
        model: an :class:`UncertainDepth` on one stream; from now on, only this object may call it. Call
            ``model.warm_up((480, 640))`` (of the images) first, or the first image waits for the compiler.
        on_result: called with each :class:`LiveResult` in the worker thread; the next image waits until it returns.
        intrinsics: of the images [px], [3, 3] or fx, fy, cx, cy; None = pass them to every ``push_image``.
        max_wait: longest wait for a pose after an image [s].
        max_gap: longest interval between the poses around an image, beyond which it is skipped [s].
        state: file of ``model.stream_state()``, from which the model continues if it exists, and to which the state
            is written atomically, every ``save_every`` seconds [s] and at the end. Delete the file for a new place.
            None = no file.
        save_every: see ``state``.

    Raises:
        TypeError, ValueError: an argument is invalid, another process writes ``state``, or the model cannot continue
            from the state in the file, which stays as it is.
        FileNotFoundError: the folder of ``state`` does not exist.

    An image of another size or camera resets the evidence of the model's anchors. An error in the model, in
    ``on_result`` or in saving ends the worker; later calls of ``push_*``, ``reset``, ``wait_idle`` and ``close`` raise
    it.
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
            if not 0 <= require_number(name, value) < math.inf:
                raise ValueError(f"{name} must be a number of seconds of at least 0, got {value}")
        if not hasattr(model, "ufm"):
            raise TypeError(f"model must be an UncertainDepth, got {type(model).__name__}: UncertainDepth(network)")
        if not callable(on_result):
            raise TypeError(f"on_result must be callable, got {type(on_result).__name__}")
        self._intrinsics = None if intrinsics is None else as_intrinsics(intrinsics)
        self._state = None if state is None else StateFile(as_path("state", state), model.load_stream_state)
        self.model, self._on_result = model, on_result
        self._save_every = save_every
        self._changed = Condition()  # guards everything below
        self._queue = ImageQueue(max_wait, max_gap)
        self._busy = self._ending = self._ended = self._resetting = False
        self._counts = Counter[str]()
        self._error: BaseException | None = None
        self._worker = Thread(target=self._run, name="ufmstar live", daemon=True)
        self._worker.start()

    def push_image(self, stamp: float, rgb: ImageLike, intrinsics: CameraLike | None = None) -> None:
        """Submit an image.

        Args:
            stamp: time of exposure [s], later than that of the previous image; an earlier image is skipped and counted.
            rgb: [H, W, 3] NumPy array or Pillow image, or [3, H, W] tensor, as for the model; copied.
            intrinsics: of this image [px], [3, 3] or fx, fy, cx, cy; None: those of the constructor.

        Raises:
            TypeError, ValueError: an argument is invalid, or there are no intrinsics.
            BaseException: the model or ``on_result`` failed before.
        """
        self._raise()
        received, stamp = perf_counter(), require_stamp(stamp)
        if len(as_image(rgb)) != 1:
            raise ValueError("rgb must be one image: create one LiveDepth per camera")
        K = self._intrinsics if intrinsics is None else as_intrinsics(intrinsics)
        if K is None:
            raise ValueError("intrinsics of the image are needed: pass them here, or once to LiveDepth")
        image = rgb.clone() if isinstance(rgb, Tensor) else rgb.copy()
        with self._changed:
            self._counts["images"] += 1
            if self._ending:
                self._queue.dropped[CLOSED] += 1
            elif self._queue.add(QueuedImage(stamp, image, K, received)):
                self._changed.notify_all()

    def push_pose(self, stamp: float, T: CameraLike) -> None:
        """Submit the camera's pose at a time; poses may come late, and in any order within two seconds. A pose replaces
        an earlier one with the same stamp.

        Args:
            stamp: [s].
            T: [4, 4] or [3, 4] camera-to-world [m]. NaN: tracking was lost, and images around the stamp are skipped.

        Raises:
            TypeError, ValueError: an argument is invalid, or the pose is finite but not rigid.
            BaseException: the model or ``on_result`` failed before.
        """
        self._raise()
        stamp, pose = require_stamp(stamp), _pose(T, self.model.ufm.config.rotation_tolerance)
        with self._changed:
            self._counts["poses"] += 1
            self._counts["dropped_poses"] += self._queue.add_pose(stamp, pose, perf_counter())
            if self._queue:  # a worker without an image has no use for a pose
                self._changed.notify_all()

    @property
    def statistics(self) -> LiveStatistics:
        """Counts so far."""
        with self._changed:
            names = ("images", "poses", "dropped_poses", "results", "saved")
            counts = {name: self._counts[name] for name in names}
            restarts = 0 if self.model.landmarks is None else self.model.landmarks.restarts
            return LiveStatistics(
                **counts, restarts=restarts, dropped=dict(self._queue.dropped), skipped=dict(self._queue.skipped)
            )

    def reset(self) -> None:
        """Drop poses and waiting images, and reset the model before its next image. Call this after a loop closure that
        moved old poses."""
        self._raise()
        with self._changed:
            self._queue.restart()
            self._resetting = True

    def wait_idle(self, timeout: float | None = None) -> bool:
        """Wait at most ``timeout`` [s] until no image waits or is processed (not in ``on_result``). Returns False after
        a timeout. Raises BaseException: the model or ``on_result`` failed."""
        timeout = None if timeout is None else require_number("timeout", timeout)
        with self._changed:
            idle = self._changed.wait_for(lambda: not (self._queue or self._busy) or self._ended, timeout)
        self._raise()
        return idle

    def close(self) -> None:
        """End after the current image, drop waiting images, save the state. May be called repeatedly, and in
        ``on_result``, where it does not wait for the worker. Raises BaseException: the model or ``on_result``
        failed."""
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
        with ExitStack() as stack:  # in reverse order, whatever fails
            stack.callback(self._finish)
            stack.push(self._keep_error)
            if self._state is not None:
                stack.callback(self._state.release)
            stack.push(self._keep_error)
            self._work()

    def _finish(self) -> None:
        with self._changed:
            self._busy, self._ended = False, True
            self._changed.notify_all()

    def _keep_error(self, _: object, error: BaseException | None, __: object) -> bool:
        self._error = self._error or error
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

    def _next(self) -> tuple[QueuedImage, np.ndarray, bool] | None:
        """Wait for the next image; returns it, its pose, and whether to reset the model first. None = the end."""
        with self._changed:
            self._busy = False
            while not self._ending:
                if (chosen := self._queue.take(perf_counter())) is not None:
                    self._busy, resetting, self._resetting = True, self._resetting, False
                    return *chosen, resetting
                self._changed.notify_all()
                wait = self._queue.due - perf_counter()
                self._changed.wait(None if wait == math.inf else max(wait, 0))
            self._queue.drop(CLOSED)
            return None

    def _process(self, frame: QueuedImage, T: np.ndarray, resetting: bool) -> bool:
        """Predict and deliver an image. Returns whether the state has changed."""
        if resetting:
            self.model.reset()
        started = perf_counter()
        out = self.model(frame.image, T, frame.intrinsics)
        finished = perf_counter()
        if fault := int(out.statistics.fault[0]):
            with self._changed:
                self._queue.skip(FRAME_FAULTS[fault], frame.stamp)
            return False
        with self._changed:
            self._counts["results"] += 1
        self._on_result(LiveResult(frame.stamp, frame.image, T, out, frame.received, started, finished))
        return True

    def _save(self) -> None:
        if self._state is not None:
            self._state.save(self.model.stream_state())
            with self._changed:
                self._counts["saved"] += 1


def _pose(T: CameraLike, tolerance: float) -> np.ndarray:
    """[4, 4] float64; all NaN where an entry is not finite. Raises TypeError, ValueError: no pose, or not rigid."""
    pose = as_pose(T).detach().cpu().double()
    if pose.dim() != 2:
        raise ValueError(f"T must be one pose, [4, 4] or [3, 4], got {tuple(pose.shape)}")
    rigid = np.array(pose.numpy())
    from ufmstar_torch.kernels.cpu.check import camera_faults  # kernels compile when they are first needed

    [fault] = camera_faults(rigid[None], np.eye(3)[None], (1, 1), tolerance)
    if fault == NOT_FINITE:
        return np.full((4, 4), np.nan)
    if fault:
        raise ValueError(f"T: {FRAME_FAULTS[fault]}")
    return rigid
