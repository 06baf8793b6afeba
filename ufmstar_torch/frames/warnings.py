"""Warnings about implausible input of a stream: each once, to the logger ``ufmstar_torch``."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from operator import itemgetter
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.frames.output import FrameStatistics

Depth = NDArray[np.floating[Any]]

# Least frames and components before a warning about views, and the largest share of components seen in only one view.
# On rendered tours, also at 1/10 of their frames, correct input stays below .7; poses in millimetres reach .99.
_FRAMES, _COMPONENTS, _ALONE = 8, 20, 0.9
# Path of the camera over the mean depth from which on views must differ: ten times the default ``view_baseline``.
_TRAVELLED = 0.7
# Anchors: least frames in which the camera moved by this share of the depth; warn below one used anchor per such frame.
_MOVED_FRAMES, _MOVED = 10, 0.01
# Largest share of pixels outside the accepted ranges, and largest standard deviation of most pixels over their depth.
_OUTSIDE, _WIDE = 0.1, 10.0
# Largest ratio of the focal lengths (over the image size) of successive frames. Largest step over the largest previous
# step, and over the mean depth, after ``_FRAMES`` steps. Largest median relative change of the depth under one pose:
# moving cameras of recordings show .07 to .5 within 8 frames.
_ZOOM, _JUMP, _AWAY, _CHANGE = 1.2, 10.0, 2.0, 0.1
# Alternating poses: successive frames that lie this many times nearer to the frame before the last than to the last.
_ALTERNATING, _NEARER = 6, 5.0
# A batch that holds successive frames of one video: least streams, successive calls, and the largest distance between
# successive frames over the step of the first stream (1/B for a uniform motion).
_BATCH, _CONTINUED, _SUCCESSIVE = 3, 3, 0.5
# A first batch whose poses form one path, as a clip's: least streams; least share of steps to the nearest of all later,
# or earlier, poses; longest step over the mean depth, and largest rotation [rad] of a step.
_CLIP, _IN_ORDER, _STEP, _TURN = 5, 0.8, 0.25, 0.35
# Shares of pixels: of valid ones, below which ``valid`` may be inverted; of those with the largest depth, if it is the
# same in every frame.
_SPARSE, _SATURATED = 0.1, 0.2
# The principal point of real cameras and usual crops lies within these shares of the image; that of a K for twice or
# half the size does not.
CENTRE_RANGE = (0.2, 0.8)
# Stride of the depth maps' rows in these checks.
_ROWS = 8
# On an accelerator, reading the counts synchronises: only every so many frames, and not while a graph is recorded.
EVERY = 64
# Counts of a frame that are read for these checks, and their type.
_READ = ("segments", "valid_pixels", "beyond", "out_of_range", "components", "fault", "single_view")
_READ_FROM = itemgetter(*_READ)
_Counts = dict[str, list[int]]
_Camera = tuple[list[list[float]], tuple[int, int]]  # intrinsics [px], and image height and width
LOGGER = logging.getLogger("ufmstar_torch")
_ONE_VIDEO = (
    "the {} streams of a batch look like successive frames of one video{}. Views are compared within a stream only: "
    "pass one frame at a time"
)
_CAUSES = (
    "Likely causes: poses or depth in another unit (millimetres, a scale of their own), world-to-camera poses, axes of "
    "another convention, a trajectory of other times, depth that is inverse or relative, or intrinsics of an image of "
    "another size"
)


def log_once(logged: set[tuple[int, str]], findings: Iterable[tuple[int, str, str]]) -> None:
    """Log the texts of findings (stream, kind, text) whose stream and kind are not ``logged``, and add these."""
    for b, kind, text in findings:
        if (b, kind) not in logged:
            logged.add((b, kind))
            LOGGER.warning("stream %d: %s (logged once)", b, text)


@dataclass
class _Track:
    """Statistics of a stream's frames without a fault."""

    first: list[list[float]]  # first pose
    T: list[list[float]]  # last pose
    camera: _Camera  # last intrinsics and image size
    total: float  # sum of the last depth map's rows
    anchored_at: tuple[float, float, float]  # camera position in the last of the ``moving`` frames
    moving: int = 0  # frames with anchors in which the camera had moved
    used: int = 0  # anchors used in these frames
    travelled: float = 0.0  # path, each step over the mean depth
    steps: int = 0  # changes of the pose
    largest: float = 0.0  # longest step [m]
    before: tuple[float, float, float] | None = None  # position before the last one
    alternating: int = 0  # successive frames that returned to the position before the last
    same: int = 0  # successive changes of the pose with an unchanged depth map
    still: int = 0  # successive frames with an unchanged pose
    farthest: float = 0.0  # largest depth of the last frame
    saturated: int = 0  # successive changes of the pose with the same largest depth
    depth: Depth | None = None  # depth map at the first of the ``still`` frames
    member: float = 0.0  # index of the network that predicted it
    waiting: bool = False  # whether its next prediction is to be compared

    def follow(
        self, T: list[list[float]], camera: _Camera, depth: Depth, total: float, mean: float, member: float
    ) -> Iterator[tuple[str, str]]:
        """Update the statistics with a frame of a ``mean`` depth [m]; yields kinds and texts of warnings."""
        position, last = _position(T), _position(self.T)
        step = math.dist(position, last)
        if camera != self.camera:
            yield from self._zoom(camera)
        if T == self.T:
            yield from self._stay(depth, member)
        else:
            self.still, self.same = 0, self.same + 1 if total == self.total else 0
            if self.same == _FRAMES:
                yield "depth", f"the depth map was the same in {_FRAMES + 1} frames of a moving camera: is it updated?"
            returned = self.before is not None and _NEARER * math.dist(position, self.before) < step
            self.alternating = self.alternating + 1 if returned else 0
            if self.alternating == _ALTERNATING:
                text = "the poses go back and forth between two places: every camera is a stream of its own (a batch)"
                yield "alternating", text
            largest = float(np.maximum.reduce(depth, None))
            self.saturated = self.saturated + 1 if largest == self.farthest > 0 else 0
            self.farthest = largest
            if self.saturated == _FRAMES:
                yield from self._saturate(depth)
            sudden = self.steps >= _FRAMES and step > _JUMP * self.largest
            if sudden and step > _AWAY * mean:
                text = f"the camera jumped by {step:.3g} m, after steps of at most {self.largest:.3g} m. Another "
                yield "jump", text + "recording, or a map that was moved, begins with reset()"
            if self.steps >= _FRAMES and self.first == T:
                text = f"the pose is exactly the first one again, {self.steps} poses later. Another recording begins "
                yield "again", text + "with reset()"
            self.steps, self.largest = self.steps + 1, max(self.largest, step)
            self.travelled += step / mean
        self.before = last
        self.T, self.camera, self.total = T, camera, total

    def _zoom(self, camera: _Camera) -> Iterator[tuple[str, str]]:
        cameras = self.camera, camera
        (old_x, old_y), (x, y) = focals = [(K[0][0] / width, K[1][1] / height) for K, (height, width) in cameras]
        if max(x / old_x, old_x / x, y / old_y, old_y / y) > _ZOOM:
            each = " and ".join(f"{fx:.2f} of the width, {fy:.2f} of the height" for fx, fy in focals)
            text = f"the focal length changed from frame to frame ({each}): every camera is a stream of its own, and "
            yield "camera", text + "another recording begins with reset()"

    def _saturate(self, depth: Depth) -> Iterator[tuple[str, str]]:
        share = np.count_nonzero(depth == self.farthest) / np.count_nonzero(depth)
        if share > _SATURATED:
            text = f"the depth of {share:.0%} of the pixels is {self.farthest:g} m in every frame: if the network "
            yield "saturated", text + "cannot predict more, as in the sky, set valid to False there"

    def _stay(self, depth: Depth, member: float) -> Iterator[tuple[str, str]]:
        self.still += 1
        if self.still == 1 or self.depth is None or self.depth.shape != depth.shape:
            self.depth, self.member = depth.copy(), member
        elif self.still % _FRAMES == 0 or self.waiting:
            self.waiting = member != self.member  # of networks in turn, the same one is compared
            if self.waiting:
                return
            both = (depth > 0) & (self.depth > 0)
            change = abs(depth[both] / self.depth[both] - 1)
            if change.size and (median := float(np.median(change))) > _CHANGE:
                text = f"the pose was the same in {self.still + 1} frames, in which the depth changed by {median:.0%}"
                yield "pose", text + " in the median: is it updated?"

    def anchored(self, used: int, depth: float) -> str:
        """Count the anchors used in a frame of this mean depth [m]; returns a warning if moving frames have too few."""
        if math.dist(position := _position(self.T), self.anchored_at) < _MOVED * depth:
            return ""
        self.anchored_at, self.moving, self.used = position, self.moving + 1, self.used + used
        if self.moving < _MOVED_FRAMES or self.used >= self.moving:
            return ""
        return (
            f"{self.used} anchors were used in {self.moving} frames of a moving camera, so the error that all views "
            "share is not measured. An anchor has a pixel (u, v) of the image, a depth [m] and a variance [m^2]. "
            + _CAUSES
        )


