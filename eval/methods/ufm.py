"""UfM, the pointwise predecessor of UfM*, as a baseline: called like :class:`ufmstar_torch.UfMStar`.

Sudhakar, Karaman, Sze, "Uncertainty from Motion for DNN Monocular Depth Estimation" (ICRA 2022). Where UfM* keeps a few
hundred Gaussians, UfM keeps every pixel it has ever seen as a point: 40 bytes each (float32), 4.0 MB at the
100,000 points that the authors allow at 224 x 224. ``ufm_cloud`` has the equations and the deliberate differences.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ufmstar_torch.camera import relative_pose, rotation_deviation
from ufmstar_torch.checked import Checked, choice, number
from ufmstar_torch.eval.methods.ufm_cloud import MOMENTS, Cloud, View, take_in
from ufmstar_torch.frame import FrameInput, check_frame, raise_faults
from ufmstar_torch.stateful import StatefulModule, full_precision, outliving

# [1] Share by which a covariance may exceed the bound of Cauchy and Schwarz.
_ROUNDING = 1e-2
_STATE = ("moments", "count", "points", "T_world_first", "started", "frames", "skipped")


@dataclass(frozen=True)
class UfMConfig(Checked):
    """The settings of UfM.

    The modes of the paper differ only in what a network predicts. "Aleatoric": depth and A. "Ensemble" and
    "MC-dropout": the members in turn, or one stochastic pass. "Depth only": no variance, s^2 = 0. "Full": mean
    depth, A and E of several inferences.

    Raises:
        ValueError: an impossible value, or, from ``from_dict``, an unknown name.
    """

    # Points kept per stream; the paper's 100,000 at 224 x 224, 300,000 at 518 x 518. None = all. With fewer than an
    # image has pixels, points are dropped before they are seen again.
    max_points: int | None = 100_000
    add_aleatoric: bool = True  # A is part of s^2, the variance of a single observation
    add_epistemic: bool = True  # likewise E
    # max |R^T R - I| of a pose; less is removed by projection onto SO(3), more is a fault.
    rotation_tolerance: float = number(0.01, "", "1", 0.0, 0.1)
    on_bad_frame: str = choice("raise", "skip")  # of unusable poses and intrinsics; skipped frames are counted, NaN

    def __post_init__(self) -> None:
        super().__post_init__()
        whole = isinstance(self.max_points, int) and not isinstance(self.max_points, bool) and self.max_points > 0
        if self.max_points is not None and not whole:
            raise ValueError(f"UfMConfig.max_points must be None or a positive whole number, got {self.max_points!r}")


@dataclass(frozen=True)
class UfMStatistics:
    """Counts of one frame, per stream [B]."""

    points: Tensor  # kept after the frame
    memory: Tensor  # of these points [bytes]
    fused: Tensor  # points that met a valid pixel
    new: Tensor  # pixels that no point had landed on, appended
    dropped: Tensor  # points pruned
    valid_pixels: Tensor  # pixels used
    fault: Tensor  # index into ``ufmstar_torch.frame.FRAME_FAULTS``; not 0 = the frame was skipped
    rotation_deviation: Tensor  # max |R^T R - I| of the pose


@dataclass(frozen=True)
class UfMOutput:
    """The prediction of one frame with its variance. Maps have the layout of the input ``depth``."""

    depth: Tensor  # the input [m]
    variance: Tensor  # S_zz of the newest point at each pixel, s^2 where there was none [m^2]; NaN where not valid
    aleatoric: Tensor | None  # A of the input [m^2]
    epistemic: Tensor | None  # E of the input [m^2]
    valid: Tensor  # True where the pixel was used
    statistics: UfMStatistics

    @property
    def std(self) -> Tensor:
        """sqrt(variance) [m]."""
        return self.variance.sqrt()


class UfM(StatefulModule):
    """Uncertainty from Motion: feed it one predicted depth map per image, read a variance per pixel.

    The points of all streams lie behind each other in buffers, which ``.to()``, ``deepcopy`` and ``state_dict``
    carry. A frame that raises leaves the state as it was. No gradient flows through it.

    Args:
        config: see :class:`UfMConfig`; None = its defaults.
        dtype: of the points and of the computation, torch.float32 or torch.float64.
        device: of the state until ``.to()``; it follows the first frame otherwise.

    Raises:
        TypeError: config is something else.
        ValueError: another dtype.
    """

    STATE = _STATE
    CONFIG = UfMConfig
    config: UfMConfig

    def __init__(
        self,
        config: UfMConfig | None = None,
        *,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        if config is not None and not isinstance(config, UfMConfig):
            raise TypeError(f"config must be a UfMConfig or None, got {type(config).__name__}")
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype}")
        self.config = config if config is not None else UfMConfig()
        for name, value in _empty(0, dtype, torch.device(device or "cpu")).items():
            self.register_buffer(name, value)

    def forward(
        self,
        depth: Tensor,
        pose: Tensor,
        intrinsics: Tensor,
        aleatoric: Tensor | None = None,
        epistemic: Tensor | None = None,
        valid: Tensor | None = None,
    ) -> UfMOutput:
        """Process one predicted depth map per stream and return its variance.

        Args:
            depth: [B, H, W] or [B, 1, H, W] metric depth along the optical axis [m], any floating dtype.
                Pixels that are NaN, infinite, zero or negative are left out.
            pose: [B, 4, 4] or [4, 4] camera-to-world (T_world_cam) [m].
            intrinsics: [B, 3, 3] or [3, 3] in pixels of this depth map, first pixel's centre at (0, 0).
            aleatoric: like ``depth``, the network's own variance A [m^2]; pixels where it is not a finite
                number >= 0 are left out.
            epistemic: likewise E [m^2].
            valid: like ``depth``, bool, True = use.

        Raises:
            TypeError: wrong kind of argument or dtype.
            ValueError: wrong shape or device; another number of streams than before (:meth:`reset` first); a pose
                that is not rigid or bad intrinsics (``config.on_bad_frame == "skip"``: counted instead).
        """
        frame = check_frame(
            depth, pose, intrinsics, aleatoric, epistemic, valid, None,
            feature_count=0, rotation_tolerance=self.config.rotation_tolerance,
        )  # fmt: skip
        with outliving(), torch.no_grad(), full_precision(frame.depth.device):
            if self.config.on_bad_frame == "raise":
                raise_faults(frame)
            variance, statistics = self._advance(frame)
        return UfMOutput(
            depth=depth,
            variance=variance.to(frame.depth.dtype).reshape(depth.shape),
            aleatoric=aleatoric,
            epistemic=epistemic,
            valid=frame.valid.reshape(depth.shape),
            statistics=statistics,
        )

    def clouds(self) -> list[Cloud]:
        """The points of every stream in the frame of its first camera (``T_world_first`` takes it to the world)."""
        sizes = self.points.tolist()
        pairs = zip(self.moments.split(sizes), self.count.split(sizes), strict=True)
        return [Cloud(moments, count) for moments, count in pairs]

    def reset(self, streams: Sequence[int] | Tensor | None = None) -> None:
        """Forget everything, or only some streams.

        Args:
            streams: indices, or a bool mask [B]; None = all, after which another batch size may follow.

        Raises:
            IndexError: an index is out of range.
            ValueError: a mask of the wrong length.
        """
        dtype, device, b = self.moments.dtype, self.moments.device, len(self.points)
        with outliving(), torch.no_grad():  # buffers must outlive the caller's inference mode
            if streams is None:
                self._store(_empty(0, dtype, device))
                return
            keep = ~self._chosen(streams, b)
            of_point = keep.repeat_interleave(self.points)
            fresh = _empty(b, dtype, device)
            remaining = {"moments": self.moments[of_point], "count": self.count[of_point]}
            for name in _STATE[2:]:
                old = getattr(self, name)
                remaining[name] = torch.where(keep.view(-1, *[1] * (old.dim() - 1)), old, fresh[name])
            self._store(remaining)

    def _require_state(self, state: Mapping[str, Tensor]) -> None:
        """Also that no stream has more points than ``max_points``, and every covariance is one that points can have."""
        n, b = len(state["moments"]) if state["moments"].dim() else 0, state["points"].numel()
        shapes = {
            "moments": (n, MOMENTS), "count": (n,), "points": (b,), "T_world_first": (b, 4, 4), "started": (b,),
            "frames": (b,), "skipped": (b,),
        }  # fmt: skip
        for name, shape in shapes.items():
            if (given := tuple(state[name].shape)) != shape:
                raise ValueError(f"{name} must have shape {shape}, got {given}")
        if state["moments"].device.type != "meta":
            _require_values(state, self.config.max_points)

    def _advance(self, frame: FrameInput) -> tuple[Tensor, UfMStatistics]:
        """One frame, whose state is stored when all streams are through; variance [B, H, W]."""
        clouds, state = self._streams(frame)
        fine = frame.fault == 0
        first = torch.where((fine & ~state["started"])[:, None, None], frame.T_world_cam, state["T_world_first"])
        R, t = relative_pose(frame.T_world_cam, first)
        s2 = self._observation_variance(frame)
        # No pixel of a stream at fault is valid: it stays as it is.
        observed = zip(clouds, frame.depth, s2, frame.valid, frame.intrinsics, R, t, strict=True)
        fused = [take_in(cloud, View(*view), self.config.max_points) for cloud, *view in observed]

        def each(values: Iterable[int]) -> Tensor:
            return torch.tensor(list(values), device=s2.device)

        points = each(len(one.cloud.count) for one in fused)
        self._store(
            {
                "moments": _joined([one.cloud.moments for one in fused]),
                "count": _joined([one.cloud.count for one in fused]),
                "points": points,
                "T_world_first": first,
                "started": state["started"] | fine,
                "frames": state["frames"] + fine,
                "skipped": state["skipped"] + ~fine,
            }
        )
        statistics = UfMStatistics(
            points=points,
            memory=points * fused[0].cloud.bytes_per_point,
            fused=each(one.fused for one in fused),
            new=each(one.new for one in fused),
            dropped=each(one.dropped for one in fused),
            valid_pixels=frame.valid.sum((1, 2)),
            fault=frame.fault,
            rotation_deviation=frame.rotation_deviation,
        )
        return torch.stack([one.variance for one in fused]), statistics

    def _observation_variance(self, frame: FrameInput) -> Tensor:
        """[B, H, W] s^2 of one observation [m^2]: the network's variance, 0 if it states none."""
        both = [(frame.aleatoric, self.config.add_aleatoric), (frame.epistemic, self.config.add_epistemic)]
        counted = [value.detach() for value, counts in both if value is not None and counts]
        return sum(counted, start=torch.zeros_like(frame.depth))

    def _streams(self, frame: FrameInput) -> tuple[list[Cloud], dict[str, Tensor]]:
        """The clouds and the rest of the state, fresh at the start. Raises ValueError: the frame has another number of
        streams or lies on another device."""
        streams, device, held = frame.depth.shape[0], frame.depth.device, len(self.points)
        if held == 0:
            fresh = _empty(streams, self.moments.dtype, device)
            return [Cloud(fresh["moments"], fresh["count"])] * streams, fresh
        if held != streams:
            raise ValueError(f"depth has {streams} streams but the state holds {held}: call reset() first")
        if self.moments.device != device:
            raise ValueError(f"depth lies on {device} but the state on {self.moments.device}: move one with .to()")
        return self.clouds(), {name: getattr(self, name) for name in _STATE}

    def extra_repr(self) -> str:
        """Streams and points."""
        return f"streams={len(self.points)}, points={self.points.tolist()}, max_points={self.config.max_points}"


