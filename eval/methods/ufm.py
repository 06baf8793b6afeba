"""UfM, the pointwise predecessor of UfM*, as a baseline: called like :class:`ufmstar_torch.UfMStar`.

Sudhakar, Karaman, Sze, "Uncertainty from Motion for DNN Monocular Depth Estimation" (ICRA 2022). Where UfM* keeps a few
hundred Gaussians, UfM keeps every pixel it has ever seen as a point: 40 bytes each (float32), 4.0 MB at the
100,000 points that the authors allow at 224 x 224. ``ufm_cloud`` has the equations and the deliberate differences.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ufmstar_torch.camera import relative_pose
from ufmstar_torch.checked import Checked, choice
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.methods.ufm_cloud import Cloud, View, take_in
from ufmstar_torch.frame import FrameInput, check_frame, raise_faults
from ufmstar_torch.stateful import full_precision, outliving


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
    on_bad_frame: str = choice("raise", "skip")  # of unusable poses and intrinsics; a skipped frame is NaN

    def __post_init__(self) -> None:
        super().__post_init__()
        whole = isinstance(self.max_points, int) and not isinstance(self.max_points, bool) and self.max_points > 0
        if self.max_points is not None and not whole:
            raise ValueError(f"UfMConfig.max_points must be None or a positive whole number, got {self.max_points!r}")


@dataclass(frozen=True)
class UfMStatistics:
    """Counts of one frame, per stream [B]."""

    points: Tensor  # kept after the frame
    fused: Tensor  # points that met a valid pixel
    new: Tensor  # pixels that no point had landed on, appended
    dropped: Tensor  # points pruned
    fault: Tensor  # index into ``ufmstar_torch.frame.FRAME_FAULTS``; not 0 = the frame was skipped


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


class UfM:
    """Uncertainty from Motion: feed it one predicted depth map per image, read a variance per pixel.

    A frame that raises leaves the state as it was. No gradient flows through it.

    Args:
        config: see :class:`UfMConfig`; None = its defaults.
        dtype: of the points and of the computation, torch.float32 or torch.float64.

    Attributes:
        clouds: the points of every stream, in the frame of its first camera, on the device of the first frame.
        T_world_first: [B, 4, 4] float64 camera-to-world of these first cameras [m].

    Raises:
        TypeError: config is something else.
        ValueError: another dtype.
    """

    def __init__(self, config: UfMConfig | None = None, *, dtype: torch.dtype = torch.float32) -> None:
        if config is not None and not isinstance(config, UfMConfig):
            raise TypeError(f"config must be a UfMConfig or None, got {type(config).__name__}")
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype}")
        self.config, self._dtype = config if config is not None else UfMConfig(), dtype
        self.reset()

    def __call__(
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
                that is not rigid or bad intrinsics (``config.on_bad_frame == "skip"``: the frame is NaN instead).
        """
        frame = check_frame(
            depth, pose, intrinsics, aleatoric, epistemic, valid, None,
            feature_count=0, rotation_tolerance=UfMStarConfig.rotation_tolerance,
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

    def reset(self) -> None:
        """Forget everything; another batch size may follow."""
        self.clouds: list[Cloud] = []
        self.T_world_first = torch.zeros(0, 4, 4, dtype=torch.float64)

    def _advance(self, frame: FrameInput) -> tuple[Tensor, UfMStatistics]:
        """One frame, stored when all streams are through; variance [B, H, W]. Raises ValueError: the frame has another
        number of streams or lies on another device."""
        streams, device = frame.depth.shape[0], frame.depth.device
        clouds, first = self.clouds, self.T_world_first
        if not clouds:
            clouds, first = [Cloud.empty(self._dtype, device)] * streams, frame.T_world_cam
        if len(clouds) != streams:
            raise ValueError(f"depth has {streams} streams but the state holds {len(clouds)}: call reset() first")
        if clouds[0].moments.device != device:
            raise ValueError(f"depth lies on {device} but the state on {clouds[0].moments.device}: call reset() first")
        begun = torch.tensor([len(cloud.count) > 0 for cloud in clouds], device=device)
        first = torch.where(begun[:, None, None], first, frame.T_world_cam)
        R, t = relative_pose(frame.T_world_cam, first)
        stated = [value.detach() for value in (frame.aleatoric, frame.epistemic) if value is not None]
        s2 = sum(stated, start=torch.zeros_like(frame.depth))
        # No pixel of a stream at fault is valid: it stays as it is.
        observed = zip(clouds, frame.depth, s2, frame.valid, frame.intrinsics, R, t, strict=True)
        taken = [take_in(cloud, View(*view), self.config.max_points) for cloud, *view in observed]
        self.clouds, self.T_world_first = [one.cloud for one in taken], first
        counts = torch.tensor([[len(one.cloud.count), one.fused, one.new, one.dropped] for one in taken], device=device)
        points, fused, new, dropped = counts.unbind(1)
        return torch.stack([one.variance for one in taken]), UfMStatistics(points, fused, new, dropped, frame.fault)