def _mean(depth: Depth, total: float) -> float:
    """Mean depth [m] of the pixels with a depth, whose sum is ``total``; infinite if there are none."""
    return total / count if (count := np.count_nonzero(depth)) else math.inf


def _position(T: list[list[float]]) -> tuple[float, float, float]:
    return T[0][3], T[1][3], T[2][3]


def one_path(pose: Tensor, depth: float) -> bool:
    """True if poses [B, 4, 4] camera-to-world [m] follow each other along one path in a scene of a mean depth [m]."""
    position, R = pose[:, :3, 3].double(), pose[:, :3, :3].double()
    step = (position[1:] - position[:-1]).norm(dim=1)
    cosine = ((R[:-1].mT @ R[1:]).diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    if not (bool((step > 0).all()) and float(step.max()) < _STEP * depth and float(cosine.min()) > math.cos(_TURN)):
        return False
    distance = torch.cdist(position, position)
    n = len(pose)
    following = [float(distance[i, i + 1 :].min()) for i in range(n - 1)]
    preceding = [float(distance[i, :i].min()) for i in range(1, n)]
    nearest = torch.tensor([*following, *preceding], dtype=torch.float64)
    return float((step.cpu().repeat(2) <= nearest).double().mean()) >= _IN_ORDER


class StreamWarnings:
    """Checks every frame and its counts, and warns of implausible input."""

    _tracks: dict[int, _Track]

    def __init__(self) -> None:
        self.reset()

    def reset(self, streams: Sequence[int] | None = None) -> None:
        """Clear the statistics and the set of logged warnings; with ``streams``, only the statistics of these."""
        self._continued = 0
        if streams is not None:
            self._tracks = {b: track for b, track in self._tracks.items() if b not in streams}
            return
        self._calls = 0
        self._logged = set[tuple[int, str]]()
        self._tracks = {}

    def after_frame(
        self, frame: FrameInput, statistics: FrameStatistics, frames: Tensor, config: UfMStarConfig
    ) -> None:
        """Warn of unused pixels, of components that only one view sees, and of inconsistent cameras, poses, depth and
        anchors; ``frames`` [B] is the number of frames used."""
        depth = frame.depth
        self._calls += 1
        if depth.is_meta or (not depth.is_cpu and (self._calls % EVERY or torch.cuda.is_current_stream_capturing())):
            return
        counts = dict(zip(_READ, map(Tensor.tolist, _READ_FROM(statistics.counts)), strict=True))
        used = statistics.counts.get("anchors_used")
        seen = frames.tolist()
        findings = (
            _left_out(frame, counts, seen, config),
            _spreads(frame) if self._calls % EVERY in (0, 1) else (),
            self._tracked(frame, counts, None if used is None else used.tolist()),
            self._alone(counts, seen),
        )
        log_once(self._logged, chain.from_iterable(findings))

    def _tracked(self, frame: FrameInput, counts: _Counts, used: list[int] | None) -> Iterator[tuple[int, str, str]]:
        rows = frame.depth.numpy(force=True)[:, ::_ROWS]
        totals, pixels, faults = np.add.reduce(rows, (1, 2)).tolist(), counts["valid_pixels"], counts["fault"]
        poses, cameras = frame.T_world_cam.tolist(), frame.intrinsics.tolist()
        members = [0.0] * len(poses) if frame.member is None else frame.member.tolist()
        size = frame.size
        if len(poses) >= _BATCH:
            yield from self._one_video(poses)
        first = not self._tracks and len(poses) >= _CLIP and not any(faults)
        if first and one_path(frame.T_world_cam, _mean(rows, sum(totals))):
            yield 0, "batch", _ONE_VIDEO.format(len(poses), ": their poses form one path")
        for b, fault in enumerate(faults):
            if fault or not pixels[b]:
                continue
            T, camera, track = poses[b], (cameras[b], size), self._tracks.get(b)
            every = pixels[b] == size[0] * size[1]
            mean = totals[b] / rows[b].size if every else _mean(rows[b], totals[b])
            if (track is None or camera != track.camera) and (text := doubtful_centre(*camera)):
                yield b, "centre", text
            if track is None:
                self._tracks[b] = track = _Track(T, T, camera, totals[b], _position(T))
            else:
                for kind, text in track.follow(T, camera, rows[b], totals[b], mean, members[b]):
                    yield b, kind, text
            if used is not None and (text := track.anchored(used[b], mean)):
                yield b, "anchors", text

    def _alone(self, counts: _Counts, seen: list[int]) -> Iterator[tuple[int, str, str]]:
        """A warning if nearly all components were seen in one view although the camera has moved far enough."""
        for b, each in enumerate(zip(counts["single_view"], counts["components"], seen, strict=True)):
            track = self._tracks.get(b)
            if track is not None and (text := hardly_compared(*each, track.travelled)):
                yield b, "views", text

    def _one_video(self, poses: list[list[list[float]]]) -> Iterator[tuple[int, str, str]]:
        """A warning if the first stream of each batch continues the last stream of the previous batch."""
        if len(self._tracks) < len(poses):
            return
        before = [_position(self._tracks[b].T) for b in range(len(poses))]
        path = [before[-1], *(_position(T) for T in poses)]
        longest = max(math.dist(*pair) for pair in pairwise(path))
        continues = longest < _SUCCESSIVE * math.dist(path[1], before[0])
        self._continued = self._continued + 1 if continues else max(self._continued - 1, 0)
        if self._continued == _CONTINUED:
            yield 0, "batch", _ONE_VIDEO.format(len(poses), "")


def _left_out(
    frame: FrameInput, counts: _Counts, frames: list[int], config: UfMStarConfig
) -> Iterator[tuple[int, str, str]]:
    area = frame.size[0] * frame.size[1]
    for b, each in enumerate(zip(*counts.values(), frames, strict=True)):
        segments, valid, beyond, outside, components, fault, _, seen = each
        positive = valid + beyond + outside
        unstated = 0 if config.segment.max_depth is not None else beyond
        if positive and not segments and not fault and (frame.informative is None or bool(frame.informative[b])):
            parted = _parted(valid, beyond, outside, config)
            text = f"a frame has no segment, so nothing is compared between views: {parted}"
            yield b, "segments", text + "Is the depth in metres, smooth, and the intrinsics the depth map's?"
        elif max(outside, unstated) > _OUTSIDE * positive:
            text = f"pixels are left out: {_parted(valid, beyond, outside, config)}Are A and E variances [m^2], not "
            text += "logarithms, which may be negative, and does the network state its largest depth "
            yield b, "range", text + "(segment.max_depth)?"
        elif seen >= _FRAMES and 0 < valid < _SPARSE * area:
            yield b, "sparse", f"only {valid / area:.1%} of the pixels are used: is valid inverted? True = use"
        elif not positive and not components and seen >= _FRAMES:
            text = f"none of {seen} frames has a pixel with a positive and finite depth where valid is True"
            yield b, "empty", text + ": nothing is compared between views"


def _parted(valid: int, beyond: int, outside: int, config: UfMStarConfig) -> str:
    limit, every = f"segment.max_depth = {config.segment.depth_limit} m", valid + beyond + outside
    return f"of {every} pixels {beyond} lie beyond {limit} and {outside} outside the accepted ranges. "


def _spreads(frame: FrameInput) -> Iterator[tuple[int, str, str]]:
    """Warnings about variances that cannot be in m^2, and about E = 0 at every pixel."""
    pixels = frame.valid.sum((1, 2))
    for name, variance in (("aleatoric", frame.aleatoric), ("epistemic", frame.epistemic)):
        if variance is None:
            continue
        wide = frame.valid & (variance.detach() > (_WIDE * frame.depth).square())
        shares = wide.sum((1, 2)) / pixels.clamp_min(1)
        for b in (b for b, share in enumerate(shares.tolist()) if share > 0.5):
            text = (
                f"the standard deviation that {name} states is over {_WIDE:g} times the depth at most pixels: is it a "
            )
            yield b, name, text + "variance in m^2?"
    if frame.epistemic is None:
        return
    spread = (frame.valid & (frame.epistemic.detach() > 0)).any(2).any(1) | (pixels == 0)
    for b in (b for b, positive in enumerate(spread.tolist()) if not positive):
        text = "epistemic is 0 at every pixel: are the members of the ensemble copies of one network, or does the "
        yield b, "copies", text + "network have no dropout in eval mode?"


def hardly_compared(alone: int, components: int, frames: int, travelled: float) -> str:
    """A warning if, after ``frames`` frames and a path of ``travelled`` mean depths, nearly all components were seen in
    only one view (``alone``); else ""."""
    if frames < _FRAMES or components < _COMPONENTS or alone <= _ALONE * components or travelled <= _TRAVELLED:
        return ""
    text = (
        f"after {frames} frames {alone} of {components} Gaussians were seen in one view alone, so hardly anything is "
    )
    return text + f"compared between views. {_CAUSES}, or views that do not overlap"


def doubtful_centre(K: Sequence[Sequence[float]], size: tuple[int, int]) -> str:
    """A warning if the principal point of K [px] is implausible for a map of ``size`` (H, W), else "": it lies near the
    border, or the product of its shares is about 1/4, as with swapped cx and cy."""
    x, y = (K[0][2] + 0.5) / size[1], (K[1][2] + 0.5) / size[0]
    low, high = CENTRE_RANGE
    swapped = min(abs(x - 0.5), abs(y - 0.5)) > 0.08 and abs(4 * x * y - 1) < 0.15
    if low < min(x, y) and max(x, y) < high and not swapped:
        return ""
    where = f"the principal point lies at {x:.2f} of the width and {y:.2f} of the height, far from the middle"
    return f"{where}: are cx and cy swapped, or are these the intrinsics of an image of another size?"