def _require_values(state: Mapping[str, Tensor], max_points: int | None) -> None:
    """Raise ValueError for values of a state that are not finite or out of their range."""
    n, largest = len(state["moments"]), max(state["points"].tolist(), default=0)
    for name in ("points", "frames", "skipped"):
        if bool((state[name] < 0).any()):
            raise ValueError(f"{name} holds negative values")
    if int(state["points"].sum()) != n:
        raise ValueError(f"points must add up to the {n} rows of moments, got {int(state['points'].sum())}")
    if max_points is not None and largest > max_points:
        raise ValueError(f"points: {largest} exceed max_points = {max_points}")
    if bool((state["count"] < 1).any()):
        raise ValueError("count must be at least 1")
    for name in ("moments", "T_world_first"):
        if not bool(state[name].isfinite().all()):
            raise ValueError(f"{name} holds NaN or infinity")
    covariance = Cloud(state["moments"].double(), state["count"]).covariance
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    # |cov(x, y)| <= sqrt(var x var y), up to what float32 rounds away over many fusions.
    bound = (1 + _ROUNDING) * (variance[:, :, None] * variance[:, None, :]).sqrt()
    if bool((variance < 0).any()) or bool((covariance.abs() > bound + torch.finfo(torch.float32).tiny).any()):
        raise ValueError("moments hold covariances that are none")
    if bool((rotation_deviation(state["T_world_first"][:, :3, :3]) > 1e-6).any()):
        raise ValueError("T_world_first holds matrices that are not rigid")


def _empty(streams: int, dtype: torch.dtype, device: torch.device) -> dict[str, Tensor]:
    """The state of streams that have seen nothing."""
    counter = torch.zeros(streams, dtype=torch.int64, device=device)
    return {
        "moments": torch.zeros(0, MOMENTS, dtype=dtype, device=device),
        "count": torch.zeros(0, dtype=torch.int32, device=device),
        "points": counter,
        "T_world_first": torch.eye(4, dtype=torch.float64, device=device).repeat(streams, 1, 1),
        "started": counter.bool(),
        "frames": counter.clone(),
        "skipped": counter.clone(),
    }


def _joined(parts: list[Tensor]) -> Tensor:
    """The points of all streams behind each other; of a single one without a copy."""
    return torch.cat(parts) if len(parts) > 1 else parts[0]
